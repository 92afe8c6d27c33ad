/* systemd: readiness, watchdog, the end (sd_notify). Without systemd every call does nothing. */
#ifndef FACET_DAEMON_NOTIFY_H
#define FACET_DAEMON_NOTIFY_H

#include <stdbool.h>
#include <stdint.h>

void notify_ready(void);
void notify_stopping(void);
void notify_status(const char *sentence); /* shown by systemctl status */

/* How often notify_alive is to be called, ms; 0: nobody watches. */
uint64_t notify_watchdog_ms(void);
void notify_alive(void);

/* True when stderr is the journal: lines then carry their priority as <N>. */
bool notify_journal(void);

#endif
