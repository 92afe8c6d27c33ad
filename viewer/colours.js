// What colours say. The colours of classes are those of the scene in Foxglove (core/scene.c), of the legend and of the shader.
export const CLASSES = ['unknown', 'floor', 'ceiling', 'wall', 'door', 'window', 'ramp', 'stair', 'table'];
export const CLASS_COLOURS = ['#a8b3c2', '#5c8c6b', '#e6e6db', '#ccb385', '#8f5433', '#73b8eb', '#de9e29', '#c76180', '#8066ad'];

// Modes, in the order of the menu and of the shader's `mode`.
export const MODES = [
  { id: 'flat', name: 'Shaded, flat' },
  { id: 'smooth', name: 'Shaded, smooth' },
  { id: 'class', name: 'Class' },
  { id: 'plane', name: 'Plane' },
  { id: 'patch', name: 'Patch' },
  { id: 'height', name: 'Height' },
  { id: 'age', name: 'Age' },
];
export const SMOOTH = 1;

// Dark blue, teal, green, yellow: even steps of lightness, also for those who confuse red and green.
export const RAMP = ['#31427c', '#2b7a8c', '#3fae83', '#a9d36b', '#fbe78a'];

export const LASER = '#ff5c5c', ACCENT = '#5fd0c5', TRAIL = '#ffb454';

export const channels = (hex) => [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16) / 255);
