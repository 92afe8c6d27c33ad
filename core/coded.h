/* The compact form of one patch: exact, context-free, a few bytes a triangle (docs/protocol.md, CODED). */
#ifndef FACET_CORE_CODED_H
#define FACET_CORE_CODED_H

#include <sys/types.h>

#include "core/model.h"
#include "core/patch.h"

#define CODED_SHARE \
	64 /* vertices and triangles together are at most so many a byte: what a few bytes can ask for is bounded */

/* Appends the patch. What comes back is equal to it in every field: order of vertices and triangles, runs, version, times.
 * nt > 0, counts as for native_put_patch. */
void coded_put_patch(struct buffer *, const struct patch *);

/* Bytes of the first coded patch in `data`; -EPROTO: there is none, or it is not whole. */
ssize_t coded_scan(const uint8_t *data, size_t len);

/* Decodes one whole patch, `len` as coded_scan says: reference 1 in *ret. -EPROTO or -ENOMEM with a sentence. */
int coded_get_patch(const uint8_t *data, size_t len, struct patch **ret, char error[128]);

#endif
