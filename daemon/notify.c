/* The few words a service says to systemd. The watchdog is fed at half its time, as sd_watchdog_enabled(3) advises. */
#include "daemon/notify.h"

#include <stdlib.h>
#include <systemd/sd-daemon.h>

void notify_ready(void)
{
	sd_notify(0, "READY=1");
}

void notify_stopping(void)
{
	sd_notify(0, "STOPPING=1");
}

void notify_status(const char *sentence)
{
	sd_notifyf(0, "STATUS=%s", sentence);
}

uint64_t notify_watchdog_ms(void)
{
	uint64_t usec = 0;

	if (sd_watchdog_enabled(0, &usec) <= 0)
		return 0;
	return usec < 2000 ? 1 : usec / 2000;
}

void notify_alive(void)
{
	sd_notify(0, "WATCHDOG=1");
}

bool notify_journal(void)
{
	return getenv("JOURNAL_STREAM") != NULL;
}
