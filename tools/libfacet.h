/* What facet's own tools ask of libfacet beyond facet.h. */
#ifndef FACET_TOOLS_LIBFACET_H
#define FACET_TOOLS_LIBFACET_H

#include "core/native.h"
#include "tools/facet.h"

#define LIBFACET_LINE_MAX (1u << 20) /* bytes of a JSON line; a longer one is refused */

int libfacet_want(struct facet *, const struct native_want *);
const struct native_mirror *libfacet_mirror(const struct facet *);

int64_t libfacet_now_ms(void); /* on CLOCK_MONOTONIC */

/* A connected descriptor that does not block, or -errno; waits at most `timeout_ms`. */
struct address;
int libfacet_connect(const struct address *, int timeout_ms);

/* Opens a WebSocket on it. Bytes that came behind the answer are appended to `ret_rest`. 0, or -errno with a sentence. */
struct buffer;
int libfacet_upgrade(int fd, const struct address *, int timeout_ms, struct buffer *ret_rest,
                     char error[FACET_ERROR_MAX]);

#endif
