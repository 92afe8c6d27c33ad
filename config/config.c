/* From bytes to a configuration: YAML to a tree (yaml_tree.c), the tree to values by the table of keys (reader.c), then
 * what keys say about each other (check.c). The result is built aside and handed out whole. */
#include "config/config.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>

#include "config/reader.h"

static int fill(struct reader *r, struct config *config)
{
	memset(config, 0, sizeof(*config));
	const int error = reader_group(r, GROUP_TOP, 0, r->tree->root, config);
	return error ? error : config_check(r, config);
}

int config_read(const char *text, size_t len, const char *file, struct config *ret, struct config_error *error)
{
	struct yaml_tree tree = {.root = -1};
	struct yaml_error yaml_error;
	struct reader reader = {.tree = &tree, .file = file, .error = error};
	error->text[0] = '\0';
	int status = yaml_tree_parse(text, len, &tree, &yaml_error);
	if (status == -EINVAL)
		reader_fail(&reader, yaml_error.line, "%s", yaml_error.text);
	struct config *config = status ? NULL : malloc(sizeof(*config));
	if (!status && !config)
		status = -ENOMEM;
	if (!status)
		status = fill(&reader, config);
	if (!status)
		*ret = *config;
	if (status == -ENOMEM)
		reader_fail(&reader, 0, "memory is out");
	free(config);
	yaml_tree_finish(&tree);
	return status;
}

void config_default(struct config *ret)
{
	struct config_error error;
	if (config_read("", 0, "default", ret, &error))
		memset(ret, 0, sizeof(*ret)); /* memory is out: an empty configuration maps nothing */
}

static const struct config_device *device_of(const struct config *config, unsigned driver)
{
	for (int i = 0; i < config->devices; i++)
		if (keys_driver(config->device[i].driver) == driver)
			return &config->device[i];
	return NULL;
}

void config_sweep_params(const struct config *config, int device, struct sweep_params *ret)
{
	const struct config_device *scanner = &config->device[device];
	const struct config_device *pose = device_of(config, KEY_POSE), *odometry = device_of(config, KEY_ODOMETRY);
	const bool swept = config->sweep.set && scanner->tilt[0] && strcmp(scanner->tilt, config->sweep.device) == 0;
	*ret = (struct sweep_params){
	    .base_tilt = config->mount.base_tilt,
	    .tilt_laser = config->mount.tilt_laser,
	    .range_min_m = scanner->range_min_m,
	    .range_max_m = scanner->range_max_m,
	    .masks = scanner->masks,
	    .has_box = config->robot.has_box,
	    .box_min = config->robot.box_min,
	    .box_max = config->robot.box_max,
	    .hold_ns = config->map.hold_ns,
	    .fixed_tilt = !scanner->tilt[0],
	    .tilt_rad = scanner->tilt_fixed_rad,
	    .fixed_pose = pose ? pose->fixed : !odometry,
	    .map_base = pose && pose->fixed ? pose->fixed_pose : transform_identity(),
	    .trust_m = odometry ? odometry->trust_m : 0,
	    .step = swept && config->sweep.profile == SWEEP_STEP,
	    .raster = (uint32_t)device,
	};
	for (int i = 0; i < scanner->masks; i++) {
		ret->mask[i].from_rad = scanner->mask[i].from_rad;
		ret->mask[i].to_rad = scanner->mask[i].to_rad;
	}
}
