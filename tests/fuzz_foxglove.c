/* Law L8: whatever a Foxglove client says, in text or binary, between changes of the map and of what is measured, nothing
 * crashes, what is answered is well-formed, and the client costs a bounded piece of memory.
 *
 * Input: a byte of switches (1 a replay, 2 it may play, 4 protobuf), then records: u8 kind, u8 n, n bytes. */
#include <jansson.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <syslog.h>

#include "daemon/foxglove.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

enum { TEXT, BINARY, LONG_TEXT, READ, PATCH, MEASURE, LINE, RESET, KINDS };

static const double cell_m = 0.05;

struct bed {
	struct publisher *publisher;
	struct live *live;
	struct foxglove *foxglove;
	struct foxglove_client *client;
	int64_t now_ns;
	uint64_t step;
	struct player_status playback;
	struct buffer heard, message;
	bool text, begun;
};

static void must(bool condition)
{
	if (!condition)
		abort();
}

static int64_t now(void *ctx)
{
	return ((struct bed *)ctx)->now_ns;
}

static void status(void *ctx, struct buffer *ret)
{
	(void)ctx;
	buffer_printf(ret, "{}");
}

static void playback(void *ctx, struct player_status *ret)
{
	*ret = ((struct bed *)ctx)->playback;
}

static bool play(void *ctx, const struct foxglove_request *request, char error[200])
{
	struct bed *bed = ctx;

	must(request->speed > 0);
	bed->playback.speed = request->speed;
	bed->playback.seeks += request->seek;
	strcpy(error, "no");
	return request->play;
}

static void wake(void *ctx)
{
	(void)ctx;
}

static void take_message(struct bed *bed)
{
	json_error_t error;
	json_t *message;

	if (bed->text) {
		message = json_loadb((char *)bed->message.data, bed->message.len, 0, &error);
		must(json_string_value(json_object_get(message, "op")) != NULL);
		json_decref(message);
	} else {
		must(bed->message.len > 0 && bed->message.data[0] >= 1 && bed->message.data[0] <= 5);
		must(bed->message.data[0] != 1 || bed->message.len > 13);
	}
	bed->message.len = 0;
}

static void read_pieces(struct bed *bed, uint8_t cap, uint8_t pieces)
{
	uint8_t piece[2048];
	bool text = false, final;

	for (int i = 0; i < pieces; i++) {
		const size_t n = foxglove_next(bed->client, piece, 1 + cap * (size_t)8, bed->now_ns, &text, &final);

		if (n == 0) {
			const int64_t deadline_ns = foxglove_deadline(bed->client);

			if (deadline_ns == INT64_MAX || foxglove_reason(bed->client))
				return;
			bed->now_ns = deadline_ns > bed->now_ns ? deadline_ns : bed->now_ns + 1;
			continue;
		}
		must(n <= 1 + cap * (size_t)8);
		bed->text = bed->begun ? bed->text : text;
		bed->begun = !final;
		buffer_append(&bed->message, piece, n);
		if (final)
			take_message(bed);
	}
}

static void publish(struct bed *bed, uint8_t key, uint8_t triangles)
{
	const uint32_t nt = triangles % 40;
	struct patch *patch =
	    patch_allocate((struct patch_key){key & 3, key >> 2 & 3, 0}, nt ? nt + 2 : 0, nt, nt ? 1 : 0);

	for (uint32_t t = 0; t < nt; t++)
		for (uint32_t c = 0; c < 3; c++)
			patch->triangle[t][c] = t + c;
	if (nt)
		patch->run[0] = (struct patch_run){PLANE_NONE, key >> 4, (uint16_t)nt};
	patch->version = ++bed->step;
	patch->t_last_ns = bed->now_ns;
	must(publisher_publish(bed->publisher, bed->step, &patch, NULL, 1) == 0);
	patch_unref(patch);
}

static void measure(struct bed *bed, const uint8_t *data, size_t n)
{
	static struct profile profile;

	profile.n = (uint16_t)n;
	profile.t_ns = bed->now_ns;
	profile.step_rad = 0.01;
	for (size_t i = 0; i < n; i++)
		profile.range_m[i] = data[i];
	live_profile(bed->live, 0, &profile);
	live_pose(bed->live, &(struct pose){.t_ns = bed->now_ns, .rotation = {1, 0, 0, 0}});
}

static void replay(struct bed *bed, const uint8_t *data, size_t size)
{
	while (size >= 2) {
		const size_t n = data[1] < size - 2 ? data[1] : size - 2;
		const uint8_t *bytes = data + 2;
		char line[256];

		if (data[0] % KINDS == TEXT || data[0] % KINDS == BINARY) {
			buffer_append(&bed->heard, bytes, n);
			foxglove_hear(bed->client, bed->heard.data, bed->heard.len, data[0] % KINDS == TEXT);
			bed->heard.len = 0;
		} else if (data[0] % KINDS == LONG_TEXT) { /* goes on in the next record */
			buffer_append(&bed->heard, bytes, n);
		} else if (data[0] % KINDS == READ && n >= 2) {
			read_pieces(bed, bytes[0], bytes[1]);
		} else if (data[0] % KINDS == PATCH && n >= 2) {
			publish(bed, bytes[0], bytes[1]);
		} else if (data[0] % KINDS == MEASURE) {
			measure(bed, bytes, n);
		} else if (data[0] % KINDS == LINE) {
			memcpy(line, bytes, n);
			line[n] = 0;
			live_log(bed->live, bed->now_ns, LOG_INFO, line);
		} else if (data[0] % KINDS == RESET) {
			publisher_reset(bed->publisher);
			live_reset(bed->live);
		}
		data += 2 + n;
		size -= 2 + n;
	}
}

static const struct config *configuration(void)
{
	static const char yaml[] = "devices: [{name: laser, driver: lms2xx, port: /dev/null}]";
	static struct config config;
	static bool read;
	struct config_error error;

	if (!read)
		must(config_read(yaml, sizeof(yaml) - 1, "fuzz", &config, &error) == 0);
	read = true;
	return &config;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	struct bed bed = {.now_ns = 1000000000, .playback = {.speed = 1, .end_ns = 5}};
	struct publisher_params params = {.cell_m = cell_m, .pinned_max = 4096};
	struct foxglove_host host = {.ctx = &bed, .now = now, .time = now, .status = status};
	const struct foxglove_wire wire = {&bed, wake};
	struct foxglove_client_stats stats;

	if (size == 0)
		return 0;
	if (data[0] & 1) {
		host.playback = playback;
		host.play = play;
	}
	foxglove_encoders(&params, &cell_m);
	bed.publisher = publisher_create(&params);
	bed.live = live_create(configuration());
	bed.foxglove = foxglove_create(bed.publisher, bed.live, &host);
	bed.client =
	    foxglove_join(bed.foxglove, data[0] & 4 ? SCENE_AS_PROTOBUF : SCENE_AS_JSON, data[0] & 2, &wire, 0);
	replay(&bed, data + 1, size - 1);
	foxglove_client_stats(bed.client, &stats);
	must(stats.bytes <= 256 << 10);
	foxglove_leave(bed.client);
	foxglove_destroy(bed.foxglove);
	live_destroy(bed.live);
	publisher_destroy(bed.publisher);
	buffer_finish(&bed.heard);
	buffer_finish(&bed.message);
	return 0;
}
