// Makes docs/viewer.png and docs/viewer_phone.png anew: node docs/viewer_pictures.mjs [URL], after `make`. Two minutes: the robot of the
// demo building (or the one of a facetd that runs at URL) drives there and most of the way back, in sight of real Chromium.
import { spawn } from 'node:child_process';
import { mkdtempSync, rmSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { dirname, join } from 'node:path';
import { fileURLToPath } from 'node:url';
import { Browser, sleep, until } from '../tests/viewer_browser.mjs';

const docs = dirname(fileURLToPath(import.meta.url)), root = join(docs, '..');
const dir = mkdtempSync(join(tmpdir(), 'viewer-pictures-')), address = process.argv[2] ?? 'http://127.0.0.1:7881/';
const ROWS = 4500;

const devices = process.argv[2] ? null : spawn(join(root, 'build/facet'), ['simulate', 'building', '--endless', '--dir', join(dir, 'd'), '--http', '127.0.0.1:7881',
  '--', join(root, 'build/facetd')], { stdio: 'ignore' });
const browser = new Browser();
try {
  const step = async () => (await fetch(`${address}status.json`)).json().then((status) => status.step).catch(() => 0);
  await until('the daemon', 20, () => step().then(() => true, () => false));
  const page = await browser.open(address, 1280, 800);
  await until('the drive', 180, async () => (await step()) > ROWS);
  const seen = 'viewer.map.whole && viewer.live?.fresh > 0 && viewer.robot.trail.n > 20';
  await page.until('the map and the laser', 60, seen);
  await sleep(2000);
  await page.picture(join(docs, 'viewer.png'));
  await page.close();
  const phone = await browser.open(address, 360, 640, true);
  await phone.until('the map on a phone', 60, 'viewer.map.whole && viewer.live?.fresh > 0 && viewer.map.drawn > 0.95 * viewer.mirror.triangles');
  await sleep(4000);
  await phone.picture(join(docs, 'viewer_phone.png'));
} finally {
  await browser.end();
  devices?.kill('SIGTERM');
  if (devices) await new Promise((done) => devices.once('exit', done));
  rmSync(dir, { recursive: true, force: true });
}
