// Debian's Chromium without a screen, with WebGL in software, driven over its debugging pipe: no port, no package.
import { spawn } from 'node:child_process';
import { mkdtempSync, rmSync, writeFileSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join } from 'node:path';

const ANSWER_MS = 180000;
const PATIENCE = 5; // times as long as is said is waited: the machine may be slow, or busy with others

export const sleep = (ms) => new Promise((done) => setTimeout(done, ms));

export async function until(what, seconds, ask) {
  const last = Date.now() + 1000 * PATIENCE * seconds;
  for (;;) {
    const answer = await ask();
    if (answer) return answer;
    if (Date.now() > last) throw new Error(`${what}: not within ${PATIENCE * seconds} s`);
    await sleep(100);
  }
}

export class Browser {
  constructor() {
    this.home = mkdtempSync(join(tmpdir(), 'viewer-browser-'));
    this.process = spawn('chromium', ['--headless=new', '--no-sandbox', '--remote-debugging-pipe', '--use-gl=angle',
      '--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--hide-scrollbars', '--no-first-run', '--mute-audio',
      '--disable-extensions', '--disable-background-networking', `--user-data-dir=${this.home}`, 'about:blank'],
    { stdio: ['ignore', 'ignore', 'ignore', 'pipe', 'pipe'], env: { ...process.env, HOME: this.home } });
    this.waiting = new Map();
    this.number = 0;
    this.rest = '';
    this.process.stdio[4].setEncoding('utf8').on('data', (text) => this.hear(text));
    this.process.on('error', (error) => this.fail(error));
    this.process.on('exit', () => this.fail(new Error('chromium has ended')));
  }

  fail(error) {
    for (const { reject } of this.waiting.values()) reject(error);
    this.waiting.clear();
  }

  hear(text) {
    const parts = (this.rest + text).split('\0');
    this.rest = parts.pop();
    for (const part of parts) {
      const { id, result, error, method, params } = JSON.parse(part);
      const waits = this.waiting.get(id);
      this.waiting.delete(id);
      if (waits) (error ? waits.reject(new Error(error.message)) : waits.resolve(result));
      else if (method) this.heard?.(method, params);
    }
  }

  call(method, params = {}, sessionId = undefined) {
    const id = ++this.number;
    this.process.stdio[3].write(`${JSON.stringify({ id, method, params, sessionId })}\0`);
    return new Promise((resolve, reject) => {
      const timer = setTimeout(() => reject(new Error(`${method}: no answer`)), ANSWER_MS);
      this.waiting.set(id, { resolve: (r) => (clearTimeout(timer), resolve(r)), reject: (e) => (clearTimeout(timer), reject(e)) });
    });
  }

  // A tab of that size; `phone`: with touch and two device pixels each.
  async open(url, width = 1280, height = 720, phone = false) {
    const { targetId } = await this.call('Target.createTarget', { url: 'about:blank' });
    const { sessionId } = await this.call('Target.attachToTarget', { targetId, flatten: true });
    const page = new Page(this, targetId, sessionId);
    await page.call('Emulation.setDeviceMetricsOverride', { width, height, deviceScaleFactor: phone ? 2 : 1, mobile: phone });
    await page.call('Emulation.setTouchEmulationEnabled', { enabled: phone });
    await page.call('Runtime.enable');
    await page.call('Page.enable');
    await page.call('Page.navigate', { url });
    return page;
  }

  async end() {
    this.process.removeAllListeners('exit');
    const gone = new Promise((done) => this.process.once('exit', done));
    this.process.kill('SIGKILL');
    await Promise.race([gone, sleep(3000)]);
    await sleep(200);
    try {
      rmSync(this.home, { recursive: true, force: true, maxRetries: 5 });
    } catch { /* a child of it still writes; it is in the temporary folder */ }
  }
}

class Page {
  constructor(browser, targetId, sessionId) {
    Object.assign(this, { browser, targetId, sessionId });
  }

  call(method, params) {
    return this.browser.call(method, params, this.sessionId);
  }

  async ask(expression) {
    const { result, exceptionDetails: wrong } = await this.call('Runtime.evaluate',
      { expression, awaitPromise: true, returnByValue: true });
    if (wrong) throw new Error(wrong.exception?.description ?? wrong.text);
    return result.value;
  }

  until(what, seconds, expression) {
    return until(what, seconds, () => this.ask(expression).catch(() => null));
  }

  async click(x, y) {
    const at = { x, y, button: 'left', clickCount: 1, pointerType: 'mouse' };
    await this.call('Input.dispatchMouseEvent', { ...at, type: 'mouseMoved', button: 'none' });
    await this.call('Input.dispatchMouseEvent', { ...at, type: 'mousePressed' });
    await this.call('Input.dispatchMouseEvent', { ...at, type: 'mouseReleased' });
  }

  async tap(x, y) {
    await this.call('Input.dispatchTouchEvent', { type: 'touchStart', touchPoints: [{ x, y }] });
    await this.call('Input.dispatchTouchEvent', { type: 'touchEnd', touchPoints: [] });
  }

  async drag(x, y, dx, dy) {
    await this.call('Input.dispatchTouchEvent', { type: 'touchStart', touchPoints: [{ x, y }] });
    for (let i = 1; i <= 5; i++)
      await this.call('Input.dispatchTouchEvent', { type: 'touchMove', touchPoints: [{ x: x + (dx * i) / 5, y: y + (dy * i) / 5 }] });
    await this.call('Input.dispatchTouchEvent', { type: 'touchEnd', touchPoints: [] });
  }

  async picture(file) {
    const { data } = await this.call('Page.captureScreenshot', { format: 'png' });
    const bytes = Buffer.from(data, 'base64');
    if (file) writeFileSync(file, bytes);
    return bytes;
  }

  close() {
    return this.browser.call('Target.closeTarget', { targetId: this.targetId });
  }
}
