// Patches to arrays for the graphics card. 4x4x4 patches make one draw call, a chunk; its positions are the lattice
// integers themselves (a chunk is 16,384 wide, which fits 16 bits), so nothing is rounded. Triangles share no vertices:
// class, plane and patch belong to faces, and the shader draws edges by the distance to the three corners.
//   position u16x4: x y z in the chunk, 0
//   tag      u8x4:  class, shade of the plane (0 none), shade of the patch, edges to be drawn (bit i: the one opposite corner i)
//   stamp    f32:   when the patch was last seen, s since the first one
//   normal   i8x4:  smooth shading only
import { isPlane } from './native.js';

export const PATCHES = 4, PATCH_UNITS = 4096;
const CREASE_COS = Math.cos((38 * Math.PI) / 180);

export const chunkKeyOf = (key) => key.map((k) => Math.floor(k / PATCHES));

// A shade 1..255 that an id keeps; neighbouring ids get distant ones.
export function shadeOf(a, b = 0, c = 0) {
  let h = Math.imul(a, 0x9e3779b1) ^ Math.imul(b, 0x85ebca6b) ^ Math.imul(c, 0xc2b2ae35);
  h = Math.imul(h ^ (h >>> 15), 0x2c1b3c6d);
  return 1 + ((h ^ (h >>> 13)) >>> 0) % 255;
}

function faceNormals({ vertices: v, indices, triangles }) {
  const normals = new Float32Array(3 * triangles); // as long as twice the area
  for (let t = 0; t < triangles; t++) {
    const a = 3 * indices[3 * t], b = 3 * indices[3 * t + 1], c = 3 * indices[3 * t + 2];
    const ux = v[b] - v[a], uy = v[b + 1] - v[a + 1], uz = v[b + 2] - v[a + 2];
    const wx = v[c] - v[a], wy = v[c + 1] - v[a + 1], wz = v[c + 2] - v[a + 2];
    normals[3 * t] = uy * wz - uz * wy;
    normals[3 * t + 1] = uz * wx - ux * wz;
    normals[3 * t + 2] = ux * wy - uy * wx;
  }
  return normals;
}

function cosBetween(n, s, m, t) {
  const dot = n[3 * s] * m[3 * t] + n[3 * s + 1] * m[3 * t + 1] + n[3 * s + 2] * m[3 * t + 2];
  return dot / (Math.hypot(n[3 * s], n[3 * s + 1], n[3 * s + 2]) * Math.hypot(m[3 * t], m[3 * t + 1], m[3 * t + 2]) || 1);
}

// Whether an edge without a partner in its patch lies in the patch's border, where the neighbour has the partner.
function onBorder(v, a, b) {
  for (let axis = 0; axis < 3; axis++) {
    const p = v[3 * a + axis];
    if ((p === 0 || p === PATCH_UNITS) && v[3 * b + axis] === p) return true;
  }
  return false;
}

// The edges that tell the shape: creases and rims. One bit set of each triangle.
function edgesOf(patch, normals) {
  const { vertices, indices, triangles } = patch;
  const edges = new Uint8Array(triangles), partner = new Map();
  for (let t = 0; t < triangles; t++)
    for (let corner = 0; corner < 3; corner++) {
      const a = indices[3 * t + (corner + 1) % 3], b = indices[3 * t + (corner + 2) % 3];
      const back = b * 65536 + a, other = partner.get(back);
      if (other === undefined) {
        partner.set(a * 65536 + b, 4 * t + corner);
        continue;
      }
      partner.delete(back);
      if (cosBetween(normals, t, normals, other >> 2) < CREASE_COS) {
        edges[t] |= 1 << corner;
        edges[other >> 2] |= 1 << (other & 3);
      }
    }
  for (const [edge, at] of partner)
    if (!onBorder(vertices, Math.floor(edge / 65536), edge % 65536)) edges[at >> 2] |= 1 << (at & 3);
  return edges;
}

// What a patch adds to its chunk; made once for each version of the patch.
function arraysOf(patch) {
  if (patch.arrays) return patch.arrays;
  const { vertices, indices, triangles, key } = patch;
  const position = new Uint16Array(12 * triangles), tag = new Uint8Array(12 * triangles);
  const normals = faceNormals(patch), edges = edgesOf(patch, normals);
  const shade = shadeOf(...key);
  const [x, y, z] = key.map((k) => (k - PATCHES * Math.floor(k / PATCHES)) * PATCH_UNITS);
  for (let i = 0; i < 3 * triangles; i++) {
    const from = 3 * indices[i], t = (i / 3) | 0, plane = patch.planes[t];
    position[4 * i] = vertices[from] + x;
    position[4 * i + 1] = vertices[from + 1] + y;
    position[4 * i + 2] = vertices[from + 2] + z;
    tag[4 * i] = patch.classes[t];
    tag[4 * i + 1] = isPlane(plane) ? shadeOf(plane, plane < 4096 ? shade : 0) : 0;
    tag[4 * i + 2] = shade;
    tag[4 * i + 3] = edges[t];
  }
  patch.arrays = { position, tag, normals };
  return patch.arrays;
}

// Smooth normals: at each point the faces that meet there at less than the crease angle, also those of other patches.
function smoothNormals(patches, around, origin) {
  const at = new Map(); // point -> [normals, triangle, ...]
  const name = (patch, index, offset) => {
    const from = 3 * index;
    return ((patch.vertices[from] + offset[0]) * 65536 + patch.vertices[from + 1] + offset[1]) * 65536 +
      patch.vertices[from + 2] + offset[2];
  };
  const offsetOf = (patch) => patch.key.map((k, axis) => (k - PATCHES * origin[axis] + 1) * PATCH_UNITS);
  for (const patch of around) {
    const { normals } = arraysOf(patch), offset = offsetOf(patch);
    patch.indices.forEach((index, i) => {
      const point = name(patch, index, offset), faces = at.get(point);
      if (faces) faces.push(normals, (i / 3) | 0);
      else at.set(point, [normals, (i / 3) | 0]);
    });
  }
  const triangles = patches.reduce((sum, patch) => sum + patch.triangles, 0);
  const smooth = new Int8Array(12 * triangles);
  let out = 0;
  for (const patch of patches) {
    const { normals } = arraysOf(patch), offset = offsetOf(patch);
    for (let i = 0; i < 3 * patch.triangles; i++, out += 4) {
      const faces = at.get(name(patch, patch.indices[i], offset)), t = (i / 3) | 0;
      let x = 0, y = 0, z = 0;
      for (let f = 0; f < faces.length; f += 2) {
        const m = faces[f], s = faces[f + 1];
        if (cosBetween(normals, t, m, s) < CREASE_COS) continue;
        x += m[3 * s];
        y += m[3 * s + 1];
        z += m[3 * s + 2];
      }
      const scale = 127 / (Math.hypot(x, y, z) || 1);
      smooth[out] = x * scale;
      smooth[out + 1] = y * scale;
      smooth[out + 2] = z * scale;
    }
  }
  return smooth;
}

// `patches` of one chunk in one; `around` (itself and its neighbours) where normals are wanted, else null.
export function buildChunk(patches, around, origin, epoch) {
  const vertices = 3 * patches.reduce((sum, patch) => sum + patch.triangles, 0);
  const position = new Uint16Array(4 * vertices), tag = new Uint8Array(4 * vertices), stamp = new Float32Array(vertices);
  let at = 0;
  for (const patch of patches) {
    const arrays = arraysOf(patch);
    position.set(arrays.position, 4 * at);
    tag.set(arrays.tag, 4 * at);
    stamp.fill(patch.last - epoch, at, at + 3 * patch.triangles);
    at += 3 * patch.triangles;
  }
  return { position, tag, stamp, normal: around && smoothNormals(patches, around, origin), vertices };
}
