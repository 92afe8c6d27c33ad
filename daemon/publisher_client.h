/* What the parts of the publisher know of each other: publisher.c (clients and walks), whole_map.c, native_stream.c. */
#ifndef FACET_DAEMON_PUBLISHER_CLIENT_H
#define FACET_DAEMON_PUBLISHER_CLIENT_H

#include "daemon/batch.h"

#define STREAM_OUT_BYTES (16u << 10) /* gathered for one write */

/* The wire of a client of the native protocol. */
struct native_stream {
	uint32_t greeted;    /* the generation whose HELLO was sent; 0: none */
	struct buffer small; /* a small frame, or the head of one; it comes before `source` */
	size_t small_at;
	const uint8_t *source; /* of what a walk handed out */
	size_t source_left;
	struct buffer json;           /* messages that wait for their turn */
	uint32_t bytes_per_s;         /* 0: all */
	int64_t next_ns;              /* not before then, by that rate */
	bool reason_sent, broken;     /* broken: no memory even for a small frame */
	size_t open_at;               /* in `out`: a frame of coded patches that takes more of them */
	struct native_packer *packer; /* of such frames, borrowed; NULL: they go as they are */
	size_t out_at, out_len;
	uint8_t out[STREAM_OUT_BYTES];
};

struct publisher_client {
	struct publisher *publisher;
	struct publisher_client *next;
	enum publisher_form form;
	bool whole; /* the next batch is the whole map */
	uint64_t committed, committed_step;
	struct interest held, wanted; /* region as of the last commit; of the next batch */
	enum { CLIENT_IDLE, CLIENT_WALKING, CLIENT_CANCELLED } state;
	struct batch batch; /* CLIENT_WALKING only */
	uint64_t batch_step;
	struct publisher_client *earlier, *later; /* CLIENT_WALKING: by when their batches began */
	int aborts_running;
	struct sheet *sent; /* the item handed out last, and its form unless NATIVE */
	struct form *sent_form;
	bool dismissed;
	char reason[160];
	struct publisher_client_stats stats;
	struct native_stream *stream; /* NULL: its owner has a wire of his own */
};

_Static_assert(sizeof(struct publisher_client) + sizeof(struct native_stream) +
                       BATCH_WINDOW * sizeof(struct batch_waiting) <=
                   PUBLISHER_CLIENT_MAX,
               "a client costs no more than is said");

struct publisher {
	struct publisher_params params;
	uint32_t generation;
	uint64_t step;
	struct patch_key robot; /* its patch */
	struct sheets sheets;
	struct batch_scratch scratch;
	struct publisher_client *clients;
	struct publisher_client *oldest, *latest; /* of those that walk: its batch began first, last */
	size_t clients_n, clients_peak_bytes;
	int snapshots;
	size_t snapshot_bytes;
};

/* Ends every batch; the clients hear of it. */
void publisher_abort_batches(struct publisher *);
/* What a walk handed out is no longer needed. */
void publisher_client_let_go(struct publisher_client *);
/* There is something to begin a batch for. */
bool publisher_client_has_news(const struct publisher_client *);

size_t native_stream_queued(const struct native_stream *);
struct native_stream *native_stream_create(void); /* NULL when memory is out */
void native_stream_destroy(struct native_stream *);
void native_stream_want(struct publisher_client *, const struct native_want *);

#endif
