/* Serial lines: raw 8N1, any rate, read back. Errors are a sentence in the caller's buffer. */
#ifndef FACET_DRIVERS_SERIAL_H
#define FACET_DRIVERS_SERIAL_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* The device file of a `port`: a path is one; usb:VENDOR:PRODUCT[:SERIAL] (hex, hex, text) is the adapter of that make that
 * is plugged in now, looked for under `sys` ("/sys"). 0, or -errno with the sentence: none, or several of them.
 * (serial_find.c) */
int serial_find(const char *sys, const char *port, char *ret_path, size_t cap, char error[160]);

/* Has the driver of an open line deliver bytes at once instead of gathering them for some ms. Empty, or a sentence in
 * `note` that says what stays as it is. (serial_latency.c) */
void serial_low_latency(int fd, const char *sys, const char *path, char note[160]);

/* Opens `path` raw, 8N1, non-blocking, close-on-exec, and discards what waits in it. On a real line nobody else may
 * open it meanwhile. A descriptor, or -errno with the sentence. */
int serial_open(const char *path, char error[160]);
void serial_close(int fd);

/* Sets both directions and reads back: drivers keep the old rate silently where they cannot do the new one. 0 or
 * -errno. */
int serial_set_baud(int fd, const char *path, uint32_t baud, char error[160]);

bool serial_is_pty(int fd);

/* The rate of the line; of a pseudo-terminal's master: what its reader set. 0 or -errno. (serial_baud.c) */
int serial_get_rate(int fd, uint32_t *ret_baud);
int serial_set_rate(int fd, uint32_t baud);

#endif
