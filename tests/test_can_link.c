/* Law: whatever an interface does, its link answers at once: with the frames and their times, with how many were lost, or with
 * one sentence that says what to do. The kernel's part is played by socket pairs and by calls that fail to order. */
#include <errno.h>
#include <linux/can.h>
#include <linux/can/error.h>
#include <linux/can/netlink.h>
#include <linux/rtnetlink.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

#include <cmocka.h>

#include "drivers/can_interface.h"
#include "drivers/can_link.h"

#define LOOP_NS INT64_C(1600000000000000000)

static const struct can_link_filter ours[] = {{0x181, CAN_LINK_EXACT}, {0x080, CAN_LINK_EXACT}};

struct bed {
	struct link *link;
	int peer;
};

static struct bed make_bed(const char *connect_to)
{
	struct bed bed;
	int pair[2];

	assert_int_equal(socketpair(AF_UNIX, SOCK_SEQPACKET | SOCK_NONBLOCK, 0, pair), 0);
	bed.link = can_link_over(pair[0], connect_to, ours, 2, NULL);
	assert_non_null(bed.link);
	assert_int_equal(can_link_fd(bed.link), pair[0]);
	bed.peer = pair[1];
	return bed;
}

static void end_bed(struct bed *bed)
{
	can_link_close(bed->link);
	close(bed->peer);
}

static void arrives(int peer, uint32_t id, const void *data, uint8_t len)
{
	struct can_frame f = {.can_id = id, .len = len};

	memcpy(f.data, data, len);
	assert_int_equal(send(peer, &f, sizeof f, 0), sizeof f);
}

/* All frames of one read. */
static int read_frames(struct link *link, struct can_frame_at *ret, int max)
{
	uint8_t bytes[4096];
	int64_t t_ns = LOOP_NS;
	ssize_t n = can_link_read(link, bytes, sizeof bytes, &t_ns);
	int frames = 0;

	assert_true(n >= 0);
	for (size_t at = 0; at < (size_t)n; frames++) {
		assert_true(frames < max);
		ssize_t step = can_wire_get(bytes + at, (size_t)n - at, &ret[frames]);
		assert_true(step > 0);
		assert_true(ret[frames].t_ns <= t_ns);
		at += (size_t)step;
	}
	return frames;
}

static int read_error(struct link *link)
{
	uint8_t bytes[4096];
	int64_t t_ns = LOOP_NS;

	return (int)can_link_read(link, bytes, sizeof bytes, &t_ns);
}

static uint32_t lost(const struct can_frame_at *f, int which)
{
	uint32_t n;

	assert_int_equal(f->id, CAN_WIRE_LOST);
	assert_int_equal(f->len, 8);
	memcpy(&n, f->data + 4 * which, sizeof n);
	return n;
}

static void frames_of_an_interface_are_read_several_at_once(void **state)
{
	struct bed bed = make_bed("can0");
	struct can_frame_at f[40];
	struct canfd_frame fd = {.can_id = 0x181, .len = 12, .flags = CANFD_BRS, .data = {1, 2, 3}};

	(void)state;
	assert_int_equal(read_frames(bed.link, f, 40), 0);
	arrives(bed.peer, 0x181, "abcdefgh", 8);
	arrives(bed.peer, 0x080, "", 0);
	assert_int_equal(send(bed.peer, &fd, sizeof fd, 0), sizeof fd);
	arrives(bed.peer, CAN_ERR_FLAG | CAN_ERR_BUSOFF, "\0\0\0\0\0\0\0\0", 8);
	assert_int_equal(read_frames(bed.link, f, 40), 4);
	assert_int_equal(f[0].id, 0x181);
	assert_int_equal(f[0].len, 8);
	assert_int_equal(f[0].flags, 0);
	assert_memory_equal(f[0].data, "abcdefgh", 8);
	assert_int_equal(f[1].id, 0x080);
	assert_int_equal(f[1].len, 0);
	assert_int_equal(f[2].flags, CAN_WIRE_FD | CAN_WIRE_BRS);
	assert_int_equal(f[2].len, 12);
	assert_memory_equal(f[2].data, fd.data, 64);
	assert_int_equal(f[3].id, CAN_WIRE_ERROR | CAN_WIRE_ERROR_BUS_OFF);
	for (int i = 0; i < 100; i++)
		arrives(bed.peer, 0x181, &i, 4);
	for (int i = 0, n; i < 100; i += n) {
		n = read_frames(bed.link, f, 40);
		assert_in_range(n, 1, 32);
		assert_int_equal(f[0].data[0], i);
	}
	assert_int_equal(read_frames(bed.link, f, 40), 0);
	end_bed(&bed);
}

static void a_small_buffer_takes_fewer_and_loses_none(void **state)
{
	struct bed bed = make_bed("can0");
	uint8_t bytes[4 * CAN_WIRE_ENTRY_FD];
	struct can_frame_at f;
	int64_t t_ns = LOOP_NS;

	(void)state;
	for (int i = 0; i < 9; i++)
		arrives(bed.peer, 0x181, &i, 4);
	for (int i = 0; i < 9;) {
		ssize_t n = can_link_read(bed.link, bytes, sizeof bytes, &t_ns);

		assert_true(n > 0);
		for (ssize_t at = 0; at < n; at += CAN_WIRE_ENTRY) {
			assert_int_equal(can_wire_get(bytes + at, (size_t)(n - at), &f), CAN_WIRE_ENTRY);
			assert_int_equal(f.data[0], i++);
		}
	}
	assert_int_equal(can_link_read(bed.link, bytes, 2 * CAN_WIRE_ENTRY_FD, &t_ns), -EMSGSIZE);
	end_bed(&bed);
}

static void what_is_no_frame_and_what_no_filter_wants_is_passed_over(void **state)
{
	struct bed bed = make_bed("can0");
	struct can_frame f = {.can_id = 0x181, .len = 9};
	struct can_frame_at got[40];

	(void)state;
	for (size_t n = 1; n < 128; n++)
		if (n != CAN_MTU && n != CANFD_MTU)
			assert_int_equal(send(bed.peer, (uint8_t[128]){0}, n, 0), (ssize_t)n);
	assert_int_equal(send(bed.peer, &f, sizeof f, 0), sizeof f); /* a length that no frame has */
	arrives(bed.peer, 0x182, "x", 1);
	arrives(bed.peer, 0x181 | CAN_EFF_FLAG, "x", 1);
	arrives(bed.peer, 0x181 | CAN_RTR_FLAG, "", 0);
	for (int i = 0; i < 3; i++) /* 32 messages a read, 129 of them */
		assert_int_equal(read_frames(bed.link, got, 40), 0);
	arrives(bed.peer, 0x181, "x", 1);
	int n = read_frames(bed.link, got, 40);
	n = n ? n : read_frames(bed.link, got, 40);
	assert_int_equal(n, 2);
	assert_int_equal(got[0].id, 0x181 | CAN_WIRE_REMOTE);
	assert_int_equal(got[1].id, 0x181);
	end_bed(&bed);
}

static int64_t wall_ns(void)
{
	struct timespec ts;

	clock_gettime(CLOCK_REALTIME, &ts);
	return (int64_t)ts.tv_sec * 1000000000 + ts.tv_nsec;
}

static void a_hub_carries_entries_with_their_times(void **state)
{
	struct bed bed = make_bed("unix:/run/hub");
	struct can_frame_at f = can_wire_frame(0x181, "abc", 3), got[40];
	uint8_t entry[CAN_WIRE_ENTRY_FD];

	(void)state;
	f.t_ns = wall_ns();
	assert_int_equal(send(bed.peer, entry, can_wire_put(&f, entry), 0), CAN_WIRE_ENTRY);
	f.id = 0x182; /* nobody asked */
	assert_int_equal(send(bed.peer, entry, can_wire_put(&f, entry), 0), CAN_WIRE_ENTRY);
	assert_int_equal(send(bed.peer, entry, CAN_WIRE_ENTRY - 1, 0), CAN_WIRE_ENTRY - 1); /* cut */
	f.id = CAN_WIRE_ERROR | CAN_WIRE_ERROR_RESTARTED;
	f.t_ns += 1000;
	assert_int_equal(send(bed.peer, entry, can_wire_put(&f, entry), 0), CAN_WIRE_ENTRY);
	f.id = 0x080;
	f.t_ns = 0; /* not said: it came just now */
	assert_int_equal(send(bed.peer, entry, can_wire_put(&f, entry), 0), CAN_WIRE_ENTRY);
	assert_int_equal(read_frames(bed.link, got, 40), 3);
	assert_int_equal(got[0].id, 0x181);
	assert_memory_equal(got[0].data, "abc", 3);
	assert_true(got[1].id == (CAN_WIRE_ERROR | CAN_WIRE_ERROR_RESTARTED) && got[1].t_ns > got[0].t_ns);
	assert_true(got[2].t_ns >= got[1].t_ns);
	f = can_wire_frame(0x600, "12345678", 8);
	f.t_ns = 5;
	assert_int_equal(can_link_write(bed.link, entry, can_wire_put(&f, entry)), CAN_WIRE_ENTRY);
	assert_int_equal(recv(bed.peer, entry, sizeof entry, 0), CAN_WIRE_ENTRY);
	assert_int_equal(can_wire_get(entry, CAN_WIRE_ENTRY, &got[0]), CAN_WIRE_ENTRY);
	assert_int_equal(got[0].t_ns, 0);
	assert_memory_equal(got[0].data, "12345678", 8);
	end_bed(&bed);
}

static void frames_are_written_as_the_kernel_wants_them(void **state)
{
	struct bed bed = make_bed("can0");
	struct can_frame_at f = can_wire_frame(0x201, "\x0F\x00", 2);
	struct canfd_frame got;
	uint8_t row[3 * CAN_WIRE_ENTRY_FD];
	size_t n = can_wire_put(&f, row);

	(void)state;
	f.id = 0x12345 | CAN_WIRE_EXTENDED;
	f.flags = CAN_WIRE_FD | CAN_WIRE_BRS;
	f.len = 16;
	n += can_wire_put(&f, row + n);
	assert_int_equal(can_link_write(bed.link, row, n), (ssize_t)n);
	assert_int_equal(recv(bed.peer, &got, sizeof got, 0), CAN_MTU);
	assert_int_equal(got.can_id, 0x201);
	assert_int_equal(got.len, 2);
	assert_memory_equal(got.data, "\x0F\x00", 2);
	assert_int_equal(recv(bed.peer, &got, sizeof got, 0), CANFD_MTU);
	assert_int_equal(got.can_id, 0x12345 | CAN_EFF_FLAG);
	assert_int_equal(got.len, 16);
	assert_int_equal(can_link_write(bed.link, row, n - 1), -EINVAL);
	end_bed(&bed);
}

/* Calls that fail to order. */
static int call_error, calls, good_calls;
static uint32_t call_drops;
static int64_t call_stamp_ns;

static ssize_t failing_send(int fd, const void *bytes, size_t len, int flags)
{
	(void)fd;
	(void)bytes;
	assert_true(flags & MSG_DONTWAIT);
	calls++;
	if (good_calls-- > 0)
		return (ssize_t)len;
	errno = call_error;
	return -1;
}

static void put_control(struct msghdr *m, struct cmsghdr **c, int type, const void *value, size_t len)
{
	(*c)->cmsg_level = SOL_SOCKET;
	(*c)->cmsg_type = type;
	(*c)->cmsg_len = CMSG_LEN(len);
	memcpy(CMSG_DATA(*c), value, len);
	*c = CMSG_NXTHDR(m, *c);
}

static ssize_t failing_recvmsg(int fd, struct msghdr *m, int flags)
{
	const struct can_frame f = {.can_id = 0x181, .len = 1};
	const struct timespec ts = {call_stamp_ns / 1000000000, call_stamp_ns % 1000000000};
	struct cmsghdr *c = CMSG_FIRSTHDR(m);

	(void)fd;
	assert_true(flags & MSG_DONTWAIT);
	if (good_calls-- <= 0) {
		errno = call_error;
		return -1;
	}
	memset(m->msg_control, 0, m->msg_controllen);
	put_control(m, &c, SO_TIMESTAMPNS, &ts, sizeof ts);
	if (call_drops)
		put_control(m, &c, SO_RXQ_OVFL, &call_drops, sizeof call_drops);
	memcpy(m->msg_iov[0].iov_base, &f, sizeof f);
	return sizeof f;
}

static const struct can_link_calls failing = {failing_recvmsg, failing_send};

static struct link *failing_link(int error, int good)
{
	struct link *link = can_link_over(dup(0), "can0", ours, 2, &failing);

	call_error = error;
	good_calls = good;
	calls = 0;
	call_drops = 0;
	call_stamp_ns = wall_ns();
	assert_non_null(link);
	return link;
}

static void a_set_point_without_room_is_dropped_once_and_told(void **state)
{
	static const int no_room[] = {ENOBUFS, EAGAIN};
	struct can_frame_at f = can_wire_frame(0x201, "\x0F\x00", 2), got[40];
	uint8_t row[5 * CAN_WIRE_ENTRY];
	size_t n = 0;

	(void)state;
	for (int i = 0; i < 5; i++)
		n += can_wire_put(&f, row + n);
	for (size_t i = 0; i < 2; i++) {
		struct link *link = failing_link(no_room[i], 2);

		assert_int_equal(can_link_write(link, row, n), (ssize_t)n); /* taken: nothing waits */
		assert_int_equal(calls, 5);                                 /* once each */
		call_error = EAGAIN;
		assert_int_equal(read_frames(link, got, 40), 1);
		assert_int_equal(lost(&got[0], 0), 0);
		assert_int_equal(lost(&got[0], 1), 3);
		assert_int_equal(read_frames(link, got, 40), 0); /* told once */
		can_link_close(link);
	}
}

static void frames_that_the_kernel_had_no_room_for_are_told(void **state)
{
	struct link *link = failing_link(EAGAIN, 3);
	struct can_frame_at got[40];

	(void)state;
	call_drops = 7;
	assert_int_equal(read_frames(link, got, 40), 4);
	assert_int_equal(lost(&got[0], 0), 7);
	assert_int_equal(got[0].t_ns, got[1].t_ns);
	good_calls = 1;
	assert_int_equal(read_frames(link, got, 40), 1); /* the same count again is none */
	call_drops = 3;                                  /* it wrapped */
	good_calls = 1;
	assert_int_equal(read_frames(link, got, 40), 2);
	assert_int_equal(lost(&got[0], 0), (uint32_t)(3 - 7));
	can_link_close(link);
}

static void a_kernels_stamp_is_the_time_of_its_frame(void **state)
{
	struct link *link = failing_link(EAGAIN, 1);
	struct can_frame_at got[40];
	int64_t first_ns;

	(void)state;
	assert_int_equal(read_frames(link, got, 40), 1);
	first_ns = got[0].t_ns;
	for (int i = 1; i <= 5; i++) { /* the stamps are 1 ms apart, whenever they are read */
		call_stamp_ns -= 1000000;
		good_calls = 1;
		assert_int_equal(read_frames(link, got, 40), 1);
		assert_true(llabs(got[0].t_ns - (first_ns - i * 1000000)) < 500000);
	}
	can_link_close(link);
}

static void every_end_of_an_interface_is_a_sentence_that_says_what_to_do(void **state)
{
	static const struct {
		int error;
		const char *says;
	} ends[] = {{ENETDOWN, "ip link set can0 up"},
	            {ENODEV, "plug the adapter in again"},
	            {ENXIO, "plug the adapter in again"}};
	struct can_frame_at f = can_wire_frame(0x201, "\x0F\x00", 2), got[40];
	uint8_t entry[CAN_WIRE_ENTRY_FD];
	char text[160];

	(void)state;
	for (size_t i = 0; i < sizeof ends / sizeof *ends; i++) {
		struct link *link = failing_link(ends[i].error, 2);

		/* What came before the end is read before it; and the end is said although the kernel says it once. */
		assert_int_equal(read_frames(link, got, 40), 2);
		call_error = EAGAIN;
		assert_int_equal(read_error(link), -ends[i].error);
		can_link_error(link, ends[i].error, text);
		assert_non_null(strstr(text, "can0"));
		assert_non_null(strstr(text, ends[i].says));
		can_link_close(link);
		link = failing_link(ends[i].error, 0);
		assert_int_equal(can_link_write(link, entry, can_wire_put(&f, entry)), -ends[i].error);
		can_link_close(link);
	}
}

static void a_frame_that_an_interface_cannot_carry_has_its_sentence(void **state)
{
	struct link *link = failing_link(EINVAL, 0);
	struct can_frame_at f = {.id = 0x201, .flags = CAN_WIRE_FD, .len = 12};
	uint8_t entry[CAN_WIRE_ENTRY_FD];
	char text[160];

	(void)state;
	assert_int_equal(can_link_write(link, entry, can_wire_put(&f, entry)), -EINVAL);
	can_link_error(link, EINVAL, text);
	assert_non_null(strstr(text, "CAN FD"));
	can_link_error(link, EPERM, text);
	assert_non_null(strstr(text, strerror(EPERM)));
	can_link_note(link, text);
	assert_string_equal(text, "");
	can_link_close(link);
}

/* A real queue that nobody empties: the writer never waits, and all that had no room is counted. */
static void a_hub_that_reads_nothing_stops_nobody(void **state)
{
	struct bed bed = make_bed("unix:/run/hub");
	struct can_frame_at f = can_wire_frame(0x201, "\x0F\x00", 2), got[40];
	uint8_t entry[CAN_WIRE_ENTRY_FD];
	const size_t n = can_wire_put(&f, entry);
	uint32_t taken = 0;

	(void)state;
	for (int i = 0; i < 20000; i++)
		assert_int_equal(can_link_write(bed.link, entry, n), (ssize_t)n);
	assert_int_equal(read_frames(bed.link, got, 40), 1);
	while (recv(bed.peer, entry, sizeof entry, 0) > 0)
		taken++;
	assert_true(taken > 0);
	assert_int_equal(lost(&got[0], 1) + taken, 20000);
	end_bed(&bed);
}

static void a_hub_that_has_gone_is_said(void **state)
{
	struct bed bed = make_bed("unix:/run/hub");
	struct can_frame_at f = can_wire_frame(0x201, "", 0);
	uint8_t entry[CAN_WIRE_ENTRY_FD];
	char text[160];

	(void)state;
	close(bed.peer);
	assert_int_equal(read_error(bed.link), -ECONNRESET);
	assert_int_equal(can_link_write(bed.link, entry, can_wire_put(&f, entry)), -EPIPE);
	can_link_error(bed.link, EPIPE, text);
	assert_non_null(strstr(text, "has gone"));
	can_link_error(bed.link, EIO, text);
	assert_non_null(strstr(text, strerror(EIO)));
	can_link_close(bed.link);
}

static void refuses(const char *connect_to, const char *says)
{
	char error[160] = "";

	assert_null(can_link_open(connect_to, ours, 2, error));
	if (!strstr(error, says))
		fail_msg("'%s' lacks '%s'", error, says);
}

static void what_cannot_be_opened_is_said(void **state)
{
	struct sockaddr_un address = {.sun_family = AF_UNIX};
	char folder[] = "/tmp/can_link.XXXXXX", connect_to[200];
	int fd = socket(AF_UNIX, SOCK_SEQPACKET, 0), other = socket(AF_UNIX, SOCK_DGRAM, 0);
	struct link *link;

	(void)state;
	assert_non_null(mkdtemp(folder));
	snprintf(address.sun_path, sizeof address.sun_path, "%s/hub", folder);
	snprintf(connect_to, sizeof connect_to, "unix:%s", address.sun_path);
	refuses(connect_to, "is it started?");
	assert_int_equal(bind(fd, (struct sockaddr *)&address, sizeof address), 0);
	refuses(connect_to, "is it started?"); /* a file that nobody listens to */
	assert_int_equal(listen(fd, 4), 0);
	link = can_link_open(connect_to, ours, 2, (char[160]){0});
	assert_non_null(link);
	can_link_close(link);
	unlink(address.sun_path);
	assert_int_equal(bind(other, (struct sockaddr *)&address, sizeof address), 0);
	refuses(connect_to, "sequenced packets");
	unlink(address.sun_path);
	close(fd);
	close(other);
	rmdir(folder);
	memset(connect_to + 5, 'x', 150);
	connect_to[155] = 0;
	refuses(connect_to, "shorter than");
	fd = socket(PF_CAN, SOCK_RAW, 1);
	refuses("nocan0", fd < 0 ? "modprobe can_raw" : "plug the adapter in");
	refuses("lo", fd < 0 ? "modprobe can_raw" : "no CAN interface");
	if (fd >= 0)
		close(fd);
}

/* What the kernel says of an interface. */
static size_t attribute(uint8_t *at, unsigned short type, const void *value, size_t len)
{
	const struct rtattr a = {.rta_len = (unsigned short)RTA_LENGTH(len), .rta_type = type};

	memset(at, 0, RTA_SPACE(len));
	memcpy(at, &a, sizeof a);
	memcpy(at + RTA_LENGTH(0), value, len);
	return RTA_SPACE(len);
}

static size_t answer(uint8_t *ret, const char *kind, uint32_t health)
{
	struct nlmsghdr head = {.nlmsg_type = RTM_NEWLINK};
	const struct can_bittiming timing = {.bitrate = 500000};
	const uint32_t restart_ms = 100;
	uint8_t data[256], info[512];
	size_t n = attribute(data, IFLA_CAN_BITTIMING, &timing, sizeof timing), m,
	       at = NLMSG_SPACE(sizeof(struct ifinfomsg));

	n += attribute(data + n, IFLA_CAN_STATE, &health, sizeof health);
	n += attribute(data + n, IFLA_CAN_RESTART_MS, &restart_ms, sizeof restart_ms);
	m = attribute(info, IFLA_INFO_KIND, kind, strlen(kind) + 1);
	m += attribute(info + m, IFLA_INFO_DATA, data, n);
	memset(ret, 0, at);
	at += attribute(ret + at, IFLA_IFNAME, "can0", 5);
	at += attribute(ret + at, IFLA_LINKINFO | NLA_F_NESTED, info, m);
	head.nlmsg_len = (uint32_t)at;
	memcpy(ret, &head, sizeof head);
	return at;
}

static void what_a_controller_is_set_to_is_read_from_the_kernels_answer(void **state)
{
	_Alignas(8) uint8_t bytes[1024];
	struct can_interface i = {0};
	size_t n = answer(bytes, "can", CAN_STATE_BUS_OFF);

	(void)state;
	assert_true(can_interface_read(bytes, n, &i));
	assert_true(i.controller && i.bit_rate == 500000 && i.restart_ms == 100);
	assert_true(i.health_known && i.health == CAN_BUS_OFF);
	n = answer(bytes, "can", CAN_STATE_STOPPED);
	assert_true(can_interface_read(bytes, n, &i) && !i.health_known);
	n = answer(bytes, "vcan", 0);
	assert_false(can_interface_read(bytes, n, &i));
}

static void an_answer_that_is_cut_or_lies_about_its_lengths_is_read_within_its_bytes(void **state)
{
	_Alignas(8) uint8_t whole[1024];
	const size_t n = answer(whole, "can", CAN_STATE_ERROR_PASSIVE);
	struct can_interface i;

	(void)state;
	for (size_t len = 0; len < n; len++) {
		uint8_t *cut = malloc(len + 1);

		memcpy(cut, whole, len);
		assert_false(can_interface_read(cut, len, &i));
		free(cut);
	}
	for (size_t at = sizeof(struct nlmsghdr); at < n; at++)
		for (int value = 0; value < 256; value += 15) {
			_Alignas(8) uint8_t bytes[1024];
			uint8_t *exact = malloc(n);

			memcpy(bytes, whole, n);
			bytes[at] = (uint8_t)value;
			memcpy(exact, bytes, n);
			can_interface_read(exact, n, &i);
			free(exact);
		}
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(frames_of_an_interface_are_read_several_at_once),
	    cmocka_unit_test(a_small_buffer_takes_fewer_and_loses_none),
	    cmocka_unit_test(what_is_no_frame_and_what_no_filter_wants_is_passed_over),
	    cmocka_unit_test(a_hub_carries_entries_with_their_times),
	    cmocka_unit_test(frames_are_written_as_the_kernel_wants_them),
	    cmocka_unit_test(a_set_point_without_room_is_dropped_once_and_told),
	    cmocka_unit_test(frames_that_the_kernel_had_no_room_for_are_told),
	    cmocka_unit_test(a_kernels_stamp_is_the_time_of_its_frame),
	    cmocka_unit_test(every_end_of_an_interface_is_a_sentence_that_says_what_to_do),
	    cmocka_unit_test(a_frame_that_an_interface_cannot_carry_has_its_sentence),
	    cmocka_unit_test(a_hub_that_reads_nothing_stops_nobody),
	    cmocka_unit_test(a_hub_that_has_gone_is_said),
	    cmocka_unit_test(what_cannot_be_opened_is_said),
	    cmocka_unit_test(what_a_controller_is_set_to_is_read_from_the_kernels_answer),
	    cmocka_unit_test(an_answer_that_is_cut_or_lies_about_its_lengths_is_read_within_its_bytes),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}
