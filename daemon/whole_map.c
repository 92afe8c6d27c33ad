/* The whole map at one step, without a copy: held by reference for a snapshot, or handed over when it ends. References
 * are counted by the loop's thread alone; what another thread may do is read. */
#include "daemon/publisher_client.h"

#include <stdlib.h>
#include <string.h>

struct publisher_old {
	size_t n;
	struct sheet *sheet[];
};

struct publisher_old *publisher_begin_map(struct publisher *p, const uint8_t map_id[16])
{
	struct publisher_old *old = malloc(sizeof(*old) + p->sheets.stats.patches * sizeof(struct sheet *));

	publisher_abort_batches(p);
	if (old)
		old->n = 0;
	for (size_t i = 0; i < p->sheets.entries && old; i++) {
		struct entry *entry = sheets_entry(&p->sheets, i);
		struct sheet *sheet = entry->sheet ? sheets_detach(&p->sheets, entry) : NULL;

		if (sheet)
			old->sheet[old->n++] = sheet;
		else if (entry->sheet) { /* half a map is none */
			publisher_old_destroy(old);
			old = NULL;
		}
	}
	publisher_reset(p);
	memcpy(p->params.map_id, map_id, sizeof(p->params.map_id));
	return old;
}

size_t publisher_old_count(const struct publisher_old *old)
{
	return old->n;
}

const uint8_t *publisher_old_frame(const struct publisher_old *old, size_t i, size_t *ret_len)
{
	*ret_len = old->sheet[i]->len;
	return old->sheet[i]->bytes;
}

void publisher_old_destroy(struct publisher_old *old)
{
	for (size_t i = 0; old && i < old->n; i++)
		free(old->sheet[i]);
	free(old);
}

/* Snapshots */

struct pinned_map {
	struct publisher_snapshot head;
	size_t bytes;
	struct sheet *sheet[];
};

struct publisher_snapshot *publisher_pin(struct publisher *p)
{
	size_t n = p->sheets.stats.patches, at = 0;
	struct pinned_map *map = NULL;

	if (p->snapshots < PUBLISHER_SNAPSHOTS_MAX)
		map = malloc(sizeof(*map) + n * sizeof(struct sheet *));
	if (!map)
		return NULL;
	map->head = (struct publisher_snapshot){
	    .generation = p->generation, .cell_m = p->params.cell_m, .step = p->step, .patches = n};
	memcpy(map->head.map_id, p->params.map_id, sizeof(map->head.map_id));
	map->bytes = p->sheets.stats.bytes;
	for (size_t i = 0; i < p->sheets.entries; i++) {
		struct sheet *sheet = sheets_entry(&p->sheets, i)->sheet;

		if (!sheet)
			continue;
		sheet->references++;
		map->sheet[at++] = sheet;
	}
	p->snapshots++;
	p->snapshot_bytes += map->bytes;
	return &map->head;
}

const uint8_t *publisher_snapshot_frame(const struct publisher_snapshot *snapshot, size_t i, size_t *ret_len)
{
	const struct pinned_map *map = (const struct pinned_map *)snapshot;

	*ret_len = map->sheet[i]->len;
	return map->sheet[i]->bytes;
}

void publisher_release(struct publisher *p, struct publisher_snapshot *snapshot)
{
	struct pinned_map *map = (struct pinned_map *)snapshot;

	if (!map)
		return;
	for (size_t i = 0; i < map->head.patches; i++)
		sheet_unref(&p->sheets, map->sheet[i]);
	p->snapshots--;
	p->snapshot_bytes -= map->bytes;
	free(map);
}
