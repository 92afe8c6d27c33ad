/* The status as text for Prometheus (exposition format 0.0.4). Pure. */
#ifndef FACET_DAEMON_WEB_METRICS_H
#define FACET_DAEMON_WEB_METRICS_H

#include "daemon/control.h"
#include "daemon/publisher.h"

void web_metrics_put(struct buffer *, const struct control_status *, const struct publisher_stats *);

#endif
