/* Law: no bytes of a configuration file crash its reader, make it allocate without bound or give a configuration that
 * breaks its own promises; what is refused is refused with one printable sentence. */
#include <ctype.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "config/address.h"
#include "config/config.h"
#include "config/keys.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static void must(bool condition)
{
	if (!condition)
		abort();
}

static void check_device(const struct config *config, int i)
{
	const struct config_device *device = &config->device[i];
	struct sweep_params params;
	must(keys_driver(device->driver) != 0);
	must(device->name[0] && memchr(device->name, '\0', sizeof(device->name)));
	must(device->masks >= 0 && device->masks <= SWEEP_MASKS_MAX);
	must(device->write.n >= 0 && device->write.n <= CONFIG_WRITES_MAX);
	if (keys_driver(device->driver) == KEY_LMS2XX)
		must(device->range_min_m < device->range_max_m && device->port[0]);
	if (keys_driver(device->driver) == KEY_MODBUS)
		must(device->position.set && device->position.scale > 0);
	config_sweep_params(config, i, &params);
}

static void check_config(const struct config *config)
{
	must(config->map.cell_m >= 0.01 && config->map.cell_m <= 1);
	must(config->devices >= 0 && config->devices <= CONFIG_DEVICES_MAX);
	must(config->listen.natives >= 0 && config->listen.natives <= CONFIG_LISTEN_MAX);
	must(!config->sweep.set || config->sweep.from_rad < config->sweep.to_rad);
	for (int i = 0; i < config->devices; i++)
		check_device(config, i);
}

static void check_sentence(const char *text)
{
	must(strncmp(text, "f.yaml:", 7) == 0 && strlen(text) > 10);
	for (; *text; text++)
		must(!iscntrl((unsigned char)*text));
}

/* The input as one address of any kind: what is taken is taken again as it is printed, but for the query of ws:. */
static void check_address(const uint8_t *data, size_t size)
{
	struct address address, again;
	char text[2 * ADDRESS_TEXT_MAX] = "", printed[ADDRESS_TEXT_MAX], error[ADDRESS_ERROR_MAX];
	memcpy(text, data, size < sizeof(text) - 1 ? size : sizeof(text) - 1);
	if (address_parse(text, ADDRESS_UNIX | ADDRESS_TCP | ADDRESS_UDP | ADDRESS_WS, &address, error))
		return;
	address_print(&address, printed);
	must(address_parse(printed, address.kind, &again, error) == 0);
	must(strcmp(address.path, again.path) == 0 && strcmp(address.host, again.host) == 0 &&
	     address.port == again.port);
	must(strncmp(address.target, again.target, strcspn(address.target, "?")) == 0);
	must(!strpbrk(address.target, " \r\n"));
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	static struct config config;
	struct config_error error;
	check_address(data, size);
	const int status = config_read((const char *)data, size, "f.yaml", &config, &error);
	if (status)
		check_sentence(error.text);
	else
		check_config(&config);
	return 0;
}
