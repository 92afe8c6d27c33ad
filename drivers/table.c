/* The drivers there are. Adding a device: its files, and one line here. */
#include "drivers/driver.h"

#include <string.h>

const struct driver *const driver_table[] = {
    &driver_lms2xx, &driver_modbus,  &driver_pose,     &driver_tim,    &driver_lms1xx, &driver_lms5xx,
    &driver_can,    &driver_canopen, &driver_odometry, &driver_carmen, NULL,
};

const struct driver *driver_find(const char *name)
{
	for (const struct driver *const *driver = driver_table; *driver != NULL; driver++)
		if (strcmp((*driver)->name, name) == 0)
			return *driver;
	return NULL;
}
