/* Law: no bytes crash the reader of scan telegrams, and one that it reads says the same when it is written again in either
 * dialect.
 *
 * Input: a byte (bit 0: dialect, bit 1: LMDscandatamon), then what stands behind the name; and the same bytes as a
 * beginning of a frame. */
#include <stdlib.h>
#include <string.h>

#include "tests/cola_telegrams.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static void must(bool condition)
{
	if (!condition)
		abort();
}

static void compare_channels(const struct cola_scan *a, const struct cola_scan *b)
{
	static uint16_t values[2][65536];

	must(a->channels == b->channels);
	for (int i = 0; i < a->channels; i++) {
		const struct cola_channel *x = &a->channel[i], *y = &b->channel[i];
		must(memcmp(x->name, y->name, sizeof(x->name)) == 0 && x->scale == y->scale && x->offset == y->offset);
		must(x->start_tdeg == y->start_tdeg && x->step_tdeg == y->step_tdeg && x->n == y->n &&
		     x->bytes == y->bytes);
		cola_channel_values(x, values[0]);
		cola_channel_values(y, values[1]);
		must(memcmp(values[0], values[1], sizeof(values[0][0]) * x->n) == 0);
		must(cola_scan_channel(a, x->name) != NULL);
	}
}

static void compare_text(const char *a, size_t a_len, const char *b, size_t b_len)
{
	must((a != NULL) == (b != NULL) && a_len == b_len && (a_len == 0 || memcmp(a, b, a_len) == 0));
}

static void compare(const struct cola_scan *a, const struct cola_scan *b)
{
	struct cola_scan x = *a, y = *b;

	compare_channels(a, b);
	compare_text(a->name, a->name_len, b->name, b->name_len);
	compare_text(a->comment, a->comment_len, b->comment, b->comment_len);
	x.name = x.comment = y.name = y.comment = NULL;
	memset(x.channel, 0, sizeof(x.channel));
	memset(y.channel, 0, sizeof(y.channel));
	must(x.serial == y.serial && x.t_startup_us == y.t_startup_us && x.t_transmit_us == y.t_transmit_us);
	must(x.telegram_counter == y.telegram_counter && x.scan_counter == y.scan_counter && x.layer == y.layer);
	must(x.frequency_chz == y.frequency_chz && x.encoders == y.encoders && x.monitored == y.monitored);
	must(memcmp(x.encoder, y.encoder, sizeof(x.encoder)) == 0);
	must(memcmp(x.position, y.position, sizeof(x.position)) == 0 && x.position_type == y.position_type);
	must(memcmp(x.event, y.event, sizeof(x.event)) == 0 && x.event_angle == y.event_angle);
	must(x.year == y.year && x.microsecond == y.microsecond && x.event_us == y.event_us);
}

/* Into a buffer of every size it needs and does not have, too. */
static void write_again(const struct cola_scan *scan, enum cola_dialect dialect)
{
	static uint8_t frame[COLA_TELEGRAM_MAX];
	struct cola_scan again;
	const uint8_t *payload;
	size_t payload_len;
	const char *words = scan->monitored ? "sRA LMDscandatamon" : "sRA LMDscandata ";
	const size_t len = telegram_scan(dialect, words, scan, 0, 0, frame, sizeof(frame));

	if (len == 0)
		return; /* CoLa-A may be longer than the frame it came from, which was as long as is allowed */
	must(cola_payload(frame, len, &payload, &payload_len) == dialect);
	must(cola_reply_kind(dialect, payload, payload_len) ==
	     (dialect == COLA_B ? COLA_READ | COLA_B_FLAG : COLA_READ));
	must(cola_scan_read(dialect, payload, payload_len, &again) == 0);
	compare(scan, &again);
	const int framed = cola_scan_frame(NULL, frame, len, true);
	must(framed == (int)len || dialect == COLA_A); /* a name may hold anything, also the end of a frame */
	frame[len / 2] = 0;
	must(telegram_scan(dialect, words, scan, 0, 0, frame, len / 2) == 0 && frame[len / 2] == 0);
}

static void judge_beginnings(const uint8_t *data, size_t size)
{
	for (size_t len = 1; len <= size && len < 40; len++) {
		const int r = cola_scan_frame(NULL, data, len, true);
		must(r <= (int)len && r > -FRAMER_REASONS);
		if (r != 0)
			return;
	}
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	struct cola_scan scan;
	struct cola_writer w;

	if (size < 1 || size > COLA_TELEGRAM_MAX - 64)
		return 0;
	judge_beginnings(data, size);
	const enum cola_dialect dialect = (data[0] & 1) != 0 ? COLA_B : COLA_A;
	uint8_t *bytes = malloc(size + 40);
	cola_writer_init(&w, dialect, bytes, size + 40,
	                 (data[0] & 2) != 0 ? "sSN LMDscandatamon " : "sSN LMDscandata ");
	const size_t head = dialect == COLA_B ? 8 : 1;
	/* A copy of exactly the payload, so that reading beyond it is seen. */
	const size_t len = w.len - head + size - 1 - (dialect == COLA_A);
	uint8_t *payload = malloc(len + 1);
	memcpy(payload, bytes + head, w.len - head);
	memcpy(payload + w.len - head - (dialect == COLA_A), data + 1, size - 1);
	payload = realloc(payload, len > 0 ? len : 1);
	if (cola_scan_read(dialect, payload, len, &scan) == 0) {
		write_again(&scan, COLA_A);
		write_again(&scan, COLA_B);
	}
	must(cola_error_text(data[0]) != NULL);
	free(payload);
	free(bytes);
	return 0;
}
