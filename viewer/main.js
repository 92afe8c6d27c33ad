// The page: joins what comes (link, mirror, live), what is seen (scene, robot, camera) and what a person does (panel, tools).
import { ColorManagement, LinearSRGBColorSpace, Scene, WebGLRenderer } from 'three';
import { Camera } from './camera.js';
import { MODES } from './colours.js';
import { Grid } from './grid.js';
import { lengthText } from './length.js';
import { askWhy, keepToken, Link, takeToken } from './link.js';
import { Live } from './live.js';
import { Measure, Picker, tell } from './measure.js';
import { Mirror } from './mirror.js';
import { FrameReader, writeWant } from './native.js';
import { $, element, Panel, span } from './panel.js';
import { Robot } from './robot.js';
import { MapScene } from './scene.js';
import { finish, stillCounts } from './still.js';
import { Transport } from './transport.js';

const query = new URLSearchParams(location.search), still = query.get('still') === '1';
const STALE_S = 2, FRESH_S = 1.5, CLICK_PIXELS = 5;

ColorManagement.enabled = false; // display colours throughout: shader.js
const renderer = makeRenderer();
renderer.outputColorSpace = LinearSRGBColorSpace;
renderer.setClearAlpha(0);

function makeRenderer() {
  try {
    return new WebGLRenderer({ canvas: $('view'), antialias: true, alpha: true, powerPreference: 'high-performance' });
  } catch (error) {
    $('state').dataset.state = 'lost';
    $('state-text').textContent = 'this browser has no WebGL 2';
    throw error;
  }
}

let token = takeToken();
const scene = new Scene(), map = new MapScene(), grid = new Grid(), robot = new Robot(), measure = new Measure();
const camera = new Camera($('view'), still), picker = new Picker(map), panel = new Panel();
scene.add(grid.mesh, map.group, robot.group, measure.group);

// ---- what comes ----

const mirror = new Mirror((name, patch, before) => map.show(name, (patch ?? before).key, patch));
let status = null, may = { change: false, play: false }, shut = null, reader, live = null;

const hooks = {
  open() {
    $('ask').hidden = true;
    shut = null;
    mirror.reconnect();
    reader = new FrameReader((type, payload) => take(type, payload));
    link.send(writeWant());
    link.send('?WATCH={"enable":true}');
    if (!live && !still) live = new Live(token, (place) => robot.moved(place));
  },
  bytes: (bytes) => reader.push(bytes),
  text: (text) => hear(JSON.parse(text)),
  lost(reason, wasOpen) {
    if (!wasOpen) refused();
  },
};
const link = new Link('/native', ['facetd.v1'], token, hooks);

// Each try without the right token counts with the daemon as a guess; so it is asked for, and not tried again.
async function refused() {
  const why = await askWhy(token);
  if (!why || link.open) return;
  shut = why;
  link.halt();
  $('ask').hidden = false;
  $('ask-why').textContent = why === 'wait' ? 'Too many wrong tokens: wait a minute, then try again.'
    : token ? 'That token is not the one of this robot.' : 'This robot asks for its token.';
}

function showToken(event) {
  event.preventDefault();
  token = $('token').value.trim();
  keepToken(token);
  live?.link.end();
  live = null;
  $('ask').hidden = true;
  link.resume(token);
}

function take(type, payload) {
  const before = mirror.hello;
  mirror.take(type, payload);
  if (mirror.hello === before) return;
  map.cell = mirror.hello.cell;
  if (before && (before.map !== mirror.hello.map || before.generation !== mirror.hello.generation)) robot.trail.clear();
}

function hear(message) {
  if (message.may) may = message.may;
  if (message.class === 'STATUS') {
    status = message;
    panel.status(status);
    transport.show(status.replay, may.play || may.change);
    rights();
  } else if (message.class === 'ERROR') panel.note(message.error, true);
  else if (message.class === 'DEVICE') panel.note(`${message.name}: ${message.state}${message.message ? `: ${message.message}` : ''}`, message.state === 'backing off');
  else if (message.class === 'JUMP') panel.note(`the pose jumped by ${message.distance.toFixed(2)} m (${message.done})`, true);
  else if (message.class === 'RECORD' && message.message) panel.note(message.message, message.state === 'failed');
  else if (message.class === 'RECORD' && message.state) panel.note(`recording ${message.state}${message.file ? `: ${message.file}` : ''}`);
}

const say = (word, more) => link.send(`?${word}${more ? `=${JSON.stringify(more)}` : ''}`);
const transport = new Transport(say);

function rights() {
  $('changes').hidden = !may.change;
  $('pause').hidden = !!status.replay; // the transport has one
  $('pause').setAttribute('aria-pressed', !!status.paused);
  $('record').setAttribute('aria-pressed', !!status.record?.recording);
  $('record').hidden = !!status.replay;
}

// ---- what a person does ----

let section = Infinity, measuring = false;

function setSection(value) { // 0..1000 of the map's height
  const { min, max } = map.frame;
  section = value >= 1000 || map.frame.isEmpty() ? Infinity : min.z + (value / 1000) * (max.z - min.z);
  map.material.uniforms.section.value = Math.min(section, 1e9);
  $('section-at').textContent = section === Infinity ? 'off' : `${section.toFixed(2)} m`;
}

function setMode(id) {
  const index = Math.max(0, MODES.findIndex((mode) => mode.id === id));
  map.setMode(index);
  $('mode').value = MODES[index].id;
  legend();
}

function legend() {
  const id = MODES[map.mode].id, counts = [];
  if (id === 'class') for (const patch of mirror.patches.values()) for (const kind of patch.classes) counts[kind] = (counts[kind] ?? 0) + 1;
  panel.legend(id, counts, map.material.uniforms.heights.value, map.material.uniforms.ageSpan.value);
}

function setCamera(mode) {
  camera.setMode(mode);
  for (const button of document.querySelectorAll('[data-camera]')) button.setAttribute('aria-pressed', button.dataset.camera === mode);
  if (mode === 'follow' && !camera.robot) panel.note('where the robot is is not known yet');
}

function setMeasuring(on) {
  measuring = on;
  document.body.classList.toggle('measuring', on);
  $('measure').setAttribute('aria-pressed', on);
  $('hint').hidden = !on;
  $('hint').textContent = 'Pick two points';
  measure.clear();
  $('pick').hidden = true;
}

function pickAt(clientX, clientY) {
  const found = picker.pick((2 * clientX) / innerWidth - 1, 1 - (2 * clientY) / innerHeight, camera.current, section, $('backs').checked);
  if (measuring) {
    if (found) measure.add(found.point);
    $('hint').hidden = measure.points.length === 2;
    $('hint').textContent = measure.points.length === 1 ? 'Pick the second point' : 'Pick two points';
    return;
  }
  measure.mark(found?.point ?? null);
  $('pick').hidden = !found;
  if (found)
    $('pick-text').replaceChildren(...tell(found, mirror.planes).flatMap(([what, text]) => [element('dt', what), element('dd', text)]));
}

function listenForClicks(canvas) {
  let down = null;
  canvas.addEventListener('pointerdown', (event) => {
    down = event.isPrimary && event.button === 0 ? event : null;
    panel.open(false);
    $('formats').hidden = true;
  });
  canvas.addEventListener('pointerup', (event) => {
    const moved = down ? Math.hypot(event.clientX - down.clientX, event.clientY - down.clientY) : Infinity;
    if (event.isPrimary && moved < CLICK_PIXELS) pickAt(event.clientX, event.clientY);
    down = null;
  });
}

function saveMenu() {
  const at = $('save').getBoundingClientRect(), open = $('formats').hidden;
  for (const item of document.querySelectorAll('[data-format]'))
    item.href = `snapshot.${item.dataset.format}${token ? `?token=${encodeURIComponent(token)}` : ''}`;
  Object.assign($('formats').style, { left: `${at.left + at.width / 2}px`, top: `${at.top - 8}px` });
  $('formats').hidden = !open;
  $('save').setAttribute('aria-expanded', open);
}

const flip = { wire: (on) => (map.material.uniforms.wire.value = on), edges: (on) => (map.material.uniforms.edges.value = on),
  backs: (on) => (map.material.uniforms.backs.value = on), laser: (on) => (robot.shown.laser = on), robot: (on) => (robot.shown.robot = on),
  trail: (on) => (robot.shown.trail = on) };
const keys = { 1: () => setCamera('free'), 2: () => setCamera('follow'), 3: () => setCamera('top'), f: () => camera.home(),
  m: () => setMeasuring(!measuring), w: () => $('wire').click(), e: () => $('edges').click(), l: () => $('laser').click(),
  b: () => $('backs').click(), c: () => setMode(MODES[(map.mode + 1) % MODES.length].id),
  ' ': () => (status?.replay ? $('play') : $('pause')).click(), Escape: () => { setMeasuring(false); $('formats').hidden = true; panel.open(false); } };

function wireUp() {
  for (const what of ['input', 'change', 'click', 'keydown', 'pointerup']) addEventListener(what, () => hand++);
  for (const [id, act] of Object.entries(flip)) $(id).onchange = () => act($(id).checked);
  for (const button of document.querySelectorAll('[data-camera]')) button.onclick = () => setCamera(button.dataset.camera);
  $('mode').onchange = () => setMode($('mode').value);
  $('section').oninput = () => setSection(+$('section').value);
  $('ask').onsubmit = showToken;
  $('home').onclick = () => { setCamera(camera.mode === 'top' ? 'top' : 'free'); camera.home(); };
  $('measure').onclick = () => setMeasuring(!measuring);
  $('save').onclick = saveMenu;
  $('formats').onclick = () => ($('formats').hidden = true);
  $('pause').onclick = () => may.change && say(status?.paused ? 'RESUME' : 'PAUSE');
  $('record').onclick = () => say('RECORD', { enable: !status?.record?.recording });
  $('pick-close').onclick = () => { $('pick').hidden = true; measure.clear(); };
  addEventListener('keydown', (event) => {
    const typing = event.target.closest?.('select, input:not([type=checkbox]), button') && event.key === ' ';
    if (event.ctrlKey || event.metaKey || event.altKey || typing || !keys[event.key]) return;
    event.preventDefault();
    keys[event.key]();
  });
  listenForClicks($('view'));
}

// ---- what is seen ----

let before = performance.now(), frames = 0, second = before, received = 0, pictureAt = null, committed = 0, firstMs = null, slow = 0;

function resize() {
  renderer.setPixelRatio(still ? 1 : Math.min(devicePixelRatio, 2));
  renderer.setSize(innerWidth, innerHeight, false);
  const sheet = $('panel').getBoundingClientRect();
  hand++;
  camera.resize(innerWidth, innerHeight, !still && sheet.width < innerWidth / 2 ? innerWidth - sheet.left : 0);
}

function tellState(now) {
  if (mirror.commits !== committed || (link.open && status)) {
    committed = mirror.commits;
    if (link.open) pictureAt = link.heard;
  }
  const age = pictureAt === null ? null : (now - pictureAt) / 1000;
  if (shut) panel.state('lost', 'a token is needed');
  else if (!link.open) panel.state('lost', age === null ? 'no daemon, trying' : `reconnecting, picture is ${span(age)} old`);
  else if (age === null) panel.state('wait', 'connecting');
  else if (age > STALE_S + slow) panel.state('wait', `picture is ${span(age)} old`);
  else if (status?.paused) panel.state('paused', 'paused');
  else if (status?.replay) panel.state('live', `replay, ${status.replay.state}`);
  else panel.state('live', 'live');
}

function everySecond(now) {
  if (now - second < 1000) return;
  const seconds = (now - second) / 1000, total = link.received + (live?.link.received ?? 0);
  panel.own({ triangles: mirror.triangles, bytesPerSecond: (total - received) / seconds, fps: frames / seconds });
  [second, frames, received] = [now, 0, total];
  map.measure(mirror.patches);
  legend();
}

function showLength() {
  const at = measure.update(camera.current, innerWidth, innerHeight), { result } = measure;
  $('length').hidden = !at;
  if (!at) return;
  $('length').style.left = `${at.x}px`;
  $('length').style.top = `${at.y}px`;
  const parts = ['x', 'y', 'z'].map((axis) => `${axis} ${lengthText(result[axis])}`).join('   ');
  $('length').replaceChildren(lengthText(result.distance), element('small', parts));
}

// Times of the map are the robot's; between two messages its clock goes on with ours.
function robotTime(now) {
  return status && link.open && !status.replay ? status.t + (now - link.heard) / 1000 : map.latest;
}

// A picture is made only when it would be another one: a phone's battery lasts, and software rendering is spared.
const seen = { view: '', live: null, hand: -1, second: -1 };
let hand = 0; // what a person did, counted
function isNew(changed, now) {
  const view = [...camera.current.matrixWorld.elements, ...camera.current.projectionMatrix.elements].join();
  const next = { view, live: live ? `${live.version} ${live.fresh}` : '', hand, second: MODES[map.mode].id === 'age' ? Math.floor(now / 1000) : 0 };
  const other = Object.keys(seen).some((key) => seen[key] !== next[key]);
  Object.assign(seen, next);
  return changed || other;
}

function draw(dt, now) {
  const changed = map.update(!mirror.batch, camera.current.position, dt);
  if (changed && map.frame.isEmpty()) map.measure(mirror.patches);
  if (live) robot.update(live);
  const place = live?.robot;
  camera.update(map.frame, map.points, place ? camera.free.position.clone().setFromMatrixPosition(place) : null, dt);
  camera.current.updateMatrixWorld();
  if (!isNew(changed, now)) return;
  grid.update(map.frame);
  map.prepare(camera.current.position, still ? map.latest : robotTime(now));
  showLength();
  renderer.render(scene, camera.current);
  if (firstMs === null && map.drawn) firstMs = performance.now();
}

function frame(now) {
  requestAnimationFrame(frame);
  frames++;
  slow = 2 * (now - before) / 1000; // a page that is late itself calls nothing old for that
  if (live) live.patienceMs = 1000 * (FRESH_S + slow);
  draw(Math.min((now - before) / 1000, 0.25), now);
  before = now;
  panel.servo(live?.scanners()[0]?.tilt ?? null);
  transport.move();
  tellState(performance.now());
  everySecond(now);
}

function stillFrame() {
  if (!mirror.commits || mirror.batch || !status) return setTimeout(stillFrame, 20);
  map.update(true, camera.current.position, Infinity);
  map.measure(mirror.patches);
  if (query.has('section')) setSection(1000 * +query.get('section'));
  draw(0, 0);
  draw(0, 0);
  finish(stillCounts(mirror, map));
  link.end();
}

wireUp();
setMode(query.get('mode') ?? 'flat');
setCamera(query.get('camera') ?? 'free');
addEventListener('resize', resize);
resize();
document.body.classList.toggle('still', still);
// For tests and the console.
// A place on the screen, in pixels, where a click hits the map; `up`: the least z of its normal; `from`: pixels it is away
// from the last picked point at least.
function somewhere(up = -1, from = 0) {
  const last = measure.points[0]?.clone().project(camera.current);
  const pixel = ({ x, y }) => ({ x: ((x + 1) / 2) * innerWidth, y: ((1 - y) / 2) * innerHeight });
  for (let i = 1; i < 400; i++) {
    const x = ((i * 0.618034) % 1) * 1.1 - 0.75, y = ((i * 0.754878) % 1) * 1.3 - 0.65;
    const found = picker.pick(x, y, camera.current, section, $('backs').checked), at = pixel({ x, y });
    if (found && found.normal.z >= up && (!last || Math.hypot(at.x - pixel(last).x, at.y - pixel(last).y) >= from))
      return { x: Math.round(at.x), y: Math.round(at.y) };
  }
  return null;
}
globalThis.viewer = { somewhere, get live() { return live; }, get firstMs() { return firstMs; }, mirror, map, camera, robot, measure,
  counts: () => stillCounts(mirror, map), status: () => status };
if (still) stillFrame();
else requestAnimationFrame(frame);
