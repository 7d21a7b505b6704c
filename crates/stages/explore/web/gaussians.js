// The Gaussians of the page: scene.json says what lies where in the bytes of scene.bin (docs/explore.md).
import { add, rotate } from "./maths.js";

export const SH_C0 = 0.2820948;
const CHUNK_FLOATS = 20;

export class Gaussians {
  constructor(scene, bytes) {
    const section = (name, Type) => {
      const [start, size] = scene.sections[name];
      return new Type(bytes, start, size / Type.BYTES_PER_ELEMENT);
    };
    this.count = scene.gaussians;
    this.chunk = scene.chunk;
    this.degree = scene.degree;
    this.harmonicsRange = scene.harmonics_range;
    this.near = scene.near;
    this.antialias = scene.antialias;
    this.words = section("packed", Uint32Array);
    this.chunks = section("chunks", Float32Array);
    this.harmonics = section("harmonics", Uint32Array);
    this.features = section("features", Uint8Array);
    this.uncut = this.cells = section("cells", scene.cells.length <= 65536 ? Uint16Array : Uint32Array);
    this.positions = new Float32Array(3 * this.count);
    // Without the arrays of `three`: there may be millions.
    for (let i = 0; i < this.count; i++) {
      const w = this.words[4 * i], at = CHUNK_FLOATS * Math.floor(i / this.chunk), c = this.chunks;
      this.positions[3 * i] = c[at] + (w >>> 21) / 2047 * (c[at + 3] - c[at]);
      this.positions[3 * i + 1] = c[at + 1] + (w >>> 11 & 1023) / 1023 * (c[at + 4] - c[at + 1]);
      this.positions[3 * i + 2] = c[at + 2] + (w & 2047) / 2047 * (c[at + 5] - c[at + 2]);
    }
  }

  // Three numbers of Gaussian i: position (word 0, group 0), logarithm of scale (word 2, group 1).
  three(i, word, group) {
    const w = this.words[4 * i + word];
    return this.within(i, group, [(w >>> 21) / 2047, (w >>> 11 & 1023) / 1023, (w & 2047) / 2047]);
  }

  within(i, group, share) {
    const at = CHUNK_FLOATS * Math.floor(i / this.chunk) + 6 * group, c = this.chunks;
    return share.map((s, k) => c[at + k] + s * (c[at + 3 + k] - c[at + k]));
  }

  color(i) {
    const w = this.words[4 * i + 3];
    return this.within(i, 2, [(w >>> 24) / 255, (w >>> 16 & 255) / 255, (w >>> 8 & 255) / 255]);
  }

  opacity(i) {
    return (this.words[4 * i + 3] & 255) / 255;
  }

  // w x y z, of unit length.
  quaternion(i) {
    const w = this.words[4 * i + 1];
    const q = [20, 10, 0].map((s) => ((w >>> s & 1023) / 1023 * 2 - 1) * Math.SQRT1_2);
    q.splice(w >>> 30, 0, Math.sqrt(Math.max(0, 1 - q[0] * q[0] - q[1] * q[1] - q[2] * q[2])));
    return q;
  }

  // The axes of Gaussian i, each as long as its standard deviation: columns of rotation times scale.
  axes(i) {
    const [w, x, y, z] = this.quaternion(i);
    const s = this.three(i, 2, 1).map(Math.exp);
    return [
      [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)].map((v) => v * s[0]),
      [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)].map((v) => v * s[1]),
      [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)].map((v) => v * s[2]),
    ];
  }

  // What a pixel shows, as the rasteriser would say: cells with their blending weights, and the mean position by weight.
  // `shown(cell)` tells what counts. This goes through all Gaussians: a page without a server has no other way.
  at(camera, x, y, shown) {
    const r = camera.rotation, t = camera.translation, found = [];
    const px = x + 0.5, py = y + 0.5, p = this.positions;
    const limits = [camera.cx / camera.fx, (camera.width - camera.cx) / camera.fx, camera.cy / camera.fy, (camera.height - camera.cy) / camera.fy];
    const margin = [0.15 * camera.width / camera.fx, 0.15 * camera.height / camera.fy];
    for (let i = 0; i < this.count; i++) {
      const a = p[3 * i], b = p[3 * i + 1], c = p[3 * i + 2];
      const z = r[6] * a + r[7] * b + r[8] * c + t[2];
      if (z < this.near) continue;
      const u = (r[0] * a + r[1] * b + r[2] * c + t[0]) / z, v = (r[3] * a + r[4] * b + r[5] * c + t[1]) / z;
      const dx = px - camera.fx * u - camera.cx, dy = py - camera.fy * v - camera.cy;
      // No Gaussian reaches farther than 3.33 standard deviations.
      const w = this.words[4 * i + 2], at = CHUNK_FLOATS * Math.floor(i / this.chunk) + 6, k = this.chunks;
      const log = Math.max(k[at] + (w >>> 21) / 2047 * (k[at + 3] - k[at]), k[at + 1] + (w >>> 11 & 1023) / 1023 * (k[at + 4] - k[at + 1]),
        k[at + 2] + (w & 2047) / 2047 * (k[at + 5] - k[at + 2]));
      const reach = 3.4 * (camera.fx * Math.exp(log) / z * (1 + Math.abs(u) + Math.abs(v)) + 1);
      if (Math.abs(dx) > reach || Math.abs(dy) > reach || !shown(this.cells[i])) continue;
      const j = Math.min(Math.max(u, -limits[0] - margin[0]), limits[1] + margin[0]);
      const l = Math.min(Math.max(v, -limits[2] - margin[1]), limits[3] + margin[1]);
      let xx = 0.3, xy = 0, yy = 0;
      const rows = [[], []];
      for (const axis of this.axes(i)) {
        const m = rotate(r, axis);
        rows[0].push(camera.fx / z * (m[0] - j * m[2]));
        rows[1].push(camera.fy / z * (m[1] - l * m[2]));
      }
      for (let n = 0; n < 3; n++) {
        xx += rows[0][n] ** 2;
        xy += rows[0][n] * rows[1][n];
        yy += rows[1][n] ** 2;
      }
      yy += 0.3;
      const det = xx * yy - xy * xy;
      let opacity = this.opacity(i);
      if (this.antialias) opacity *= Math.sqrt(Math.max(0, ((xx - 0.3) * (yy - 0.3) - xy * xy) / det));
      const alpha = Math.min(0.99, opacity * Math.exp(-0.5 * (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / det));
      if (alpha >= 1 / 255) found.push([z, alpha, i]);
    }
    found.sort((a, b) => a[0] - b[0]);
    const weights = new Map();
    let position = [0, 0, 0], left = 1;
    for (const [, alpha, i] of found) {
      const weight = left * alpha;
      weights.set(this.cells[i], (weights.get(this.cells[i]) ?? 0) + weight);
      position = add(position, p.subarray(3 * i, 3 * i + 3), weight);
      left *= 1 - alpha;
      if (left < 1e-4) break;
    }
    const alpha = 1 - left;
    return { weights, alpha, position: alpha > 0 ? position.map((v) => v / alpha) : null };
  }

  // A 3DGS PLY of the Gaussians of which `meant(cell)` holds, as exact as the page has them; null where there are none.
  ply(meant) {
    const chosen = [];
    for (let i = 0; i < this.count; i++) if (meant(this.cells[i])) chosen.push(i);
    if (!chosen.length) return null;
    const names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"];
    const header = `ply\nformat binary_little_endian 1.0\n${this.antialias ? "comment antialias true\n" : ""}element vertex ${chosen.length}\n`
      + names.map((n) => `property float ${n}\n`).join("") + "end_header\n";
    const values = new Float32Array(names.length * chosen.length);
    chosen.forEach((i, at) => {
      const opacity = Math.min(Math.max(this.opacity(i), 1e-4), 1 - 1e-4);
      values.set([...this.three(i, 0, 0), ...this.color(i).map((c) => (c - 0.5) / SH_C0), Math.log(opacity / (1 - opacity)),
        ...this.three(i, 2, 1), ...this.quaternion(i)], names.length * at);
    });
    return new Blob([header, values]);
  }
}

// Blending weights by instance: the largest, and within it the largest cell. `labelOf(cell)` is -1 for noise.
export function largest(weights, labelOf) {
  const sums = new Map();
  for (const [cell, w] of weights) sums.set(labelOf(cell), (sums.get(labelOf(cell)) ?? 0) + w);
  const most = (entries) => entries.reduce((a, b) => (b[1] > a[1] ? b : a), [null, 0])[0];
  const label = most([...sums]);
  const cell = most([...weights].filter(([c]) => labelOf(c) === label));
  return { instance: label === null || label < 0 ? null : label, cell };
}
