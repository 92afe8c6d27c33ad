/* One line, one write, so that lines of several programs on one terminal stay whole. */
#include "daemon/log.h"

#include <pthread.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>
#include <unistd.h>

#include "daemon/notify.h"

#define LINE_MAX_BYTES 600

static struct {
	void (*hear)(void *ctx, int priority, const char *text);
	void *ctx;
	pthread_t thread;
} listener;

void log_listen(void (*hear)(void *ctx, int priority, const char *text), void *ctx)
{
	listener.hear = hear;
	listener.ctx = ctx;
	listener.thread = pthread_self();
}

/* What a device's sentence repeats of foreign bytes must not move a terminal's cursor. */
static void clean(char *text)
{
	for (; *text; text++)
		if ((unsigned char)*text < ' ' || *text == 0x7f)
			*text = '?';
}

void log_line(int priority, const char *format, ...)
{
	char line[LINE_MAX_BYTES + 1];
	va_list arguments;
	int prefix = notify_journal() ? snprintf(line, sizeof(line), "<%d>", priority)
	                              : snprintf(line, sizeof(line), "facetd: ");
	size_t n;

	va_start(arguments, format);
	vsnprintf(line + prefix, LINE_MAX_BYTES - (size_t)prefix, format, arguments);
	va_end(arguments);
	clean(line + prefix);
	if (listener.hear && pthread_equal(listener.thread, pthread_self()))
		listener.hear(listener.ctx, priority, line + prefix);
	n = strlen(line);
	line[n++] = '\n';
	if (write(STDERR_FILENO, line, n) < 0)
		return; /* nobody reads the log: nothing can be said about that */
}
