/* The files of the viewer, embedded.
 *
 * viewer/build.mjs bundles viewer/ into build/viewer/ and lists what it made in pages.h, one PAGE(number, path, type,
 * etag, file, bytes) a line. The assembler's .incbin takes the bytes in: a C array of 170 KB would cost the compiler more
 * than everything else, and a file beside the program could be lost or of another version. Where node is missing the list
 * is empty and the daemon says so instead of the page. The etag is a hash of the bytes, so pages.h, on which this file's
 * object depends, changes whenever they do. */
#include "daemon/page.h"

#include <string.h>

#if __has_include("pages.h")
#define PAGE(number, path, type, etag, file, len) \
	__asm__(".pushsection .rodata\n"          \
	        "page_bytes_" #number ":\n"       \
	        ".incbin \"" file "\"\n"          \
	        ".popsection\n");                 \
	extern const unsigned char page_bytes_##number[len] __attribute__((visibility("hidden")));
#include "pages.h"
#undef PAGE
#endif

#define PAGE(number, path, type, etag, file, len) {path, type, etag, page_bytes_##number, len},
static const struct page pages[] = {
#if __has_include("pages.h")
#include "pages.h"
#endif
    {NULL, NULL, NULL, NULL, 0},
};

const struct page *page_find(const char *path)
{
	for (const struct page *page = pages; page->path; page++) {
		if (strcmp(page->path, path) == 0)
			return page;
	}
	return NULL;
}

bool page_built(void)
{
	return page_find("/");
}
