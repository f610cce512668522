/* A relay as one would write it in C: epoll, timerfd, a heap, one delay for all.
 *
 * usage: relay LISTEN_PORT TARGET_PORT DELAY_US STAMPS
 *
 * With STAMPS 1 a datagram is due when the kernel received it plus the delay, else when it was read
 * plus the delay. It writes "ready" and ends when it is killed.
 */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/prctl.h>
#include <sys/socket.h>
#include <sys/timerfd.h>
#include <time.h>
#include <unistd.h>

#define SECOND_NS 1000000000L
#define SIZE_MAX_BYTES 2048
#define HELD_MAX 16384
#define DRAIN_MAX 64

struct held {
    long due_ns;
    long number;
    int size;
    char *data;
};

static struct held heap[HELD_MAX];
static int held_count;
static long number;

static long clock_ns(clockid_t id) {
    struct timespec now;
    clock_gettime(id, &now);
    return now.tv_sec * SECOND_NS + now.tv_nsec;
}

static int before(const struct held *a, const struct held *b) {
    return a->due_ns < b->due_ns || (a->due_ns == b->due_ns && a->number < b->number);
}

static void push(struct held one) {
    int at = held_count++;
    while (at && before(&one, &heap[(at - 1) / 2])) {
        heap[at] = heap[(at - 1) / 2];
        at = (at - 1) / 2;
    }
    heap[at] = one;
}

static struct held pop(void) {
    struct held top = heap[0], last = heap[--held_count];
    int at = 0, child;
    while ((child = 2 * at + 1) < held_count) {
        if (child + 1 < held_count && before(&heap[child + 1], &heap[child])) child++;
        if (!before(&heap[child], &last)) break;
        heap[at] = heap[child];
        at = child;
    }
    heap[at] = last;
    return top;
}

static long received_ns(struct msghdr *message) {
    long now_ns, wall_ns = clock_ns(CLOCK_REALTIME);
    now_ns = clock_ns(CLOCK_MONOTONIC);
    for (struct cmsghdr *c = CMSG_FIRSTHDR(message); c; c = CMSG_NXTHDR(message, c))
        if (c->cmsg_level == SOL_SOCKET && c->cmsg_type == SCM_TIMESTAMPNS) {
            struct timespec stamp;
            memcpy(&stamp, CMSG_DATA(c), sizeof stamp);
            return now_ns - (wall_ns - stamp.tv_sec * SECOND_NS - stamp.tv_nsec);
        }
    return now_ns;
}

static void take_in(int in, long delay_ns) {
    static char buffer[SIZE_MAX_BYTES], control[256];
    for (int n = 0; n < DRAIN_MAX; n++) {
        struct iovec part = {buffer, sizeof buffer};
        struct msghdr message = {.msg_iov = &part, .msg_iovlen = 1,
                                 .msg_control = control, .msg_controllen = sizeof control};
        ssize_t size = recvmsg(in, &message, MSG_DONTWAIT);
        if (size < 0) return;
        if (held_count == HELD_MAX) continue;
        struct held one = {received_ns(&message) + delay_ns, number++, (int)size, malloc(size)};
        memcpy(one.data, buffer, size);
        push(one);
    }
}

int main(int argc, char **argv) {
    if (argc != 5) return 2;
    struct sockaddr_in listen = {.sin_family = AF_INET, .sin_port = htons(atoi(argv[1]))};
    struct sockaddr_in target = {.sin_family = AF_INET, .sin_port = htons(atoi(argv[2]))};
    long delay_ns = atol(argv[3]) * 1000, armed_ns = 0;
    int yes = atoi(argv[4]), in = socket(AF_INET, SOCK_DGRAM, 0);
    int out = socket(AF_INET, SOCK_DGRAM, 0);
    int timer = timerfd_create(CLOCK_MONOTONIC, TFD_NONBLOCK), poll = epoll_create1(0);
    struct epoll_event on_in = {.events = EPOLLIN, .data.fd = in}, ready[2];
    struct epoll_event on_timer = {.events = EPOLLIN | EPOLLET, .data.fd = timer};
    listen.sin_addr.s_addr = target.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    prctl(PR_SET_TIMERSLACK, 1, 0, 0, 0);
    if (bind(in, (struct sockaddr *)&listen, sizeof listen)) return 1;
    setsockopt(in, SOL_SOCKET, SO_TIMESTAMPNS, &yes, sizeof yes);
    epoll_ctl(poll, EPOLL_CTL_ADD, in, &on_in);
    epoll_ctl(poll, EPOLL_CTL_ADD, timer, &on_timer);
    puts("ready");
    fflush(stdout);
    for (;;) {
        if (held_count && heap[0].due_ns != armed_ns) {
            armed_ns = heap[0].due_ns;
            struct itimerspec due = {.it_value = {armed_ns / SECOND_NS, armed_ns % SECOND_NS}};
            timerfd_settime(timer, TFD_TIMER_ABSTIME, &due, NULL);
        }
        int count = epoll_wait(poll, ready, 2, -1);
        while (held_count && heap[0].due_ns <= clock_ns(CLOCK_MONOTONIC)) {
            struct held one = pop();
            sendto(out, one.data, one.size, 0, (struct sockaddr *)&target, sizeof target);
            free(one.data);
        }
        for (int n = 0; n < count; n++)
            if (ready[n].data.fd == in) take_in(in, delay_ns);
    }
}
