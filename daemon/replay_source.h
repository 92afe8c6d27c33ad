/* What a kind of file must do to be replayed: one table of functions each (daemon/replay.h). Sentences of errors come without
 * the file's name. */
#ifndef FACET_DAEMON_REPLAY_SOURCE_H
#define FACET_DAEMON_REPLAY_SOURCE_H

#include "daemon/replay.h"

#define REPLAY_SENTENCE_MAX 200

struct replay_file {
	const char *path;
	const uint8_t *data; /* mapped: stays while the source is open */
	size_t len;
};

struct replay_source;

struct replay_format {
	const char *name;
	/* Which is how its events are put in order with those of other files: */
	enum {
		REPLAY_CHAINED,  /* it knows all of its time: one file after the other */
		REPLAY_TIMELESS, /* as above, but its times count from 0: REPLAY_SCAN_NS is a file's share */
		REPLAY_MERGED    /* it knows a part of what happened: merged by time, ticks are made up */
	} order;
	bool (*is)(const struct replay_file *);
	/* 0 or -errno with a sentence. */
	int (*open)(const struct replay_file *, struct replay_source **ret, char error[REPLAY_SENTENCE_MAX]);
	void (*close)(struct replay_source *);
	const char *(*config)(const struct replay_source *, size_t *ret_len);                       /* may be NULL */
	int (*use)(struct replay_source *, const struct config *, char error[REPLAY_SENTENCE_MAX]); /* may be NULL */
	/* Log times of the first and last event, after `use` where it is MERGED. False: nothing is in it. */
	bool (*span)(struct replay_source *, int64_t *ret_first_ns, int64_t *ret_last_ns);
	/* 1, 0 at the end, -errno with a sentence. What it points to is good until the next call. */
	int (*next)(struct replay_source *, struct replay_event *ret, char error[REPLAY_SENTENCE_MAX]);
	void (*rewind)(struct replay_source *);
	void (*note)(const struct replay_source *, char ret[REPLAY_SENTENCE_MAX]); /* may be NULL */
};

/* The line at `*at` of a text without its end, and `*at` behind it; false at the end. Lines beyond 1 MB are cut. */
bool replay_line(const struct replay_file *, size_t *at, const char **ret_line, size_t *ret_len);
/* The device that takes poses as JSON datagrams; -1: none. */
int replay_pose_device(const struct config *);

#define REPLAY_SCAN_NS 30000000000ll

extern const struct replay_format replay_recording, replay_journal, replay_scan, replay_candump, replay_capture,
    replay_carmen, replay_poses;

#endif
