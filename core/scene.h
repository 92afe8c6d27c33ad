/* A patch as an entity of a scene, in the schemas that Foxglove reads (foxglove.SceneUpdate), as JSON text or as
 * protobuf bytes. Pure; docs/foxglove.md says what a reader makes of it. */
#ifndef FACET_CORE_SCENE_H
#define FACET_CORE_SCENE_H

#include "core/model.h"
#include "core/patch.h"

enum scene_encoding { SCENE_AS_JSON, SCENE_AS_PROTOBUF };

#define SCENE_FRAME   "map"
#define SCENE_ID_MAX  40 /* "x,y,z" with its NUL */
#define SCENE_CLASSES 9  /* interfaces, section 1: 0 unknown .. 8 table */

/* An entity: id "x,y,z" (the patch's key), frame `map`, the time of the last row in it, for ever; one list of
 * triangles for each class in it, in that class's colour. As JSON one object, without a comma; as protobuf the field
 * `entities` of a SceneUpdate, tag and length included, so that fields in a row are a SceneUpdate. nt > 0. */
void scene_put_entity(struct buffer *, enum scene_encoding, const struct patch *, double cell_m);

/* The removal of one entity, or (`all`) of every one, that is older than `t_ns`; likewise one object, or the field
 * `deletions`. */
struct scene_deletion {
	int64_t t_ns;
	bool all;
	struct patch_key key;
};
void scene_put_deletion(struct buffer *, enum scene_encoding, const struct scene_deletion *);

/* A whole SceneUpdate: with `all` everything before it goes first; then patches that are gone (nt 0) are deletions of
 * `t_ns`, the others entities. */
void scene_put_update(struct buffer *, enum scene_encoding, int64_t t_ns, bool all, struct patch *const *, size_t n,
                      double cell_m);

/* What stands around JSON objects of a SceneUpdate; protobuf needs nothing. */
#define SCENE_JSON_BEGIN  "{\"deletions\":["
#define SCENE_JSON_MIDDLE "],\"entities\":["
#define SCENE_JSON_END    "]}"

void scene_id(struct patch_key, char ret[SCENE_ID_MAX]);
/* r, g, b of a class, 0..1. */
const double *scene_colour(uint8_t class);

#endif
