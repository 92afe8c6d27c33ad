/* L6: the store hands out every patch that changed after a version, once, in the order of (version, key). */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <cmocka.h>

#include "core/model.h"
#include "core/patch.h"

static uint16_t corner[4][3] = {{0, 0, 0}, {256, 0, 0}, {0, 256, 0}, {0, 0, 4096}};

/* Four faces on planes 7, none, 3, 7; the first two begin with an index that is not their smallest. */
static struct patch *four_faces(struct patch_key key, uint64_t version)
{
	uint32_t triangle[4][3] = {{2, 1, 0}, {3, 0, 1}, {1, 2, 3}, {0, 2, 3}}, plane[4] = {7, PLANE_NONE, 3, 7};
	struct surface surface = {.nv = 4, .nt = 4, .vertex = corner, .triangle = triangle, .plane = plane};
	struct patch *patch = patch_create(key, &surface);
	assert_non_null(patch);
	patch->version = version;
	return patch;
}

static struct patch *tombstone(struct patch_key key, uint64_t version)
{
	struct patch *patch = patch_create(key, &(struct surface){0});
	assert_non_null(patch);
	patch->version = version;
	return patch;
}

static void put(struct patch_store *store, struct patch *patch)
{
	assert_int_equal(patch_store_put(store, patch), 0);
}

static void a_patch_sorts_its_triangles_into_runs_and_rotates_them(void **state)
{
	(void)state;
	static const uint32_t expected[4][3] = {{1, 2, 3}, {0, 2, 1}, {0, 2, 3}, {0, 1, 3}};
	struct patch *patch = four_faces((struct patch_key){-1, 2, 3}, 1);
	assert_int_equal(patch->nv, 4);
	assert_int_equal(patch->nruns, 3);
	assert_memory_equal(patch->triangle, expected, sizeof expected);
	assert_memory_equal(patch->vertex, corner, sizeof corner);
	assert_true(patch->run[0].plane == 3 && patch->run[0].triangles == 1);
	assert_true(patch->run[1].plane == 7 && patch->run[1].triangles == 2);
	assert_true(patch->run[2].plane == PLANE_NONE && patch->run[2].triangles == 1);
	patch_unref(patch);
}

static void a_patch_without_planes_is_one_run_in_its_order(void **state)
{
	(void)state;
	uint32_t triangle[2][3] = {{3, 1, 2}, {0, 1, 2}};
	struct surface surface = {.nv = 4, .nt = 2, .vertex = corner, .triangle = triangle};
	struct patch *patch = patch_create((struct patch_key){0, 0, 0}, &surface);
	assert_int_equal(patch->nruns, 1);
	assert_true(patch->run[0].plane == PLANE_NONE && patch->run[0].triangles == 2);
	assert_true(patch->triangle[0][0] == 1 && patch->triangle[0][1] == 2 && patch->triangle[0][2] == 3);
	patch_unref(patch);
}

static void patches_are_equal_by_geometry_and_runs_alone(void **state)
{
	(void)state;
	struct patch_key key = {1, 1, 1};
	struct patch *a = four_faces(key, 1), *b = four_faces(key, 9), *c = four_faces((struct patch_key){1, 1, 2}, 1);
	b->t_last_ns = 5;
	assert_true(patch_equal(a, b));
	assert_false(patch_equal(a, c));
	b->vertex[3][2]--;
	assert_false(patch_equal(a, b));
	b->vertex[3][2]++;
	b->run[1].class = 2;
	assert_false(patch_equal(a, b));
	b->run[1].class = 0;
	b->triangle[3][1] = 2;
	assert_false(patch_equal(a, b));
	patch_unref(a);
	patch_unref(b);
	patch_unref(c);
}

static void a_patch_lives_until_its_last_reference_goes(void **state)
{
	(void)state;
	struct patch_store *store = patch_store_create();
	struct patch *patch = four_faces((struct patch_key){0, 0, 0}, 1);
	put(store, patch);
	patch_ref(patch);
	put(store, tombstone((struct patch_key){0, 0, 0}, 2));
	assert_int_equal(atomic_load(&patch->references), 1);
	assert_int_equal(patch->nt, 4);
	patch_unref(patch);
	patch_store_destroy(store);
}

static void a_tombstone_is_found_and_handed_out_but_not_counted(void **state)
{
	(void)state;
	struct patch_store *store = patch_store_create();
	struct patch_key key = {4, -5, 6};
	assert_null(patch_store_get(store, key));
	assert_null(patch_store_after(store, 0, NULL));
	put(store, four_faces(key, 3));
	assert_int_equal(patch_store_count(store), 1);
	put(store, tombstone(key, 8));
	assert_int_equal(patch_store_count(store), 0);
	assert_int_equal(patch_store_get(store, key)->nt, 0);
	struct patch *after = patch_store_after(store, 3, NULL);
	assert_true(after && after->version == 8 && after->nt == 0);
	assert_null(patch_store_after(store, 8, NULL));
	assert_null(patch_store_after(store, 3, after));
	assert_null(patch_store_after(store, UINT64_MAX, NULL));
	patch_store_destroy(store);
}

static void bytes_grow_with_patches_and_fall_with_tombstones(void **state)
{
	(void)state;
	struct patch_store *store = patch_store_create();
	size_t empty = patch_store_bytes(store);
	put(store, four_faces((struct patch_key){0, 0, 0}, 1));
	size_t one = patch_store_bytes(store);
	assert_true(one >= empty + sizeof(struct patch) + sizeof corner + 4 * 12);
	put(store, tombstone((struct patch_key){0, 0, 0}, 2));
	assert_true(patch_store_bytes(store) < one);
	assert_true(patch_store_bytes(store) > empty);
	patch_store_destroy(store);
}

static uint64_t random_next(uint64_t *state)
{
	*state ^= *state << 13;
	*state ^= *state >> 7;
	*state ^= *state << 17;
	return *state >> 11;
}

#define SIDE 12
#define KEYS (SIDE * SIDE * SIDE)

static struct patch_key key_of(int n)
{
	return (struct patch_key){n % SIDE - 6, n / SIDE % SIDE - 6, n / SIDE / SIDE - 6};
}

/* Walks the store and compares it with a plain table of the newest version of every key. */
static void check_walk(const struct patch_store *store, const uint64_t *version, uint64_t from)
{
	size_t expected = 0, met = 0;
	const struct patch *last = NULL;
	for (int n = 0; n < KEYS; n++)
		expected += version[n] > from;
	for (struct patch *patch; (patch = patch_store_after(store, from, last)); last = patch, met++) {
		int n = ((patch->key.z + 6) * SIDE + patch->key.y + 6) * SIDE + patch->key.x + 6;
		assert_true(patch->version == version[n] && patch->version > from);
		if (last)
			assert_true(last->version < patch->version ||
			            (last->version == patch->version && patch_key_compare(last->key, patch->key) < 0));
	}
	assert_int_equal(met, expected);
}

static void a_walk_meets_every_newer_patch_once_in_order_whatever_was_put(void **state)
{
	(void)state;
	struct patch_store *store = patch_store_create();
	static uint64_t version[KEYS];
	uint64_t random = 9;
	for (int round = 1; round <= 20000; round++) {
		int n = (int)(random_next(&random) % KEYS);
		/* a server puts rising versions; a client that joins receives them in any order */
		version[n] = round < 10000 ? 1 + random_next(&random) % 500 : (uint64_t)round / 7;
		put(store,
		    random_next(&random) % 4 ? four_faces(key_of(n), version[n]) : tombstone(key_of(n), version[n]));
		if (round % 1000 == 0)
			for (uint64_t from = 0; from < 3000; from += 171)
				check_walk(store, version, from);
	}
	size_t living = 0;
	for (int n = 0; n < KEYS; n++) {
		struct patch *patch = patch_store_get(store, key_of(n));
		assert_true(patch ? patch->version == version[n] : version[n] == 0);
		living += patch && patch->nt;
	}
	assert_int_equal(patch_store_count(store), living);
	patch_store_destroy(store);
}

static void the_living_come_in_key_order(void **state)
{
	(void)state;
	struct patch_store *store = patch_store_create();
	struct patch **patches;
	for (int n = 0; n < KEYS; n++) {
		int shuffled = n * 5 % KEYS;
		put(store, n % 3 ? four_faces(key_of(shuffled), 5) : tombstone(key_of(shuffled), 6));
	}
	size_t n = patch_store_living(store, &patches);
	assert_int_equal(n, patch_store_count(store));
	assert_int_equal(n, KEYS - KEYS / 3);
	for (size_t i = 1; i < n; i++)
		assert_true(patch_key_compare(patches[i - 1]->key, patches[i]->key) < 0);
	free(patches);
	patch_store_destroy(store);
}

static void the_hash_is_that_of_the_documented_bytes(void **state)
{
	(void)state;
	struct patch_store *store = patch_store_create();
	char got[65], expected[65];
	put(store, four_faces((struct patch_key){-1, 2, 3}, 77));
	put(store, tombstone((struct patch_key){-1, 2, 4}, 78));
	static const uint32_t words[] = {0xffffffff, 2, 3, 4, 4};
	static const uint32_t triangles[] = {1, 2, 3, 0, 2, 1, 0, 2, 3, 0, 1, 3};
	static const uint32_t runs[] = {0, 1, 1, 2, 0xffffffff, 1};
	struct sha256 sha;
	sha256_init(&sha);
	sha256_add(&sha, words, sizeof words);
	sha256_add(&sha, corner, sizeof corner);
	sha256_add(&sha, triangles, sizeof triangles);
	sha256_add(&sha, runs, sizeof runs);
	sha256_hex(&sha, expected);
	patch_store_hash(store, got);
	assert_string_equal(got, expected);
	patch_store_destroy(store);
}

static void the_hash_knows_no_versions_times_or_order_of_putting(void **state)
{
	(void)state;
	struct patch_store *a = patch_store_create(), *b = patch_store_create();
	char hash_a[65], hash_b[65];
	for (int n = 0; n < 100; n++) {
		put(a, four_faces(key_of(n), (uint64_t)n + 1));
		put(b, four_faces(key_of(99 - n), (uint64_t)n / 7));
	}
	patch_store_hash(a, hash_a);
	patch_store_hash(b, hash_b);
	assert_string_equal(hash_a, hash_b);
	patch_store_get(b, key_of(50))->vertex[0][0]++;
	patch_store_hash(b, hash_b);
	assert_string_not_equal(hash_a, hash_b);
	patch_store_destroy(a);
	patch_store_destroy(b);
}

static void sha256_gives_the_standards_digests(void **state)
{
	(void)state;
	static const struct {
		const char *text, *digest;
	} known[] = {
	    {"", "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"},
	    {"abc", "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"},
	    {"abcdbcdecdefdefgefghfghighijhijkijkljklmklmnlmnomnopnopq",
	     "248d6a61d20638b8e5c026930c3e6039a33ce45964ff2167f6ecedd419db06c1"},
	};
	struct sha256 sha;
	char hex[65];
	for (size_t i = 0; i < sizeof known / sizeof *known; i++) {
		sha256_init(&sha);
		sha256_add(&sha, known[i].text, strlen(known[i].text));
		sha256_hex(&sha, hex);
		assert_string_equal(hex, known[i].digest);
	}
	sha256_init(&sha);
	for (int i = 0; i < 1000000; i += 125) /* a million times "a", in pieces that straddle blocks */
		sha256_add(&sha,
		           "aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa"
		           "aaaaaaaaaaaaaaaaaa"
		           "aaaaaaaaaaaaaaaaaaaaaaaaaaaa",
		           125);
	sha256_hex(&sha, hex);
	assert_string_equal(hex, "cdc76e5c9914fb9281a1c7e284d73e67f1809a48a497200e046d39ccc7112cd0");
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(a_patch_sorts_its_triangles_into_runs_and_rotates_them),
	    cmocka_unit_test(a_patch_without_planes_is_one_run_in_its_order),
	    cmocka_unit_test(patches_are_equal_by_geometry_and_runs_alone),
	    cmocka_unit_test(a_patch_lives_until_its_last_reference_goes),
	    cmocka_unit_test(a_tombstone_is_found_and_handed_out_but_not_counted),
	    cmocka_unit_test(bytes_grow_with_patches_and_fall_with_tombstones),
	    cmocka_unit_test(a_walk_meets_every_newer_patch_once_in_order_whatever_was_put),
	    cmocka_unit_test(the_living_come_in_key_order),
	    cmocka_unit_test(the_hash_is_that_of_the_documented_bytes),
	    cmocka_unit_test(the_hash_knows_no_versions_times_or_order_of_putting),
	    cmocka_unit_test(sha256_gives_the_standards_digests),
	};
	return cmocka_run_group_tests(tests, NULL, NULL);
}
