/* The real sweeps that lie beside the repository, for tests that are skipped without them. */
#ifndef FACET_TESTS_REAL_SWEEPS_H
#define FACET_TESTS_REAL_SWEEPS_H

#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>

#define REAL_SWEEPS 3
#define REAL_ROWS   226
#define REAL_BEAMS  360

/* The whole file, terminated; NULL where it is not there. The caller frees it. */
static inline uint8_t *real_read(const char *path, size_t *ret_len)
{
	FILE *file = fopen(path, "rb");
	if (!file)
		return NULL;
	fseek(file, 0, SEEK_END);
	long size = ftell(file);
	rewind(file);
	uint8_t *data = malloc((size_t)size + 1);
	*ret_len = fread(data, 1, (size_t)size, file);
	data[*ret_len] = 0;
	fclose(file);
	return data;
}

static inline uint8_t *real_scan(int i, size_t *ret_len)
{
	char path[64];
	snprintf(path, sizeof path, "../shared/data/kurt3d/scan00%d.3d", i);
	return real_read(path, ret_len);
}

static inline uint8_t *real_profiles(int i, size_t *ret_len)
{
	char path[80];
	snprintf(path, sizeof path, "../shared/data/captures/tilt/kurt3d_scan%d_profiles.csv", i);
	return real_read(path, ret_len);
}

#endif
