/* Slows the clock of a kernel that is an ordinary program (User-Mode Linux): while it computes, its clock runs EMB_SLOW
 * times slower than the host's. What the host takes from it, by other programs or by being slow, then counts for that
 * much less inside (time dilation: Gupta et al., "To infinity and beyond: time-warped network emulation", NSDI 2006).
 * Idle time is skipped.
 *
 * Preloaded: such a kernel knows the time from two clocks and one timer only, and sleeps in one place. All this begins
 * when it opens the file EMB_SLOW_FROM, and is told on standard output: while it boots it measures, for most of a
 * second, how fast it is.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

enum { CLOCKS = CLOCK_MONOTONIC + 1 };

static const int64_t second = 1000000000;
static const char told[] = "time runs slowly\n"; /* uml.py looks for it */

static int (*next_gettime)(clockid_t, struct timespec *);
static int (*next_open)(const char *, int, ...);
static int (*next_set)(timer_t, int, const struct itimerspec *, struct itimerspec *);
static int (*next_get)(timer_t, struct itimerspec *);
static int (*next_suspend)(const sigset_t *);

static const char *from;
static int64_t slow = 1; /* 1 until it begins */
static int64_t begin[CLOCKS], skipped;
static timer_t the_timer;
static int armed;

static void *next(const char *name)
{
	void *found = dlsym(RTLD_NEXT, name);

	if (found == NULL)
		abort();
	return found;
}

__attribute__((constructor)) static void prepare(void)
{
	*(void **)&next_gettime = next("clock_gettime");
	*(void **)&next_open = next("open64");
	*(void **)&next_set = next("timer_settime");
	*(void **)&next_get = next("timer_gettime");
	*(void **)&next_suspend = next("sigsuspend");
	from = getenv("EMB_SLOW_FROM");
}

static int64_t nanoseconds(const struct timespec *time)
{
	return time->tv_sec * second + time->tv_nsec;
}

static struct timespec timespec(int64_t nanoseconds)
{
	return (struct timespec){ .tv_sec = nanoseconds / second, .tv_nsec = nanoseconds % second };
}

static int64_t now(clockid_t clock)
{
	struct timespec time;

	if (next_gettime(clock, &time) != 0)
		abort();
	return nanoseconds(&time);
}

int open64(const char *path, int flags, ...)
{
	va_list arguments;
	mode_t mode;

	va_start(arguments, flags);
	mode = va_arg(arguments, mode_t);
	va_end(arguments);
	while (path[0] == '/' && path[1] == '/')
		path++;
	if (from != NULL && strcmp(path, from) == 0) {
		for (clockid_t clock = 0; clock < CLOCKS; clock++)
			begin[clock] = now(clock);
		slow = atoi(getenv("EMB_SLOW"));
		from = NULL;
		if (write(STDOUT_FILENO, told, sizeof told - 1) < 0)
			abort();
	}
	return next_open(path, flags, mode);
}

int clock_gettime(clockid_t clock, struct timespec *time)
{
	if (clock < 0 || clock >= CLOCKS)
		return next_gettime(clock, time);
	*time = timespec(begin[clock] + (now(clock) - begin[clock]) / slow + skipped);
	return 0;
}

int gettimeofday(struct timeval *restrict time, void *restrict zone)
{
	struct timespec exact;

	(void)zone;
	clock_gettime(CLOCK_REALTIME, &exact);
	*time = (struct timeval){ .tv_sec = exact.tv_sec, .tv_usec = exact.tv_nsec / 1000 };
	return 0;
}

static struct itimerspec times(const struct itimerspec *given, int64_t numerator, int64_t denominator)
{
	/* Rounded up: what is not nothing must not become nothing, which would disarm the timer. */
	int64_t value = nanoseconds(&given->it_value) * numerator, interval = nanoseconds(&given->it_interval) * numerator;

	return (struct itimerspec){ .it_value = timespec((value + denominator - 1) / denominator),
				    .it_interval = timespec((interval + denominator - 1) / denominator) };
}

int timer_settime(timer_t timer, int flags, const struct itimerspec *value, struct itimerspec *old)
{
	struct itimerspec scaled = times(value, slow, 1);
	int result;

	if (flags & TIMER_ABSTIME) { /* by a clock that is not told here */
		errno = EINVAL;
		return -1;
	}
	the_timer = timer;
	armed = 1;
	result = next_set(timer, flags, &scaled, old);
	if (result == 0 && old != NULL)
		*old = times(old, 1, slow);
	return result;
}

int timer_gettime(timer_t timer, struct itimerspec *value)
{
	int result = next_get(timer, value);

	if (result == 0)
		*value = times(value, 1, slow);
	return result;
}

/* Where it has nothing to do. SIGALRM is blocked here, so the timer cannot fire unseen between these lines. */
int sigsuspend(const sigset_t *mask)
{
	static const struct itimerspec at_once = { .it_value = { .tv_nsec = 1 } };
	struct itimerspec left;

	if (slow > 1 && armed && next_get(the_timer, &left) == 0 && nanoseconds(&left.it_value) > 0) {
		skipped += nanoseconds(&left.it_value) / slow + 1;
		next_set(the_timer, 0, &at_once, NULL);
	}
	return next_suspend(mask);
}
