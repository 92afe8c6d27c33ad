/* A whole file as bytes in memory, without reading it. */
#ifndef FACET_TOOLS_MAPPED_H
#define FACET_TOOLS_MAPPED_H

#include <stddef.h>
#include <stdint.h>

struct mapped {
	const uint8_t *data; /* never NULL */
	size_t len;
};

/* 0, or -errno with one sentence that begins with the file's name. */
int mapped_open(const char *path, struct mapped *ret, char error[400]);
void mapped_close(struct mapped *);

#endif
