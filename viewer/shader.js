// The one material of the map: every colour mode, edges and wireframe, the section. Changing the look uploads nothing.
// Colours are display values throughout (no linear workflow), as in the style sheet beside them.
import { GLSL3, RawShaderMaterial, DoubleSide, Vector2, Vector3 } from 'three';
import { CLASS_COLOURS, RAMP, channels } from './colours.js';

const vertexShader = `
precision highp float;
uniform mat4 modelMatrix, viewMatrix, projectionMatrix;
in vec4 position;
in vec4 tag;
in float stamp;
in vec4 normal;
out vec3 at;
out vec3 corner;
out vec3 smoothNormal;
flat out vec4 face;
flat out float seen;
void main() {
  vec4 world = modelMatrix * vec4(position.xyz, 1.0);
  int c = gl_VertexID % 3;
  at = world.xyz;
  corner = vec3(c == 0, c == 1, c == 2);
  smoothNormal = normal.xyz;
  face = tag;
  seen = stamp;
  gl_Position = projectionMatrix * viewMatrix * world;
}`;

const fragmentShader = `
precision highp float;
uniform int mode;
uniform bool wire, edges, backs;
uniform float section, now, ageSpan, veilFrom;
uniform vec2 heights;
uniform vec3 eye, classes[9], ramp[5];
in vec3 at;
in vec3 corner;
in vec3 smoothNormal;
flat in vec4 face;
flat in float seen;
out vec4 colour;

vec3 shadeColour(float shade) { // golden angle in hue, two lightnesses
  float hue = fract(shade * 0.61803399);
  vec3 pure = clamp(abs(mod(hue * 6.0 + vec3(0.0, 4.0, 2.0), 6.0) - 3.0) - 1.0, 0.0, 1.0);
  return mix(vec3(mod(shade, 2.0) < 0.5 ? 0.50 : 0.62), pure, 0.42) + 0.10;
}
vec3 rampColour(float x) {
  x = clamp(x, 0.0, 1.0) * 4.0;
  int i = int(min(x, 3.0));
  return mix(ramp[i], ramp[i + 1], x - float(i));
}
vec3 plaster(vec3 n) { // by where a surface faces: floors sand, ceilings blue-grey, walls warm and cool by turns
  vec3 wall = mix(vec3(0.64, 0.71, 0.77), vec3(0.86, 0.84, 0.80), n.y * n.y);
  return n.z > 0.0 ? mix(wall, vec3(0.71, 0.66, 0.57), smoothstep(0.5, 0.95, n.z))
                   : mix(wall, vec3(0.52, 0.60, 0.70), smoothstep(0.5, 0.95, -n.z));
}
vec3 baseColour(vec3 n) {
  if (mode == 2) return classes[int(min(face.x, 8.0))];
  if (mode == 3) return face.y < 0.5 ? vec3(0.42, 0.45, 0.48) : shadeColour(face.y);
  if (mode == 4) return shadeColour(face.z);
  if (mode == 5) return rampColour((at.z - heights.x) / max(heights.y - heights.x, 0.1));
  if (mode == 6) return rampColour(1.0 - (now - seen) / ageSpan);
  return plaster(n);
}
float lineAlong(vec3 bars, vec3 wanted, float width) { // 1 on the wanted edges, softened over a pixel
  vec3 pixel = fwidth(bars);
  vec3 near = 1.0 - smoothstep(pixel * (width - 0.5), pixel * (width + 0.5), bars);
  vec3 on = near * wanted;
  return max(on.x, max(on.y, on.z));
}
void main() {
  if (at.z > section) discard;
  vec3 flatNormal = normalize(cross(dFdx(at), dFdy(at)));
  if (!gl_FrontFacing && !backs) { // walls seen from behind are a veil, floors and ceilings nothing: a doll's house
    ivec2 p = ivec2(gl_FragCoord.xy);
    if (abs(flatNormal.z) > 0.6 || length(eye - at) < veilFrom) discard; // near, a veil would be in the way
    if ((p.x & 1) != 0 || ((p.y + (p.x >> 1)) & 1) != 0) discard;
  }
  vec3 toEye = normalize(eye - at);
  vec3 n = mode == 1 && dot(smoothNormal, smoothNormal) > 0.01 ? normalize(smoothNormal) : flatNormal;
  if (!gl_FrontFacing && mode == 1) n = -n;
  vec3 base = baseColour(gl_FrontFacing ? n : -n);
  float key = max(dot(n, normalize(vec3(-0.45, -0.62, 0.64))), 0.0);
  float fill = max(dot(n, normalize(vec3(0.80, 0.35, 0.15))), 0.0);
  float light = 0.56 + 0.06 * n.z + 0.36 * key + 0.14 * fill + 0.06 * max(dot(n, toEye), 0.0);
  light *= mix(1.0, mix(0.82, 1.0, smoothstep(0.0, 0.7, at.z - heights.x)), 1.0 - abs(n.z)); // walls darken to their feet
  vec3 lit = base * light;
  if (!gl_FrontFacing) lit = mix(vec3(dot(lit, vec3(0.33))), lit, 0.4) * (backs ? 0.62 : 0.8);
  float edgeBits = face.w;
  vec3 wanted = vec3(mod(edgeBits, 2.0) >= 1.0, mod(edgeBits, 4.0) >= 2.0, edgeBits >= 4.0);
  if (edges) lit = mix(lit, lit * 0.30, 0.85 * lineAlong(corner, wanted, 0.9));
  if (wire) lit = mix(lit, vec3(0.04, 0.09, 0.12), 0.72 * lineAlong(corner, vec3(1.0), 0.55));
  colour = vec4(lit, 1.0);
}`;

const vectors = (colours) => colours.map((hex) => new Vector3(...channels(hex)));

export function mapMaterial() {
  return new RawShaderMaterial({
    glslVersion: GLSL3, vertexShader, fragmentShader, side: DoubleSide,
    uniforms: {
      mode: { value: 0 }, wire: { value: false }, edges: { value: true }, backs: { value: false }, section: { value: 1e9 }, now: { value: 0 },
      ageSpan: { value: 60 }, veilFrom: { value: 9 }, heights: { value: new Vector2(0, 3) }, eye: { value: new Vector3() },
      classes: { value: vectors(CLASS_COLOURS) }, ramp: { value: vectors(RAMP) },
    },
  });
}
