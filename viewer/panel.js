// The panel: what the daemon says of itself (STATUS, docs/protocol.md), and what this page measures. Only text is written,
// never markup: names come from outside.
import { CLASSES, CLASS_COLOURS, MODES, RAMP } from './colours.js';

const HISTORY = 90; // values of a spark line
export const $ = (id) => document.getElementById(id);

export function element(tag, text = '', className = '') {
  const made = document.createElement(tag);
  made.textContent = text;
  if (className) made.className = className;
  return made;
}

const put = (id, text) => {
  const target = $(id);
  if (target.textContent !== text) target.textContent = text;
};
const whole = (n) => Math.round(n).toLocaleString('en').replaceAll(',', '\u202f');
export const short = (n) => (n >= 1e6 ? `${(n / 1e6).toFixed(2)} M` : n >= 1e4 ? `${(n / 1e3).toFixed(1)} k` : whole(n));
export const size = (n) => (n >= 1e6 ? `${(n / 1e6).toFixed(1)} MB` : n >= 1e3 ? `${(n / 1e3).toFixed(1)} kB` : `${Math.round(n)} B`);
const milli = (ms) => (ms < 10 ? ms.toFixed(1) : ms.toFixed(0));
export function span(seconds) {
  if (seconds < 10) return `${seconds.toFixed(1)} s`;
  return seconds < 120 ? `${seconds.toFixed(0)} s` : seconds < 7200 ? `${(seconds / 60).toFixed(0)} min` : `${(seconds / 3600).toFixed(1)} h`;
}

class Spark {
  constructor(id, colours) {
    this.canvas = $(id);
    this.colours = colours;
    this.lines = colours.map(() => []);
  }

  add(...values) {
    this.lines.forEach((line, i) => {
      line.push(values[i]);
      if (line.length > HISTORY) line.shift();
    });
    this.draw();
  }

  draw() {
    const { canvas } = this, ratio = devicePixelRatio, width = canvas.clientWidth, height = canvas.clientHeight;
    if (!width) return;
    canvas.width = width * ratio;
    canvas.height = height * ratio;
    const context = canvas.getContext('2d');
    context.scale(ratio, ratio);
    const most = Math.max(...this.lines.flat(), 1e-9);
    this.lines.forEach((line, i) => {
      const x = (k) => width - 1 - ((line.length - 1 - k) * (width - 2)) / (HISTORY - 1);
      const y = (v) => height - 2 - (v / most) * (height - 5);
      context.beginPath();
      line.forEach((v, k) => context.lineTo(x(k), y(v)));
      context.strokeStyle = this.colours[i];
      context.lineWidth = 1.5;
      context.stroke();
      if (i || line.length < 2) return;
      context.lineTo(x(line.length - 1), height);
      context.lineTo(x(0), height);
      context.fillStyle = `${this.colours[i]}26`;
      context.fill();
    });
  }
}

export class Panel {
  constructor() {
    this.latency = new Spark('latency-spark', ['#ffb454', '#5fd0c5']);
    this.bytes = new Spark('bytes-spark', ['#7aa7e8']);
    this.beams = null;
    for (const { id, name } of MODES) {
      const option = element('option', name);
      option.value = id;
      $('mode').append(option);
    }
    $('drawer').onclick = () => this.open(!document.body.classList.contains('open'));
  }

  open(on) {
    document.body.classList.toggle('open', on);
    $('drawer').setAttribute('aria-expanded', on);
  }

  // A STATUS message, whole; members that are missing are left as they were.
  status(status) {
    const { rows = {}, map_size: map = {}, memory = {}, latency_ms: latency = {} } = status;
    put('rows', (rows.rate ?? 0).toFixed(1));
    put('p50', latency.n ? `${milli(latency.p50)} ms` : '–');
    put('latency', latency.n ? `${milli(latency.p50)} / ${milli(latency.p99)} ms` : 'no rows yet');
    if (latency.n) this.latency.add(latency.p99, latency.p50);
    this.reduction(map.triangles_raw ?? 0, map.triangles ?? 0);
    put('memory', `${size(memory.used ?? 0)} of ${size(memory.cap ?? 0)}`);
    this.meter('memory-bar', memory.cap ? memory.used / memory.cap : 0);
    put('step', whole(status.step ?? 0));
    put('patches', whole(map.patches ?? 0));
    put('cell', `${((status.cell ?? 0) * 100).toFixed(1)} cm`);
    put('clients', `${(status.clients ?? []).length}`);
    put('sweeps', whole(rows.sweeps ?? 0));
    put('dropped', whole(Object.values(rows.dropped ?? {}).reduce((sum, n) => sum + n, 0)));
    this.beamRate(rows.beams?.ok, status.t);
    const { record } = status;
    put('recorded', record?.recording ? size(record.bytes) : record?.error ? 'failed' : 'off');
    $('recorded').title = record?.error ?? record?.file ?? '';
    put('version', `facetd ${status.version ?? ''}`);
    this.devices(status.devices ?? []);
  }

  reduction(raw, kept) {
    put('reduction', raw ? `${short(raw)} → ${short(kept)}` : '–');
    put('reduction-text', raw ? `${((1 - kept / raw) * 100).toFixed(1)} % fewer` : '');
    this.meter('reduction-bar', raw ? kept / raw : 0);
  }

  meter(id, share) {
    $(id).style.width = `${Math.min(100, share * 100)}%`;
    $(id).classList.toggle('full', share > 0.92 && id === 'memory-bar');
  }

  beamRate(ok, t) {
    if (ok === undefined) return;
    if (this.beams && t > this.beams.t && ok >= this.beams.ok) put('beams', short((ok - this.beams.ok) / (t - this.beams.t)));
    this.beams = { ok, t };
  }

  devices(devices) {
    $('devices').replaceChildren(...devices.map(({ name, driver, state, rate, error, note, silent }) => {
      const line = element('li', '', state === 'backing off' ? 'backing' : state);
      const title = element('b', name);
      title.append(element('small', driver));
      line.append(element('i'), title, element('span', state === 'streaming' ? `${(rate ?? 0).toFixed(1)} /s` : state));
      const trouble = state === 'streaming' ? (silent > 2 ? `nothing for ${span(silent)}` : note) : error;
      if (trouble) line.append(element('p', trouble));
      return line;
    }));
    if (!devices.length) $('devices').append(element('li', 'none', 'dim'));
  }

  // What this page holds and measures itself.
  own({ triangles, bytesPerSecond, fps }) {
    put('triangles', short(triangles));
    put('bytes', `${size(bytesPerSecond)}/s`);
    put('fps', fps.toFixed(0));
    this.bytes.add(bytesPerSecond);
  }

  state(kind, text) {
    $('state').dataset.state = kind;
    put('state-text', text);
  }

  servo(angle) {
    $('servo').hidden = angle === null;
    if (angle === null) return;
    const x = 20 + 34 * Math.cos(angle), y = 17 + 34 * Math.sin(angle);
    put('servo-angle', `${((angle * 180) / Math.PI).toFixed(1)}°`);
    $('servo-arm').setAttribute('d', `M20 17L${x.toFixed(1)} ${y.toFixed(1)}`);
    $('servo-arc').setAttribute('d', `M20 17h16A16 16 0 0 ${angle > 0 ? 1 : 0} ${(20 + 16 * Math.cos(angle)).toFixed(2)} ${(17 + 16 * Math.sin(angle)).toFixed(2)}z`);
  }

  // What the colours of a mode mean. `counts`: triangles of each class.
  legend(mode, counts, heights, age) {
    const ramp = (low, high) => {
      const scale = element('div', '', 'scale'), ends = element('div', '', 'ends');
      scale.style.background = `linear-gradient(90deg, ${RAMP.join(', ')})`;
      ends.append(element('span', low), element('span', high));
      return [scale, ends];
    };
    let parts = [];
    if (mode === 'class')
      parts = CLASSES.map((name, i) => {
        const part = element('span'), swatch = element('i');
        swatch.style.background = CLASS_COLOURS[i];
        part.append(swatch, name);
        return counts[i] ? part : null;
      }).filter(Boolean);
    else if (mode === 'height') parts = ramp(`${heights.x.toFixed(1)} m`, `${heights.y.toFixed(1)} m`);
    else if (mode === 'age') parts = ramp(`${span(age)} ago`, 'now');
    $('legend').hidden = !parts.length;
    $('legend').replaceChildren(...parts);
  }

  note(text, bad = false) {
    const line = element('li', text, bad ? 'bad' : '');
    $('notes').append(line);
    while ($('notes').children.length > 3) $('notes').firstChild.remove();
    setTimeout(() => line.remove(), 6000);
  }
}
