/* glTF 2.0 binary (.glb): a header, one JSON chunk, one binary chunk.
 *
 *   12 bytes  "glTF", u32 2, u32 length of all
 *   chunk     u32 length, "JSON", text padded with blanks to 4 bytes
 *   chunk     u32 length, "BIN\0": positions (3 floats), normals (3 floats), indices (3 u32 a face)
 *
 * glTF is y up, z forward, x to the left; the map frame is x forward, y left, z up: (x, y, z) -> (y, z, x), a rotation
 * that moves numbers and rounds none. Positions are floats, as the format wants them; their least and greatest values
 * are those of the floats. An empty mesh has no accessors, which must count at least one: the file then holds an
 * empty scene. */
#include "core/model.h"

#include <errno.h>
#include <string.h>

#define CHUNK_JSON 0x4e4f534au
#define CHUNK_BIN  0x004e4942u

static void put_u32(struct buffer *buffer, uint32_t value)
{
	buffer_append(buffer, &value, sizeof value);
}

static void turn(const double from[3], float to[3])
{
	to[0] = (float)from[1];
	to[1] = (float)from[2];
	to[2] = (float)from[0];
}

static void bounds(const struct model *model, float ret_min[3], float ret_max[3])
{
	turn(model->vertex[0], ret_min);
	turn(model->vertex[0], ret_max);
	for (uint32_t v = 1; v < model->nv; v++) {
		float p[3];
		turn(model->vertex[v], p);
		for (int a = 0; a < 3; a++) {
			ret_min[a] = p[a] < ret_min[a] ? p[a] : ret_min[a];
			ret_max[a] = p[a] > ret_max[a] ? p[a] : ret_max[a];
		}
	}
}

static void describe(const struct model *model, struct buffer *json)
{
	size_t points = (size_t)model->nv * 12, indices = (size_t)model->nt * 12;
	float min[3], max[3];
	bounds(model, min, max);
	buffer_printf(
	    json,
	    ",\"scenes\":[{\"nodes\":[0]}],\"nodes\":[{\"mesh\":0,\"name\":\"map\"}],\"meshes\":[{\"primitives\":["
	    "{\"attributes\":{\"POSITION\":0,\"NORMAL\":1},\"indices\":2,\"material\":0,\"mode\":4}]}]");
	buffer_printf(json, ",\"materials\":[{\"pbrMetallicRoughness\":{\"baseColorFactor\":[0.8,0.8,0.8,1],"
	                    "\"metallicFactor\":0,\"roughnessFactor\":1},\"doubleSided\":true}]");
	buffer_printf(json, ",\"accessors\":[{\"bufferView\":0,\"componentType\":5126,\"count\":%u,\"type\":\"VEC3\",",
	              model->nv);
	buffer_printf(json, "\"min\":[%.9g,%.9g,%.9g],\"max\":[%.9g,%.9g,%.9g]}", (double)min[0], (double)min[1],
	              (double)min[2], (double)max[0], (double)max[1], (double)max[2]);
	buffer_printf(json, ",{\"bufferView\":1,\"componentType\":5126,\"count\":%u,\"type\":\"VEC3\"}", model->nv);
	buffer_printf(json, ",{\"bufferView\":2,\"componentType\":5125,\"count\":%zu,\"type\":\"SCALAR\"}]",
	              (size_t)model->nt * 3);
	buffer_printf(json, ",\"bufferViews\":[{\"buffer\":0,\"byteOffset\":0,\"byteLength\":%zu,\"target\":34962}",
	              points);
	buffer_printf(json, ",{\"buffer\":0,\"byteOffset\":%zu,\"byteLength\":%zu,\"target\":34962}", points, points);
	buffer_printf(json, ",{\"buffer\":0,\"byteOffset\":%zu,\"byteLength\":%zu,\"target\":34963}]", points * 2,
	              indices);
	buffer_printf(json, ",\"buffers\":[{\"byteLength\":%zu}]", points * 2 + indices);
}

static void put_data(const struct model *model, struct buffer *ret)
{
	for (uint32_t v = 0; v < model->nv; v++) {
		float p[3];
		turn(model->vertex[v], p);
		buffer_append(ret, p, sizeof p);
	}
	for (uint32_t v = 0; v < model->nv; v++) {
		const float *n = model->normal[v], turned[3] = {n[1], n[2], n[0]};
		buffer_append(ret, turned, sizeof turned);
	}
	buffer_append(ret, model->triangle, (size_t)model->nt * 12);
}

void gltf_write(const struct model *model, struct buffer *ret)
{
	struct buffer json = {0};
	size_t data = (size_t)model->nv * 24 + (size_t)model->nt * 12;
	buffer_printf(&json, "{\"asset\":{\"version\":\"2.0\",\"generator\":\"facetd\"},\"scene\":0");
	if (model->nt)
		describe(model, &json);
	else
		buffer_printf(&json, ",\"scenes\":[{\"name\":\"empty\"}]");
	buffer_printf(&json, "}");
	while (json.len % 4 && !json.error)
		buffer_append(&json, " ", 1);
	size_t all = 12 + 8 + json.len + (model->nt ? 8 + data : 0);
	if (json.error || all > UINT32_MAX) {
		ret->error = json.error ? json.error : -EFBIG;
		buffer_finish(&json);
		return;
	}
	buffer_append(ret, "glTF", 4);
	put_u32(ret, 2);
	put_u32(ret, (uint32_t)all);
	put_u32(ret, (uint32_t)json.len);
	put_u32(ret, CHUNK_JSON);
	buffer_append(ret, json.data, json.len);
	buffer_finish(&json);
	if (!model->nt)
		return;
	put_u32(ret, (uint32_t)data);
	put_u32(ret, CHUNK_BIN);
	put_data(model, ret);
}
