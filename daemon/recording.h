/* A recording: what the loop handed to the pipeline (law L7, daemon/journal.h) as messages of an MCAP file, and back. Pure: bytes
 * in memory on both sides; files, limits and threads are recorder.c's. docs/recording.md says what is in a file.
 *
 *   topic             encoding            what
 *   /raw/NAME/in      facetd.bytes.v1     i64 t_read_ns, u8 flags (1: the link was opened, no bytes), bytes
 *   /raw/NAME/out     facetd.bytes.v1     ... that were written to the device
 *   /raw/NAME         facetd.can.v1       frames of a CAN device as in drivers/can_wire.h; sent: /raw/NAME/out
 *   /raw/NAME         facetd.modbus.v1    transactions as in drivers/modbus_wire.h; wishes: /raw/NAME/out
 *   /pose             json                datagrams of poses as they came (of a second such device: /pose/NAME)
 *   /control          json                commands of clients that change something, as they came
 *   /event            json                {"class": "BEGIN" | "ROW" | "CLOCK" | "DEVICE" | "MAP" | ... | "END"}
 *   /tick             facetd.tick.v1      empty: 10 times a second of log time
 *   /state/pipeline   facetd.state.v1     pipeline_state; its BEGIN follows, with the map's id
 *
 * Whatever a device's record is, `log_time` is its log_ns and `publish_time` its t_ns, and the message gives back the record byte for byte:
 * what does not fit a channel's encoding (a link that was opened, a datagram that is no JSON) goes to /raw/NAME/in as bytes.
 * The order of messages is the order of handling. A record, tick or step of the clock and the ROW events that it led to are
 * always in one chunk, so a file that was cut never ends between them. */
#ifndef FACET_DAEMON_RECORDING_H
#define FACET_DAEMON_RECORDING_H

#include "config/config.h"
#include "core/mcap.h"
#include "daemon/foxglove_schema.h"
#include "drivers/driver.h"

/* Where a list begins: at the birth of a map, or in the middle of one. */
struct recording_begin {
	int64_t log_ns;
	uint8_t map_id[16];
	uint32_t generation;
	bool whole;       /* the map was empty: the file has all of its rows. False: it began earlier */
	uint64_t session; /* of the one who records: random */
	uint32_t
	    part; /* counted from 0 within the session. part N + 1 goes on exactly where part N ended, if that one has an END */
	const void *snapshot; /* pipeline_state, for pipeline_state; borrowed */
	size_t len;
};

/* Writing */

struct recording_params {
	const struct config *config; /* borrowed: names and drivers of devices */
	const char *config_text;     /* attached as facetd.yaml; secrets are removed already */
	const char *version;
	int level; /* of zstd */
};

struct recording_writer;

/* Appends to `out`, as mcap_writer_create says. NULL when memory is out. `begin` as recording_put_begin. */
struct recording_writer *recording_writer_create(const struct recording_params *, const struct recording_begin *begin,
                                                 struct buffer *out);
void recording_writer_destroy(struct recording_writer *);
struct mcap_writer *recording_writer_mcap(struct recording_writer *); /* for channels of others: published messages */

/* In the order of handling. 0 or -errno. Log times earlier than the one before are taken as that one. */
int recording_put_begin(struct recording_writer *, const struct recording_begin *); /* another map in the same file */
int recording_put_record(struct recording_writer *, const struct record *);
int recording_put_tick(struct recording_writer *, int64_t log_ns);
int recording_put_skip(struct recording_writer *, uint64_t number, const char *reason); /* the row was not applied */
int recording_put_clock(struct recording_writer *, int64_t ahead_ns);
int recording_put_event(struct recording_writer *, const char *json, size_t len);
int recording_put_control(struct recording_writer *, const char *json, size_t len);
/* What was published, for others (record.messages); readers of ours pass it over. */
int recording_put_message(struct recording_writer *, enum foxglove_schema, const void *data, size_t len);
/* An orderly end, with its reason ("ended", "rotated", ...), the summary and the footer. */
int recording_end(struct recording_writer *, const char *reason);

/* Reading */

enum recording_kind {
	RECORDING_BEGIN, /* a list begins: the first event of a file, and again at each new map in it */
	RECORDING_SKIP, /* this row was not applied: comes BEFORE the record that completes it, as pipeline_skip wants it */
	RECORDING_RECORD,  /* pipeline_handle */
	RECORDING_TICK,    /* pipeline_tick */
	RECORDING_CLOCK,   /* pipeline_clock */
	RECORDING_CONTROL, /* a command, for people: what it did is in the other events */
	RECORDING_EVENT,   /* for people */
	RECORDING_END,     /* the recording was ended in order; a file without it was cut */
	RECORDING_DAMAGED /* a part of the file cannot be read: what follows does not join what came before; go on from the
	                      next BEGIN, or with what a decoder makes of a gap */
};

struct recording_event {
	enum recording_kind kind;
	int64_t log_ns;  /* never decreases within a file; a file where it would is damaged */
	uint64_t offset; /* in the file: of its chunk */
	union {
		struct recording_begin begin;
		uint64_t skip;        /* number */
		struct record record; /* .device: -1 where the configuration has no such device: `device` names it */
		int64_t ahead_ns;     /* CLOCK */
		struct {
			const char *text; /* not ended by a 0 */
			size_t len;
		} json; /* CONTROL, EVENT, END (`reason`) */
		const char *damage;
	};
	const char *device; /* RECORD: its name, ended by a 0 */
};

struct recording_reader;

/* 0, -EINVAL with a sentence (no MCAP, or no recording of facetd), -ENOMEM. `data` is borrowed: a mapped file. */
int recording_reader_create(const uint8_t *data, size_t len, struct recording_reader **ret, char error[160]);
void recording_reader_destroy(struct recording_reader *);

/* The attached configuration, as the recording's beginning has it; NULL: none (the beginning is damaged). */
const char *recording_reader_config(const struct recording_reader *, size_t *ret_len);
/* record.device is an index into this configuration from here on (borrowed). */
void recording_reader_use(struct recording_reader *, const struct config *);

/* The next event; what it points to is good until the next call. 1; 0: the end; -ENOMEM. Damage is an event.
 * Memory is one chunk's: the reader looks ahead for skips within the chunk alone. */
int recording_reader_next(struct recording_reader *, struct recording_event *ret);
void recording_reader_rewind(struct recording_reader *);
/* First and last log time by the heads of the chunks, without decompressing; both 0 where there are none. */
void recording_reader_span(struct recording_reader *, int64_t *ret_first_ns, int64_t *ret_last_ns);
const struct mcap_reader *recording_reader_mcap(const struct recording_reader *);

#endif
