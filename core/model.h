/* A whole mesh in one piece, for files: vertices welded by lattice point, in metres.
 * Writers fill a buffer; tools and the daemon open files (law L1). */
#ifndef FACET_CORE_MODEL_H
#define FACET_CORE_MODEL_H

#include <stddef.h>
#include <stdint.h>

#include "core/patch.h"
#include "core/types.h"

struct model {
	uint32_t nv, nt;
	double (*vertex)[3]; /* m */
	float (*normal)[3];  /* averaged over all faces of a point, area-weighted, unit length */
	uint32_t (*triangle)[3];
	int32_t *plane; /* [nt] -1 none */
	uint8_t *class; /* [nt] */
};

/* Welds the living patches of a store, in key order: two vertices are one exactly where their lattice points are equal. 0 or -ENOMEM. */
int model_weld(const struct patch_store *, double cell_m, struct model *ret);
void model_finish(struct model *);

/* Bytes that grow; a failed allocation is remembered and everything after it ignored. */
struct buffer {
	uint8_t *data;
	size_t len, cap;
	int error; /* 0, -ENOMEM, or -EFBIG: more than the format can hold (4 GB of .glb) */
};
bool buffer_reserve(struct buffer *, size_t more); /* room behind `len`; false: memory is out, and it is remembered */
void buffer_append(struct buffer *, const void *data, size_t len);
void buffer_printf(struct buffer *, const char *format, ...) __attribute__((format(printf, 2, 3)));
void buffer_finish(struct buffer *);

/* Writers: x y z as double in PLY (so that equal lattice points stay equal), nx ny nz as float, per face plane and class. */
void ply_write(const struct model *, bool ascii, struct buffer *ret);
void obj_write(const struct model *, struct buffer *ret);
void stl_write(const struct model *, struct buffer *ret);  /* binary */
void gltf_write(const struct model *, struct buffer *ret); /* .glb; z up turned to glTF's y up */

/* Readers: parse a whole file in memory. On bad input they answer -EINVAL and one sentence without the file's name
 * but with the line (0 where lines mean nothing), say "line 7: ..." is made by the caller. */
struct parse_error {
	uint32_t line;
	char text[160];
};

/* A cloud without a raster. */
struct cloud {
	size_t n;
	struct vec3 *point; /* m */
};
void cloud_finish(struct cloud *);
int ply_read_cloud(const uint8_t *data, size_t len, struct cloud *ret, struct parse_error *error);
int pcd_read(const uint8_t *data, size_t len, struct cloud *ret,
             struct parse_error *error); /* ascii, binary, binary_compressed */
int xyz_read(const uint8_t *data, size_t len, struct cloud *ret,
             struct parse_error *error); /* .xyz; .pts with a count line */

/* uos .3d: rows of a raster where one can be recovered (else the file is a cloud). Ranges and bearings as the scanner
 * had them, so that the rows go the way of live ones; see uos.c for the frames. Ranges outside these limits keep their
 * value and are BEAM_OUT_OF_RANGE; SICK's error codes are states, their range (32.759 .. 32.767 m) is kept too; a beam
 * the file has no point for is BEAM_NO_ECHO with range 0. */
#define UOS_RANGE_MIN_M 0.3
#define UOS_RANGE_MAX_M 30.0
struct uos_scan {
	uint32_t rows;
	struct uos_row {
		double tilt_rad;            /* positive looks down */
		double first_rad, step_rad; /* 0 straight ahead, positive left */
		uint32_t n;
		float *range_m;
		uint8_t *state; /* enum beam_state */
	} * row;
	struct cloud cloud; /* filled instead when there is no raster; in the scanner's frame, m, x forward, z up */
};
int uos_read(const uint8_t *data, size_t len, struct uos_scan *ret, struct parse_error *error);
void uos_finish(struct uos_scan *);
/* .pose: x y z in cm, Euler angles in degrees, left-handed -> map <- scanner, right-handed, metres. */
int uos_read_pose(const char *text, size_t len, struct transform *ret, struct parse_error *error);

/* SHA-256 (FIPS 180-4). */
struct sha256 {
	uint32_t h[8];
	uint64_t len;
	uint8_t block[64];
};
void sha256_init(struct sha256 *);
void sha256_add(struct sha256 *, const void *data, size_t len);
void sha256_hex(struct sha256 *, char ret_hex[65]);

#endif
