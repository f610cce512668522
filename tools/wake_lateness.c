/*
 * SPDX-License-Identifier: Apache-2.0
 */

/* Print how late this machine wakes a process that sleeps until a given time: p50 and p99 [us].
 *
 * cc -O2 -o wake_lateness tools/wake_lateness.c && ./wake_lateness [SECONDS]
 *
 * It sleeps with clock_nanosleep 1,000 times a second, with a timer slack of 1 ns. No program that
 * waits for its packets can be more punctual on this machine, at this time, unless it spins.
 */
#define _GNU_SOURCE
#include <stdio.h>
#include <stdlib.h>
#include <sys/prctl.h>
#include <time.h>

static long long ns(struct timespec t) { return t.tv_sec * 1000000000LL + t.tv_nsec; }

static int compare(const void *a, const void *b)
{
    long long one = *(const long long *)a, other = *(const long long *)b;
    return (one > other) - (one < other);
}

int main(int argc, char **argv)
{
    int count = (int)(1000 * (argc > 1 ? atof(argv[1]) : 10.0));
    long long *late = malloc(sizeof *late * (size_t)(count + 1));
    struct timespec due, now;

    if (count < 1 || late == NULL) {
        fprintf(stderr, "usage: wake_lateness [SECONDS]\n");
        return 2;
    }
    prctl(PR_SET_TIMERSLACK, 1UL, 0UL, 0UL, 0UL);
    clock_gettime(CLOCK_MONOTONIC, &due);
    for (int i = 0; i < count; i++) {
        due.tv_nsec += 1000000;
        due.tv_sec += due.tv_nsec / 1000000000;
        due.tv_nsec %= 1000000000;
        clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, NULL);
        clock_gettime(CLOCK_MONOTONIC, &now);
        late[i] = ns(now) - ns(due);
    }
    qsort(late, (size_t)count, sizeof *late, compare);
    printf("%.1f %.1f\n", (double)late[count / 2] * 1e-3, (double)late[count * 99 / 100] * 1e-3);
    return 0;
}
