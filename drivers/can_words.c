/* The sentences are told of transitions; who reads them has a shell, so each names the command. */
#include "drivers/can_words.h"

#include <errno.h>
#include <stdio.h>
#include <string.h>

bool can_words_hub(const char *connect)
{
	return strncmp(connect, "unix:", 5) == 0;
}

void can_words_opening(const char *name, int error, char ret[160])
{
	if (error == ENODEV || error == ENXIO)
		snprintf(ret, 160,
		         "there is no interface %.15s: plug the adapter in, load its driver, or correct `connect`",
		         name);
	else if (error == ENETDOWN)
		snprintf(ret, 160, "%.15s is down: `ip link set %.15s up type can bitrate 500000 restart-ms 100`", name,
		         name);
	else if (error == EAFNOSUPPORT)
		snprintf(ret, 160, "%.15s is no CAN interface; correct `connect`", name);
	else
		snprintf(ret, 160, "%.15s: %s", name, strerror(error));
}

void can_words_end(const char *connect, int error, char ret[160])
{
	const char *name = connect;

	if (can_words_hub(connect) && (error == ECONNRESET || error == EPIPE || error == ENOTCONN))
		snprintf(ret, 160, "%.100s: whoever carried CAN frames there has gone", name);
	else if (can_words_hub(connect))
		snprintf(ret, 160, "%.100s: %s", name, strerror(error));
	else if (error == ENODEV || error == ENXIO)
		snprintf(ret, 160, "the interface %.15s has gone: plug the adapter in again, or load its driver", name);
	else if (error == ENETDOWN)
		snprintf(ret, 160, "%.15s was set down: `ip link set %.15s up`, or look why the system did it", name,
		         name);
	else if (error == EINVAL || error == EMSGSIZE)
		snprintf(ret, 160, "%.15s does not take this frame: CAN FD needs `ip link set %.15s mtu 72`", name,
		         name);
	else
		snprintf(ret, 160, "%.15s: %s", name, strerror(error));
}
