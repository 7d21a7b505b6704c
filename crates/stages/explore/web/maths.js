// Vectors, rotations and cameras. A rotation is nine numbers by rows. A camera has the numbers of a pinhole:
// width, height, fx, fy, cx, cy in pixels, and camera = rotation * world + translation, x right, y down, z forward.

export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
export const add = (a, b, t = 1) => [a[0] + t * b[0], a[1] + t * b[1], a[2] + t * b[2]];
export const times = (a, t) => [a[0] * t, a[1] * t, a[2] * t];
export const length = (a) => Math.hypot(a[0], a[1], a[2]);
export const unit = (a) => times(a, 1 / (length(a) || 1));
export const row = (r, k) => [r[3 * k], r[3 * k + 1], r[3 * k + 2]];
export const rotate = (r, v) => [dot(row(r, 0), v), dot(row(r, 1), v), dot(row(r, 2), v)];
export const rotateBack = (r, v) => [0, 1, 2].map((k) => r[k] * v[0] + r[3 + k] * v[1] + r[6 + k] * v[2]);

// The rows of `r` turned about a unit axis by an angle in radians.
export function turned(r, axis, angle) {
  const c = Math.cos(angle), s = Math.sin(angle);
  const turn = (v) => add(add(times(v, c), cross(axis, v), s), axis, dot(axis, v) * (1 - c));
  return [0, 1, 2].flatMap((k) => turn(row(r, k)));
}

// The rotation that looks along `forward` with `up` upwards.
export function lookingAlong(forward, up) {
  const z = unit(forward);
  let x = cross(z, up);
  if (length(x) < 1e-6) x = cross(z, Math.abs(z[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0]);
  x = unit(x);
  return [...x, ...cross(z, x), ...z];
}

export const eyeOf = (camera) => times(rotateBack(camera.rotation, camera.translation), -1);

// Where a point of the world is in the picture: x, y in pixels and depth.
export function project(camera, point) {
  const t = add(rotate(camera.rotation, point), camera.translation);
  return [camera.fx * t[0] / t[2] + camera.cx, camera.fy * t[1] / t[2] + camera.cy, t[2]];
}

// The camera with its whole picture fitted into `width` x `height` pixels, and the rectangle that it fills.
export function fitted(camera, width, height) {
  const s = Math.min(width / camera.width, height / camera.height);
  const x = (width - s * camera.width) / 2, y = (height - s * camera.height) / 2;
  const own = { width, height, fx: camera.fx * s, fy: camera.fy * s, cx: camera.cx * s + x, cy: camera.cy * s + y };
  return { ...camera, ...own, rectangle: [x, y, s * camera.width, s * camera.height] };
}
