/* The native protocol's bytes: framed little-endian messages (interfaces, section 4; docs/protocol.md).
 * Pure encoders and decoders, shared by the daemon and its clients. */
#ifndef FACET_CORE_NATIVE_H
#define FACET_CORE_NATIVE_H

#include <sys/types.h>

#include "core/model.h"
#include "core/patch.h"

#define NATIVE_MAJOR           1
#define NATIVE_MINOR           1 /* 1: CODED, and frames compressed with zstd, both on request */
#define NATIVE_PORT            7878
#define NATIVE_HEAD            8 /* u32 length of what follows, u8 type, u8 flags, u16 0 */
#define NATIVE_FROM_CLIENT_MAX (64u << 10)
#define NATIVE_TO_CLIENT_MAX   (16u << 20)

enum native_type {
	NATIVE_HELLO = 1,
	NATIVE_WANT,
	NATIVE_BEGIN,
	NATIVE_PATCH,
	NATIVE_REMOVE,
	NATIVE_PLANE,
	NATIVE_PLANE_GONE,
	NATIVE_COMMIT,
	NATIVE_ABORT,
	NATIVE_JSON,
	NATIVE_PING,
	NATIVE_CODED /* one or several patches in the compact form */
};

/* Flags of WANT: what a client wishes, and is ready to read. */
enum {
	NATIVE_WANT_PLANES = 1,
	NATIVE_WANT_CODED = 2, /* patches come as CODED */
	NATIVE_WANT_BOX = 4,
	NATIVE_WANT_RADIUS = 8,
	NATIVE_WANT_ZSTD = 16 /* any frame may come compressed */
};

struct native_hello {
	uint16_t major, minor;
	uint8_t map_id[16];
	uint32_t generation;
	double cell_m;
	uint64_t step;
	int64_t t_ns;
};

struct native_want {
	uint8_t flags; /* NATIVE_WANT_... */
	uint32_t bytes_per_s;
	float region[6];
};

struct native_begin {
	uint64_t step;
	uint32_t patches, removals;
	bool reset;
};

/* A plane of the map: n . p = distance. */
struct native_plane {
	uint32_t id;
	float normal[3]; /* unit length */
	double distance_m;
	uint8_t class;
	float area_m2;
	float covariance[6]; /* upper triangle */
	int64_t t_ns;        /* of its last change */
};

/* One decoded message. Pointers in `patch` belong to the message: native_message_finish. */
struct native_message {
	enum native_type type;
	union {
		struct native_hello hello;
		struct native_want want;
		struct native_begin begin;
		struct patch *patch; /* PATCH: reference 1 */
		struct patch_key remove;
		uint64_t step; /* COMMIT, ABORT */
		struct native_plane plane;
		uint32_t plane_gone;
		struct {
			const char *text;
			size_t len;
		} json; /* borrowed from the bytes */
		struct {
			const uint8_t *bytes;
			size_t len;
		} coded; /* patches one after another, whole (core/coded.h), borrowed from the bytes */
	};
};

/* Each appends one whole frame. */
void native_put_hello(struct buffer *, const struct native_hello *);
void native_put_want(struct buffer *, const struct native_want *); /* pads: no length whose low byte is 0x3F or 0x7B */
void native_put_begin(struct buffer *, const struct native_begin *);
void native_put_patch(struct buffer *, const struct patch *);
void native_put_coded(struct buffer *, const uint8_t *patches, size_t len); /* as coded_put_patch made them, in a row */
void native_put_coded_head(struct buffer *, size_t len); /* of the same: `len` bytes of patches are to follow */
void native_put_remove(struct buffer *, struct patch_key);
void native_put_plane(struct buffer *, const struct native_plane *);
void native_put_plane_gone(struct buffer *, uint32_t id);
void native_put_step(struct buffer *, enum native_type commit_or_abort, uint64_t step);
void native_put_json(struct buffer *, const char *text, size_t len);
void native_put_ping(struct buffer *);

/* Bytes of the first whole frame, 0: more is needed, -EPROTO: no frame can begin so (length beyond `max`, reserved bytes). */
ssize_t native_scan(const uint8_t *data, size_t len, size_t max);

/* Appends the frame compressed, or as it is where that is not smaller. Level 1 of zstd: the bytes are a function of the
 * frame and of the library's version. 0 or -ENOMEM (also in the buffer). */
struct native_packer;
struct native_packer *native_packer_create(void); /* NULL: memory is out. About 300 KB that every frame uses again */
void native_packer_destroy(struct native_packer *);
int native_put_packed(struct native_packer *, struct buffer *, const uint8_t *frame, size_t len);

static inline bool native_is_packed(const uint8_t *frame)
{
	return frame[5] & 1;
}

/* Appends the plain frame of a compressed one. -EPROTO with a sentence where it is not valid, or would be longer than `max`
 * (judged before anything is decompressed); -ENOMEM. Only for those who asked for compressed frames. */
int native_unpack(const uint8_t *frame, size_t len, size_t max, struct buffer *ret, char error[128]);

/* Decodes one whole plain frame; -EPROTO with a sentence where it is not valid (every count judged before use); -ENOTSUP for
 * a type this version does not know (skip it). */
int native_decode(const uint8_t *frame, size_t len, struct native_message *ret, char error[128]);
void native_message_finish(struct native_message *);

/* What a client holds: patches as of its last COMMIT, changed by whole batches only. */
struct native_mirror;
struct native_mirror *native_mirror_create(void);
void native_mirror_destroy(struct native_mirror *);
/* 0; 1 when the message was a COMMIT (the mirror changed); -EPROTO with a sentence. Takes the message's patch over. */
int native_mirror_apply(struct native_mirror *, struct native_message *, char error[128]);
const struct patch_store *native_mirror_patches(const struct native_mirror *);
const struct native_hello *native_mirror_hello(const struct native_mirror *); /* NULL before HELLO */
uint64_t native_mirror_step(const struct native_mirror *);

/* What the last COMMIT brought: patches, and the keys of those that are gone (as tombstones). Borrowed until the next one. */
struct patch *const *native_mirror_changed(const struct native_mirror *, size_t *ret_n);
struct patch *const *native_mirror_removed(const struct native_mirror *, size_t *ret_n);
bool native_mirror_was_reset(const struct native_mirror *); /* ... and everything else is gone */
/* The connection broke: half a batch is forgotten, the map stays until another HELLO and a batch with `reset`. */
void native_mirror_lost(struct native_mirror *);

#endif
