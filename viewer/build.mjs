// Bundles the viewer: node viewer/build.mjs OUT. OUT holds node_modules (npm ci); it gets the gzipped files and pages.h,
// the list that daemon/page.c embeds.
import { createHash } from 'node:crypto';
import { readFileSync, writeFileSync } from 'node:fs';
import { createRequire } from 'node:module';
import { dirname, join, resolve } from 'node:path';
import { fileURLToPath } from 'node:url';
import { gzipSync } from 'node:zlib';

const LIMIT = 200 * 1024; // gzipped, in all: a robot's radio link carries it in a second
const from = dirname(fileURLToPath(import.meta.url));
const out = process.argv[2];
const modules = resolve(out, 'node_modules');
const esbuild = createRequire(join(modules, 'x.js'))('esbuild');

function bundle(entry) {
  const made = esbuild.buildSync({
    entryPoints: [join(from, entry)], bundle: true, minify: true, write: false, format: 'esm', target: 'es2020',
    nodePaths: [modules], legalComments: 'none', logLevel: 'warning',
    banner: entry.endsWith('.js') ? { js: '/* three.js, MIT: notices.txt */' } : {},
  });
  return Buffer.from(made.outputFiles[0].contents);
}

const notices = Buffer.from('The viewer of facetd contains three.js:\n\n' + readFileSync(join(modules, 'three/LICENSE')));
const files = [
  ['/', 'text/html; charset=utf-8', 'index.html', readFileSync(join(from, 'index.html'))],
  ['/viewer.js', 'text/javascript; charset=utf-8', 'viewer.js', bundle('main.js')],
  ['/viewer.css', 'text/css; charset=utf-8', 'viewer.css', bundle('style.css')],
  ['/icon.svg', 'image/svg+xml', 'icon.svg', readFileSync(join(from, 'icon.svg'))],
  ['/notices.txt', 'text/plain; charset=utf-8', 'notices.txt', notices],
];

let list = '/* Made by viewer/build.mjs. */\n';
let total = 0;
for (const [number, [path, type, name, bytes]] of files.entries()) {
  const gzip = gzipSync(bytes, { level: 9 });
  const etag = createHash('sha256').update(bytes).digest('hex').slice(0, 16);
  const file = join(out, name + '.gz');
  writeFileSync(file, gzip);
  list += `PAGE(${number}, "${path}", "${type}", "\\"${etag}\\"", "${file}", ${gzip.length})\n`;
  total += gzip.length;
}
if (total > LIMIT) {
  console.error(`the viewer takes ${total} bytes gzipped, more than ${LIMIT}`);
  process.exit(1);
}
writeFileSync(join(out, 'pages.h'), list);
console.log(`  PAGE build/viewer (${(total / 1024).toFixed(0)} KB gzipped)`);
