// Draws Gaussians with WebGL2: one quad each, from far to near, into a picture of half floats with the weight of the
// selection beside the colours; then that picture with outlines on the canvas.
import { eyeOf, row } from "./maths.js";
import { sorter } from "./sort.js";

const WIDTH = 4096;
// Cells in a row of the texture of states.
const STATES = 1024;
export const SHOWN = 0, GHOST = 1, HIDDEN = 2;

const VERTEX = `#version 300 es
precision highp float; precision highp int; precision highp usampler2D;
uniform usampler2D words, cells, harmonics;
uniform sampler2D chunks, states, features;
uniform mat3 rotation; uniform vec3 translation, eye; uniform vec4 lens; uniform vec2 size;
uniform float near, grow, harmonicsRange; uniform int antialias, degree, byFeature; uniform uint chunkSize;
in vec2 corner; in uint index;
out vec2 at; flat out vec4 color; flat out vec2 extra;
vec4 range(uint chunk, uint k) { uint n = chunk * 5u + k; return texelFetch(chunks, ivec2(n & 4095u, n >> 12), 0); }
vec3 eleven(uint w) { return vec3(w >> 21, w >> 11 & 1023u, w & 2047u) / vec3(2047., 1023., 2047.); }
vec3 ten(uint w) { return (vec3(w >> 20 & 1023u, w >> 10 & 1023u, w & 1023u) / 1023. * 2. - 1.) * harmonicsRange; }
void main() {
  gl_Position = vec4(2., 2., 2., 1.);
  ivec2 place = ivec2(index & 4095u, index >> 12);
  uint cell = texelFetch(cells, place, 0).r;
  ivec2 state = ivec2(cell & 1023u, 2u * (cell >> 10));
  vec4 tint = texelFetch(states, state, 0), mode = texelFetch(states, state + ivec2(0, 1), 0) * 255.;
  if (mode.r > 1.5) return;
  uvec4 w = texelFetch(words, place, 0);
  uint chunk = index / chunkSize;
  vec4 a = range(chunk, 0u), b = range(chunk, 1u), c = range(chunk, 2u), d = range(chunk, 3u), e = range(chunk, 4u);
  vec3 mean = mix(a.xyz, vec3(a.w, b.xy), eleven(w.x));
  vec3 t = rotation * mean + translation;
  if (t.z < near) return;
  float opacity = float(w.w & 255u) / 255.;
  vec3 s = grow * exp(mix(vec3(b.zw, c.x), c.yzw, eleven(w.z)));
  vec3 q3 = (vec3(w.y >> 20 & 1023u, w.y >> 10 & 1023u, w.y & 1023u) / 1023. * 2. - 1.) * 0.70710678;
  float largest = sqrt(max(0., 1. - dot(q3, q3)));
  uint which = w.y >> 30;
  vec4 q = which == 0u ? vec4(largest, q3) : which == 1u ? vec4(q3.x, largest, q3.yz) : which == 2u ? vec4(q3.xy, largest, q3.z) : vec4(q3, largest);
  mat3 turn = mat3(
    1. - 2. * (q.z * q.z + q.w * q.w), 2. * (q.y * q.z + q.x * q.w), 2. * (q.y * q.w - q.x * q.z),
    2. * (q.y * q.z - q.x * q.w), 1. - 2. * (q.y * q.y + q.w * q.w), 2. * (q.z * q.w + q.x * q.y),
    2. * (q.y * q.w + q.x * q.z), 2. * (q.z * q.w - q.x * q.y), 1. - 2. * (q.y * q.y + q.z * q.z));
  mat3 m = rotation * turn;
  m[0] *= s.x; m[1] *= s.y; m[2] *= s.z;
  vec2 margin = 0.15 * size / lens.xy;
  vec2 uv = clamp(t.xy / t.z, -lens.zw / lens.xy - margin, (size - lens.zw) / lens.xy + margin);
  vec3 depth = vec3(m[0].z, m[1].z, m[2].z);
  vec3 u = lens.x / t.z * (vec3(m[0].x, m[1].x, m[2].x) - uv.x * depth);
  vec3 v = lens.y / t.z * (vec3(m[0].y, m[1].y, m[2].y) - uv.y * depth);
  float xx = dot(u, u) + 0.3, xy = dot(u, v), yy = dot(v, v) + 0.3;
  vec3 area = cross(u, v);
  float own = dot(area, area);
  float det = own + 0.3 * (dot(u, u) + dot(v, v)) + 0.09;
  if (antialias == 1) opacity *= sqrt(own / det);
  if (mode.r > 0.5) opacity *= 0.05;
  float reach = log(255. * opacity);
  if (reach <= 0.) return;
  float mid = 0.5 * (xx + yy), gap = length(vec2(0.5 * (xx - yy), xy));
  float long2 = mid + gap, short2 = max(det / long2, 0.3);
  // Of the two forms of the long axis the one that does not cancel.
  vec2 axis = gap > 1e-6 * mid ? normalize(xx > yy ? vec2(long2 - yy, xy) : vec2(xy, long2 - xx)) : vec2(1., 0.);
  vec2 pixel = lens.xy * t.xy / t.z + lens.zw;
  vec2 half1 = sqrt(2. * reach * long2) * axis, half2 = sqrt(2. * reach * short2) * vec2(-axis.y, axis.x);
  vec2 corners = abs(half1) + abs(half2);
  if (any(lessThan(pixel + corners, vec2(0.))) || any(greaterThan(pixel - corners, size))) return;
  vec2 position = pixel + corner.x * half1 + corner.y * half2;
  at = corner;
  vec3 rgb = mix(vec3(d.xyz), vec3(d.w, e.xy), vec3(w.w >> 24, w.w >> 16 & 255u, w.w >> 8 & 255u) / 255.);
  if (degree == 1) {
    vec3 dir = normalize(mean - eye);
    uvec3 h = texelFetch(harmonics, place, 0).rgb;
    rgb += 0.4886025 * (-dir.y * ten(h.x) + dir.z * ten(h.y) - dir.x * ten(h.z));
  }
  rgb = max(rgb, 0.);
  if (byFeature == 1) rgb = texelFetch(features, place, 0).rgb;
  color = vec4(mix(rgb, tint.rgb, tint.a), opacity);
  extra = vec2(reach, mode.g > 0.5 ? 1. : 0.);
  gl_Position = vec4(position / size * vec2(2., -2.) + vec2(-1., 1.), 0., 1.);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
in vec2 at; flat in vec4 color; flat in vec2 extra;
layout(location = 0) out vec4 picture; layout(location = 1) out vec4 selection;
void main() {
  float r2 = dot(at, at);
  if (r2 > 1.) discard;
  float alpha = min(0.99, color.a * exp(-extra.x * r2));
  picture = vec4(color.rgb * alpha, alpha);
  selection = vec4(extra.y * alpha, 0., 0., alpha);
}`;

const SCREEN = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4. - 1., 0., 1.); }`;

const FINISH = `#version 300 es
precision highp float;
uniform sampler2D picture, selection; uniform vec3 background, highlight; uniform float outline;
out vec4 result;
void main() {
  ivec2 p = ivec2(gl_FragCoord.xy), size = textureSize(picture, 0);
  vec4 c = texelFetch(picture, p, 0);
  vec3 rgb = c.rgb + (1. - c.a) * background;
  if (outline > 0.) {
    bool inside = texelFetch(selection, p, 0).r > 0.5, edge = false;
    int r = int(outline);
    for (int y = -r; y <= r; y++) for (int x = -r; x <= r; x++)
      edge = edge || texelFetch(selection, clamp(p + ivec2(x, y), ivec2(0), size - 1), 0).r > 0.5;
    if (inside) rgb = mix(rgb, highlight, 0.125);
    else if (edge) rgb = highlight;
  }
  result = vec4(rgb, 1.);
}`;

export class Viewer {
  // Throws where the browser has no WebGL2. `drawn` is called after every frame with the share of Gaussians
  // in it and, in motion, the milliseconds that it took.
  constructor(canvas, gaussians, drawn) {
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, preserveDrawingBuffer: true, powerPreference: "high-performance" });
    if (!gl) throw new Error("This browser has no WebGL2. Any current Firefox, Chrome, Edge or Safari has it; look for hardware acceleration in its settings.");
    Object.assign(this, { canvas, gl, gaussians, drawn, background: [0, 0, 0], highlight: [0.78, 1, 0.05], byFeature: false, sorted: 0, share: 1 });
    this.halfFloats = Boolean(gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float"));
    this.splats = program(gl, VERTEX, FRAGMENT);
    this.finish = program(gl, SCREEN, FINISH);
    this.upload();
    this.worker = new Worker(URL.createObjectURL(new Blob([`(${sorter})()`], { type: "text/javascript" })));
    this.worker.postMessage({ positions: gaussians.positions });
    this.waiting = new Map();
    this.worker.onmessage = ({ data }) => {
      this.waiting.get(data.id)?.(data.sorted);
      this.waiting.delete(data.id);
    };
    this.next = 0;
    this.targets = [];
  }

  upload() {
    const gl = this.gl, g = this.gaussians;
    const rows = Math.max(1, Math.ceil(g.count / WIDTH));
    this.textures = {
      words: texture(gl, gl.RGBA32UI, gl.RGBA_INTEGER, gl.UNSIGNED_INT, WIDTH, rows, padded(g.words, 4 * WIDTH * rows)),
      harmonics: g.degree
        ? texture(gl, gl.RGB32UI, gl.RGB_INTEGER, gl.UNSIGNED_INT, WIDTH, rows, padded(g.harmonics, 3 * WIDTH * rows))
        : texture(gl, gl.RGB32UI, gl.RGB_INTEGER, gl.UNSIGNED_INT, 1, 1, new Uint32Array(3)),
      features: g.features.length
        ? texture(gl, gl.RGB8, gl.RGB, gl.UNSIGNED_BYTE, WIDTH, rows, padded(g.features, 3 * WIDTH * rows))
        : texture(gl, gl.RGB8, gl.RGB, gl.UNSIGNED_BYTE, 1, 1, new Uint8Array(3)),
    };
    this.setCells();
    const ranges = Math.max(1, Math.ceil(g.chunks.length / 4 / WIDTH));
    this.textures.chunks = texture(gl, gl.RGBA32F, gl.RGBA, gl.FLOAT, WIDTH, ranges, padded(g.chunks, 4 * WIDTH * ranges));
    this.array = gl.createVertexArray();
    gl.bindVertexArray(this.array);
    const attribute = (name, size, integer, divisor, data) => {
      const buffer = gl.createBuffer(), at = gl.getAttribLocation(this.splats.program, name);
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.bufferData(gl.ARRAY_BUFFER, data, divisor ? gl.DYNAMIC_DRAW : gl.STATIC_DRAW);
      gl.enableVertexAttribArray(at);
      if (integer) gl.vertexAttribIPointer(at, size, gl.UNSIGNED_INT, 0, 0);
      else gl.vertexAttribPointer(at, size, gl.FLOAT, false, 0, 0);
      gl.vertexAttribDivisor(at, divisor);
      return buffer;
    };
    attribute("corner", 2, false, 0, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]));
    this.order = attribute("index", 1, true, 1, new Uint32Array(Math.max(1, g.count)));
  }

  // The cells of the Gaussians as they are now.
  setCells() {
    const gl = this.gl, g = this.gaussians, rows = Math.max(1, Math.ceil(g.count / WIDTH));
    if (this.textures.cells) gl.deleteTexture(this.textures.cells);
    this.textures.cells = texture(gl, gl.R32UI, gl.RED_INTEGER, gl.UNSIGNED_INT, WIDTH, rows, padded(Uint32Array.from(g.cells), WIDTH * rows));
  }

  // How each cell is drawn: `of(cell)` gives { color: [r, g, b] or null, mix, mode, selected }.
  setStates(count, of) {
    const rows = Math.ceil(Math.max(1, count) / STATES), bytes = new Uint8Array(4 * STATES * 2 * rows);
    this.anySelected = false;
    for (let cell = 0; cell < count; cell++) {
      const { color, mix, mode, selected } = of(cell);
      const at = 4 * (STATES * 2 * Math.floor(cell / STATES) + cell % STATES);
      if (color) bytes.set([...color, mix].map((v) => Math.round(255 * v)), at);
      bytes.set([mode, selected ? 1 : 0], at + 4 * STATES);
      this.anySelected ||= selected && mode === SHOWN;
    }
    const gl = this.gl;
    if (this.textures.states) gl.deleteTexture(this.textures.states);
    this.textures.states = texture(gl, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, STATES, 2 * rows, bytes);
  }

  // Sorts for a camera and draws. While one sort is under way, the last camera asked for waits.
  show(camera, share = 1, moving = false) {
    this.wanted = { camera, share, moving };
    if (!this.busy) this.busy = this.work().finally(() => (this.busy = null));
    return this.busy;
  }

  async work() {
    while (this.wanted) {
      const { camera, share, moving } = this.wanted;
      this.wanted = null;
      await this.sort(camera, share);
      const begun = performance.now();
      this.draw(camera);
      await this.finished();
      this.drawn?.(share, moving ? performance.now() - begun : null);
    }
  }

  // Until the last picture is drawn: frames must not pile up in a slow machine's queue.
  async finished() {
    const gl = this.gl, fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    while (gl.clientWaitSync(fence, 0, 0) === gl.TIMEOUT_EXPIRED) await new Promise((go) => setTimeout(go, 1));
    gl.deleteSync(fence);
  }

  async sort(camera, share) {
    const key = JSON.stringify([row(camera.rotation, 2), camera.translation[2], share]);
    if (key === this.sortedFor) return;
    const id = this.next++;
    const sorted = await new Promise((done) => {
      this.waiting.set(id, done);
      this.worker.postMessage({ forward: row(camera.rotation, 2), offset: camera.translation[2], near: this.gaussians.near, share, id });
    });
    const gl = this.gl;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, sorted);
    Object.assign(this, { sorted: sorted.length, sortedFor: key, share });
  }

  draw(camera) {
    const { gl, canvas } = this;
    if (canvas.width !== camera.width || canvas.height !== camera.height) [canvas.width, canvas.height] = [camera.width, camera.height];
    this.target(camera.width, camera.height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
    gl.drawBuffers([gl.COLOR_ATTACHMENT0, this.anySelected ? gl.COLOR_ATTACHMENT1 : gl.NONE]);
    gl.viewport(0, 0, camera.width, camera.height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    const { program: splats, at } = this.splats, g = this.gaussians;
    gl.useProgram(splats);
    bind(gl, at, this.textures, ["words", "cells", "harmonics", "features", "chunks", "states"]);
    gl.uniformMatrix3fv(at("rotation"), true, camera.rotation);
    gl.uniform3fv(at("translation"), camera.translation);
    gl.uniform3fv(at("eye"), eyeOf(camera));
    gl.uniform4f(at("lens"), camera.fx, camera.fy, camera.cx, camera.cy);
    gl.uniform2f(at("size"), camera.width, camera.height);
    gl.uniform1f(at("near"), g.near);
    // A share of the Gaussians covers as much when each is larger.
    gl.uniform1f(at("grow"), Math.min(2, 1 / Math.sqrt(this.share)));
    gl.uniform1f(at("harmonicsRange"), g.harmonicsRange);
    gl.uniform1i(at("antialias"), g.antialias ? 1 : 0);
    gl.uniform1i(at("degree"), g.degree);
    gl.uniform1i(at("byFeature"), this.byFeature && g.features.length ? 1 : 0);
    gl.uniform1ui(at("chunkSize"), g.chunk);
    gl.bindVertexArray(this.array);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.sorted);
    gl.disable(gl.BLEND);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.useProgram(this.finish.program);
    bind(gl, this.finish.at, { picture: this.targets[0], selection: this.targets[1] }, ["picture", "selection"]);
    gl.uniform3fv(this.finish.at("background"), this.background);
    gl.uniform3fv(this.finish.at("highlight"), this.highlight);
    gl.uniform1f(this.finish.at("outline"), this.anySelected ? Math.max(2, Math.round(camera.width / 500)) : 0);
    gl.bindVertexArray(null);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    this.camera = camera;
  }

  target(width, height) {
    if (this.frame && this.size?.[0] === width && this.size[1] === height) return;
    const gl = this.gl;
    this.targets.forEach((t) => gl.deleteTexture(t));
    const bytes = [gl.RGBA8, gl.UNSIGNED_BYTE], colours = this.halfFloats ? [gl.RGBA16F, gl.HALF_FLOAT] : bytes;
    this.targets = [colours, bytes].map(([inside, type]) => texture(gl, inside, gl.RGBA, type, width, height, null));
    this.frame ??= gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
    this.targets.forEach((t, k) => gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + k, gl.TEXTURE_2D, t, 0));
    this.size = [width, height];
  }

  // The pixels of the last picture, rgb by rows from the top.
  pixels() {
    const gl = this.gl, { width, height } = this.canvas, flipped = new Uint8Array(4 * width * height);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, flipped);
    const rgb = new Uint8Array(3 * width * height);
    for (let y = 0; y < height; y++) {
      for (let x = 0; x < width; x++) {
        const from = 4 * ((height - 1 - y) * width + x);
        rgb.set(flipped.subarray(from, from + 3), 3 * (y * width + x));
      }
    }
    return rgb;
  }
}

function padded(array, size) {
  const out = new array.constructor(size);
  out.set(array);
  return out;
}

function program(gl, vertex, fragment) {
  const linked = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(`WebGL does not take a shader: ${gl.getShaderInfoLog(shader)}`);
    gl.attachShader(linked, shader);
  }
  gl.linkProgram(linked);
  if (!gl.getProgramParameter(linked, gl.LINK_STATUS)) throw new Error(`WebGL does not link the shaders: ${gl.getProgramInfoLog(linked)}`);
  const places = new Map();
  const at = (name) => {
    if (!places.has(name)) places.set(name, gl.getUniformLocation(linked, name));
    return places.get(name);
  };
  return { program: linked, at };
}

function texture(gl, inside, format, type, width, height, data) {
  const made = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, made);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  gl.texImage2D(gl.TEXTURE_2D, 0, inside, width, height, 0, format, type, data);
  for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, side, gl.NEAREST);
  for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
  return made;
}

function bind(gl, at, textures, names) {
  names.forEach((name, unit) => {
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, textures[name]);
    gl.uniform1i(at(name), unit);
  });
}
