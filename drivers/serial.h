/* Serial lines: raw 8N1, any rate, read back. Errors are a sentence in the caller's buffer. */
#ifndef FACET_DRIVERS_SERIAL_H
#define FACET_DRIVERS_SERIAL_H

#include <stdint.h>

/* Opens `path` raw, 8N1, non-blocking, close-on-exec, and discards what waits in it. On a real line nobody else may
 * open it meanwhile. A descriptor, or -errno with the sentence. */
int serial_open(const char *path, char error[160]);
void serial_close(int fd);

/* Sets both directions and reads back: drivers keep the old rate silently where they cannot do the new one. 0 or
 * -errno. */
int serial_set_baud(int fd, const char *path, uint32_t baud, char error[160]);

/* The rate of the line; of a pseudo-terminal's master: what its reader set. 0 or -errno. (serial_baud.c) */
int serial_get_rate(int fd, uint32_t *ret_baud);
int serial_set_rate(int fd, uint32_t baud);

#endif
