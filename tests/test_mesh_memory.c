/* L8, L9: where memory runs out while a mesh is made, kept, welded or written, nothing is half done and nothing leaks. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <cmocka.h>

#include "core/map.h"
#include "core/model.h"
#include "tests/scarce.h"

#define PATCHES 200 /* so that the store's table grows twice */

static struct patch *small_patch(int n)
{
	static uint16_t vertex[4][3] = {{0, 0, 0}, {256, 0, 0}, {0, 256, 0}, {0, 0, 256}};
	static uint32_t triangle[2][3] = {{2, 1, 0}, {3, 0, 1}}, plane[2] = {4, 2};
	struct surface surface = {.nv = 4, .nt = 2, .vertex = vertex, .triangle = triangle, .plane = plane};
	return patch_create((struct patch_key){n, -n, 0}, &surface);
}

/* 0, or -1 when memory ran out on the way. What was put is counted right and found. */
static int fill_store(struct patch_store *store)
{
	for (int n = 0; n < PATCHES; n++) {
		struct patch *patch = small_patch(n);
		if (!patch)
			return -1;
		if (patch_store_put(store, patch)) {
			assert_null(patch_store_get(store, patch->key));
			assert_int_equal(patch_store_count(store), n);
			patch_unref(patch);
			return -1;
		}
		assert_ptr_equal(patch_store_get(store, patch->key), patch);
	}
	return 0;
}

static int weld_and_write(const struct patch_store *store)
{
	struct model model = {.nv = 77};
	struct buffer file = {0};
	if (model_weld(store, 0.05, &model)) {
		assert_int_equal(model.nv, 77); /* results are untouched on failure */
		return -1;
	}
	assert_int_equal(model.nt, 2 * PATCHES);
	ply_write(&model, false, &file);
	obj_write(&model, &file);
	stl_write(&model, &file);
	gltf_write(&model, &file);
	int r = file.error ? -1 : 0;
	buffer_finish(&file);
	model_finish(&model);
	return r;
}

static int keep_and_write(void)
{
	struct patch_store *store = patch_store_create();
	if (!store)
		return -1;
	char hex[65];
	int r = fill_store(store);
	if (!r) {
		patch_store_hash(store, hex);
		r = hex[0] ? weld_and_write(store) : -1;
	}
	patch_store_destroy(store);
	return r;
}

/* A wall in one block, meshed and reduced. */
static int make_and_mesh(void)
{
	struct map_params params = {
	    .cell_m = 0.05, .tolerance = 0.25, .reduce = true, .lookahead = 2, .memory = 16 << 20};
	struct map *map = map_create(&params);
	struct mesher *mesher = mesher_create();
	struct block *block = map ? grid_touch(map_grid(map), (struct block_key){0, 0, 0}) : NULL;
	int r = -1;
	if (block && mesher) {
		for (int v = 0; v < BLOCK_VOXELS; v++)
			block_publish(block, v, (int16_t)(((v & 7) - 3) * 256 - 100));
		const struct patch_key *keys;
		grid_mark_changed(map_grid(map), block->key, (const uint8_t[3]){0xff, 0xff, 0xff});
		map_take_dirty(map, &keys);
		struct patch *patch = map_mesh_patch(map, mesher, (struct patch_key){0, 0, 0}, NULL);
		if (patch) {
			assert_true(patch->nt > 0);
			r = 0;
		}
		patch_unref(patch);
	}
	mesher_destroy(mesher);
	map_destroy(map);
	return r;
}

/* Runs `work` with memory running out once, at its first call, its second, ... until it is not reached any more. */
static void at_every_call(int (*work)(void), long least)
{
	long n = 0;
	assert_int_equal(work(), 0); /* what is allocated once for ever is allocated now */
	for (bool reached = true; reached; n++) {
		long live = scarce_live;
		scarce_left = n;
		int r = work();
		reached = scarce_left < 0;
		scarce_left = -1;
		assert_int_equal(scarce_live, live);
		assert_true(r == 0 || reached);
	}
	print_message("note: %ld calls refused\n", n - 1);
	assert_true(n - 1 >= least);
}

static void keeping_and_writing_patches_survives_a_refusal_at_every_call(void **state)
{
	(void)state;
	at_every_call(keep_and_write, 3 * PATCHES);
}

static void making_a_patch_survives_a_refusal_at_every_call(void **state)
{
	(void)state;
	at_every_call(make_and_mesh, 5);
}

int main(void)
{
	if (!SCARCE_WORKS) {
		puts("a sanitizer has taken malloc");
		return 77;
	}
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(keeping_and_writing_patches_survives_a_refusal_at_every_call),
	    cmocka_unit_test(making_a_patch_survives_a_refusal_at_every_call),
	};
	return cmocka_run_group_tests(tests, NULL, NULL);
}
