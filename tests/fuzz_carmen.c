/* Law L8: no line of a CARMEN log crashes its reader or its decoder, and what is taken is finite and within its counts. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/carmen_lines.h"
#include "drivers/driver.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static void must(bool condition)
{
	if (!condition)
		abort();
}

static void on_profile(void *ctx, int device, const struct profile *p)
{
	(void)ctx;
	(void)device;
	must(p->n > 0 && p->n <= PROFILE_BEAMS_MAX && p->beam_ns >= 0 && p->interlace > 0);
	for (int i = 0; i < p->n; i++)
		must(isfinite(p->range_m[i]) && p->range_m[i] >= 0 && p->state[i] < BEAM_STATES);
}

static void on_tilt(void *ctx, int device, const struct tilt *tilt)
{
	(void)ctx;
	(void)device;
	must(isfinite(tilt->angle_rad));
}

/* It is no device: a daemon that is told so says what to do, and its snapshot is a word. */
static void judge_the_rest(const struct driver *driver, const struct config_device *device, struct decoder *decoder)
{
	int64_t t_ns = 0;
	uint8_t bytes[64];
	char error[160] = "";
	struct state s;

	must(driver->link_open(device, error) == NULL && *error != 0);
	must(driver->link_fd(NULL) == -1 && driver->link_read(NULL, bytes, sizeof bytes, &t_ns) == 0);
	driver->link_close(NULL);
	state_save(&s, bytes, sizeof bytes);
	driver->state(decoder, &s);
	must(state_done(&s));
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	static struct carmen_line line;
	const struct record_sink sink = {.profile = on_profile, .tilt = on_tilt};
	const struct driver *driver = driver_find("carmen");
	struct config_device device = {.name = "laser"};
	struct decoder_counters counters;
	struct decoder *decoder;

	if (size > 0 && data[0] == '!') { /* the rear laser alone, with an encoder's sign */
		strcpy(device.message, "RLASER");
		device.encoder.set = true;
		device.encoder.scale = 1;
		device.encoder.sign = -1;
		data++;
		size--;
	}
	decoder = driver->decoder_create(&device, 0);
	for (size_t at = 0; decoder && at < size;) {
		const uint8_t *end = memchr(data + at, '\n', size - at);
		const size_t len = end ? (size_t)(end - data) - at : size - at;
		const struct record record = {1000000000, 1000000000, 0, FROM_DEVICE, data + at, len};

		if (carmen_read((const char *)data + at, len, &line) == CARMEN_LASER)
			must(line.n > 0 && line.n <= PROFILE_BEAMS_MAX && isfinite(line.first_rad));
		driver->decode(decoder, &record, &sink);
		at += len + 1;
	}
	if (decoder) {
		driver->counters(decoder, &counters);
		judge_the_rest(driver, &device, decoder);
		driver->decoder_destroy(decoder);
	}
	return 0;
}
