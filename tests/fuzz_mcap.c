/* Law: no file crashes the reader of recordings, makes it read beyond its end, allocate without bound or go on for ever; what it
 * hands out can be put into a recording again; it can be sought in. */
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/recording.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static void must(bool condition)
{
	if (!condition)
		abort();
}

static uint64_t sum;

/* Every byte that is handed out is there. */
static void touch(const void *data, size_t len)
{
	for (size_t i = 0; i < len; i++)
		sum += ((const uint8_t *)data)[i];
}

static void walk(const uint8_t *data, size_t size)
{
	struct mcap_reader *r;
	struct mcap_item item;
	char error[160];
	uint64_t first_ns, last_ns, at = 0;
	size_t chunks = 0;

	if (mcap_reader_create(data, size, &r, error) < 0)
		return;
	while (mcap_reader_next(r, &item) == 1) {
		must(item.offset <= item.end && item.end <= size && (item.kind == MCAP_DAMAGED || item.offset >= at));
		at = item.offset;
		chunks += item.kind == MCAP_CHUNK;
		if (item.kind == MCAP_MESSAGE)
			touch(item.message.data, item.message.len);
		if (item.kind == MCAP_ATTACHMENT)
			touch(item.attachment.data, item.attachment.len);
		if (item.kind == MCAP_METADATA)
			for (size_t i = 0; i < item.metadata.map.n; i++)
				touch(item.metadata.map.pair[i].value.at, item.metadata.map.pair[i].value.len);
	}
	for (struct mcap_channel *c = mcap_reader_channel(r, 0); c; c = mcap_reader_channel(r, c->id + 1u))
		touch(c->topic.at, c->topic.len);
	mcap_reader_span(r, &first_ns, &last_ns);
	must(first_ns <= last_ns || chunks == 0);
	must(mcap_reader_seek(r, (int64_t)(first_ns / 2 + last_ns / 2)) == 0);
	mcap_reader_next(r, &item);
	mcap_reader_destroy(r);
}

static struct config config = {.devices = 4,
                               .device = {{.name = "laser", .driver = "lms2xx"},
                                          {.name = "axis", .driver = "can"},
                                          {.name = "servo", .driver = "modbus"},
                                          {.name = "pose", .driver = "pose"}}};

/* Into another recording; what would be refused there is a fault of the reader. */
static void put(struct recording_writer *w, const struct recording_event *event)
{
	if (event->kind == RECORDING_SKIP)
		must(recording_put_skip(w, event->skip, "queue full") == 0);
	else if (event->kind == RECORDING_RECORD && event->record.device >= 0)
		must(recording_put_record(w, &event->record) == 0);
	else if (event->kind == RECORDING_TICK)
		must(recording_put_tick(w, event->log_ns) == 0);
	else if (event->kind == RECORDING_CLOCK)
		must(recording_put_clock(w, event->ahead_ns) == 0);
	else if (event->kind == RECORDING_EVENT)
		must(recording_put_event(w, event->json.text, event->json.len) == 0);
	else if (event->kind == RECORDING_CONTROL)
		must(recording_put_control(w, event->json.text, event->json.len) == 0);
	else if (event->kind == RECORDING_BEGIN)
		must(recording_put_begin(w, &event->begin) == 0);
}

static void check(const struct recording_event *event)
{
	if (event->kind == RECORDING_RECORD) {
		must(event->record.device >= -1 && event->record.device < config.devices && event->device);
		touch(event->record.bytes, event->record.len);
	} else if (event->kind == RECORDING_BEGIN) {
		touch(event->begin.snapshot, event->begin.len);
	} else if (event->kind == RECORDING_EVENT || event->kind == RECORDING_CONTROL) {
		touch(event->json.text, event->json.len);
	}
}

static void listen(const uint8_t *data, size_t size)
{
	const struct recording_params params = {&config, "devices: []\n", "1", 0};
	const struct recording_begin begin = {.snapshot = "", .whole = true};
	struct buffer out = {0};
	struct recording_writer *w;
	struct recording_reader *r;
	struct recording_event event;
	int64_t log_ns = INT64_MIN, first_ns, last_ns;
	char error[160];
	size_t len;
	const char *text;

	if (recording_reader_create(data, size, &r, error) < 0)
		return;
	w = recording_writer_create(&params, &begin, &out);
	text = recording_reader_config(r, &len);
	touch(text, text ? len : 0);
	recording_reader_next(r, &event); /* its channel is known before the configuration is */
	recording_reader_use(r, &config);
	recording_reader_rewind(r);
	while (recording_reader_next(r, &event) == 1) {
		must(event.log_ns >= log_ns || event.kind == RECORDING_DAMAGED);
		log_ns = event.log_ns > log_ns ? event.log_ns : log_ns;
		check(&event);
		put(w, &event);
	}
	must(recording_end(w, "ended") == 0 && mcap_writer_open_bytes(recording_writer_mcap(w)) == 0);
	recording_writer_destroy(w);
	buffer_finish(&out);
	recording_reader_span(r, &first_ns, &last_ns);
	must(mcap_reader_tell(recording_reader_mcap(r)) <= (64u << 20));
	recording_reader_destroy(r);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	walk(data, size);
	listen(data, size);
	return 0;
}
