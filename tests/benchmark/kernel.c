/* The integrated inverse Omega^-1[y] = Pi^-1[Lambda^-1(y)] in plain C: the loop of
 * hilctl.kernels.hysteresis.integrated_inverse, in the same order of arithmetic.
 * Array lengths: d_up and g_up ups, d_down and g_down downs, thresholds and weights m,
 * memory m + 1, y and out n.
 */
#include <math.h>
#include <stddef.h>

static double deadband_value(double x, double slope, const double *d_up, const double *g_up,
                             ptrdiff_t ups, const double *d_down, const double *g_down,
                             ptrdiff_t downs)
{
    double total = slope * x;
    for (ptrdiff_t j = 0; j < ups && x > d_up[j]; j++)
        total += g_up[j] * (x - d_up[j]);
    for (ptrdiff_t j = 0; j < downs && x < d_down[j]; j++)
        total += g_down[j] * (x - d_down[j]);
    return total;
}

static double widening_of(double change, double gain)
{
    double rate = fabs(change);
    return rate >= 0.0 ? gain * rate : 0.0;
}

static void move_plays(double v, double widening, const double *thresholds, double *memory,
                       ptrdiff_t m)
{
    for (ptrdiff_t i = 0; i < m; i++) {
        double threshold = thresholds[i] + widening;
        double high = v + threshold;
        double low = v - threshold;
        double held = high < memory[i] ? high : memory[i];
        memory[i] = low > held ? low : held;
    }
}

static double weigh(const double *weights, const double *values, ptrdiff_t m)
{
    double total = 0.0;
    for (ptrdiff_t i = 0; i < m; i++)
        total += weights[i] * values[i];
    return total;
}

void integrated_inverse(const double *y, ptrdiff_t n, double slope, const double *d_up,
                        const double *g_up, ptrdiff_t ups, const double *d_down,
                        const double *g_down, ptrdiff_t downs, double rate_gain, double direct,
                        const double *thresholds, const double *weights, ptrdiff_t m,
                        double *memory, double *out)
{
    for (ptrdiff_t k = 0; k < n; k++) {
        double x = deadband_value(y[k], slope, d_up, g_up, ups, d_down, g_down, downs);
        double widening = widening_of(x - memory[m], rate_gain);
        move_plays(x, widening, thresholds, memory, m);
        out[k] = direct * x + weigh(weights, memory, m);
        memory[m] = x;
    }
}
