/* libfacet: the map of a running facetd in a program of your own, in C or C++. pkg-config calls it `libfacet`.
 *
 *   struct facet *facet = facet_open(NULL, 5000, error);      $FACETD, the user's socket, the system's
 *   facet_want(facet, NULL);                                  all of the map, as it is and as it changes
 *   while (facet_follow(facet, -1, &event) > 0)
 *           if (event.kind == FACET_COMMIT)
 *                   for (size_t i = 0; i < event.changed; i++)
 *                           use(facet_changed(facet, i));
 *
 * Shapes. The map is made of patches: cubes of 16 cells a side, named by three integers, each with one mesh. A vertex is a
 * point of the lattice of 1/256 cell: three integers 0 .. 4096 within its patch; equal points of neighbouring patches are
 * equal integers, so that patches may be welded without a tolerance. Triangles are counter-clockwise seen from the free
 * side, and lie in runs of one plane and class.
 *
 * Time and truth. What facet_patches, facet_patch_at and facet_changed tell is the map of one step (rows applied by the
 * daemon), whole; it changes only when facet_next, facet_wait or facet_follow answers with FACET_COMMIT.
 *
 * Units: metres, map frame (x forward, y left, z up); nanoseconds since 1970.
 *
 * Ownership. Patches are immutable. They are lent until the next call of facet_next, facet_wait, facet_follow or
 * facet_close; facet_patch_ref keeps one beyond that, in any thread. All else that is lent ends with the next call too.
 *
 * Errors are negative errno values; facet_error is the sentence about the last one. After an error of a connection nothing
 * more is read from it: facet_reopen begins a new one, and the map that is held stays until the new one has come.
 *
 * A struct facet belongs to one thread at a time. The library prints nothing, sets no handlers and raises no SIGPIPE. */
#ifndef FACET_H
#define FACET_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#if defined(__GNUC__)
#define FACET_API __attribute__((visibility("default")))
#else
#define FACET_API
#endif

#define FACET_ERROR_MAX  320 /* bytes of a sentence, with the NUL */
#define FACET_NO_PLANE   0xffffffffu
#define FACET_SIDE_CELLS 16
#define FACET_LATTICE    256 /* steps a cell */

struct facet;
struct facet_patch;

/* Connections --------------------------------------------------------------------------------------------------------- */

/* `address`: unix:PATH, tcp:HOST:PORT or ws://HOST:PORT/ (with ?token=TOKEN where one is needed); NULL or empty: the default one. Waits at most `timeout_ms`. NULL with one sentence
 * in `error` (may be NULL). */
FACET_API struct facet *facet_open(const char *address, int timeout_ms, char error[FACET_ERROR_MAX]);
FACET_API void facet_close(struct facet *); /* NULL is fine */

/* To the same address, with the same wishes. 0 or -errno; may be tried again. */
FACET_API int facet_reopen(struct facet *, int timeout_ms);

FACET_API const char *facet_address(const struct facet *);
FACET_API const char *facet_error(const struct facet *); /* "" where there was none */

enum {
	FACET_WANT_BOX = 1,    /* only patches that reach into the box */
	FACET_WANT_RADIUS = 2, /* only those about the robot */
	FACET_WANT_CODED =
	    4, /* few bytes a triangle, a little more work on both sides; the default beyond a unix socket */
	FACET_WANT_PLAIN = 8 /* not so */
};

struct facet_want {
	uint32_t flags;       /* FACET_WANT_... */
	uint32_t bytes_per_s; /* at most; 0: all */
	float box[6];         /* min x y z, max x y z, m */
	float radius_m;
};

/* Asks for the map (NULL: all of it). Again on the same connection: for something else from now on. 0 or -errno. */
FACET_API int facet_want(struct facet *, const struct facet_want *);

/* One line of JSON or a command ("?STATUS", docs/protocol.md); the answer is an event. On a connection that asked for no
 * map it is sent at once, and makes it one that speaks JSON lines only. 0 or -errno. */
FACET_API int facet_say(struct facet *, const char *line);

/* Events -------------------------------------------------------------------------------------------------------------- */

enum facet_kind {
	FACET_HELLO =
	    1, /* a map: facet_map; a new one when its generation changed. What was held stays until the next commit */
	FACET_COMMIT, /* the map is that of another step: facet_changed, facet_removed */
	FACET_JSON,   /* an answer, a STATUS, an event of the daemon: `text` */
	FACET_LOST    /* facet_follow only: the connection is gone, facet_error says why; it will be tried again */
};

struct facet_event {
	enum facet_kind kind;
	uint64_t step;           /* COMMIT */
	int reset;               /* COMMIT: all patches that are not among the changed ones are gone */
	size_t changed, removed; /* COMMIT */
	const char *text;        /* JSON: ended by a NUL */
	size_t len;              /* of the text */
};

/* For poll: the descriptor, and what to wait for (POLLIN, POLLOUT). They change with facet_reopen and facet_follow. */
FACET_API int facet_fd(const struct facet *);
FACET_API short facet_poll_events(const struct facet *);

/* Never waits. 1: an event; call again, there may be more. 0: nothing more now. -errno. */
FACET_API int facet_next(struct facet *, struct facet_event *ret);

/* The same, and waits for one: 0 when `timeout_ms` is over (-1: never). */
FACET_API int facet_wait(struct facet *, int timeout_ms, struct facet_event *ret);

/* The same, and when the connection is lost it says so (FACET_LOST) and is tried again every second. */
FACET_API int facet_follow(struct facet *, int timeout_ms, struct facet_event *ret);

/* The map ------------------------------------------------------------------------------------------------------------- */

struct facet_map {
	uint8_t id[16];      /* random, born with the map */
	uint32_t generation; /* one more at every start and reset */
	double cell_m;
	uint64_t step; /* last committed */
};

/* 0, or -EAGAIN before the first HELLO. */
FACET_API int facet_map(const struct facet *, struct facet_map *ret);

/* Of the last COMMIT. */
FACET_API const struct facet_patch *facet_changed(const struct facet *, size_t i);
FACET_API void facet_removed(const struct facet *, size_t i, int32_t ret_key[3]);

/* All patches, in the order of their keys. Lent, as they are. -ENOMEM. */
FACET_API int facet_patches(struct facet *, const struct facet_patch *const **ret, size_t *ret_n);
FACET_API const struct facet_patch *facet_patch_at(const struct facet *, const int32_t key[3]); /* NULL: none */

/* SHA-256 of what is held, as `facet reconstruct --stats` prints it: 64 digits and a NUL. 0 or -ENOMEM. */
FACET_API int facet_hash(const struct facet *, char ret[65]);

/* Patches ------------------------------------------------------------------------------------------------------------- */

FACET_API const struct facet_patch *facet_patch_ref(const struct facet_patch *);
FACET_API void facet_patch_unref(const struct facet_patch *); /* NULL is fine */

struct facet_patch_info {
	int32_t key[3];
	uint64_t version; /* the step that made it */
	int64_t t_first_ns, t_last_ns;
	uint32_t vertices, triangles, runs;
};
FACET_API void facet_patch_info(const struct facet_patch *, struct facet_patch_info *ret);

FACET_API const uint16_t *facet_patch_lattice(const struct facet_patch *);   /* x y z of every vertex */
FACET_API const uint32_t *facet_patch_triangles(const struct facet_patch *); /* three vertices each */

/* x y z of every vertex, m; room for 3 * vertices. */
FACET_API void facet_patch_vertices(const struct facet_patch *, double cell_m, double *ret);

struct facet_run {
	uint32_t first, triangles; /* from this triangle on, so many */
	uint32_t plane;            /* FACET_NO_PLANE: in none; else a number within the patch */
	uint8_t class_; /* 0 unknown, 1 floor, 2 ceiling, 3 wall, 4 door, 5 window, 6 ramp, 7 stair, 8 table */
};
FACET_API void facet_patch_runs(const struct facet_patch *, struct facet_run *ret); /* room for `runs` */

#ifdef __cplusplus
}
#endif

#endif
