/* An interface's flags come by ioctl, which every kernel and every sandbox with sockets has; what a controller is set to
 * only by netlink (RTM_GETLINK), as attributes within attributes:
 *
 *   nlmsghdr, ifinfomsg, ... IFLA_LINKINFO { IFLA_INFO_KIND "can", IFLA_INFO_DATA { BITTIMING, STATE, RESTART_MS, ... } }
 *
 * A message is judged by its lengths before anything of it is used. */
#include "drivers/can_interface.h"

#include <errno.h>
#include <linux/can/netlink.h>
#include <linux/rtnetlink.h>
#include <net/if.h>
#include <net/if_arp.h>
#include <stdio.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <unistd.h>

int can_interface_find(int fd, const char *name)
{
	struct ifreq ifr = {0};
	int index;

	snprintf(ifr.ifr_name, sizeof ifr.ifr_name, "%.15s", name);
	if (ioctl(fd, SIOCGIFINDEX, &ifr) < 0)
		return -errno;
	index = ifr.ifr_ifindex;
	if (ioctl(fd, SIOCGIFHWADDR, &ifr) < 0)
		return -errno;
	if (ifr.ifr_hwaddr.sa_family != ARPHRD_CAN)
		return -EAFNOSUPPORT;
	if (ioctl(fd, SIOCGIFFLAGS, &ifr) < 0)
		return -errno;
	return ifr.ifr_flags & IFF_UP ? index : -ENETDOWN;
}

/* The attribute of this type among `len` bytes of them; NULL: not there, or the lengths lie. */
static const struct rtattr *attribute(const void *bytes, size_t len, unsigned short type)
{
	const uint8_t *at = bytes;

	while (len >= sizeof(struct rtattr)) {
		const struct rtattr *a = (const struct rtattr *)(const void *)at;
		const size_t step = RTA_ALIGN((size_t)a->rta_len);

		if (a->rta_len < sizeof *a || a->rta_len > len)
			return NULL;
		if ((a->rta_type & NLA_TYPE_MASK) == type)
			return a;
		if (step > len)
			return NULL;
		at += step;
		len -= step;
	}
	return NULL;
}

static const struct rtattr *inner(const struct rtattr *a, unsigned short type)
{
	return a ? attribute((const uint8_t *)a + RTA_LENGTH(0), a->rta_len - RTA_LENGTH(0), type) : NULL;
}

static bool number(const struct rtattr *a, uint32_t *ret)
{
	if (!a || a->rta_len < RTA_LENGTH(sizeof *ret))
		return false;
	memcpy(ret, (const uint8_t *)a + RTA_LENGTH(0), sizeof *ret); /* of a can_bittiming: its first, the bit rate */
	return true;
}

bool can_interface_read(const void *message, size_t len, struct can_interface *ret)
{
	const size_t head = NLMSG_SPACE(sizeof(struct ifinfomsg));
	const struct rtattr *info, *kind, *data;
	struct can_interface i = {.controller = true};
	struct nlmsghdr h;
	uint32_t state;

	if (len < head)
		return false;
	memcpy(&h, message, sizeof h);
	if (h.nlmsg_type != RTM_NEWLINK || h.nlmsg_len < head || h.nlmsg_len > len)
		return false;
	info = attribute((const uint8_t *)message + head, h.nlmsg_len - head, IFLA_LINKINFO);
	kind = inner(info, IFLA_INFO_KIND);
	data = inner(info, IFLA_INFO_DATA);
	if (!data || !kind || kind->rta_len < RTA_LENGTH(4) ||
	    memcmp((const uint8_t *)kind + RTA_LENGTH(0), "can", 4) != 0)
		return false;
	number(inner(data, IFLA_CAN_BITTIMING), &i.bit_rate);
	number(inner(data, IFLA_CAN_RESTART_MS), &i.restart_ms);
	if (number(inner(data, IFLA_CAN_STATE), &state) && state <= CAN_STATE_BUS_OFF) {
		i.health_known = true;
		i.health = (enum can_bus_health)state; /* both count active, warning, passive, off */
	}
	*ret = i;
	return true;
}

void can_interface_ask(int index, struct can_interface *ret)
{
	struct {
		struct nlmsghdr head;
		struct ifinfomsg info;
	} ask = {.head = {.nlmsg_len = sizeof ask, .nlmsg_type = RTM_GETLINK, .nlmsg_flags = NLM_F_REQUEST},
	         .info = {.ifi_family = AF_UNSPEC, .ifi_index = index}};
	_Alignas(8) uint8_t answer[8192];
	int fd = socket(AF_NETLINK, SOCK_RAW | SOCK_CLOEXEC | SOCK_NONBLOCK, NETLINK_ROUTE);
	ssize_t n;

	memset(ret, 0, sizeof *ret);
	if (fd < 0)
		return;
	/* The kernel answers within the call. */
	n = send(fd, &ask, sizeof ask, 0) < 0 ? -1 : recv(fd, answer, sizeof answer, MSG_DONTWAIT);
	if (n > 0)
		can_interface_read(answer, (size_t)n, ret);
	close(fd);
}
