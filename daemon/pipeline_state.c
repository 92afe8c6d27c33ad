/* The snapshot that a list begins with in mid-session: everything that the rows to come hang on (law L7). */
#include "daemon/pipeline_parts.h"

#include <stdio.h>
#include <string.h>

#define LOAD_REFUSED "the snapshot is damaged, or of another version of facetd"

/* The list of devices is part of it: bytes of one are nothing to another. */
static void device_state(struct state *s, const struct config_device *device, char error[160])
{
	char name[CONFIG_NAME_MAX] = "", driver[CONFIG_NAME_MAX] = "";

	snprintf(name, sizeof(name), "%s", device->name);
	snprintf(driver, sizeof(driver), "%s", device->driver);
	state_bytes(s, name, sizeof(name));
	state_bytes(s, driver, sizeof(driver));
	if (s->failed || (strcmp(name, device->name) == 0 && strcmp(driver, device->driver) == 0))
		return;
	s->failed = true;
	snprintf(error, 160, "kept with a device `%.31s` (%.31s) where the configuration has `%s` (%s)", name, driver,
	         device->name, device->driver);
}

static void devices_state(struct state *s, const struct config *config, char error[160])
{
	int devices = config->devices;

	state_int(s, &devices, 0, CONFIG_DEVICES_MAX);
	if (!s->failed && devices != config->devices) {
		s->failed = true;
		snprintf(error, 160, "kept with %d devices, the configuration has %d", devices, config->devices);
	}
	for (int i = 0; i < config->devices && !s->failed; i++)
		device_state(s, &config->device[i], error);
}

/* Oldest first. */
static void scanner_state(struct state *s, struct scanner *scanner)
{
	const unsigned end = scanner->arrivals;
	size_t known = end < ARRIVALS ? end : ARRIVALS;

	state_tag(s, "scanner1");
	state_bool(s, &scanner->begins);
	state_size(s, &known, ARRIVALS);
	for (size_t i = 0; i < known && !s->failed; i++) {
		const size_t at = s->loading ? i : (end - known + i) % ARRIVALS;

		state_time(s, &scanner->arrival[at].t_ns);
		state_time(s, &scanner->arrival[at].log_ns);
	}
	if (s->loading)
		scanner->arrivals = (unsigned)known;
	sweep_state(s, scanner->sweep);
}

static void numbers_state(struct state *s, struct pipeline *p)
{
	state_tag(s, "numbers1");
	state_time(s, &p->log_ns);
	state_time(s, &p->arrival_ns);
	state_time(s, &p->last_row_ns);
	state_bool(s, &p->rows_since_flush);
	state_u64(s, &p->next_number);
	state_u64(s, &p->rows);
	state_u64(s, &p->not_applied);
}

static void parts_state(struct state *s, struct pipeline *p)
{
	for (int i = 0; i < p->config->devices; i++) {
		bool remembers = p->device[i].driver->state != NULL;
		const bool can = remembers;

		state_bool(s, &remembers);
		s->failed |= remembers != can;
		if (can)
			p->device[i].driver->state(p->device[i].decoder, s);
	}
	pose_track_state(s, p->track);
	for (int i = 0; i < p->scanners; i++)
		scanner_state(s, &p->scanner[i]);
	numbers_state(s, p);
}

/* Every part that refuses a load is as new afterwards, so the parts that took theirs are made to refuse one. */
static void forget(struct pipeline *p)
{
	struct state nothing;

	state_load(&nothing, NULL, 0);
	parts_state(&nothing, p);
	for (int i = 0; i < p->scanners; i++) {
		p->scanner[i].arrivals = 0;
		p->scanner[i].begins = false;
	}
	p->log_ns = p->arrival_ns = p->last_row_ns = 0;
	p->rows_since_flush = false;
	p->next_number = p->rows = p->not_applied = 0;
}

void pipeline_state(struct pipeline *p, struct state *s, char error[160])
{
	snprintf(error, 160, "%s", LOAD_REFUSED);
	state_tag(s, "pipeline2");
	devices_state(s, p->config, error);
	if (!s->failed)
		parts_state(s, p);
	if (s->loading && !state_done(s))
		s->failed = true;
	if (s->failed)
		forget(p);
	else
		*error = 0;
}
