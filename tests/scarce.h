/* Memory that runs out at a chosen call, for tests: malloc and its kin of the whole program, libraries included, are
 * replaced. Not with sanitizers, which bring their own. One file of a program includes this. */
#ifndef FACET_TESTS_SCARCE_H
#define FACET_TESTS_SCARCE_H

#include <stdbool.h>
#include <stddef.h>

#if defined(__has_feature)
#if __has_feature(address_sanitizer) || __has_feature(thread_sanitizer)
#define SCARCE_WORKS false
#endif
#endif
#ifdef __SANITIZE_ADDRESS__
#define SCARCE_WORKS false
#endif
#ifdef SCARCE_WORKS

static long scarce_left, scarce_live;

#else
#define SCARCE_WORKS true

static long scarce_left = -1; /* calls until memory is out once; -1: never */
static long scarce_live;      /* blocks in use */

void *__libc_malloc(size_t size);
void *__libc_memalign(size_t alignment, size_t size);
void *__libc_calloc(size_t n, size_t size);
void *__libc_realloc(void *p, size_t size);
void __libc_free(void *p);

static bool scarce_refuses(void)
{
	return scarce_left >= 0 && scarce_left-- == 0;
}

void *malloc(size_t size)
{
	void *p = scarce_refuses() ? NULL : __libc_malloc(size);
	scarce_live += p != NULL;
	return p;
}

void *aligned_alloc(size_t alignment, size_t size)
{
	void *p = scarce_refuses() ? NULL : __libc_memalign(alignment, size);
	scarce_live += p != NULL;
	return p;
}

void *calloc(size_t n, size_t size)
{
	void *p = scarce_refuses() ? NULL : __libc_calloc(n, size);
	scarce_live += p != NULL;
	return p;
}

void *realloc(void *p, size_t size)
{
	void *q = scarce_refuses() ? NULL : __libc_realloc(p, size);
	scarce_live += !p && q;
	return q;
}

void free(void *p)
{
	scarce_live -= p != NULL;
	__libc_free(p);
}
#endif

#endif
