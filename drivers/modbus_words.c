/* The sentences are told of transitions; each names what to look at, and the key of the configuration that may be wrong. */
#include "drivers/modbus_words.h"

#include <errno.h>
#include <stdio.h>
#include <string.h>

static void tell_serial(const char *line, int unit, int error, char ret[160])
{
	if (error == ETIMEDOUT)
		snprintf(ret, 160, "%.50s: unit %d does not answer: check power, cable, `baud`, `parity` and `unit`",
		         line, unit);
	else if (error == EPROTO)
		snprintf(ret, 160, "%.50s: what comes is no answer of unit %d: check `baud`, `parity` and the cable",
		         line, unit);
	else if (error == EBUSY)
		snprintf(ret, 160, "%.50s: another program uses this line; end that one, or correct `connect`", line);
	else if (error == EIO || error == ECONNRESET)
		snprintf(ret, 160, "%.50s: the line hung up: is the adapter plugged in?", line);
	else if (error == ENOTTY)
		snprintf(ret, 160, "%.50s: this is no serial line; correct `connect`", line);
	else
		snprintf(ret, 160, "%.50s: the line failed (%s)", line, strerror(error));
}

/* libmodbus says of a name that nobody knows that it refused. */
static void tell_tcp(const char *peer, int unit, int error, char ret[160])
{
	if (error == ECONNREFUSED)
		snprintf(ret, 160,
		         "%.60s refuses the connection, or nobody knows the name: check address and port in `connect`",
		         peer);
	else if (error == EHOSTUNREACH || error == ENETUNREACH)
		snprintf(ret, 160,
		         "%.60s cannot be reached: check cable and power, and that this host is in its network", peer);
	else if (error == ETIMEDOUT)
		snprintf(ret, 160, "%.60s: unit %d does not answer: check cable, power, address and `unit`", peer,
		         unit);
	else if (error == ECONNRESET || error == EPIPE)
		snprintf(ret, 160, "%.60s broke the connection off: it was restarted, or serves too many clients",
		         peer);
	else if (error == EPROTO)
		snprintf(ret, 160, "%.60s: what comes is no answer of unit %d: is this the servo's address?", peer,
		         unit);
	else
		snprintf(ret, 160, "the connection to %.60s failed (%s)", peer, strerror(error));
}

void modbus_words_end(const char *connect, int unit, int error, char ret[160])
{
	if (strchr(connect, '/'))
		tell_serial(connect, unit, error, ret);
	else
		tell_tcp(connect, unit, error, ret);
}
