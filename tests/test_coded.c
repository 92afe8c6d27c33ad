/* Law: a coded patch is the patch, whatever it is: the same order, runs, version and times (L4); nothing that is no coded
 * patch passes as one, and what a few bytes can ask for is bounded (L8). */
#include <errno.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include "core/coded.h"
#include "core/coded_table.h"

static uint32_t draw(uint64_t *seed)
{
	*seed = *seed * 6364136223846793005u + 1442695040888963407u;
	return (uint32_t)(*seed >> 33);
}

static void expect_back(const struct patch *patch)
{
	struct buffer b = {0};
	struct patch *back;
	char error[128];
	coded_put_patch(&b, patch);
	assert_int_equal(b.error, 0);
	assert_int_equal(coded_scan(b.data, b.len), b.len);
	if (coded_get_patch(b.data, b.len, &back, error))
		fail_msg("%s", error);
	assert_true(patch_equal(patch, back));
	assert_true(back->version == patch->version && back->t_first_ns == patch->t_first_ns &&
	            back->t_last_ns == patch->t_last_ns);
	assert_true((size_t)patch->nv + patch->nt <= b.len * CODED_SHARE);
	patch_unref(back);
	buffer_finish(&b);
}

static struct patch *random_patch(uint64_t *seed, uint32_t nv, uint32_t nt, uint32_t nruns)
{
	const int32_t wide = GRID_PATCH_LIMIT;
	const uint32_t kind = draw(seed) % 3;
	struct patch_key key = {(int32_t)(draw(seed) % 9) - 4, -wide, wide};
	struct patch *patch = patch_allocate(key, nv, nt, nruns);
	assert_non_null(patch);
	patch->version = draw(seed) % 2 ? UINT64_MAX : draw(seed);
	patch->t_first_ns = kind == 0 ? INT64_MIN : draw(seed);
	patch->t_last_ns = kind == 1 ? INT64_MAX : 1 + patch->t_first_ns;
	for (uint32_t i = 0; i < nv; i++)
		for (int axis = 0; axis < 3; axis++)
			patch->vertex[i][axis] = (uint16_t)(kind ? draw(seed) % 17 * 256 : draw(seed) % 4097);
	for (uint32_t i = 0; i < nt; i++)
		for (int c = 0; c < 3; c++)
			do
				patch->triangle[i][c] = kind == 2 ? (i + draw(seed) % 9) % nv : draw(seed) % nv;
			while ((c > 0 && patch->triangle[i][c] == patch->triangle[i][0]) ||
			       (c > 1 && patch->triangle[i][c] == patch->triangle[i][1]));
	for (uint32_t i = 0, left = nt; i < nruns; i++) {
		const uint32_t most = left - (nruns - i - 1), n = i + 1 == nruns ? left : 1 + draw(seed) % most;
		patch->run[i].plane = kind == 0 ? draw(seed) * 2 + 1 : kind == 1 ? PLANE_NONE : i;
		patch->run[i].class = (uint8_t)draw(seed);
		patch->run[i].triangles = (uint16_t)n;
		left -= n;
	}
	return patch;
}

static void any_patch_comes_back_as_it_was(void **state)
{
	uint64_t seed = 6;
	(void)state;
	for (int i = 0; i < 600; i++) {
		const uint32_t nv = 3 + draw(&seed) % (i % 20 ? 60 : 2000), nt = 1 + draw(&seed) % (i % 20 ? 90 : 3000);
		struct patch *patch = random_patch(&seed, nv, nt, 1 + draw(&seed) % nt);
		expect_back(patch);
		patch_unref(patch);
	}
}

static void the_largest_patch_comes_back(void **state)
{
	uint64_t seed = 7;
	struct patch *patch = random_patch(&seed, PATCH_VERTICES_MAX, UINT16_MAX, UINT16_MAX);
	(void)state;
	expect_back(patch);
	patch_unref(patch);
}

static struct patch *tetrahedron(void)
{
	uint16_t vertex[4][3] = {{0, 0, 0}, {256, 0, 0}, {0, 250, 0}, {0, 0, 4096}};
	uint32_t triangle[4][3] = {{0, 2, 1}, {0, 1, 3}, {0, 3, 2}, {1, 2, 3}};
	uint32_t plane[4] = {0, 0, 0, 7};
	struct surface surface = {.nv = 4, .nt = 4, .vertex = vertex, .triangle = triangle, .plane = plane};
	struct patch *patch = patch_create((struct patch_key){-1, 2, 300}, &surface);
	assert_non_null(patch);
	patch->version = 777;
	patch->t_first_ns = 1;
	patch->t_last_ns = -2;
	patch->run[1].class = 3;
	return patch;
}

static void its_bytes_are_golden(void **state)
{
	static const char golden[] = "2a0104d8048906feffffffffffffff0100000000000000"
	                             "11f4d1cf04ce0f167bc200267d02d924639285e1";
	struct patch *patch = tetrahedron();
	struct buffer b = {0};
	char text[200] = "";
	(void)state;
	coded_put_patch(&b, patch);
	for (size_t i = 0; i < b.len; i++)
		sprintf(text + 2 * i, "%02x", b.data[i]);
	assert_string_equal(text, golden);
	patch_unref(patch);
	buffer_finish(&b);
}

/* A cut one has the wrong length; one whose length was made to fit lacks decisions, and ends in zeros: it may be a patch,
 * never bytes that are not there (the sanitizer sees to that). */
static void every_shorter_one_is_refused(void **state)
{
	struct patch *patch = tetrahedron(), *back;
	struct buffer b = {0};
	char error[128];
	(void)state;
	coded_put_patch(&b, patch);
	for (size_t len = 0; len < b.len; len++) {
		uint8_t *cut = malloc(len ? len : 1);
		memcpy(cut, b.data, len);
		assert_int_equal(coded_scan(cut, len), -EPROTO);
		assert_int_equal(coded_get_patch(cut, len, &back, error), -EPROTO);
		if (len > 0) {
			cut[0] = (uint8_t)(len - 1);
			if (coded_get_patch(cut, len, &back, error) == 0)
				patch_unref(back);
		}
		free(cut);
	}
	patch_unref(patch);
	buffer_finish(&b);
}

static void few_bytes_cannot_ask_for_much(void **state)
{
	uint64_t seed = 8;
	(void)state;
	for (int i = 0; i < 20000; i++) {
		uint8_t data[64];
		struct patch *patch;
		char error[128];
		const size_t len = 24 + draw(&seed) % 40;
		for (size_t k = 0; k < len; k++)
			data[k] = (uint8_t)(k < 5 ? 0 : draw(&seed));
		data[0] = (uint8_t)(len - 1);
		if (coded_get_patch(data, len, &patch, error) == 0) {
			assert_true(patch->nv + patch->nt <= len * CODED_SHARE);
			expect_back(patch);
			patch_unref(patch);
		}
	}
}

static void no_decision_is_impossible_in_the_table(void **state)
{
	(void)state;
	for (int i = 0; i < CODED_CONTEXTS; i++)
		assert_int_not_equal(coded_table[i], 0);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(any_patch_comes_back_as_it_was), cmocka_unit_test(the_largest_patch_comes_back),
	    cmocka_unit_test(its_bytes_are_golden),           cmocka_unit_test(every_shorter_one_is_refused),
	    cmocka_unit_test(few_bytes_cannot_ask_for_much),  cmocka_unit_test(no_decision_is_impossible_in_the_table),
	};
	return cmocka_run_group_tests(tests, NULL, NULL);
}
