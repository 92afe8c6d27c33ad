// Judges the files that facetd serves: node files_web.mjs URL PACKAGES. Other people's readers must find in them what
// /status.json says there is. One line on what is wrong for each claim that fails; exit 1 then.
import { createRequire } from 'node:module';
import { pathToFileURL } from 'node:url';
import { join } from 'node:path';

const [url, packages] = process.argv.slice(2);
const require = createRequire(pathToFileURL(join(packages, 'package.json')));
const validator = require('gltf-validator');
const { parse } = require('@loaders.gl/core');
const { PLYLoader } = require('@loaders.gl/ply');
const { PLYLoader: ThreePLYLoader } = await import(pathToFileURL(join(packages, 'node_modules/three/examples/jsm/loaders/PLYLoader.js')));

let failed = 0;
const check = (what, sentence) => { if (!what) { failed++; console.log('FAILED: ' + sentence); } };
const fetched = async (path) => {
  const answer = await fetch(new URL(path, url));
  check(answer.status === 200, `${path}: ${answer.status}`);
  return new Uint8Array(await answer.arrayBuffer());
};

const status = JSON.parse(new TextDecoder().decode(await fetched('/status.json')));
const triangles = status.map_size.triangles;
const header = /element vertex (\d+)[^]*element face (\d+)/;

// glTF
const glb = await fetched('/snapshot.glb');
const report = await validator.validateBytes(glb, { maxIssues: 20 });
check(report.issues.numErrors === 0, `glb: ${JSON.stringify(report.issues.messages.slice(0, 3))}`);
check(report.issues.numWarnings === 0, `glb warns: ${JSON.stringify(report.issues.messages.slice(0, 3))}`);
check(report.info.totalTriangleCount === triangles, `glb: ${report.info.totalTriangleCount} triangles, not ${triangles}`);

// PLY
const ply = await fetched('/snapshot.ply');
const [, nv, nt] = header.exec(new TextDecoder('latin1').decode(ply.subarray(0, 1000))).map(Number);
check(nt === triangles, `ply: its header says ${nt} triangles, not ${triangles}`);
const geometry = new ThreePLYLoader().parse(ply.buffer);
check((geometry.index ? geometry.index.count : 0) === 3 * nt, `three: ${geometry.index?.count} indices, not ${3 * nt}`);
check(geometry.attributes.position.count === nv && (nv === 0 || geometry.attributes.normal.count === nv),
  `three: ${geometry.attributes.position.count} points, not ${nv}`);
if (triangles > 0) {
  const mesh = await parse(ply.buffer, PLYLoader, { worker: false });
  check(mesh.indices.value.length === 3 * nt, `loaders.gl: ${mesh.indices.value.length} indices, not ${3 * nt}`);
  check(mesh.attributes.POSITION.value.length === 3 * nv, `loaders.gl: ${mesh.attributes.POSITION.value.length / 3} points`);
  // Both read the same points: three's as floats.
  const points = geometry.attributes.position.array, others = mesh.attributes.POSITION.value;
  check(points.every((value, i) => Math.abs(value - others[i]) < 1e-5), 'three and loaders.gl read other points');
}

// OBJ, by a parser of its own
let points = 0, faces = 0, out = 0;
for (const line of new TextDecoder().decode(await fetched('/snapshot.obj')).split('\n')) {
  const words = line.trim().split(/\s+/);
  if (words[0] === 'v') points += words.length === 4 && words.slice(1).every((word) => Number.isFinite(Number(word)));
  if (words[0] !== 'f') continue;
  faces++;
  for (const word of words.slice(1)) {
    const index = Number(word.split('/')[0]);
    if (!Number.isInteger(index) || index < 1 || index > nv) out++;
  }
  if (words.length !== 4) out++;
}
check(points === nv && faces === nt && out === 0, `obj: ${points} points, ${faces} faces, ${out} indices out of range`);

console.log(`note: gltf-validator, three, loaders.gl and an OBJ parser read ${nt} triangles, ${nv} points`);
process.exit(failed ? 1 : 0);
