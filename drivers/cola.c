/* driver_tim, driver_lms1xx, driver_lms5xx: the families in one table, and the table that joins decoder, dialogue and links
 * (their own files). A scanner is reached by TCP or by USB: `connect` decides when the link is opened, and the link
 * remembers. */
#include "drivers/cola.h"

#include <stdio.h>
#include <string.h>

/* What the stamp marks was measured (t_transmit - t_startup against the time a sweep takes): TiM and LMS1xx stamp the
 * end, LMS5xx the start. Rates are the slowest each can be set to, so that nobody is taken for silent too early. */
static const struct cola_family families[] = {
    {.driver = "tim", .stamp_at_end = true, .usb = true, .measures_hz = 15},
    {.driver = "lms1xx", .stamp_at_end = true, .encoders = true, .waits_ready = true, .measures_hz = 25},
    {.driver = "lms5xx", .encoders = true, .measures_hz = 25},
};

const struct cola_family *cola_family(const char *driver)
{
	for (size_t i = 0; i < sizeof families / sizeof families[0]; i++)
		if (strcmp(families[i].driver, driver) == 0)
			return &families[i];
	return NULL;
}

static struct link *link_open(const struct config_device *config, char error[160])
{
	return strncmp(config->connect, "usb", 3) == 0 ? cola_usb.open(config, error) : cola_tcp.open(config, error);
}

static int link_fd(const struct link *link)
{
	return link->stream->fd(link);
}

static ssize_t link_read(struct link *link, uint8_t *buf, size_t cap, int64_t *t_ns)
{
	return link->stream->read(link, buf, cap, t_ns);
}

static ssize_t link_write(struct link *link, const uint8_t *bytes, size_t len)
{
	return link->stream->write(link, bytes, len);
}

static void link_error(const struct link *link, int error, char ret[160])
{
	if (link->stream->error)
		link->stream->error(link, error, ret);
	else
		snprintf(ret, 160, "the connection failed (%s)", strerror(error));
}

static void link_close(struct link *link)
{
	link->stream->close(link);
}

#define COLA_DRIVER(NAME)                                                                                         \
	{                                                                                                         \
		.name = NAME, .role = ROLE_LASER, .decoder_create = cola_decoder_create,                          \
		.decoder_destroy = cola_decoder_destroy, .decode = cola_decode, .counters = cola_counters,        \
		.timing = cola_timing, .state = cola_decoder_state, .dialogue_create = cola_dialogue_create,      \
		.dialogue_destroy = cola_dialogue_destroy, .dialogue_reset = cola_dialogue_reset,                 \
		.dialogue_reply = cola_dialogue_reply, .dialogue_data = cola_dialogue_data,                       \
		.dialogue_step = cola_dialogue_step, .dialogue_stop = cola_dialogue_stop, .link_open = link_open, \
		.link_fd = link_fd, .link_read = link_read, .link_write = link_write, .link_error = link_error,   \
		.link_close = link_close,                                                                         \
	}

const struct driver driver_tim = COLA_DRIVER("tim");
const struct driver driver_lms1xx = COLA_DRIVER("lms1xx");
const struct driver driver_lms5xx = COLA_DRIVER("lms5xx");
