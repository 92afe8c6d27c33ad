/* The daemon's log: lines on stderr, under systemd with their priority. */
#ifndef FACET_DAEMON_LOG_H
#define FACET_DAEMON_LOG_H

#include <syslog.h>

/* Hands the lines that this thread logs to somebody else as well; NULL: no longer. */
void log_listen(void (*hear)(void *ctx, int priority, const char *text), void *ctx);

void log_line(int priority, const char *format, ...) __attribute__((format(printf, 2, 3)));

#endif
