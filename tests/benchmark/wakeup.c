/* cyclictest's measurement for machines that allow no SCHED_FIFO, where cyclictest won't start.
 *
 * wakeup INTERVAL_US LOOPS LONGEST_US [catch_up] prints "us count" for each us, then what lies
 * beyond. With catch_up it makes up for the wake-ups that a stall has cost, each late.
 */
#define _GNU_SOURCE
#include <stdio.h>
#include <stdlib.h>
#include <sys/prctl.h>
#include <time.h>

#define SECOND 1000000000LL

static long long now_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * SECOND + now.tv_nsec;
}

int main(int argc, char **argv)
{
    if (argc != 4 && argc != 5)
        return 2;
    long long interval = atoll(argv[1]) * 1000, loops = atoll(argv[2]), longest = atoll(argv[3]);
    long long *counts = calloc(longest + 1, sizeof *counts);
    if (counts == NULL)
        return 1;
    for (long long us = 0; us <= longest; us++)
        counts[us] = 0;
    prctl(PR_SET_TIMERSLACK, 1, 0, 0, 0);
    long long due = now_ns() + interval;
    for (long long k = 0; k < loops; k++) {
        struct timespec when = {due / SECOND, due % SECOND};
        if (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &when, NULL))
            return 1;
        long long now = now_ns(), late_us = (now - due) / 1000;
        counts[late_us < longest ? late_us : longest]++;
        do
            due += interval;
        while (due <= now && argc == 4); /* as cyclictest does: a stall counts once */
    }
    for (long long us = 0; us < longest; us++)
        printf("%06lld %06lld\n", us, counts[us]);
    printf("# Histogram Overflows: %05lld\n", counts[longest]);
    return 0;
}
