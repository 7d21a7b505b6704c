// The visitor's camera: orbit, pan, zoom, fly; mouse, touch and keys.
import { add, dot, eyeOf, fitted, length, lookingAlong, rotate, rotateBack, row, times, turned, unit } from "./maths.js";

// Radians of a turn across the whole canvas.
const TURN = Math.PI;
// The view never comes nearer than this to straight up or down, in radians: there left and right would change places.
const POLE = 0.05;

export class Visitor {
  // `cameras` are those of the photographs: they tell what is up. `changed(moving)` is called after every change.
  constructor(cameras, spread, changed) {
    const sum = cameras.reduce((s, c) => add(s, row(c.rotation, 1), -1), [0, 0, 0]);
    this.up = length(sum) > 1e-6 ? unit(sum) : [0, 0, 1];
    Object.assign(this, { spread, changed, distance: spread, target: [0, 0, 0], rotation: lookingAlong([0, 1, 0], this.up), tan: 0.5, photograph: null });
  }

  get eye() {
    return add(this.target, row(this.rotation, 2), -this.distance);
  }

  // The camera for a canvas of this size.
  camera(width, height) {
    if (this.photograph) return fitted(this.photograph, width, height);
    const f = 0.5 * height / this.tan;
    const translation = times(rotate(this.rotation, this.eye), -1);
    return { width, height, fx: f, fy: f, cx: width / 2, cy: height / 2, rotation: this.rotation, translation };
  }

  // Stands where a photograph was taken, until the visitor moves; orbits about the point `depth` before it.
  jump(camera, depth) {
    this.photograph = camera;
    this.rotation = camera.rotation;
    this.distance = depth > 0 ? depth : this.spread;
    this.target = add(eyeOf(camera), row(camera.rotation, 2), this.distance);
    this.tan = 0.5 * camera.height / camera.fy;
    this.changed(false);
  }

  // Looks at a ball from where the visitor is.
  frame(center, radius) {
    this.leave();
    this.target = center;
    this.distance = Math.max(1.3 * radius / this.tan, 1e-3 * this.spread);
    this.changed(false);
  }

  // From here on the camera is the visitor's own.
  leave() {
    this.photograph = null;
  }

  orbit(dx, dy) {
    this.leave();
    const turnedRight = turned(this.rotation, this.up, -dx * TURN);
    const tilted = turned(turnedRight, row(turnedRight, 0), -dy * TURN);
    const height = Math.acos(Math.min(1, Math.max(-1, dot(row(tilted, 2), this.up))));
    // A tilt past a pole is left out, and with it what would roll the view.
    const kept = height > POLE && height < Math.PI - POLE ? tilted : turnedRight;
    this.rotation = lookingAlong(row(kept, 2), this.up);
    this.changed(true);
  }

  // By shares of the canvas's height.
  pan(dx, dy) {
    this.leave();
    const scale = 2 * this.tan * this.distance;
    this.target = add(this.target, rotateBack(this.rotation, [-dx * scale, -dy * scale, 0]));
    this.changed(true);
  }

  zoom(factor) {
    this.leave();
    this.distance = Math.min(Math.max(this.distance * factor, 1e-3 * this.spread), 100 * this.spread);
    this.changed(true);
  }

  // Moves the eye along right, down, forward; in shares of the scene's size.
  fly(step) {
    this.leave();
    this.target = add(this.target, rotateBack(this.rotation, times(step, this.spread)));
    this.changed(true);
  }

  // Listens to a canvas. `click(event)` is called for a press that does not move. `trace(event, done)` says whether a drag is a
  // tool's; then the camera stays.
  listen(canvas, click, trace) {
    const fingers = new Map();
    let moved = 0;
    canvas.addEventListener("contextmenu", (e) => e.preventDefault());
    canvas.addEventListener("pointerdown", (e) => {
      canvas.setPointerCapture(e.pointerId);
      if (!fingers.size) moved = 0;
      fingers.set(e.pointerId, [e.clientX, e.clientY]);
      if (fingers.size === 1) trace(e, false);
    });
    canvas.addEventListener("pointermove", (e) => {
      const last = fingers.get(e.pointerId);
      if (!last) return;
      const now = [e.clientX, e.clientY], h = canvas.clientHeight;
      const dx = (now[0] - last[0]) / h, dy = (now[1] - last[1]) / h;
      moved += Math.hypot(now[0] - last[0], now[1] - last[1]);
      const other = [...fingers].find(([id]) => id !== e.pointerId)?.[1];
      fingers.set(e.pointerId, now);
      const moves = other || e.buttons & 2 || e.ctrlKey;
      if (moved < 4 || (!moves && trace(e, false))) return;
      if (other) {
        const gap = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]);
        this.pan(dx / 2, dy / 2);
        this.zoom(gap(last) / Math.max(1, gap(now)));
      } else if (moves) {
        this.pan(dx, dy);
      } else {
        this.orbit(dx, dy);
      }
    });
    const end = (e) => {
      if (!fingers.delete(e.pointerId) || fingers.size) return;
      if (e.type === "pointerup" && moved < 4 && e.button === 0) click(e);
      else if (!trace(e, true)) this.changed(false);
    };
    canvas.addEventListener("pointerup", end);
    canvas.addEventListener("pointercancel", end);
    canvas.addEventListener("wheel", (e) => {
      e.preventDefault();
      this.zoom(Math.exp(0.001 * e.deltaY * (e.deltaMode ? 30 : 1)));
      clearTimeout(this.rest);
      this.rest = setTimeout(() => this.changed(false), 200);
    }, { passive: false });
  }

  // Flies while keys are held: W A S D and Q E, arrows turn. `held` is the set of keys; call it every frame with the seconds
  // since the last one.
  move(held, seconds) {
    const of = (plus, minus) => (held.has(plus) ? 1 : 0) - (held.has(minus) ? 1 : 0);
    const step = [of("d", "a"), of("q", "e"), of("w", "s")];
    if (length(step)) this.fly(times(step, 0.6 * seconds));
    const turn = [of("arrowleft", "arrowright"), of("arrowup", "arrowdown")];
    if (turn[0] || turn[1]) this.orbit(0.25 * turn[0] * seconds, 0.25 * turn[1] * seconds);
  }
}
