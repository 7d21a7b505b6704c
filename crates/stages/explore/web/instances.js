// Instances, the tree that they were cut from, and what a person changed of them. Gaussians of one instance and one
// cluster of the tree are a cell, cut where a person gave a part of it away: everything here is about cells.

// Most bytes of a name and of a note, as artifacts::Edits has them.
const LONGEST = { name: 100, text: 500 };

export class Instances {
  constructor(scene, gaussians) {
    Object.assign(this, { scene, gaussians, edits: [], undone: [] });
    this.root = Math.min(...scene.tree.map((e) => e[0]));
    this.setCells(scene.cut);
    this.setEdits(scene.edits);
  }

  // The cells as somebody who knows all Gaussians cut them for some edits, and which of them each edit assigns; null: uncut.
  setCells(cut) {
    const { gaussians } = this, { cells, cell_counts, assigned } = cut ?? { ...this.scene, assigned: [] };
    gaussians.cells = cut ? new Uint32Array(Uint8Array.from(atob(cut.of), (c) => c.charCodeAt(0)).buffer) : gaussians.uncut;
    Object.assign(this, { cells, counts: cell_counts, assigned });
    this.sizes = new Float64Array(this.cells.length);
    this.sums = this.cells.map(() => [0, 0, 0]);
    this.lowest = this.cells.map(() => [Infinity, Infinity, Infinity]);
    this.highest = this.cells.map(() => [-Infinity, -Infinity, -Infinity]);
    const p = gaussians.positions;
    for (let i = 0; i < gaussians.count; i++) {
      const cell = gaussians.cells[i];
      this.sizes[cell]++;
      for (let k = 0; k < 3; k++) {
        const v = p[3 * i + k];
        this.sums[cell][k] += v;
        if (v < this.lowest[cell][k]) this.lowest[cell][k] = v;
        if (v > this.highest[cell][k]) this.highest[cell][k] = v;
      }
    }
  }

  // Starts from these edits; nothing of them can be undone one by one but from the last.
  setEdits(edits, undone = []) {
    Object.assign(this, { edits: [], undone, assigns: 0 });
    this.start();
    for (const edit of edits) {
      this.apply(edit);
      this.edits.push(edit);
    }
  }

  start() {
    this.label = Int32Array.from(this.cells, (c) => c[0]);
    this.tree = this.scene.tree.map(([parent, child, lambda, size, instance]) => ({ parent, child, lambda, size, instance }));
    this.names = new Map();
    this.notes = new Map();
    // What a vocabulary calls those that nobody merged or split: k -> { name, sure }.
    this.guesses = new Map(this.scene.instances.flatMap(({ guess }, k) => (guess ? [[k, guess]] : [])));
    this.origin = this.scene.instances.map((_, k) => [k]);
    this.metresPerUnit = null;
  }

  get length() {
    return this.origin.length;
  }

  // One more edit; returns why not, or null.
  edit(edit) {
    const wrong = this.apply(edit);
    if (wrong) return wrong;
    this.edits.push(edit);
    this.undone = [];
    return null;
  }

  undo() {
    if (!this.edits.length) return false;
    this.setEdits(this.edits.slice(0, -1), [...this.undone, this.edits.at(-1)]);
    return true;
  }

  redo() {
    const edit = this.undone.pop();
    if (!edit) return false;
    this.apply(edit);
    this.edits.push(edit);
    return true;
  }

  // The rules are those of artifacts::Edits, which the other programs follow.
  apply(edit) {
    if (edit.op === "merge") {
      const [first, ...others] = edit.instances;
      if (!others.length) return "Select two or more instances to merge (shift-click).";
      const gone = new Set(others);
      this.guesses.delete(first);
      this.label = this.label.map((l) => (gone.has(l) ? first : l));
      for (const e of this.tree) if (gone.has(e.instance)) e.instance = first;
      for (const k of others) {
        this.origin[first] = [...this.origin[first], ...this.origin[k]];
        this.forget(k);
      }
    } else if (edit.op === "split") {
      const k = edit.instance, { own, parts } = this.family(k);
      if (parts.length < 2) return "This has no parts in the tree.";
      const inside = parts.map((p) => this.within(p));
      const members = this.cellsOf(k);
      const partOf = (cell) => inside.findIndex((s) => s.has(this.cells[cell][1]));
      const sizes = parts.map((_, p) => members.filter((c) => partOf(c) === p).reduce((s, c) => s + this.counts[c], 0));
      const keeps = sizes.indexOf(Math.max(...sizes));
      const ids = parts.map((_, p) => (p === keeps ? k : this.origin.push(sizes[p] ? [...this.origin[k]] : []) - 1));
      for (const cell of members) {
        const part = partOf(cell);
        if (part >= 0) this.label[cell] = ids[part];
      }
      this.guesses.delete(k);
      for (const e of this.tree) {
        if (own.includes(e.child)) e.instance = -1;
        if (parts.includes(e.child)) e.instance = ids[parts.indexOf(e.child)];
      }
    } else if (edit.op === "rename" || edit.op === "note") {
      const [field, all] = edit.op === "note" ? ["text", this.notes] : ["name", this.names];
      const bytes = new TextEncoder().encode(edit[field]).length;
      if (bytes > LONGEST[field]) return `This is too long: it has ${bytes} bytes, and ${LONGEST[field]} at most are kept.`;
      if (edit[field]) all.set(edit.instance, edit[field]);
      else all.delete(edit.instance);
    } else if (edit.op === "assign") {
      // Until the cells were cut for this edit it changes nothing here.
      const cells = this.assigned[this.assigns++] ?? [], had = new Set(cells.map((c) => this.label[c]));
      for (const c of cells) this.label[c] = edit.instance;
      for (const k of had) {
        if (k < 0 || this.label.includes(k)) continue;
        this.forget(k);
        for (const e of this.tree) if (e.instance === k) e.instance = -1;
      }
    } else if (edit.op === "scale") {
      this.metresPerUnit = edit.metres / Math.hypot(...edit.from.map((v, k) => v - edit.to[k]));
    }
    return null;
  }

  // Leaves nothing of an instance that is no more.
  forget(k) {
    this.origin[k] = [];
    for (const known of [this.names, this.notes, this.guesses]) known.delete(k);
  }

  // The clusters of an instance, and those that it consists of.
  family(k) {
    const own = this.tree.filter((e) => e.instance === k).map((e) => e.child);
    const parts = own.length > 1 ? own : this.tree.filter((e) => e.parent === own[0]).map((e) => e.child);
    return { own, parts };
  }

  // A cluster and all below it.
  within(top) {
    const found = new Set([top]);
    for (const e of [...this.tree].sort((a, b) => a.parent - b.parent)) if (found.has(e.parent)) found.add(e.child);
    return found;
  }

  cellsOf(instance) {
    return this.cellsWhere((c) => this.label[c] === instance);
  }

  cellsWhere(holds) {
    const found = [];
    for (let c = 0; c < this.cells.length; c++) if (holds(c)) found.push(c);
    return found;
  }

  // From the smallest part at a cell to the largest group, each { name, cells }, and which of them is the instance.
  levels(cell) {
    const instance = this.label[cell];
    if (instance < 0) return { levels: [], thing: -1 };
    const above = new Map(this.tree.map((e) => [e.child, e]));
    const chain = [];
    for (let at = this.cells[cell][1]; above.has(at) && at !== this.root; at = above.get(at).parent) {
      chain.push(at);
      if (above.get(at).lambda === 0) break;
    }
    const thing = this.cellsOf(instance);
    const levels = [{ name: "thing", cells: thing }];
    let index = 0;
    for (const cluster of chain) {
      const nodes = this.within(cluster);
      const cells = this.cellsWhere((c) => nodes.has(this.cells[c][1]));
      const own = cells.filter((c) => this.label[c] === instance);
      if (own.length && own.length < thing.length && own.length === cells.length) levels.splice(index++, 0, { name: "part", cells });
      else if (cells.length > levels.at(-1).cells.length && own.length === thing.length) levels.push({ name: "group", cells });
    }
    return { levels, thing: index };
  }

  name(k) {
    return this.called(k) ?? `instance ${k}`;
  }

  // As a person or the vocabulary calls it, a guess with a question mark; null where neither does.
  called(k) {
    const guess = this.guesses.get(k);
    return this.names.get(k) ?? (guess ? guess.name + (guess.sure ? "" : "?") : null);
  }

  // What is there: [name, instances], those of which there are most first.
  inventory() {
    const there = new Map();
    for (const k of new Set(this.label)) {
      if (k < 0) continue;
      const name = this.names.get(k) ?? this.guesses.get(k)?.name ?? "without a name";
      there.set(name, [...(there.get(name) ?? []), k]);
    }
    return [...there].sort((a, b) => b[1].length - a[1].length || (a[0] < b[0] ? -1 : 1));
  }

  // Views that show it, best first: [view, mask, score].
  views(k) {
    const own = new Set(this.origin[k]), best = new Map();
    for (const [instance, view, mask, score, visible] of this.scene.matches) {
      if (own.has(instance) && !(best.get(view)?.[3] >= score * visible)) best.set(view, [view, mask, score, score * visible]);
    }
    return [...best.values()].sort((a, b) => b[3] - a[3]);
  }

  // The middle of some cells, their Gaussians, and the box along the axes of the world around them.
  extent(cells) {
    let count = 0;
    const sum = [0, 0, 0], low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
    for (const c of cells) {
      count += this.sizes[c];
      for (let k = 0; k < 3; k++) {
        sum[k] += this.sums[c][k];
        low[k] = Math.min(low[k], this.lowest[c][k]);
        high[k] = Math.max(high[k], this.highest[c][k]);
      }
    }
    return { count, center: sum.map((v) => v / count), low, high };
  }
}
