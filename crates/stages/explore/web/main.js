// The page: what a person does, and what it changes.
import { add, fitted, length, lookingAlong, project, row, times } from "./maths.js";
import { GHOST, HIDDEN, SHOWN, Viewer } from "./viewer.js";
import { Visitor } from "./camera.js";
import { Instances } from "./instances.js";
import { File, Server } from "./doors.js";

const $ = (id) => document.getElementById(id);
const errors = [];
addEventListener("error", (e) => errors.push(e.message));
addEventListener("unhandledrejection", (e) => errors.push(String(e.reason)));

const door = $("scene-json") ? new File() : new Server();
// While a visitor moves, at most so many Gaussians are drawn.
const MOST_IN_MOTION = 1_500_000;
// How long a frame may take in motion, in milliseconds; where it takes longer, fewer pixels are drawn, down to this share of each side.
const FRAME = 16, COARSEST = 0.25;
let viewer, visitor, instances, scene, gaussians, started = false;
const state = { cells: new Set(), clicked: null, levels: null, hidden: new Set(), rest: "shown", colors: "photograph", answer: null, tool: "select", points: [], path: [], moving: false, sharpness: 1 };
const held = new Set();

function say(text, wrong = false) {
  $("hint").textContent = text;
  $("hint").classList.toggle("wrong", wrong);
  clearTimeout(say.timer);
  if (text && !wrong) say.timer = setTimeout(() => say(""), 6000);
}

// Runs what may fail, and says why it did.
const attempt = (work) => async (...given) => {
  try {
    return await work(...given);
  } catch (e) {
    say(e.message, true);
    return null;
  }
};

// ---- drawing ----

function hiddenCells() {
  const isolated = state.rest === "hidden" && state.cells.size;
  return instances.cellsWhere((c) => state.hidden.has(c) || (isolated && !state.cells.has(c)));
}

function hue(t) {
  // Dark blue over red to yellow, as perceived lightness grows.
  const stops = [[0.05, 0.03, 0.53], [0.6, 0.1, 0.6], [0.9, 0.4, 0.35], [0.94, 0.97, 0.13]];
  const x = Math.min(Math.max(t, 0), 1) * 3, k = Math.min(2, Math.floor(x));
  return stops[k].map((a, i) => a + (x - k) * (stops[k + 1][i] - a));
}

// The colours of artifacts::instance_color.
function instanceColor(id) {
  if (id < 0) return [0.25, 0.25, 0.25];
  const h = (id * 0.618034 + 0.08) % 1, value = [0.95, 0.75, 0.85][id % 3], saturation = [0.75, 0.55, 0.9, 0.65][id % 4];
  return [0, 2 / 3, 1 / 3].map((shift) => {
    const trapezoid = Math.abs(((h + shift) % 1) * 6 - 3) - 1;
    return value * (1 - saturation + saturation * Math.min(Math.max(trapezoid, 0), 1));
  });
}

function states() {
  const scores = state.answer?.scores ?? [];
  const known = scores.filter((s) => s !== null);
  const [low, high] = [Math.min(...known), Math.max(...known)];
  const tint = (cell) => {
    const label = instances.label[cell];
    if (state.colors === "instance") return [instanceColor(label), 0.75];
    if (state.colors === "score") return [label >= 0 && known.length && scores[label] != null ? hue((scores[label] - low) / (high - low || 1)) : [0.15, 0.15, 0.15], 0.85];
    return [null, 0];
  };
  viewer.byFeature = state.colors === "feature";
  viewer.setStates(instances.cells.length, (cell) => {
    const [color, mix] = tint(cell), selected = state.cells.has(cell);
    const rest = state.cells.size && !selected ? { hidden: HIDDEN, ghost: GHOST, shown: SHOWN }[state.rest] : SHOWN;
    return { color, mix, selected, mode: state.hidden.has(cell) ? HIDDEN : rest };
  });
}

function camera() {
  const scale = Math.min(devicePixelRatio || 1, 1.5) * (state.moving ? state.sharpness : 1);
  return visitor.camera(Math.max(1, Math.round($("stage").clientWidth * scale)), Math.max(1, Math.round($("stage").clientHeight * scale)));
}

function draw() {
  const share = state.moving ? Math.min(1, MOST_IN_MOTION / gaussians.count) : 1;
  const done = viewer.show(camera(), share, state.moving);
  overlay();
  return done;
}

// Everything again: after a selection, an edit, another colour.
function refresh() {
  states();
  const done = draw();
  panel();
  tools();
  return done;
}

// The photograph over the render, points of a measurement, the box of the selection.
function overlay() {
  const photograph = visitor.photograph, blend = Number($("blend").value), image = $("photograph");
  $("blend-label").style.visibility = photograph ? "visible" : "hidden";
  image.hidden = !photograph || blend === 0 || !door.photograph(photograph.index);
  if (!image.hidden) {
    const source = door.photograph(photograph.index);
    if (image.getAttribute("src") !== source) image.src = source;
    const [x, y, w, h] = fitted(photograph, $("stage").clientWidth, $("stage").clientHeight).rectangle;
    Object.assign(image.style, { left: `${x}px`, top: `${y}px`, width: `${w}px`, height: `${h}px`, opacity: blend });
  }
  $("view").value = photograph ? photograph.index : "";
  const here = visitor.camera($("stage").clientWidth, $("stage").clientHeight), marks = [];
  const line = (a, b, kind = "") => {
    const [p, q] = [project(here, a), project(here, b)];
    if (p[2] > gaussians.near && q[2] > gaussians.near) marks.push(`<line class="${kind}" x1="${p[0]}" y1="${p[1]}" x2="${q[0]}" y2="${q[1]}"/>`);
  };
  const box = state.tool === "select" ? selectedBox() : null;
  if (box) {
    const corner = (s) => box.axes.reduce((at, axis, k) => add(at, axis, s[k] * box.half[k]), box.center);
    for (let k = 0; k < 3; k++) for (const a of [-1, 1]) for (const b of [-1, 1]) {
      const ends = [-1, 1].map((c) => [0, 1, 2].map((i) => (i === k ? c : i === (k + 1) % 3 ? a : b)));
      line(corner(ends[0]), corner(ends[1]), "box");
    }
  }
  if (state.path.length) marks.push(`<polygon points="${state.path.join(" ")}"/>`);
  const points = state.points;
  if (points.length === 2) line(points[0], points[1]);
  for (const point of points) {
    const p = project(here, point);
    if (p[2] > gaussians.near) marks.push(`<circle cx="${p[0]}" cy="${p[1]}" r="4"/>`);
  }
  if (points.length === 2) {
    const p = project(here, times(add(points[0], points[1]), 0.5));
    if (p[2] > gaussians.near) marks.push(`<text x="${p[0] + 8}" y="${p[1] - 8}">${size(length(add(points[0], points[1], -1)))}</text>`);
  }
  $("marks").innerHTML = marks.join("");
}

// A length of the scene in words.
function size(units) {
  const metres = instances.metresPerUnit;
  if (!metres) return `${units.toPrecision(3)} units`;
  const m = units * metres;
  return m < 0.995 ? `${(100 * m).toPrecision(3)} cm` : `${m.toPrecision(3)} m`;
}

// ---- selection ----

function selectedInstances() {
  return [...new Set([...state.cells].map((c) => instances.label[c]))].filter((l) => l >= 0).sort((a, b) => a - b);
}

// The one instance that is selected whole, else null.
function wholeInstance() {
  const [k, ...others] = selectedInstances();
  return k === undefined || others.length || instances.cellsOf(k).some((c) => !state.cells.has(c)) ? null : k;
}

// The box of the selection: of a whole instance along its own axes, of anything else along the world's.
function selectedBox() {
  if (!state.cells.size) return null;
  const k = wholeInstance(), known = k === null ? null : state.list?.[k] ?? (instances.edits.length ? null : scene.instances[k]);
  if (known) return known.box;
  const { low, high } = instances.extent(state.cells);
  const axes = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
  return { center: low.map((v, i) => (v + high[i]) / 2), axes, half: low.map((v, i) => (high[i] - v) / 2) };
}

function select(cells, { extend = false, clicked = null } = {}) {
  const before = extend ? [...state.cells] : [];
  const drop = extend && cells.length && cells.every((c) => state.cells.has(c));
  state.cells = new Set(drop ? before.filter((c) => !cells.includes(c)) : [...before, ...cells]);
  state.clicked = clicked;
  state.levels = clicked === null || extend ? null : instances.levels(clicked);
  return refresh();
}

const selectInstances = (ids, options) => select(ids.flatMap((k) => instances.cellsOf(k)), options);

async function pick(here, x, y) {
  const picked = await door.pick(here, x, y, hiddenCells(), (cell) => instances.label[cell]).catch(async (e) => {
    // The cells may be others since.
    door.behind = true;
    await catchUp();
    throw e;
  });
  if (door.behind) await catchUp();
  return picked;
}

// What is where an event happened; null outside of the picture.
async function under(event) {
  const here = camera(), scale = here.width / $("stage").clientWidth;
  const rect = $("canvas").getBoundingClientRect();
  const [x, y] = [event.clientX - rect.left, event.clientY - rect.top].map((v) => Math.floor(v * scale));
  const outside = x < 0 || y < 0 || x >= here.width || y >= here.height;
  return outside ? null : pick(here, x, y);
}

const click = attempt(async (event) => {
  const picked = await under(event);
  if (!picked) return;
  if (["measure", "scale"].includes(state.tool)) return measure(picked.position);
  if (picked.instance === null) {
    if (!event.shiftKey) await select([]);
    say(picked.alpha > 0.1 ? "This belongs to no instance." : "");
    return;
  }
  await selectInstances([picked.instance], { extend: event.shiftKey, clicked: picked.cell });
});

const measure = attempt(async (position) => {
  if (!position) return say("There is nothing to measure at.");
  state.points = state.points.length < 2 ? [...state.points, position] : [position];
  overlay();
  if (state.points.length < 2) return say("Click on the second point.");
  const units = length(add(state.points[0], state.points[1], -1));
  if (state.tool === "measure") return say(`${size(units)} apart`);
  const answer = await ask("How far are these two points apart, in metres?", instances.metresPerUnit ? (units * instances.metresPerUnit).toPrecision(3) : "");
  const metres = Number(answer?.replace(",", "."));
  if (answer !== null && !(metres > 0 && Number.isFinite(metres))) throw new Error(`${answer}: not a length in metres, such as 0.30.`);
  if (answer !== null) await edit({ op: "scale", from: state.points[0], to: state.points[1], metres });
  setTool("select");
});

// A drag with a lasso draws around Gaussians.
function trace(event, done) {
  if (!["add", "remove"].includes(state.tool)) return false;
  const rect = $("canvas").getBoundingClientRect();
  if (event.type === "pointerdown") state.path = [];
  if (!done) state.path.push([event.clientX - rect.left, event.clientY - rect.top]);
  const path = state.path;
  if (done) state.path = [];
  overlay();
  if (done && event.type === "pointerup" && path.length > 2) lasso(path);
  return true;
}

// What is seen within is given to the selected instance, or taken from it.
const lasso = attempt(async (path) => {
  const instance = wholeInstance(), adds = state.tool === "add";
  if (instance === null) throw new Error("Select one whole thing first.");
  const here = camera(), scale = here.width / $("stage").clientWidth;
  const { gaussians, count } = await door.lasso(here, path.map((p) => p.map((v) => v * scale)), hiddenCells(), instance, !adds);
  if (!count) return say(adds ? "Nothing else is seen in there." : "Nothing of it is seen in there.");
  if (await edit({ op: "assign", instance: adds ? instance : -1, gaussians }) === null) return;
  if (!state.cells.size) setTool("select");
  say(`${count.toLocaleString("en")} Gaussians ${adds ? "added" : "removed"}. Undo with ctrl+z.`);
});

function setTool(tool) {
  Object.assign(state, { tool, points: [], path: [] });
  $("canvas").classList.toggle("tool", tool !== "select");
  say({
    measure: "Click on two points to measure between them.", scale: "Click on two points whose distance you know.",
    add: "Draw around what belongs to it.", remove: "Draw around what does not belong to it.",
  }[tool] ?? "");
  overlay();
  tools();
}

// ---- words ----

const find = attempt(async (text) => {
  if (!text.trim()) return clearAnswer();
  const answer = await door.find(text, instances.names);
  // Not waited for: a change that waits for this goes first.
  if (door.behind) catchUp();
  // A file knows the scores of the instances as they were: what was split off since has those of the whole.
  const best = (from) => from.map((k) => answer.scores[k]).filter((s) => s != null).reduce((a, b) => (a === null || b > a ? b : a), null);
  const scores = answer.scores.length ? instances.origin.map((from, k) => (from.length ? answer.scores[k] ?? best(from) : null)) : [];
  const ranking = scores.map((score, k) => ({ k, score })).filter((r) => r.score !== null).sort((a, b) => b.score - a.score || a.k - b.k);
  const named = answer.named.filter((k) => instances.origin[k]?.length);
  const all = [...named.map((k) => ({ k, score: null })), ...ranking.filter((r) => !named.includes(r.k))];
  if (!all.length) throw new Error("No instance has a descriptor to compare with.");
  const none = !named.length && answer.verdict?.matches === false;
  state.answer = { text: answer.text, scores, ranking: all, none };
  state.threshold = named.length || none ? null : ranking[0].score;
  results();
  await selectInstances(named.length ? named : none ? [] : [ranking[0].k]);
  const { verdict } = answer;
  say(none ? `Nothing matches “${answer.text}”: its best score, ${verdict.best.toFixed(3)}, is no better than that of unrelated texts (${verdict.by_chance.toFixed(3)}).` : "");
});

function clearAnswer() {
  state.answer = null;
  results();
  return refresh();
}

// All that is there, by name: in the place of what was found.
const inventory = attempt(() => {
  state.answer = state.threshold = null;
  const there = instances.inventory(), all = there.reduce((sum, [, own]) => sum + own.length, 0);
  reveal("results", true);
  for (const part of ["histogram", "threshold-label"]) $(part).style.display = "none";
  $("results-title").textContent = `${all} thing${all === 1 ? "" : "s"} here`;
  fill(there.map(([name, own]) => ({ name, own, beside: `× ${own.length}`, title: own.map((k) => `${instances.name(k)} (${k})`).join(", ") })));
});

// Fills the list: things of a name, their notes, and what stands beside it.
function fill(rows) {
  const at = [...$("ranking").querySelectorAll("button")].indexOf(document.activeElement);
  $("ranking").replaceChildren(...rows.map(({ name, own, beside, title }) => {
    const button = element("button", { type: "button", title }), words = element("span", {}, name);
    const pictured = own.find((k) => instances.views(k).length), picture = pictured === undefined ? null : door.thumbnail(pictured);
    for (const k of own) if (instances.notes.has(k)) words.append(element("small", {}, instances.notes.get(k)));
    button.append(picture ? element("img", { src: picture, alt: "", loading: "lazy" }) : element("span"), words, element("small", {}, beside));
    button.addEventListener("click", (e) => selectInstances(own, { extend: e.shiftKey }));
    const item = element("li");
    item.append(button);
    return item;
  }));
  $("ranking").querySelectorAll("button")[at]?.focus();
}

// Arrows go along the list, and do not turn the scene.
function along(event) {
  const step = { ArrowDown: 1, ArrowUp: -1 }[event.key], all = [...$("ranking").querySelectorAll("button")];
  if (!step) return;
  event.preventDefault();
  event.stopPropagation();
  all[all.indexOf(document.activeElement) + step]?.focus();
}

// Hides or shows a panel; the focus does not go with it.
function reveal(id, shown) {
  if (!shown && $(id).contains(document.activeElement)) $("canvas").focus();
  $(id).hidden = !shown;
}

// Where the pointer rests, the thing's name is shown.
const HOVER_MS = 300;
let resting = 0;
function hover(event) {
  clearTimeout(resting);
  $("canvas").title = "";
  if (event.buttons || event.pointerType === "touch" || !(instances.guesses.size + instances.names.size)) return;
  resting = setTimeout(async () => {
    const picked = await under(event).catch(() => null);
    if (picked?.instance != null) $("canvas").title = instances.called(picked.instance) ?? "";
  }, HOVER_MS);
}

function results() {
  const answer = state.answer;
  reveal("results", Boolean(answer));
  if (!answer) return;
  const scored = answer.ranking.filter((r) => r.score !== null), values = scored.map((r) => r.score);
  const [low, high] = [Math.min(...values), Math.max(...values)];
  const slider = $("threshold");
  for (const part of ["histogram", "threshold-label"]) $(part).style.display = values.length > 1 ? "" : "none";
  if (values.length) Object.assign(slider, { min: low, max: high, value: state.threshold ?? high });
  $("results-title").textContent = `“${answer.text}”${answer.none ? ": nothing matches" : ""}`;
  const BINS = 25, counts = new Array(BINS).fill(0);
  const bin = (v) => Math.min(BINS - 1, Math.floor((v - low) / (high - low || 1) * BINS));
  values.forEach((v) => counts[bin(v)]++);
  const tallest = Math.max(1, ...counts), limit = state.threshold ?? Infinity;
  $("histogram").innerHTML = counts.map((n, b) => `<rect class="${b >= bin(limit) && limit !== Infinity ? "in" : ""}" x="${b * 4 + 0.3}" y="${24 - 24 * n / tallest}" width="3.4" height="${24 * n / tallest}"/>`).join("");
  $("threshold-value").textContent = state.threshold === null ? "" : state.threshold.toFixed(3);
  fill(answer.ranking.slice(0, 60).map(({ k, score }) => ({ name: instances.name(k), own: [k], beside: score === null ? "name" : score.toFixed(3), title: `Select ${instances.name(k)}` })));
}

// ---- panels ----

function element(tag, attributes = {}, text = "") {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  made.textContent = text;
  return made;
}

function panel() {
  const chosen = selectedInstances();
  reveal("details", state.cells.size > 0);
  if (!state.cells.size) {
    $("said").textContent = "";
    return;
  }
  const whole = wholeInstance(), { levels, thing } = state.levels ?? { levels: [], thing: -1 };
  const { count } = instances.extent(state.cells);
  $("selection-name").textContent = chosen.length > 1 ? `${chosen.length} instances` : whole === null ? `part of ${instances.name(chosen[0])}` : instances.name(whole);
  const box = selectedBox();
  $("facts").textContent = `${count.toLocaleString("en")} Gaussians, ${box.half.map((h) => size(2 * h)).join(" × ")}`;
  $("note").textContent = (whole !== null && instances.notes.get(whole)) || "";
  $("said").textContent = ["selection-name", "facts", "note"].map((id) => $(id).textContent).filter(Boolean).join(". ");
  $("level-label").hidden = levels.length < 2;
  if (levels.length > 1) {
    const at = levels.findIndex((l) => l.cells.length === state.cells.size);
    Object.assign($("level"), { max: levels.length - 1, value: at });
    $("level-name").textContent = at === thing ? "(thing)" : `(${levels[at]?.name})`;
  }
  const views = new Map();
  for (const k of chosen) for (const v of instances.views(k)) if (!(views.get(v[0])?.[3] >= v[3])) views.set(v[0], v);
  const best = [...views.values()].sort((a, b) => b[3] - a[3]).slice(0, 12);
  $("photographs").replaceChildren(...best.map(([view, mask, score]) => {
    const { name } = scene.cameras[view], source = door.preview(view);
    const title = `Stand where ${name} was taken; mask ${mask} fits by ${score.toFixed(2)}`;
    const button = element("button", { type: "button", title }, source ? "" : name);
    if (source) button.append(element("img", { src: source, alt: name, loading: "lazy" }));
    button.addEventListener("click", () => jump(view));
    const item = element("li");
    item.append(button);
    return item;
  }));
  if (!best.length) $("photographs").append(element("li", {}, "no mask of a photograph matches it"));
}

function jump(view) {
  const camera = scene.cameras[view];
  if (!camera) return;
  // The depth of the middle of what this view is about: the selection, or the middle of the scene.
  const at = state.cells.size ? instances.extent(state.cells).center : state.center;
  visitor.jump(camera, Math.max(project(camera, at)[2], 0.05 * scene.spread));
}

// What a person can do: [id, label, key, what it does, whether it can be done, whether it is on].
const ACTIONS = [
  ["isolate", "Isolate", "i", () => setRest("hidden"), () => state.cells.size, () => state.rest === "hidden"],
  ["ghost", "Ghost the rest", "g", () => setRest("ghost"), () => state.cells.size, () => state.rest === "ghost"],
  ["hide", "Hide", "h", () => hide(), () => state.cells.size],
  ["frame", "Look at it", "f", () => frame(), () => state.cells.size],
  ["rename", "Rename", "n", () => rename(), () => wholeInstance() !== null],
  ["annotate", "Note", "o", () => annotate(), () => wholeInstance() !== null],
  ["merge", "Merge", "m", () => merge(), () => selectedInstances().length > 1],
  ["split", "Split", "x", () => split(), () => wholeInstance() !== null && instances.family(wholeInstance()).parts.length > 1],
  // Which Gaussians of the geometry are seen only a server knows.
  ...(door.lasso ? [
    ["add", "Add with a lasso", "l", () => toggle("add"), () => wholeInstance() !== null, () => state.tool === "add"],
    ["remove", "Remove with a lasso", "shift+l", () => toggle("remove"), () => wholeInstance() !== null, () => state.tool === "remove"],
  ] : []),
  ["save-selection", "Save as PLY", "p", () => savePly(false), () => state.cells.size],
  ["save-rest", "Save the rest as PLY", "shift+p", () => savePly(true), () => state.cells.size],
  ["save-json", "Save as JSON", "j", () => saveJson(), () => state.cells.size],
];
const TOOLS = [
  ["undo", "Undo", "ctrl+z", () => change(() => instances.undo()), () => instances.edits.length],
  ["redo", "Redo", "ctrl+y", () => change(() => instances.redo()), () => instances.undone.length],
  ["show-all", "Show all", "escape", () => showAll(), () => true],
  ["inventory", "What is here", "t", () => inventory(), () => true],
  ["measure", "Measure", "u", () => toggle("measure"), () => true, () => state.tool === "measure"],
  ["scale", "Set scale", "k", () => toggle("scale"), () => true, () => state.tool === "scale"],
  ["picture", "Save picture", "c", () => savePicture(), () => true],
  ["save-edits", "Save edits", "ctrl+s", () => saveEdits(), () => instances.edits.length && scene.mode === "file"],
];
const OTHER_KEYS = [
  ["drag", "turn the scene about its middle"], ["right drag, two fingers", "move it"], ["wheel, pinch", "nearer and farther"],
  ["W A S D Q E", "fly; arrows turn"], ["click", "select a thing; with shift, one more or one less"], ["/", "ask in words"],
  ["[ ]", "from thing to part, from thing to group"], [", .", "the photograph before, the next one"], ["1 2 3 4", "colours: photograph, instance, feature, score"], ["?", "this help"],
];

function buttons(place, actions) {
  $(place).replaceChildren(...actions.map(([id, label, key, act]) => {
    const button = element("button", { type: "button", id, title: `${label} (${key})` }, label);
    button.addEventListener("click", () => attempt(act)());
    return button;
  }));
}

function tools() {
  for (const [id, , , , can, on] of [...ACTIONS, ...TOOLS]) {
    $(id).disabled = !can();
    if (on) $(id).setAttribute("aria-pressed", Boolean(on()));
  }
}

const toggle = (tool) => setTool(state.tool === tool ? "select" : tool);

function setRest(rest) {
  state.rest = state.rest === rest ? "shown" : rest;
  return refresh();
}

function hide() {
  state.cells.forEach((c) => state.hidden.add(c));
  return select([]);
}

function showAll() {
  if (state.tool !== "select") return setTool("select");
  state.hidden.clear();
  state.rest = "shown";
  return select([]);
}

function frame() {
  const { center, low, high } = instances.extent(state.cells);
  visitor.frame(center, length(add(high, low, -1)) / 2);
}

function setLevel(at) {
  const level = state.levels?.levels[at];
  if (!level) return;
  state.cells = new Set(level.cells);
  return refresh();
}

// ---- edits ----

// One change after the other: each is made of what the one before left.
let changing = Promise.resolve();
const inTurn = (work) => (...given) => (changing = changing.then(() => work(...given)));

const same = (a, b) => JSON.stringify(a) === JSON.stringify(b);

// Shows these edits, with the cells cut for them; where those are not told, as they are. What was selected or hidden stays so.
function replay(edits, cut, undone) {
  const before = gaussians.cells, whole = wholeInstance();
  if (cut !== undefined && (cut || before !== gaussians.uncut)) {
    instances.setCells(cut);
    // New cells come last: those of the scene keep their numbers.
    const now = (cells) => {
      const still = new Set([...cells].filter((c) => c < scene.cells.length));
      before.forEach((cell, i) => cells.has(cell) && still.add(gaussians.cells[i]));
      return still;
    };
    Object.assign(state, { cells: now(state.cells), hidden: now(state.hidden), clicked: null });
    viewer.setCells();
  }
  instances.setEdits(edits, undone);
  // What a lasso took from it, or gave it, is out or in.
  if (before !== gaussians.cells && whole !== null) state.cells = new Set(instances.cellsOf(whole));
}

// After any change of the edits: what was selected may be no more.
async function settle(list) {
  state.list = list;
  state.levels = null;
  if (state.answer) await find(state.answer.text);
  else if (!$("results").hidden) inventory();
  await refresh();
}

// Changes the edits, and the server keeps them. Where others came in meanwhile, a new edit is put after them; whatever else was
// wanted must be done again.
const change = inTurn(attempt(async (work) => {
  let before = [...instances.edits], list = state.list, said = null;
  work();
  try {
    for (;;) {
      const saved = await door.save(instances.edits), added = instances.edits.at(-1);
      if (!saved.edits) {
        list = saved.instances;
        replay(instances.edits, saved.cut, instances.undone);
        break;
      }
      const one = same(instances.edits.slice(0, -1), before) && same(saved.edits.slice(0, before.length), before);
      before = saved.edits;
      list = saved.instances;
      replay(before, saved.cut);
      said = "The edits were changed elsewhere meanwhile: yours was put after those.";
      const wrong = one ? instances.edit(added) : "The edits were changed elsewhere meanwhile, and are shown as they are now: do yours again.";
      if (wrong) throw new Error(wrong);
    }
  } catch (e) {
    instances.setEdits(before);
    await settle(list);
    throw e;
  }
  await settle(list);
  if (said) say(said);
}));

// Shows the edits that others made, where an answer knew of some.
const catchUp = inTurn(attempt(async () => {
  if (!door.behind) return;
  const { edits, instances: list, cut } = await door.edits();
  if (same(edits, instances.edits)) return;
  replay(edits, cut);
  await settle(list);
  say("The edits were changed elsewhere: they are shown as they are now.");
}));

const edit = (one) => change(() => {
  const wrong = instances.edit(one);
  if (wrong) throw new Error(wrong);
});

async function merge() {
  await edit({ op: "merge", instances: selectedInstances() });
}

async function split() {
  await edit({ op: "split", instance: wholeInstance() });
  say(`Now ${selectedInstances().length} instances.`);
}

// A text without control characters, those that turn it around among them; a name has no dash before it either (gs_io::check_name).
const plain = (text) => text.replace(/[\p{Cc}\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]+/gu, " ").trim();
const plainName = (name) => plain(name).replace(/^[\s-]+/, "");

async function rename() {
  const instance = wholeInstance();
  const name = await ask("What is it?", instances.names.get(instance) ?? "");
  if (name && plainName(name)) await edit({ op: "rename", instance, name: plainName(name) });
}

async function annotate() {
  const instance = wholeInstance();
  const text = await ask("What should people know of it?", instances.notes.get(instance) ?? "");
  if (text !== null && plain(text) !== (instances.notes.get(instance) ?? "")) await edit({ op: "note", instance, text: plain(text) });
}

// Asks for one line; null when the person would rather not.
function ask(label, value) {
  const dialog = $("ask");
  $("ask-label").textContent = label;
  $("ask-value").value = value;
  dialog.returnValue = "";
  dialog.showModal();
  $("ask-value").select();
  return new Promise((done) => dialog.addEventListener("close", () => done(dialog.returnValue === "yes" ? $("ask-value").value : null), { once: true }));
}

// ---- files ----

function save(name, blob) {
  const link = element("a", { href: URL.createObjectURL(blob), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
  say(`Saved ${name}.`);
  page.saved = { name, blob };
}

const fileName = () => selectedInstances().map((k) => instances.name(k)).slice(0, 3).join("-").replace(/[^\p{L}\p{N}]+/gu, "-").replace(/^-|-$/g, "") || "scene";

async function savePly(others) {
  const blob = await door.selection([...state.cells], others);
  if (door.behind) {
    await catchUp();
    throw new Error("The edits were changed elsewhere meanwhile: save again.");
  }
  save(others ? `without-${fileName()}.ply` : `${fileName()}.ply`, blob);
}

function saveJson() {
  const metres = instances.metresPerUnit;
  const things = selectedInstances().map((k) => {
    const cells = instances.cellsOf(k), { count, center, low, high } = instances.extent(cells);
    const views = instances.views(k).map(([view, mask, score]) => ({ view: scene.cameras[view].name, mask, score }));
    return { instance: k, name: instances.names.get(k) ?? null, note: instances.notes.get(k) ?? null, gaussians: count, center, low, high, box: state.list?.[k]?.box ?? scene.instances[k]?.box ?? null, views };
  });
  const all = { scene: scene.name, instances_hash: scene.instances_hash, metres_per_unit: metres, selection: things };
  save(`${fileName()}.json`, new Blob([JSON.stringify(all, null, 1)], { type: "application/json" }));
}

function saveEdits() {
  const edits = { format: "instances.edits", version: 1, instances: scene.instances_hash, edits: instances.edits };
  save("instances.edits.json", new Blob([JSON.stringify(edits, null, 1)], { type: "application/json" }));
}

async function savePicture() {
  const blob = await new Promise((done) => $("canvas").toBlob(done, "image/png"));
  save(`${scene.name}.png`, blob);
}

// ---- start ----

function keys(event) {
  const typing = event.target.closest?.("input:not([type=range]), select, dialog");
  const key = event.key.toLowerCase(), slides = event.target.type === "range" && key.startsWith("arrow");
  if (typing || slides) {
    if (key === "escape" && event.target === $("text")) $("canvas").focus();
    return;
  }
  const name = (event.ctrlKey || event.metaKey ? "ctrl+" : "") + (event.shiftKey && key.length === 1 && /[a-z]/.test(key) ? "shift+" : "") + key;
  const action = [...ACTIONS, ...TOOLS].find((a) => a[2] === name);
  const others = {
    "/": () => $("text").focus(), "?": () => $("help").showModal(),
    "[": () => setLevel(levelNow() - 1), "]": () => setLevel(levelNow() + 1),
    ",": () => jump(((visitor.photograph?.index ?? 0) + scene.cameras.length - 1) % scene.cameras.length),
    ".": () => jump(((visitor.photograph?.index ?? -1) + 1) % scene.cameras.length),
    1: () => setColors("photograph"), 2: () => setColors("instance"), 3: () => setColors("feature"), 4: () => setColors("score"),
  };
  const act = action ? action[4]() && action[3] : others[name];
  if (act) {
    event.preventDefault();
    attempt(act)();
  } else if (["w", "a", "s", "d", "q", "e", "arrowleft", "arrowright", "arrowup", "arrowdown"].includes(name)) {
    event.preventDefault();
    if (!held.size) fly();
    held.add(name);
  }
}

const levelNow = () => state.levels?.levels.findIndex((l) => l.cells.length === state.cells.size) ?? -1;

function fly() {
  let last = performance.now();
  const frame = (now) => {
    if (!held.size) return changed(false);
    visitor.move(held, Math.min(0.1, (now - last) / 1000));
    last = now;
    requestAnimationFrame(frame);
  };
  requestAnimationFrame(frame);
}

function setColors(colors) {
  state.colors = colors;
  $("colors").value = colors;
  if (colors === "feature" && !gaussians.features.length) say("The run has no features.safetensors any more: there are no colours of features.");
  if (colors === "score" && !state.answer) say("Ask for something first: colours of scores are those of an answer.");
  return refresh();
}

// The camera changed: while it moves the picture may be coarse.
function changed(moving) {
  state.moving = moving;
  if (moving) state.path = [];
  clearTimeout(changed.timer);
  if (moving) changed.timer = setTimeout(() => changed(false), 250);
  draw();
}

function about() {
  const { words } = scene, named = words.names?.length ? ` Known words: ${words.names.slice(0, 8).join(", ")}…` : "";
  $("words").textContent = scene.mode === "file" ? "words that were asked when this file was written" : words.source ? `words: ${words.source}` : "no language model: clicking works";
  $("words").title = (words.why ?? "") + named;
  const known = scene.mode === "file" ? Object.keys(door.pictures.texts) : words.names ?? [];
  $("known").replaceChildren(...known.slice(0, 500).map((value) => element("option", { value })));
  if (known.length) $("text").placeholder = `Find: ${known[0]}`;
  $("keys").replaceChildren(...[...OTHER_KEYS, ...[...ACTIONS, ...TOOLS].map(([, label, key]) => [key, label])].map(([key, what]) => {
    const tr = element("tr"), td = element("td");
    td.append(element("kbd", {}, key));
    tr.append(td, element("td", {}, what));
    return tr;
  }));
  const bytes = (scene.bytes / 1e6).toFixed(1), left = scene.of - scene.gaussians;
  $("about").textContent = `${scene.gaussians.toLocaleString("en")} Gaussians in ${bytes} MB (${(scene.bytes / scene.gaussians).toFixed(1)} bytes each)`
    + (left ? `; ${left.toLocaleString("en")} too faint to be seen are left out` : "") + `. ${words.why ?? ""}`;
  $("messages").replaceChildren(...scene.messages.map((m) => element("li", {}, m)));
}

function listen() {
  visitor.listen($("canvas"), click, trace);
  $("canvas").addEventListener("pointermove", hover);
  $("canvas").addEventListener("pointerleave", () => clearTimeout(resting));
  $("search").addEventListener("submit", (e) => {
    e.preventDefault();
    find($("text").value);
  });
  $("text").addEventListener("search", () => $("text").value || clearAnswer());
  $("ranking").addEventListener("keydown", along);
  $("threshold").addEventListener("input", () => {
    state.threshold = Number($("threshold").value);
    const chosen = state.answer.ranking.filter((r) => r.score !== null && r.score >= state.threshold);
    results();
    selectInstances(chosen.map((r) => r.k));
  });
  $("level").addEventListener("input", () => setLevel(Number($("level").value)));
  $("colors").addEventListener("change", () => setColors($("colors").value));
  $("view").addEventListener("change", () => ($("view").value === "" ? visitor.leave() : jump(Number($("view").value))));
  $("blend").addEventListener("input", overlay);
  $("help-button").addEventListener("click", () => $("help").showModal());
  addEventListener("keydown", keys);
  addEventListener("keyup", (e) => held.delete(e.key.toLowerCase()));
  addEventListener("blur", () => held.clear());
  new ResizeObserver(() => draw()).observe($("stage"));
  $("canvas").addEventListener("webglcontextlost", () => say("The browser took the graphics memory back: reload the page.", true));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", background);
}

function background() {
  const rgb = getComputedStyle($("stage")).backgroundColor.match(/[\d.]+/g).slice(0, 3).map((v) => v / 255);
  viewer.background = rgb;
  if (viewer.camera) viewer.draw(viewer.camera);
}

async function start() {
  const begun = performance.now();
  buttons("actions", ACTIONS);
  buttons("tools", TOOLS);
  await door.load((done, total) => {
    $("loading-bar").value = total ? done / total : 1;
    $("loading-text").textContent = `Loading ${(done / 1e6).toFixed(1)} of ${(total / 1e6).toFixed(1)} MB`;
  });
  ({ scene, gaussians } = door);
  if (!gaussians.count) throw new Error("The scene has no Gaussian that can be seen.");
  document.title = $("name").textContent = scene.name ?? "scene";
  scene.cameras.forEach((c, index) => (c.index = index));
  instances = new Instances(scene, gaussians);
  state.list = instances.edits.length ? scene.edited : null;
  state.center = instances.extent(instances.cellsWhere((c) => instances.label[c] >= 0 || instances.cells.length === 1)).center;
  if (!state.center.every(Number.isFinite)) state.center = instances.extent(instances.cellsWhere(() => true)).center;
  viewer = new Viewer($("canvas"), gaussians, (share, milliseconds) => {
    if (milliseconds) state.sharpness = Math.min(1, Math.max(COARSEST, state.sharpness * Math.sqrt(FRAME / Math.max(1, milliseconds))));
    $("status").textContent = share < 1 ? `${Math.round(100 * share)} % of the Gaussians while moving` : `${instances.origin.filter((o) => o.length).length} instances`;
  });
  visitor = new Visitor(scene.cameras, scene.spread, (moving) => started && changed(moving));
  $("view").replaceChildren(element("option", { value: "" }, "my own"), ...scene.cameras.map((c) => element("option", { value: c.index }, c.name)));
  about();
  listen();
  background();
  states();
  if (scene.cameras.length) jump(Math.floor(scene.cameras.length / 2));
  else {
    visitor.rotation = lookingAlong([1, 1, -0.5], visitor.up);
    visitor.frame(state.center, scene.spread);
  }
  // A coarse picture at once, wherever it is drawn; then a sharp one.
  Object.assign(state, { moving: true, sharpness: COARSEST });
  await draw();
  started = true;
  $("loading").hidden = true;
  page.seconds = (performance.now() - begun) / 1000;
  state.moving = false;
  await refresh();
}

// For tests and for people who like to write: everything that a click can do.
const page = { state, errors, row, door, select, selectInstances, find, jump, setColors, setLevel, edit, change, refresh, selectedInstances, pick, seconds: null, saved: null,
  get viewer() { return viewer; }, get instances() { return instances; }, get scene() { return scene; }, get gaussians() { return gaussians; }, get visitor() { return visitor; },
  act: (id) => [...ACTIONS, ...TOOLS].find((a) => a[0] === id)[3]() };
globalThis.explore = page;

start().catch((e) => {
  errors.push(e.message);
  $("loading").hidden = false;
  $("loading-text").textContent = e.message;
  $("loading-bar").hidden = true;
});
