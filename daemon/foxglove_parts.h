/* The parts of Foxglove's protocol among themselves: foxglove.c says, foxglove_heard.c hears and answers, foxglove_map.c
 * says the map. */
#ifndef FACET_DAEMON_FOXGLOVE_PARTS_H
#define FACET_DAEMON_FOXGLOVE_PARTS_H

#include <string.h>

#include "daemon/foxglove.h"

enum { OP_MESSAGE = 1, OP_TIME = 2, OP_ASSET = 4, OP_PLAYBACK = 5 };     /* to the client */
enum { OP_HEARD_MESSAGE = 1, OP_HEARD_CALL = 2, OP_HEARD_PLAYBACK = 3 }; /* from it */
enum { LEVEL_INFO, LEVEL_WARNING, LEVEL_ERROR };                         /* of status */
enum { CHANNEL_MAP, CHANNEL_TF, CHANNEL_POSE, CHANNEL_LOG, CHANNEL_STATUS, CHANNEL_SCANS };

#define CHANNELS_MAX   (CHANNEL_SCANS + CONFIG_DEVICES_MAX)
#define CHANNEL_ID(at) ((uint32_t)(at) + 1)
#define TOPIC_MAX      (CONFIG_NAME_MAX + 8)
#define ANSWER_HEAD    5            /* u32 length, u8 text */
#define RETRY_NS       1000000000ll /* after memory was out */

struct stream {
	bool subscribed;
	uint32_t subscription;
	uint64_t shown;  /* the sequence number of what was told last */
	int64_t next_ns; /* not before then */
};

/* The SceneUpdate that is being said. */
struct scene {
	struct publisher_client *walk; /* NULL: the map is not asked for */
	bool talking, ended, whole;    /* whole: the walk came to its end */
	bool dismissed;                /* unsubscribed meanwhile: the message ends, then the walk */
	bool reset, begun, first, entities;
	bool quiet; /* nothing was new when last asked */
	uint32_t subscription;
	const uint8_t *item; /* borrowed of the walk */
	size_t item_left;
	int64_t newest_ns; /* no entity that was sent is younger */
};

struct foxglove_client {
	struct foxglove *foxglove;
	struct foxglove_client *next;
	enum scene_encoding encoding;
	bool may_play;
	struct foxglove_wire wire;
	int64_t joined_ns, told_ns; /* told_ns: the deadline the wire knows of */
	bool greeted, advertised;
	struct stream stream[CHANNELS_MAX], time;
	unsigned turn;
	struct scene scene;
	struct buffer answers; /* messages, each behind ANSWER_HEAD bytes */
	size_t answers_at;
	struct buffer out; /* of the message that is being said */
	size_t out_at;
	bool out_text;
	struct player_status playback; /* as told */
	bool playback_told;
	uint64_t messages, dropped;
};

struct foxglove {
	struct publisher *publisher;
	struct live *live;
	struct foxglove_host host;
	struct foxglove_client *clients;
	int channels;
	int64_t begun_ns;
};

/* foxglove.c */
void foxglove_wake(struct foxglove_client *);
void foxglove_begin_message(struct foxglove_client *, uint32_t subscription, int64_t time_ns); /* into `out` */

/* foxglove_heard.c */
void foxglove_look_at_playback(struct foxglove_client *); /* tells what is new of it */

/* foxglove_map.c */
bool foxglove_map_begin(struct foxglove_client *); /* true: a message is begun */
size_t foxglove_map_next(struct foxglove_client *, uint8_t *buf, size_t cap, int64_t t_ns, bool *ret_final);
void foxglove_map_leave(struct foxglove_client *);

/* Bytes */

static inline void put_u8(struct buffer *b, uint8_t v)
{
	buffer_append(b, &v, 1);
}

static inline void put_u32(struct buffer *b, uint32_t v)
{
	buffer_append(b, &v, 4);
}

static inline void put_u64(struct buffer *b, uint64_t v)
{
	buffer_append(b, &v, 8);
}

static inline void put_text(struct buffer *b, const char *text)
{
	buffer_append(b, text, strlen(text));
}

static inline uint32_t get_u32(const uint8_t *at)
{
	uint32_t v;

	memcpy(&v, at, 4);
	return v;
}

/* Of text that is valid UTF-8. */
static inline void put_json_string(struct buffer *b, const char *text, size_t len)
{
	put_text(b, "\"");
	for (size_t i = 0; i < len; i++) {
		if (text[i] == '"' || text[i] == '\\')
			buffer_printf(b, "\\%c", text[i]);
		else if ((unsigned char)text[i] < ' ')
			buffer_printf(b, "\\u%04x", (unsigned)(unsigned char)text[i]);
		else
			buffer_append(b, text + i, 1);
	}
	put_text(b, "\"");
}

#endif
