/* The viewer's page: files built from viewer/, gzipped, part of the program. A build without node has none. */
#ifndef FACET_DAEMON_PAGE_H
#define FACET_DAEMON_PAGE_H

#include <stdbool.h>
#include <stddef.h>

/* What a page may load and connect to; goes out with each of them as Content-Security-Policy. */
#define PAGE_POLICY                                                                                      \
	"default-src 'self'; connect-src 'self' ws: wss:; img-src 'self' data: blob:; style-src 'self' " \
	"'unsafe-inline'; "                                                                              \
	"object-src 'none'; base-uri 'none'; frame-ancestors 'none'"

struct page {
	const char *path;           /* "/", "/viewer.js", ... */
	const char *type;           /* Content-Type */
	const char *etag;           /* with its quotes; other bytes have another one */
	const unsigned char *bytes; /* gzip: send with Content-Encoding: gzip. Static */
	size_t len;
};

/* The file of a path without its query; NULL: there is none. */
const struct page *page_find(const char *path);
/* Whether this build has the viewer. */
bool page_built(void);

#endif
