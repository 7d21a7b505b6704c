// Where answers come from: a server on this machine, or what the file itself holds. Both have the same doors:
// load(progress), photograph(view), preview(view), thumbnail(instance), pick(...), find(text), save(edits), selection(...); only a
// server, which knows the Gaussians of the geometry, has lasso(...).
// A server may have edits that this page has not: `behind` says that an answer was made with others.
import { Gaussians, largest } from "./gaussians.js";

async function answer(response) {
  if (response.ok) return response;
  const text = await response.text();
  throw new Error(text || `the server says ${response.status}`);
}

const post = (path, body) =>
  fetch(path, { method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify(body) }).then(answer);

const pinhole = ({ width, height, fx, fy, cx, cy, rotation, translation }) => ({ width, height, fx, fy, cx, cy, rotation, translation });

export class Server {
  // `progress(done, total)` in bytes.
  async load(progress) {
    const scene = await this.known(await fetch("scene.json").then(answer)).json();
    const response = await fetch("scene.bin").then(answer);
    const bytes = new Uint8Array(scene.bytes), reader = response.body.getReader();
    for (let at = 0; ;) {
      const { done, value } = await reader.read();
      if (done) break;
      bytes.set(value, at);
      progress((at += value.length), scene.bytes);
    }
    this.scene = scene;
    this.gaussians = new Gaussians(scene, bytes.buffer);
  }

  // The page has the edits that this answer was made with.
  known(response) {
    this.version = response.headers.get("etag");
    this.behind = false;
    return response;
  }

  seen(response) {
    this.behind = response.headers.get("etag") !== this.version;
    return response;
  }

  photograph(view) {
    return `photograph/${view}`;
  }

  preview(view) {
    return `preview/${view}`;
  }

  thumbnail(instance) {
    return `thumbnail/${instance}`;
  }

  async pick(camera, x, y, hidden) {
    return this.seen(await post("pick", { camera: pinhole(camera), x, y, hidden })).json();
  }

  // { gaussians, count }: those seen within an outline in pixels, that the instance has, or that it has not.
  async lasso(camera, outline, hidden, instance, own) {
    return (await post("lasso", { camera: pinhole(camera), outline, hidden, instance, own })).json();
  }

  async find(text) {
    return this.seen(await fetch(`find?text=${encodeURIComponent(text)}`).then(answer)).json();
  }

  // The edits that there are, and the instances and cells after them.
  async edits() {
    return this.known(await fetch("edits").then(answer)).json();
  }

  // { instances, cut } after the edits; where others were made since, nothing is saved, and those are told, too: { edits }.
  async save(edits) {
    const headers = { "content-type": "application/json", "if-match": this.version };
    const response = await fetch("edits", { method: "PUT", headers, body: JSON.stringify(edits) });
    const stale = response.status === 409 && response.headers.has("etag");
    return this.known(stale ? response : await answer(response)).json();
  }

  async selection(cells, others) {
    return this.seen(await post("selection", { cells, others })).blob();
  }
}

// The page as one file: nothing is asked of anybody.
export class File {
  async load(progress) {
    const text = (id) => document.getElementById(id).textContent;
    this.scene = JSON.parse(text("scene-json"));
    this.pictures = JSON.parse(text("pictures-json"));
    const base64 = text("scene-bin"), bytes = new Uint8Array(this.scene.bytes);
    // A multiple of four letters at a time, so that the bar moves.
    for (let at = 0, step = 1 << 20; at < base64.length; at += step) {
      const part = atob(base64.slice(at, at + step));
      for (let k = 0; k < part.length; k++) bytes[at / 4 * 3 + k] = part.charCodeAt(k);
      progress(Math.min(bytes.length, at / 4 * 3), bytes.length);
      await new Promise((go) => setTimeout(go));
    }
    this.gaussians = new Gaussians(this.scene, bytes.buffer);
  }

  photograph(view) {
    return this.pictures.photographs[view] ?? null;
  }

  preview(view) {
    return this.photograph(view);
  }

  thumbnail(instance) {
    return this.pictures.thumbnails[instance] ?? null;
  }

  async pick(camera, x, y, hidden, labelOf) {
    const away = new Set(hidden);
    const { weights, alpha, position } = this.gaussians.at(camera, x, y, (cell) => !away.has(cell));
    return { ...largest(weights, labelOf), alpha, position };
  }

  async find(text, names) {
    const wanted = text.trim().toLowerCase();
    const named = [...names].filter(([, name]) => name.toLowerCase().includes(wanted)).map(([k]) => k);
    const known = Object.keys(this.pictures.texts).find((t) => t.toLowerCase() === wanted);
    if (!known && !named.length) {
      const texts = Object.keys(this.pictures.texts);
      throw new Error(texts.length ? `This file knows the answers to: ${texts.join(", ")}. Other words need explore serve.` : "This file was written without texts (explore page --text). Names that you give can be found.");
    }
    return { scores: [], verdict: null, ...(known && this.pictures.texts[known]), text, named };
  }

  async save() {
    return { instances: null };
  }

  async selection(cells, others) {
    const meant = new Set(cells);
    const ply = this.gaussians.ply((c) => meant.has(c) !== others);
    if (!ply) throw new Error("Nothing is selected: there is nothing to save.");
    return ply;
  }
}
