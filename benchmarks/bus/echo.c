/* The least that can answer a pair of sensor frames: recvmsg() of angle and velocity, one send().
 *
 *     echo INTERFACE COMMANDS ANGLE_ID VELOCITY_ID PRIORITY
 *
 * COMMANDS has 15 x 15 ready frames (struct can_frame), by own counter and by the counter that is answered; the
 * benchmark that runs this lets the project's codec write them. It ends when nothing has come for a second.
 */
#include <fcntl.h>
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <unistd.h>

enum { COUNTERS = 15 };

static struct can_frame commands[COUNTERS][COUNTERS];

static void die(const char *what)
{
	perror(what);
	exit(1);
}

int main(int argc, char **argv)
{
	if (argc != 6)
		return 2;
	unsigned angle = strtoul(argv[3], NULL, 0), velocity = strtoul(argv[4], NULL, 0);

	int file = open(argv[2], O_RDONLY);
	if (file < 0 || read(file, commands, sizeof commands) != sizeof commands)
		die(argv[2]);

	int bus = socket(PF_CAN, SOCK_RAW, CAN_RAW);
	struct can_filter filters[] = {
		{ angle, CAN_SFF_MASK | CAN_EFF_FLAG | CAN_RTR_FLAG },
		{ velocity, CAN_SFF_MASK | CAN_EFF_FLAG | CAN_RTR_FLAG },
	};
	struct timeval patience = { .tv_sec = 1 };
	struct sockaddr_can address = { .can_family = AF_CAN, .can_ifindex = if_nametoindex(argv[1]) };
	if (bus < 0 || setsockopt(bus, SOL_CAN_RAW, CAN_RAW_FILTER, filters, sizeof filters) ||
	    setsockopt(bus, SOL_SOCKET, SO_RCVTIMEO, &patience, sizeof patience) ||
	    bind(bus, (struct sockaddr *)&address, sizeof address))
		die(argv[1]);

	struct sched_param priority = { .sched_priority = atoi(argv[5]) };
	if (mlockall(MCL_CURRENT | MCL_FUTURE) || sched_setscheduler(0, SCHED_FIFO, &priority))
		perror("real time not obtained");

	struct can_frame frame;
	struct iovec buffer = { &frame, sizeof frame };
	struct msghdr message = { .msg_iov = &buffer, .msg_iovlen = 1 };
	unsigned own = 0, paired = COUNTERS;
	while (recvmsg(bus, &message, 0) == sizeof frame) {
		unsigned counter = frame.data[1] & 0x0f;
		if (frame.can_id == angle) {
			paired = counter;
		} else if (counter == paired && counter < COUNTERS) {
			if (send(bus, &commands[own][counter], sizeof frame, 0) != sizeof frame)
				die("send");
			own = (own + 1) % COUNTERS;
		}
	}
	return 0;
}
