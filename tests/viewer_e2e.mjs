// Law: what the page shows is what the daemon holds, through restarts, on any screen. node tests/viewer_e2e.mjs BUILD
// The devices and facetd are two processes here, so that facetd can be ended and started again.
import assert from 'node:assert/strict';
import { spawn } from 'node:child_process';
import { existsSync, mkdtempSync, readdirSync, readFileSync, rmSync, writeFileSync } from 'node:fs';
import { connect, createServer } from 'node:net';
import { tmpdir } from 'node:os';
import { join, resolve } from 'node:path';
import { Browser, sleep, until } from './viewer_browser.mjs';

const build = resolve(process.argv[2] ?? 'build');
const dir = mkdtempSync(join(tmpdir(), 'viewer-'));
const TINY = 200 * 1024, PATCHES = 250, TOKEN = 'a-token-of-the-page-0123456789';
const ours = [];

function start(program, ...words) {
  const child = spawn(join(build, program), words, { stdio: ['ignore', 'ignore', 'pipe'], env: { ...process.env, FACETD: '' } });
  child.log = '';
  child.stderr.setEncoding('utf8').on('data', (text) => (child.log += text));
  child.gone = new Promise((done) => child.once('exit', done));
  ours.push(child);
  return child;
}

async function end(child) {
  child.kill('SIGTERM');
  await Promise.race([child.gone, sleep(120000).then(() => child.kill('SIGKILL'))]);
}

function freePort() {
  return new Promise((done) => {
    const server = createServer().listen(0, '127.0.0.1', () => {
      const { port } = server.address();
      server.close(() => done(port));
    });
  });
}

// One command over the unix socket, which may change everything; its answer. Node may be kept from writing it for so long that the
// daemon closes the connection of one who says nothing; and a daemon that has just begun may not be there so far.
async function command(word) {
  for (let tries = 0; ; tries++) {
    try {
      return await commandOnce(word);
    } catch (error) {
      if (tries === 5) throw error;
      await sleep(200);
    }
  }
}

function commandOnce(word) {
  return new Promise((done, fail) => {
    const socket = connect(join(dir, 'facetd.sock'));
    let text = '';
    socket.on('error', fail).on('close', () => fail(new Error(`?${word}: no answer`))).on('data', (data) => {
      text += data;
      const answer = text.split('\n').slice(0, -1).map((line) => JSON.parse(line)).find((one) => one.class !== 'VERSION');
      if (!answer) return;
      done(answer);
      socket.destroy();
    });
    socket.write(`?${word}\n`);
  });
}

const status = () => command('STATUS');
const counts = (page) => page.ask('viewer.counts()');

// Into the configuration that `facet simulate` wrote: a token, and a folder for recordings.
function grantToken() {
  const config = join(dir, 'facetd.yaml'), file = join(dir, 'token');
  writeFileSync(file, `${TOKEN}\n`, { mode: 0o600 });
  writeFileSync(config, readFileSync(config, 'utf8').replace(/^listen: \{/m, `listen: {token_file: "${file}", `) +
    `record: {dir: "${dir}"}\n`);
}

// The same without devices' recording of what is replayed.
function replayConfig() {
  const config = join(dir, 'replay.yaml');
  writeFileSync(config, readFileSync(join(dir, 'facetd.yaml'), 'utf8').replace(/^record: .*\n/m, ''));
  return config;
}

let address;
const startDaemon = async () => {
  const daemon = start('facetd', '--config', join(dir, 'facetd.yaml'));
  await until('facetd listens', 60, () => status().catch(() => null));
  return daemon;
};

// A map that stands still: rows are not applied any more, and all is meshed. Whoever has a page to look at meanwhile begins it
// before, so that the map does not grow for as long as a slow machine takes for the page.
async function standStill(patches) {
  await until(`a map of ${patches} patches`, 60, async () => (await status()).map_size.patches >= patches);
  assert.equal((await command('PAUSE')).class, 'OK');
  return until('the map stands', 60, async () => {
    const now = await status();
    return now.queue.idle && now;
  });
}

// Both are asked anew each time: what the daemon still works on when it is asked is no map that the page could have.
const holds = (page, what) => until(what, 120, async () => {
  const now = await status(), shown = await counts(page), { patches, triangles } = now.map_size;
  return shown.patches === patches && shown.triangles === triangles && shown.drawn === triangles && shown.step === now.step &&
    shown.generation === now.generation;
});

// The camera glides; it stands when three pictures in a row are seen from the same place.
const standing = (page) => page.until('the camera stands', 60, `new Promise((done) => {
  const at = () => viewer.camera.current.matrixWorld.elements.join() + viewer.camera.current.projectionMatrix.elements.join();
  const before = at();
  let frames = 0;
  const turn = () => (++frames < 4 ? requestAnimationFrame(turn) : done(before === at()));
  requestAnimationFrame(turn);
})`);

// ---- the claims ----

const claims = {
  async 'the page takes at most 200 KB and names nobody else'({ browser }) {
    const asked = [];
    browser.heard = (method, params) => method === 'Network.requestWillBeSent' && asked.push(params.request.url);
    const page = await browser.open('about:blank');
    await page.call('Network.enable');
    await page.call('Page.navigate', { url: address });
    await page.until('the page runs', 60, 'viewer.counts().patches > 0');
    browser.heard = null;
    await page.close();
    assert.ok(asked.length >= 3);
    for (const url of asked) assert.equal(new URL(url).host, new URL(address).host, url);
    let bytes = 0;
    for (const url of new Set(asked)) {
      const answer = await fetch(url, { headers: { 'accept-encoding': 'gzip' } });
      assert.equal(answer.status, 200, url);
      bytes += +answer.headers.get('content-length');
      await answer.arrayBuffer();
    }
    assert.ok(bytes > 0 && bytes <= TINY, `${bytes} bytes`);
    console.log(`note: the page takes ${Math.round(bytes / 1024)} KB`);
  },

  async 'it shows the robot, the angle of its servo, its laser and its trail'({ page }) {
    await page.until('the robot', 60, 'viewer.robot.body.visible && viewer.live.scanners().length === 1');
    await page.until('a profile', 60, `viewer.live.scanners()[0].scan?.ranges.length > 100 && [...viewer.robot.heads.values()].some(({ fan }) => fan.visible)`);
    await page.until('the angle', 60, `/^-?\\d+\\.\\d°$/.test(document.getElementById('servo-angle').textContent)`);
    await page.until('the trail', 60, 'viewer.robot.trail.n > 5');
    const names = await page.ask(`document.getElementById('devices').innerText`);
    for (const name of ['laser', 'servo', 'pose']) assert.ok(names.includes(name), names);
  },

  async 'it shows the map: as many patches and triangles as the daemon says'({ page, stands }) {
    await stands;
    await holds(page, 'the page has the map');
    const { patches, triangles } = await counts(page);
    console.log(`note: ${patches} patches, ${triangles} triangles`);
    await page.until('the panel says so', 60, `document.getElementById('state-text').textContent === 'paused' &&
      document.getElementById('patches').textContent.length > 0`);
  },

  async 'it opens with a picture'({ browser }) {
    const page = await browser.open(address);
    await page.until('a picture', 60, 'viewer.firstMs !== null');
    console.log(`note: a picture ${await page.ask('Math.round(viewer.firstMs)')} ms after the page was opened, WebGL in software`);
    await page.close();
  },

  async 'a still picture is the same twice, and tells its counts in the title'({ browser }) {
    const shots = [];
    for (const query of ['?still=1', '?still=1', '?still=1&section=0.3', '?still=1&mode=height', '?still=1&camera=top', '?still=1&mode=smooth']) {
      const page = await browser.open(address + query, 640, 400);
      await page.until('the title', 60, `document.title.startsWith('{')`);
      const told = JSON.parse(await page.ask('document.title')), now = await status();
      assert.deepEqual([told.patches, told.triangles, told.drawn, told.step],
        [now.map_size.patches, now.map_size.triangles, now.map_size.triangles, now.step]);
      shots.push((await page.picture()).toString('base64'));
      await page.close();
    }
    assert.equal(shots[0], shots[1]);
    for (let i = 2; i < shots.length; i++) assert.notEqual(shots[0], shots[i], `picture ${i}`);
  },

  async 'a click tells point, class, plane and patch'({ page }) {
    await page.ask(`viewer.camera.home()`);
    await standing(page);
    const { x, y } = await page.until('a place to click', 60, `viewer.somewhere()`);
    await page.click(x, y);
    await page.until('the pick', 60, `!document.getElementById('pick').hidden`);
    const text = await page.ask(`document.getElementById('pick-text').innerText`);
    for (const word of ['Point', 'Class', 'unknown', 'Plane', 'Normal', 'Patch', 'triangles']) assert.ok(text.includes(word), text);
    await page.click(...(await page.ask(`(r => [r.x + r.width / 2, r.y + r.height / 2])(document.getElementById('pick-close').getBoundingClientRect())`)));
    assert.ok(await page.ask(`document.getElementById('pick').hidden`));
  },

  async 'two clicks measure what lies between them'({ page }) {
    await page.ask(`document.querySelector('[data-camera=top]').click(); viewer.camera.home(); document.getElementById('measure').click()`);
    await standing(page);
    const { x, y } = await page.until('a floor to click', 60, `viewer.somewhere(0.95)`);
    await page.click(x, y);
    await page.until('the first point', 60, `viewer.measure.points.length === 1`);
    const other = await page.until('another place', 60, `viewer.somewhere(0.95, 60)`);
    await page.click(other.x, other.y);
    await page.until('a length', 60, `!document.getElementById('length').hidden`);
    const { level } = await page.ask(`viewer.measure.result`);
    const wanted = Math.hypot(other.x - x, other.y - y) * (await page.ask(`viewer.camera.metresPerPixel(innerHeight)`));
    assert.ok(Math.abs(level - wanted) < 0.02 + 0.002 * wanted, `${level} m measured, ${wanted} m by the scale of the plan`);
    console.log(`note: measured ${level.toFixed(3)} m, by the plan's scale ${wanted.toFixed(3)} m`);
    await page.ask(`document.getElementById('measure').click(); document.querySelector('[data-camera=free]').click(); viewer.camera.home()`);
  },

  async 'the section slider takes the ceiling off, and puts it on again'({ page }) {
    await page.ask(`for (const id of ['laser', 'robot', 'trail']) if (document.getElementById(id).checked) document.getElementById(id).click();
      document.getElementById('backs').click()`);
    const clip = { x: 60, y: 80, width: 580, height: 460, scale: 1 };
    const shot = async () => (await page.call('Page.captureScreenshot', { format: 'png', clip })).data;
    const slide = (value) => page.ask(`(s => { s.value = ${value}; s.dispatchEvent(new Event('input')); })(document.getElementById('section'))`);
    await standing(page);
    await until('one picture', 60, async () => (await shot()) === (await shot()));
    const whole = await shot();
    await slide(450);
    await until('pixels change', 60, async () => (await shot()) !== whole);
    assert.match(await page.ask(`document.getElementById('section-at').textContent`), /m$/);
    await slide(1000);
    await until('all is there again', 60, async () => (await shot()) === whole);
    await page.ask(`for (const id of ['laser', 'robot', 'trail', 'backs']) document.getElementById(id).click()`);
  },

  async 'who has no token is offered nothing that changes'({ page }) {
    assert.ok(await page.ask(`document.getElementById('changes').hidden`));
    assert.ok(await page.ask(`document.getElementById('transport').hidden`));
  },

  async 'who shows the token may pause and record'({ browser }) {
    const page = await browser.open(`${address}#token=${encodeURIComponent(TOKEN)}`, 640, 400);
    await page.until('the buttons', 60, `document.getElementById('changes').offsetParent !== null`);
    assert.equal(await page.ask('location.hash'), '', 'it is out of the address bar');
    await page.ask(`document.getElementById('pause').click()`);
    await until('it goes on', 60, async () => !(await status()).paused);
    await page.until('the button says so', 60, `document.getElementById('pause').getAttribute('aria-pressed') === 'false'`);
    await page.ask(`document.getElementById('pause').click()`);
    await until('it pauses', 60, async () => (await status()).paused);
    for (const wanted of [false, true]) { // `record.dir` is set: it records from the start
      await page.ask(`document.getElementById('record').click()`);
      await until(wanted ? 'it records' : 'it ends', 60, async () => (await status()).record.recording === wanted);
      await page.until('the button says so', 60, `document.getElementById('record').getAttribute('aria-pressed') === '${wanted}'`);
    }
    await page.close();
    await standStill(1);
  },

  async 'a wrong token is asked for again, and not tried over and over'({ browser }) {
    const page = await browser.open(`${address}#token=wrong-wrong-wrong-wrong`, 640, 400);
    await page.until('it asks', 60, `!document.getElementById('ask').hidden`);
    await sleep(3000);
    await page.ask(`document.getElementById('token').value = ${JSON.stringify(TOKEN)}; document.getElementById('ask').requestSubmit()`);
    await page.until('the right one opens', 60, `viewer.counts().patches > 0 && document.getElementById('ask').hidden`);
    await page.close();
  },

  async 'save leads to a snapshot'({ page }) {
    await page.ask(`document.getElementById('save').click()`);
    const links = await page.ask(`[...document.querySelectorAll('#formats a')].map((a) => a.href)`);
    assert.deepEqual(links.map((link) => new URL(link).pathname), ['/snapshot.ply', '/snapshot.glb', '/snapshot.obj']);
    const answer = await fetch(links[0]), text = Buffer.from(await answer.arrayBuffer()).toString('latin1');
    assert.ok(answer.ok && text.startsWith('ply\n'));
    assert.equal(+text.match(/element face (\d+)/)[1], (await status()).map_size.triangles);
    await page.ask(`document.getElementById('save').click()`);
  },

  async 'on a phone all is there, and large enough for a finger'({ browser }) {
    const page = await browser.open(address, 360, 640, true);
    await page.until('the map', 60, 'viewer.map.drawn > 0');
    const small = await page.ask(`[...document.querySelectorAll('button')].filter((b) => b.getClientRects().length && getComputedStyle(b).visibility === 'visible')
      .map((b) => [b.id || b.dataset.camera, b.getBoundingClientRect()]).filter(([, r]) => r.width < 40 || r.height < 40 || r.left < 0 || r.right > 360)
      .map(([id, r]) => id + ' ' + r.width + 'x' + r.height + ' at ' + r.left)`);
    assert.deepEqual(small, []);
    assert.equal(await page.ask('document.documentElement.scrollWidth'), 360);
    const hidden = `getComputedStyle(document.getElementById('panel')).visibility === 'hidden'`;
    assert.ok(await page.ask(hidden), 'the panel begins collapsed');
    await page.tap(338, 34);
    await page.until('the panel opens', 60, `!(${hidden})`);
    await page.tap(180, 60);
    await page.until('the panel closes', 60, hidden);
    const before = await page.ask('viewer.camera.free.position.toArray()');
    await page.drag(180, 300, 90, 20);
    await page.until('a finger turns the view', 60, `Math.hypot(...viewer.camera.free.position.toArray().map((v, i) => v - ${JSON.stringify(before)}[i])) > 0.5`);
    await page.close();
  },

  async 'it survives a restart of the daemon, and says how old the picture is meanwhile'(bed) {
    const { page } = bed;
    await holds(page, 'the page has the map');
    const before = await counts(page);
    await end(bed.daemon);
    await page.until('the page says that the daemon is gone', 60, `/reconnecting, picture is/.test(document.getElementById('state-text').textContent)`);
    const meanwhile = await counts(page);
    assert.deepEqual([meanwhile.patches, meanwhile.drawn], [before.patches, before.drawn], 'the picture stays');
    await sleep(2500);
    bed.daemon = await startDaemon();
    const stands = standStill(60);
    stands.catch(() => null); // it is waited for below
    await page.until('it is back', 60, `viewer.counts().map !== ${JSON.stringify(before.map)}`);
    await stands;
    await holds(page, 'the page has the new map');
    await page.until('the panel says so', 60, `document.getElementById('state-text').textContent === 'paused'`);
  },

  async 'a replay has a transport: pause, seek, speed'(bed) {
    await end(bed.daemon);
    const file = readdirSync(dir).filter((name) => name.endsWith('.mcap')).sort()[0];
    bed.daemon = start('facetd', '--config', replayConfig(), '--replay', join(dir, file));
    await until('facetd replays', 60, async () => (await status().catch(() => null))?.replay);
    assert.equal((await command('SEEK={"speed": 0.1}')).class, 'OK'); // it lasts until the page is there
    const page = await bed.browser.open(address, 900, 500);
    await page.until('the transport', 60, `!document.getElementById('transport').hidden && !document.getElementById('play').disabled`);
    await page.ask(`document.getElementById('play').click()`);
    await until('it stops', 60, async () => (await status()).replay.state === 'paused');
    await page.ask(`(s => { s.value = 'max'; s.dispatchEvent(new Event('change')); })(document.getElementById('speed'))`);
    await until('its speed is max', 60, async () => (await status()).replay.speed === 'max');
    await page.ask(`(s => { s.value = 200; s.dispatchEvent(new Event('input')); s.dispatchEvent(new Event('change')); })(document.getElementById('seek'))`);
    await until('it is there', 60, async () => {
      const { replay } = await status();
      return replay.state === 'paused' && Math.abs(replay.position - replay.begin - 0.2 * (replay.end - replay.begin)) < 0.5;
    });
    await holds(page, 'the page has that map');
    await page.until('the page says that it is paused', 60, `viewer.status().replay.state === 'paused'`);
    await page.ask(`document.getElementById('play').click()`);
    await until('it plays to the end', 120, async () => (await status()).replay.state === 'ended');
    await holds(page, 'the page has the whole map');
    await page.close();
    await end(bed.daemon);
  },
};

async function main() {
  const port = await freePort(), bed = {};
  address = `http://127.0.0.1:${port}/`;
  const devices = start('facet', 'simulate', 'building', '--endless', '--dir', dir, '--http', `127.0.0.1:${port}`);
  let failures = 0;
  try {
    await until('simulated devices', 60, () => existsSync(join(dir, 'facetd.yaml')));
    grantToken();
    bed.daemon = await startDaemon();
    bed.stands = standStill(PATCHES);
    bed.stands.catch(() => null); // it is waited for by the claim
    bed.browser = new Browser();
    bed.page = await bed.browser.open(address, 1000, 640);
    for (const [claim, hold] of Object.entries(claims)) {
      const begun = Date.now();
      try {
        await hold(bed);
        console.log(`ok ${claim} (${((Date.now() - begun) / 1000).toFixed(1)} s)`);
      } catch (error) {
        failures++;
        console.log(`FAILED: ${claim}: ${error.stack}`);
      }
    }
  } finally {
    await bed.browser?.end();
    for (const child of ours.reverse()) if (child.exitCode === null) await end(child);
    if (failures) for (const child of ours) console.log(child.log);
    rmSync(dir, { recursive: true, force: true });
  }
  process.exit(failures ? 1 : 0);
}

main();
