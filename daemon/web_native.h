/* The native protocol over a WebSocket, subprotocol facetd.v1 (docs/protocol.md): binary messages are whole frames, text messages
 * are JSON lines. */
#ifndef FACET_DAEMON_WEB_NATIVE_H
#define FACET_DAEMON_WEB_NATIVE_H

#include "daemon/web.h"

#define WEB_NATIVE_TEXTS_MAX \
	(256u << 10) /* answers waiting for a client: then its questions wait; events are left out */

extern const struct web_language web_native_language; /* its ctx is not used */

#endif
