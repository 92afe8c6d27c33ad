// Lengths: from point to point, and as people read them.

// From a to b: the distance, its parts, and the slope to the level, rad.
export function between(a, b) {
  const [x, y, z] = ['x', 'y', 'z'].map((axis) => b[axis] - a[axis]);
  const level = Math.hypot(x, y);
  return { distance: Math.hypot(level, z), level, x, y, z, slope: Math.atan2(z, level) };
}

export function lengthText(m) {
  return Math.abs(m) < 1 ? `${(m * 100).toFixed(1)} cm` : `${m.toFixed(m < 100 ? 3 : 1)} m`;
}
