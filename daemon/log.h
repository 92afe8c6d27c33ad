/* The daemon's log: lines on stderr, under systemd with their priority. */
#ifndef FACET_DAEMON_LOG_H
#define FACET_DAEMON_LOG_H

#include <syslog.h>

void log_line(int priority, const char *format, ...) __attribute__((format(printf, 2, 3)));

#endif
