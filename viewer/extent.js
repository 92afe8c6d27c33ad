// The extent of a map by its patches: of the largest bodies that hang together. Beams that leave through a window end far
// away; a picture that had to show those specks would show little of the building.
const SHARE = 0.1; // a body counts with at least this share of the largest one's patches

const packed = (x, y, z) => ((x & 0xffff) * 65536 + (y & 0xffff)) * 65536 + (z & 0xffff);

function bodyFrom(start, at, left) {
  const body = { keys: [], low: [...start], high: [...start] }, todo = [start];
  left.delete(packed(...start));
  while (todo.length) {
    const key = todo.pop(), [x, y, z] = key;
    body.keys.push(key);
    key.forEach((k, axis) => {
      body.low[axis] = Math.min(body.low[axis], k);
      body.high[axis] = Math.max(body.high[axis], k);
    });
    for (let i = 0; i < 27; i++) {
      const name = packed(x + (i % 3) - 1, y + (((i / 3) | 0) % 3) - 1, z + ((i / 9) | 0) - 1);
      if (left.delete(name)) todo.push(at.get(name));
    }
  }
  return body;
}

// `keys`: [x, y, z] of each patch, at least one. Lowest and highest key of what counts, and its keys.
export function mainBody(keys) {
  const at = new Map(keys.map((key) => [packed(...key), key])), left = new Set(at.keys()), bodies = [];
  for (const key of keys) if (left.has(packed(...key))) bodies.push(bodyFrom(key, at, left));
  const most = Math.max(...bodies.map(({ keys: body }) => body.length));
  const main = bodies.filter(({ keys: body }) => body.length >= SHARE * most);
  return { low: [0, 1, 2].map((axis) => Math.min(...main.map(({ low }) => low[axis]))),
    high: [0, 1, 2].map((axis) => Math.max(...main.map(({ high }) => high[axis]))), keys: main.flatMap((body) => body.keys) };
}
