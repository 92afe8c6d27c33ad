/* The line of a simulated device: a queue of pieces, each with the time at which it may leave.
 *
 *   telegram -> [lost? wrong? twice? late?] -> piece | piece | ... -> take(t): as much of the first one as is due
 *
 * A serial line gives a piece byte by byte, at its pace; deadlines come a millisecond apart, as a UART behind USB hands
 * bytes over. A packet line gives a piece at once. Garbage fills the time it lasts: as many bytes as the pace allows, and
 * 8 MB/s where there is none; more than that only measures the reader's machine. */
#include "tools/sim_line.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>

#define GARBAGE_BYTE_NS 125.0
#define CHUNK_NS        1000000
#define SEGMENT_NS      300000 /* between the segments of a telegram, as measured */
#define MS              1000000
#define HELD            INT64_MAX

int sim_line_init(struct sim_line *line, size_t cap, uint64_t seed)
{
	memset(line, 0, sizeof *line);
	line->bytes = malloc(cap);
	line->cap = cap;
	line->random = sim_mix(seed);
	return line->bytes != NULL ? 0 : -ENOMEM;
}

void sim_line_finish(struct sim_line *line)
{
	free(line->bytes);
	line->bytes = NULL;
}

static struct sim_piece *piece_at(struct sim_line *line, unsigned i)
{
	return &line->piece[(line->first + i) % SIM_LINE_PIECES];
}

void sim_line_clear(struct sim_line *line)
{
	for (unsigned i = 0; i < line->pieces; i++)
		line->counts.dropped += piece_at(line, i)->last && piece_at(line, i)->profile;
	line->begin = line->end = 0;
	line->pieces = 0;
	line->end_ns = 0;
	line->merged = 0;
}

bool sim_line_idle(const struct sim_line *line)
{
	return line->pieces == 0;
}

/* Does this fault befall this telegram? Shares are drawn; single ones wait for a profile. */
static bool befalls(struct sim_line *line, enum sim_line_fault kind, bool profile)
{
	struct sim_fault_state *fault = &line->fault[kind];
	const double share = kind == SIM_GAP ? 1.0 : sim_fault_value(fault, 1.0);
	if (fault->on)
		return sim_random(&line->random) < share;
	return profile && sim_fault_due(fault);
}

static void add_piece(struct sim_line *line, const uint8_t *bytes, size_t len, int64_t from_ns)
{
	if (line->end + len > line->cap) {
		memmove(line->bytes, line->bytes + line->begin, line->end - line->begin);
		line->end -= line->begin;
		line->begin = 0;
	}
	memcpy(line->bytes + line->end, bytes, len);
	line->end += len;
	const int64_t begin_ns = line->end_ns > from_ns ? line->end_ns : from_ns;
	line->end_ns = begin_ns + (int64_t)((double)len * line->byte_ns);
	*piece_at(line, line->pieces++) = (struct sim_piece){.len = len, .begin_ns = begin_ns, .end_ns = line->end_ns};
}

/* Where a telegram is cut, 0: nowhere. Of 766 telegrams of 3,374 bytes on TCP 728 were cut after one segment (the rest came
 * in one), 13 after two, 25 not at all. */
static size_t cut_at(struct sim_line *line, size_t len)
{
	if (line->segment == 0 || len <= line->segment)
		return 0;
	const double drawn = sim_random(&line->random) * 766;
	if (drawn < 25)
		return 0;
	return drawn < 38 && len > 2 * line->segment ? 2 * line->segment : line->segment;
}

/* The telegram in its pieces: one, or two with a pause between them. */
static bool add(struct sim_line *line, const uint8_t *bytes, size_t len, int64_t from_ns, bool profile, bool bad)
{
	const bool gap = befalls(line, SIM_GAP, profile);
	const size_t cut = gap ? len / 2 : cut_at(line, len);
	const int64_t pause_ns = gap ? (int64_t)(sim_fault_value(&line->fault[SIM_GAP], 14.0) * MS) : SEGMENT_NS;
	if (line->pieces + 2 > SIM_LINE_PIECES || line->end - line->begin + len > line->cap)
		return false;
	if (cut > 0) {
		add_piece(line, bytes, cut, from_ns);
		from_ns = line->end_ns + pause_ns;
	}
	add_piece(line, bytes + cut, len - cut, from_ns);
	struct sim_piece *last = piece_at(line, line->pieces - 1);
	last->last = true;
	last->profile = profile;
	last->bad = bad;
	return true;
}

static void release(struct sim_line *line, int64_t t_ns)
{
	for (unsigned i = 0; i < line->pieces; i++) {
		struct sim_piece *piece = piece_at(line, i);
		if (piece->end_ns != HELD)
			continue;
		piece->begin_ns = piece->end_ns = t_ns;
		piece->joined = i + 1 < line->pieces;
	}
	line->merged = 0;
}

/* Telegrams that wait for each other leave when the last of them does, as one transfer. */
static void merge(struct sim_line *line, int64_t t_ns)
{
	struct sim_fault_state *fault = &line->fault[SIM_MERGE];
	struct sim_piece *last = piece_at(line, line->pieces - 1);
	if (!fault->on && fault->owed == 0)
		return;
	last->begin_ns = last->end_ns = HELD;
	if (++line->merged < (int)sim_fault_value(fault, 2.0))
		return;
	sim_fault_due(fault);
	release(line, t_ns);
}

static int64_t delayed(struct sim_line *line, int64_t from_ns)
{
	const struct sim_fault_state *fault = &line->fault[SIM_JITTER];
	if (!fault->on)
		return from_ns;
	return from_ns + (int64_t)(sim_random(&line->random) * sim_fault_value(fault, 5.0) * MS);
}

static void spoil_byte(struct sim_line *line, uint8_t *byte)
{
	if (line->text)
		*byte = 0x01;
	else
		*byte ^= (uint8_t)(1 + (int)(sim_random(&line->random) * 255));
}

bool sim_line_put(struct sim_line *line, const uint8_t *telegram, size_t len, int64_t from_ns, bool profile)
{
	uint8_t wrong[65536 + 16];
	const bool gone =
	    line->fault[SIM_SILENCE].on || line->fault[SIM_GARBAGE].on || befalls(line, SIM_LOST, profile);
	if (gone || len > sizeof wrong) {
		line->counts.dropped += profile;
		return false;
	}
	const bool corrupt = befalls(line, SIM_CORRUPT, profile), crc = befalls(line, SIM_CRC, profile);
	if (corrupt || crc) {
		memcpy(wrong, telegram, len);
		spoil_byte(line, &wrong[crc ? len - 1 : (size_t)(sim_random(&line->random) * (double)len)]);
		telegram = wrong;
	}
	from_ns = delayed(line, from_ns);
	bool fits = add(line, telegram, len, from_ns, profile, corrupt || crc);
	if (fits && profile)
		merge(line, from_ns);
	if (fits && befalls(line, SIM_DUPLICATE, profile))
		add(line, telegram, len, from_ns, false, false);
	line->counts.dropped += profile && !fits;
	return fits;
}

/* Of the first piece, how much has left by t_ns. */
static size_t due(const struct sim_piece *piece, int64_t t_ns)
{
	if (t_ns >= piece->end_ns)
		return piece->len;
	if (t_ns <= piece->begin_ns)
		return 0;
	return (size_t)((double)piece->len * (double)(t_ns - piece->begin_ns) /
	                (double)(piece->end_ns - piece->begin_ns));
}

static size_t take_garbage(struct sim_line *line, uint8_t *buf, size_t cap, int64_t t_ns)
{
	const double byte_ns = line->byte_ns > 0 ? line->byte_ns : GARBAGE_BYTE_NS;
	const double waiting = (double)(t_ns - line->garbage_ns) / byte_ns;
	const size_t n = waiting < (double)cap ? (size_t)waiting : cap;
	for (size_t i = 0; i < n; i++)
		buf[i] = (uint8_t)(sim_random(&line->random) * 256);
	/* What could not be taken in time was overrun. */
	line->garbage_ns = n == cap ? t_ns : line->garbage_ns + (int64_t)((double)n * byte_ns);
	line->counts.garbage += n;
	return n;
}

static void count_end(struct sim_line *line, const struct sim_piece *piece)
{
	if (!piece->last || !piece->profile)
		return;
	if (piece->bad)
		line->counts.corrupted++;
	else
		line->counts.sent++;
}

/* The first piece has left. */
static void remove_piece(struct sim_line *line)
{
	const struct sim_piece *piece = piece_at(line, 0);
	if (!piece->last && line->pieces > 1)
		piece_at(line, 1)->bad |= piece->bad;
	count_end(line, piece);
	line->first = (line->first + 1) % SIM_LINE_PIECES;
	if (--line->pieces == 0)
		line->begin = line->end = 0;
}

size_t sim_line_take(struct sim_line *line, uint8_t *buf, size_t cap, int64_t t_ns, bool spoil)
{
	size_t taken = 0;
	bool joined = true;
	if (line->fault[SIM_GARBAGE].on)
		return take_garbage(line, buf, cap, t_ns);
	if (line->fault[SIM_STALL].on)
		return 0;
	if (line->fault[SIM_SPLIT].on && cap > 1)
		cap = 1;
	while (joined && line->pieces > 0 && taken < cap) {
		struct sim_piece *piece = piece_at(line, 0);
		const size_t left = due(piece, t_ns) - piece->sent, n = left < cap - taken ? left : cap - taken;
		memcpy(buf + taken, line->bytes + line->begin, n);
		piece->bad |= spoil && n > 0;
		piece->sent += n;
		line->begin += n;
		taken += n;
		joined = piece->joined && piece->sent == piece->len;
		if (piece->sent == piece->len)
			remove_piece(line);
	}
	return taken;
}

int64_t sim_line_deadline(const struct sim_line *line, int64_t t_ns)
{
	if (line->fault[SIM_GARBAGE].on)
		return t_ns + CHUNK_NS;
	if (line->pieces == 0 || line->fault[SIM_STALL].on)
		return INT64_MAX;
	const struct sim_piece *piece = &line->piece[line->first];
	if (piece->end_ns == HELD)
		return INT64_MAX;
	if (due(piece, t_ns) > piece->sent)
		return t_ns;
	const int64_t from_ns = piece->begin_ns > t_ns ? piece->begin_ns : t_ns;
	const int64_t chunk_ns = from_ns + CHUNK_NS + (int64_t)line->byte_ns;
	return piece->end_ns < chunk_ns ? piece->end_ns : chunk_ns;
}

bool sim_line_order(struct sim_line *line, const struct sim_fault *fault, bool on, int64_t t_ns)
{
	static const char *const kinds[] = {SIM_LINE_KINDS, NULL};
	const int i = sim_fault_index(kinds, fault->kind);
	if (i < 0)
		return false;
	sim_fault_set(&line->fault[i], fault, on);
	if (!on && i == SIM_MERGE)
		release(line, t_ns);
	if (on && i == SIM_GARBAGE) {
		sim_line_clear(line);
		line->garbage_ns = t_ns;
	}
	if (on && i == SIM_SILENCE)
		sim_line_clear(line);
	return true;
}
