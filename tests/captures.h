/* Captures of real devices as lists of chunks: what one read delivered, with its time. They stand beside the repository
 * and are not part of it. */
#ifndef FACET_TESTS_CAPTURES_H
#define FACET_TESTS_CAPTURES_H

#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define CAPTURES "../shared/data/captures/"

struct chunk {
	int64_t t_ns;
	bool to_device;
	uint8_t *bytes;
	size_t len;
};

struct capture {
	struct chunk *chunk;
	size_t n, cap;
	size_t from_device; /* bytes */
};

static inline void capture_add(struct capture *c, int64_t t_ns, bool to_device, const uint8_t *bytes, size_t len)
{
	if (c->n == c->cap) {
		c->cap = c->cap * 2 + 16;
		c->chunk = realloc(c->chunk, c->cap * sizeof(*c->chunk));
	}
	c->chunk[c->n] = (struct chunk){.t_ns = t_ns, .to_device = to_device, .bytes = malloc(len + 1), .len = len};
	memcpy(c->chunk[c->n++].bytes, bytes, len);
	c->from_device += to_device ? 0 : len;
}

static inline void capture_free(struct capture *c)
{
	for (size_t i = 0; i < c->n; i++)
		free(c->chunk[i].bytes);
	free(c->chunk);
	*c = (struct capture){0};
}

static inline uint8_t *capture_file(const char *name, size_t *ret_len)
{
	char path[256];
	snprintf(path, sizeof(path), CAPTURES "%s", name);
	FILE *file = fopen(path, "rb");
	if (file == NULL)
		return NULL;
	uint8_t *bytes = malloc(1 << 21);
	*ret_len = fread(bytes, 1, (1 << 21) - 1, file);
	bytes[*ret_len] = 0;
	fclose(file);
	return bytes;
}

/* "t_rel_s C>S|S>C hex", a telegram a line. */
static inline void capture_lines(struct capture *c, char *text)
{
	static uint8_t bytes[65536];

	for (char *line = strtok(text, "\n"); line != NULL; line = strtok(NULL, "\n")) {
		double t_s;
		char way[4];
		int at;
		size_t len = 0;
		unsigned byte;
		if (sscanf(line, "%lf %3s %n", &t_s, way, &at) < 2)
			continue;
		for (const char *hex = line + at; len < sizeof(bytes) && sscanf(hex, "%2x", &byte) == 1; hex += 2)
			bytes[len++] = (uint8_t)byte;
		capture_add(c, (int64_t)(t_s * 1e6 + 0.5) * 1000, way[0] == 'C', bytes, len);
	}
}

static inline uint32_t capture_le32(const uint8_t *at)
{
	return (uint32_t)at[0] | (uint32_t)at[1] << 8 | (uint32_t)at[2] << 16 | (uint32_t)at[3] << 24;
}

/* One Ethernet frame: what a TCP segment from or to port 2112 carries. */
static inline void capture_segment(struct capture *c, int64_t t_ns, const uint8_t *frame, size_t len)
{
	if (len < 54 || frame[12] != 8 || frame[13] != 0 || frame[23] != 6)
		return;
	const uint8_t *ip = frame + 14, *tcp = ip + (ip[0] & 15) * 4;
	const uint8_t *data = tcp + (tcp[12] >> 4) * 4, *end = ip + (ip[2] << 8 | ip[3]);
	if (data < end && end <= frame + len)
		capture_add(c, t_ns, (tcp[0] << 8 | tcp[1]) != 2112, data, (size_t)(end - data));
}

/* pcapng, little-endian, nanoseconds: enhanced packet blocks. */
static inline void capture_packets(struct capture *c, const uint8_t *bytes, size_t len)
{
	for (size_t at = 0; at + 32 <= len;) {
		const uint32_t type = capture_le32(bytes + at), size = capture_le32(bytes + at + 4);
		if (size < 12 || size > len - at)
			return;
		const uint32_t kept = capture_le32(bytes + at + 20);
		const uint64_t t = (uint64_t)capture_le32(bytes + at + 12) << 32 | capture_le32(bytes + at + 16);
		if (type == 6 && kept <= size - 32)
			capture_segment(c, (int64_t)(t % 1000000000000000ull), bytes + at + 28, kept);
		at += size;
	}
}

/* False: it is not there. */
static inline bool capture_load(struct capture *c, const char *name)
{
	size_t len;
	uint8_t *bytes = capture_file(name, &len);

	*c = (struct capture){0};
	if (bytes == NULL)
		return false;
	if (strstr(name, ".txt") != NULL)
		capture_lines(c, (char *)bytes);
	else if (strstr(name, ".pcapng") != NULL)
		capture_packets(c, bytes, len);
	else
		capture_add(c, 0, false, bytes, len);
	free(bytes);
	return true;
}

#endif
