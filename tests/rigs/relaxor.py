"""Simulated electrostrictive stack of a relaxor, whose polarisation relaxes over many decades.

The strain is Q P^2 and the anhysteretic polarisation P_s tanh(k E), as C. L. Hom and N. Shankar, "A
fully coupled constitutive model for electrostrictive ceramic materials", J. Intell. Mater. Syst.
Struct. 5 (1994) 795, have it for PMN-PT; the strain is even in the field. A bias on the stack makes
0 to 100 V move one way. The field is that of cells with dry friction (A. Bergqvist, Physica B 233
(1997) 342), which makes thin loops:

    p = sum w_i tanh((z_i + V_b) / V_0),  |V - z_i| <= r_i.

A part of the polarisation relaxes. Relaxors have a wide distribution of times (D. Viehland et al.,
"Freezing of the polarization fluctuations in lead magnesium niobate relaxors", J. Appl. Phys. 68
(1990) 2916); here there are nine in even steps of the logarithm from 10 us to two minutes:

    dq_j/dt = (p - q_j) / tau_j,  P = p + sum g_j (q_j - p),  x = S (P^2 - P_rest^2).

The shares g_j can be drawn. The constants are not those of a product.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from hilctl.base.types import F64
from hilctl.kernels.jit import ensure_compiled, kernel
from hilctl_drivers.simulated.actuator_base import CHUNK, Plant
from hilctl_drivers.simulated.structure import motion, respond

_SPREAD = 0.4  # standard deviation of the logarithms of drawn shares


@dataclass(frozen=True, slots=True)
class RelaxorParameters:
    """Constants of stack, structure, amplifier and sensor."""

    drive_min_v: float = 0.0  # bottom of the drive
    drive_max_v: float = 100.0  # top of the drive
    amplifier_bandwidth_hz: float = 3e3  # corner of the first-order amplifier
    saturation_um: float = 60.0  # S, displacement by the polarisation P_s
    bias_v: float = 25.0  # V_b
    knee_v: float = 110.0  # V_0
    pinning_max_v: float = 6.0  # r of the hardest cell; the others are evenly spaced to 0
    cells: int = 8  # of equal weight
    relaxing: tuple[float, ...] = (0.009,) * 9  # g_j
    relaxation_s: tuple[float, ...] = tuple(np.geomspace(1e-5, 120.0, 9).tolist())  # tau_j
    # Natural frequency in Hz, damping ratio and share of the static displacement.
    modes: tuple[tuple[float, float, float], ...] = ((1800.0, 0.03, 1.0),)
    dac_codes: int = 65535  # codes above 0 V
    adc_codes: int = 32767  # codes on either side of zero
    sensor_range_um: float = 50.0  # reading at either end of the sensor's range
    sensor_bandwidth_hz: float = 10e3  # corner of the first-order sensor
    sensor_noise_um: float = 2e-3  # noise of each reading, rms
    step_max_s: float = 2e-5  # longest internal time step

    def drawn(self, draw: int) -> "RelaxorParameters":
        """Return shares drawn around these, with the same sum; draw 0 returns these."""
        if not draw:
            return self
        shares = np.array(self.relaxing)
        shares *= np.exp(_SPREAD * np.random.default_rng(draw).standard_normal(shares.size))
        return replace(self, relaxing=tuple((shares * sum(self.relaxing) / shares.sum()).tolist()))


@kernel()
def _polarise(
    command: F64,  # float64[n], drive in V
    drive_v: F64,  # float64[n], filled with the drive at the instant of each reading
    free_um: F64,  # float64[n substeps], filled with the displacement at the end of each step
    state: F64,  # float64[1], drive in V; updated
    cells: F64,  # float64[m], field of each cell in V; updated
    relaxed: F64,  # float64[k], q; updated
    table: tuple[F64, F64, F64],  # r; g and remaining part of the distance of q after a step
    constants: tuple[float, float, float, float, float],
    substeps: int,
) -> None:
    """Output commands and let drive, cells and polarisation follow."""
    pinning, share, decay = table
    # Remaining part of the drive's error after a step, a DAC code in V, V_b, V_0 and S.
    left, code, bias, knee, scale = constants
    drive = state[0]
    for j in range(command.size):
        drive_v[j] = drive
        target = np.rint(command[j] / code) * code
        for k in range(j * substeps, (j + 1) * substeps):
            drive = target + left * (drive - target)
            quick = 0.0
            for i in range(cells.size):
                cells[i] = min(max(cells[i], drive - pinning[i]), drive + pinning[i])
                quick += math.tanh((cells[i] + bias) / knee)
            quick /= cells.size
            whole = quick
            for i in range(relaxed.size):
                relaxed[i] = quick + decay[i] * (relaxed[i] - quick)
                whole += share[i] * (relaxed[i] - quick)
            free_um[k] = scale * whole * whole
    state[0] = drive


class Relaxor(Plant):
    """The stack with its amplifier and sensor; commands and drive in V."""

    def __init__(self, parameters: RelaxorParameters, sample_rate_hz: float, seed: int = 1) -> None:
        """Build the stack at rest after a long time at 0 V."""
        self._substeps = math.ceil(1.0 / (sample_rate_hz * parameters.step_max_s) - 1e-9)
        range_um = parameters.sensor_range_um
        sensor = range_um / parameters.adc_codes, range_um
        chunk = max(1, CHUNK // self._substeps)
        super().__init__(parameters.sensor_noise_um, seed, sensor, chunk)
        step_s = 1.0 / (sample_rate_hz * self._substeps)
        ensure_compiled(_polarise, respond)
        self._table = (
            np.linspace(0.0, parameters.pinning_max_v, parameters.cells),
            np.array(parameters.relaxing),
            np.exp(-step_s / np.array(parameters.relaxation_s)),
        )
        self._constants = (
            math.exp(-2.0 * math.pi * parameters.amplifier_bandwidth_hz * step_s),
            parameters.drive_max_v / parameters.dac_codes,
            parameters.bias_v,
            parameters.knee_v,
            parameters.saturation_um,
        )
        self._polarised = math.tanh(parameters.bias_v / parameters.knee_v)
        self._rest_um = parameters.saturation_um * self._polarised**2
        modes = [(2.0 * math.pi * hz, damping, share) for hz, damping, share in parameters.modes]
        self._motion = motion(modes, parameters.sensor_bandwidth_hz, step_s)
        self._mechanics = np.zeros(self._motion.shape[1])
        self._drive, self._cells = np.zeros(1), np.zeros(parameters.cells)
        self._relaxed = np.zeros(len(parameters.relaxing))
        self.warm_up()

    def _rest(self) -> None:
        self._drive[:] = 0.0
        self._cells[:] = 0.0
        self._relaxed[:] = self._polarised
        self._mechanics[:] = 0.0

    def _advance(self, command: F64, noise_um: F64, signal_um: F64, measured: F64) -> None:
        free_um = np.empty(command.size * self._substeps)
        _polarise(
            command, measured, free_um, self._drive, self._cells, self._relaxed, self._table,
            self._constants, self._substeps,
        )  # fmt: skip
        fixed = self._mechanics, self._motion, self._rest_um, self._substeps
        respond(free_um, signal_um, *fixed)
