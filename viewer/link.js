// A WebSocket that comes back: it tries again after 0.25 s, then ever later, at most 2 s; a connection that says nothing
// for 5 s (the daemon's status comes every second) counts as lost, since a radio link goes without a word.
const FIRST_MS = 250, LAST_MS = 2000, SILENT_MS = 5000, TOKEN = 'facetd-token';

// The token of the URL's fragment, which no server log sees; kept for this tab and taken out of the address bar.
export function takeToken() {
  const given = new URLSearchParams(location.hash.slice(1)).get('token');
  if (given) {
    keepToken(given);
    history.replaceState(null, '', location.pathname + location.search);
  }
  try {
    return given ?? sessionStorage.getItem(TOKEN);
  } catch {
    return given; // storage is forbidden
  }
}

export function keepToken(token) {
  try {
    sessionStorage.setItem(TOKEN, token);
  } catch { /* it lasts as long as the page */ }
}

// Why a WebSocket was refused, which browsers do not tell: 'token' (one is needed, or this one is wrong), 'wait' (too many
// wrong ones), or null: something else, or nobody is there.
export async function askWhy(token) {
  try {
    const { status } = await fetch('status.json', { headers: token ? { authorization: `Bearer ${token}` } : {}, cache: 'no-store' });
    return status === 401 ? 'token' : status === 429 ? 'wait' : null;
  } catch {
    return null;
  }
}

export class Link {
  // `hooks`: open(), bytes(Uint8Array), text(string), lost(reason, wasOpen). What they throw ends the connection.
  constructor(path, protocols, token, hooks, silentMs = SILENT_MS) {
    Object.assign(this, { path, protocols, token, hooks, silentMs, wait: FIRST_MS, heard: 0, received: 0 });
    this.connect();
    this.watch = setInterval(() => this.judge(), 1000);
  }

  get open() {
    return this.socket?.readyState === WebSocket.OPEN;
  }

  connect() {
    const url = new URL(this.path, location.href);
    url.protocol = location.protocol === 'https:' ? 'wss:' : 'ws:';
    if (this.token) url.searchParams.set('token', this.token);
    const socket = new WebSocket(url, this.protocols);
    this.socket = socket;
    this.heard = performance.now();
    socket.binaryType = 'arraybuffer';
    this.wasOpen = false;
    socket.onopen = () => {
      this.wasOpen = true;
      this.guard(() => this.hooks.open());
    };
    socket.onmessage = ({ data }) => {
      this.heard = performance.now();
      this.wait = FIRST_MS;
      this.received += data.byteLength ?? data.length;
      this.guard(() => (typeof data === 'string' ? this.hooks.text(data) : this.hooks.bytes(new Uint8Array(data))));
    };
    socket.onclose = ({ reason }) => this.lose(reason);
  }

  guard(what) {
    try {
      what();
    } catch (error) {
      console.warn(error);
      this.lose(error.message);
    }
  }

  lose(reason) {
    const { socket } = this;
    if (!socket) return;
    socket.onopen = socket.onmessage = socket.onclose = null;
    socket.close();
    this.socket = null;
    this.retry = setTimeout(() => this.connect(), this.wait * (0.8 + 0.2 * Math.random()));
    this.wait = Math.min(this.wait * 2, LAST_MS);
    this.hooks.lost(reason, this.wasOpen);
  }

  // Tries no more, until resume().
  halt() {
    clearTimeout(this.retry);
    this.lose('');
    clearTimeout(this.retry);
  }

  resume(token) {
    this.halt();
    this.token = token;
    this.wait = FIRST_MS;
    this.connect();
  }

  judge() {
    if (this.socket && performance.now() - this.heard > this.silentMs) this.lose('silent');
  }

  send(data) {
    if (this.open) this.socket.send(data);
  }

  end() {
    clearInterval(this.watch);
    this.hooks.lost = () => {};
    this.halt();
  }
}
