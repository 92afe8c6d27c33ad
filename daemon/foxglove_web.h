/* Foxglove's protocol as a language of the web: what joins daemon/foxglove to daemon/web. */
#ifndef FACET_DAEMON_FOXGLOVE_WEB_H
#define FACET_DAEMON_FOXGLOVE_WEB_H

#include "daemon/foxglove.h"
#include "daemon/web.h"

/* Both subprotocol names; web_speak(web, &foxglove_language, foxglove). */
extern const struct web_language foxglove_language;

#endif
