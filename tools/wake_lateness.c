/* How late a thread wakes that does nothing else: clock_nanosleep to instants 1 ms apart.
 *
 * usage: wake_lateness COUNT      prints one lateness [ns] a line
 */
#define _GNU_SOURCE
#include <stdio.h>
#include <stdlib.h>
#include <sys/prctl.h>
#include <time.h>

#define PERIOD_NS 1000000L
#define SECOND_NS 1000000000L

int main(int argc, char **argv) {
    long count = argc > 1 ? atol(argv[1]) : 1000;
    long *late = calloc(count, sizeof *late);
    struct timespec due, now;
    if (!late) return 1;
    prctl(PR_SET_TIMERSLACK, 1, 0, 0, 0);
    clock_gettime(CLOCK_MONOTONIC, &due);
    for (long n = 0; n < count; n++) {
        due.tv_nsec += PERIOD_NS;
        if (due.tv_nsec >= SECOND_NS) {
            due.tv_nsec -= SECOND_NS;
            due.tv_sec++;
        }
        while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, NULL)) {}
        clock_gettime(CLOCK_MONOTONIC, &now);
        late[n] = (now.tv_sec - due.tv_sec) * SECOND_NS + now.tv_nsec - due.tv_nsec;
    }
    for (long n = 0; n < count; n++) printf("%ld\n", late[n]);
    return 0;
}
