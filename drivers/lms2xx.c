/* driver_lms2xx: the serial link, and the table that joins it with the decoder and the dialogue (their own files). */
#include "drivers/lms2xx.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <termios.h>
#include <unistd.h>

#include "drivers/serial.h"

struct link {
	int fd;
	char port[CONFIG_TEXT_MAX]; /* the device file */
	char note[160];
};

static struct link *link_open(const struct config_device *config, char error[160])
{
	struct link *link = calloc(1, sizeof *link);
	if (link == NULL) {
		snprintf(error, 160, "out of memory");
		return NULL;
	}
	link->fd = serial_find("/sys", config->port, link->port, sizeof link->port, error);
	if (link->fd == 0)
		link->fd = serial_open(link->port, error);
	if (link->fd < 0) {
		free(link);
		return NULL;
	}
	serial_low_latency(link->fd, "/sys", link->port, link->note);
	return link;
}

static int link_fd(const struct link *link)
{
	return link->fd;
}

static ssize_t link_read(struct link *link, uint8_t *buf, size_t cap, int64_t *t_ns)
{
	(void)t_ns; /* the kernel stamps no bytes of a serial line */
	const ssize_t n = read(link->fd, buf, cap);
	if (n > 0)
		return n;
	if (n == 0)
		return cap == 0 ? 0 : -EIO; /* hung up */
	return errno == EAGAIN || errno == EINTR ? 0 : -errno;
}

static ssize_t link_write(struct link *link, const uint8_t *bytes, size_t len)
{
	const ssize_t n = write(link->fd, bytes, len);
	if (n >= 0)
		return n;
	return errno == EAGAIN || errno == EINTR ? 0 : -errno;
}

/* What was written last has been answered, or given up on hundreds of milliseconds ago: nothing is left to drain. */
static int link_baud(struct link *link, uint32_t baud, char error[160])
{
	return serial_set_baud(link->fd, link->port, baud, error);
}

static void link_flush(struct link *link)
{
	tcflush(link->fd, TCIFLUSH);
}

static void link_note(const struct link *link, char ret[160])
{
	snprintf(ret, 160, "%s", link->note);
}

static void link_close(struct link *link)
{
	serial_close(link->fd);
	free(link);
}

const struct driver driver_lms2xx = {
    .name = "lms2xx",
    .role = ROLE_LASER,
    .decoder_create = lms2xx_decoder_create,
    .decoder_destroy = lms2xx_decoder_destroy,
    .decode = lms2xx_decode,
    .counters = lms2xx_counters,
    .timing = lms2xx_timing,
    .state = lms2xx_decoder_state,
    .dialogue_create = lms2xx_dialogue_create,
    .dialogue_destroy = lms2xx_dialogue_destroy,
    .dialogue_reset = lms2xx_dialogue_reset,
    .dialogue_reply = lms2xx_dialogue_reply,
    .dialogue_data = lms2xx_dialogue_data,
    .dialogue_step = lms2xx_dialogue_step,
    .dialogue_stop = lms2xx_dialogue_stop,
    .link_open = link_open,
    .link_fd = link_fd,
    .link_read = link_read,
    .link_write = link_write,
    .link_baud = link_baud,
    .link_flush = link_flush,
    .link_note = link_note,
    .link_close = link_close,
};
