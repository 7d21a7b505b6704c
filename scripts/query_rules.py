#!/usr/bin/env python3
"""Rules of queries and of names, each alone against the default, on synthetic scenes in both languages: the tables of docs/results/queries.md.

    scripts/query_rules.py OUT [--bin target/release]

Needs numpy. Makes the scenes in OUT, where they are not yet there, runs the stages, and compares what each rule selects
with the true parts, over every sixth point of the true surface, each of which belongs to its nearest Gaussian of opacity 0.1 or more."""

import argparse
import json
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np

FAMILIES = ["table", "kitchen", "studio"]
SEEDS = {"tuning": [0, 1], "reporting": [10, 11]}
LANGUAGES = ["words", "clip-like"]
SCENE = "--objects 16 --views 24 --width 160 --height 120 --points 3000 --corruption sam --features".split()
TRAIN = "--iterations 600 --max-gaussians 6000".split()
NEGATIVES = ["object", "things", "stuff", "texture"]
UNRELATED = (Path(__file__).parent.parent / "crates/lib/query/src/unrelated.txt").read_text().splitlines()
VIEWS = [1, 2, 4, 8, 0]


def make(folder, family, seed, bin):
    """The scene, its geometry, the masks that describe it by each of VIEWS, and instances, names and scores in each language; what is
    there is kept."""

    def run(program, *arguments):
        subprocess.run([bin / program, *map(str, arguments), "--quiet", "--overwrite"], check=True, stderr=subprocess.DEVNULL)

    scene, shape = folder / "scene", [*SCENE, "--family", family, "--seed", seed]
    at = {name: folder / f"{name}.safetensors" for name in ["footprints", "graph"]}
    geometry = folder / "geometry.ply"
    if not (scene / "label/absent").is_dir():
        run("synth-scene", "--out", scene, *shape)
    if not geometry.exists():
        run("gs-geom", "train", "--scene", scene, "--out", geometry, *TRAIN)
    masks = scene / "language_features"
    if not at["graph"].exists():
        made = ["--footprints", at["footprints"], "--graph", at["graph"]]
        run("graph-precompute", "--scene", scene, "--geometry", geometry, "--masks", masks, *made)
    inputs = ["--scene", scene, "--geometry", geometry, *(v for name, path in at.items() for v in ["--" + name, path])]
    for k in VIEWS:
        draft = folder / f"draft-{k}.safetensors"
        if not draft.exists():
            run("cluster-match", *inputs, "--masks", masks, "--out", folder / "none.safetensors", "--draft", draft, "--describe-views", k)
    words = folder / "words.txt"
    words.write_text("\n".join(sorted(classes(folder) | absent(folder))))
    for language in LANGUAGES:
        own, out = folder / language, folder / f"{language}.safetensors"
        if not (own / "masks.json").exists():
            run("synth-scene", "--masks-to", own, *shape, "--language", language)
        if not out.exists():
            run("cluster-match", *inputs, "--masks", own, "--out", out)
        texts = ["--geometry", geometry, "--instances", out, "--text-features", own / "text_features.json"]
        run("eval", "names", *texts, "--vocabulary", words, "--out", folder / f"{language}.names.json")
        run("eval", "score", *texts, "--scene", scene, "--out", folder / f"{language}.score.json")


def things(folder):
    """What the scene's truth holds."""
    return json.loads((folder / "scene/truth/scene.json").read_text())["objects"]


def classes(folder):
    return {t["class"] for t in things(folder)}


def absent(folder):
    """Classes of the catalogue that the scene does not hold."""
    labels = (folder / "scene/label/absent").glob("*.json")
    return {o["category"] for f in labels for o in json.loads(f.read_text())["objects"]}


def tensors(path):
    """All arrays of a safetensors file, and the names of its views."""
    data = path.read_bytes()
    (size,) = struct.unpack("<Q", data[:8])
    types = {"F32": "<f4", "F64": "<f8", "I32": "<i4", "U32": "<u4"}
    header, body = json.loads(data[8 : 8 + size]), data[8 + size :]
    views = json.loads(header.pop("__metadata__", {}).get("cags", "{}")).get("extra", {}).get("views")
    read = lambda v: np.frombuffer(body[slice(*v["data_offsets"])], types[v["dtype"]]).reshape(v["shape"])
    return {"views": views, **{k: read(v) for k, v in header.items()}}


def gaussians(path):
    """Centres and opacities of a PLY."""
    data = path.read_bytes()
    end = data.index(b"end_header\n") + len("end_header\n")
    lines = data[:end].decode().splitlines()
    fields = [line.split()[2] for line in lines if line.startswith("property")]
    rows = np.frombuffer(data[end:], "<f4").reshape(-1, len(fields))
    column = lambda name: rows[:, fields.index(name)]
    return np.stack([column("x"), column("y"), column("z")], 1), 1 / (1 + np.exp(-column("opacity")))


def nearest_of(points, centres):
    """The nearest centre of each point."""
    points, centres = points.astype(float), centres.astype(float)
    half = (centres**2).sum(1) / 2
    return np.concatenate([(half - p @ centres.T).argmin(1) for p in np.array_split(points, len(points) // 1000 + 1)])


def unit(v):
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    return v / np.where(length > 0, length, 1)


def descriptors(draft, masks, middle):
    """Unit descriptors of granules and of instances by a draft: weighted means of unit features, or their medians where `middle`."""
    rows = [unit(np.load(masks / f"{view}_f.npy")) for view in draft["views"]]
    out = {}
    for name, count in [("instance", len(draft["support"])), ("granule", len(draft["granule_fit"]))]:
        column = lambda field: draft[f"{name}_witness_{field}"]
        features = np.array([rows[v][m] for v, m in zip(column("view"), column("mask"))])
        out[name] = np.zeros((count, features.shape[1]))
        for k in range(count):
            own, weights = features[column("of") == k], column("weight")[column("of") == k]
            if len(own):
                out[name][k] = np.median(own, 0) if middle else weights @ own
    return unit(out["granule"]), unit(out["instance"])


class Asked:
    """What can be asked of a scene, what may answer, and how well each answer would do."""

    def __init__(self, folder, language, views=None, middle=False):
        """With the descriptors of the program, or with those of a draft of so many `views`."""
        i = tensors(folder / (f"{language}.safetensors" if views is None else f"draft-{views}.safetensors"))
        if views is not None:
            i["granule_descriptor"], i["descriptor"] = descriptors(i, folder / language, middle)
        truth = {k: v[::6] for k, v in tensors(folder / "scene/truth/points.safetensors").items() if k != "views"}
        means, opacity = gaussians(folder / "geometry.ply")
        solid = np.flatnonzero(opacity >= 0.1)
        nearest = solid[nearest_of(truth["position"], means[solid])]
        above = dict(zip(i["tree_child"].tolist(), i["tree_parent"].tolist()))

        def members(instance, cluster):
            if instance >= 0:
                return i["label"] == instance
            within = {cluster}
            for child in sorted(above):
                if above[child] in within:
                    within.add(child)
            return np.isin(i["node"], list(within))

        granules = [members(*g) for g in zip(i["granule_instance"].tolist(), i["granule_cluster"].tolist())]
        self.member = np.array([g[nearest] for g in granules], np.float32)
        self.feature, self.fit = unit(i["granule_descriptor"]), i["granule_fit"]
        self.all = unit(np.concatenate([i["descriptor"][i["support"] > 0], i["granule_descriptor"]]))
        self.mean = unit(i["descriptor"][i["support"] > 0]).mean(0)
        table = {k: np.array(v) for k, v in json.loads((folder / language / "text_features.json").read_text()).items()}
        self.unrelated = unit(np.array([table[t] for t in UNRELATED]))
        self.negatives = unit(np.array([table[t] for t in NEGATIVES]))
        all = things(folder)
        parts = lambda chosen, name=None: [p["id"] for t in chosen for p in t["parts"] if name in (None, p["name"])]
        named = {t["name"]: [t] for t in all if not t["background"]}
        self.texts, true = [], []
        for kind in ["one", "parts", "groups", "several", "absent"]:
            place = folder / "scene/label" / ("" if kind == "one" else kind)
            labels = [json.loads(f.read_text())["objects"] for f in sorted(place.glob("*.json"))]
            for text in sorted({o["category"] for objects in labels for o in objects}):
                part, _, whole = text.partition(" of the ")
                pair = text.split(" and ")
                own = {
                    "one": lambda: parts(named[text]),
                    "parts": lambda: parts(named[whole], part),
                    "groups": lambda: parts([t for n in pair for t in named[n]]),
                    "several": lambda: parts([t for t in all if t["class"] == text and not t["background"]]),
                    "absent": list,
                }[kind]()
                self.texts.append((kind, unit(table[text])))
                true.append(np.isin(truth["part"], own))
        self.true = np.array(true, np.float32)

        self.both, self.sizes = self.member @ self.true.T, self.member.sum(1)

    def iou(self, text, chosen):
        """Of the union of granules with what a text means."""
        if len(chosen) == 1:
            both, size = self.both[chosen[0], text], self.sizes[chosen[0]]
        else:
            mask = self.member[chosen].max(0)
            both, size = mask @ self.true[text], mask.sum()
        return both / max(size + self.true[text].sum() - both, 1)


class Rule:
    """How a scene is asked."""

    def __init__(self, a, rule):
        self.a, self.rule = a, rule
        centred = lambda v: unit(v - a.mean) if rule.get("centre") else v
        self.granules, self.all = centred(a.feature), centred(a.all)
        self.chance = np.sort([self.best(u) for u in a.unrelated])[int(np.ceil(rule.get("share", 0.95) * len(a.unrelated))) - 1]

    def scores(self, features, text):
        if self.rule.get("text-centre"):
            text = unit(text - self.a.unrelated.mean(0))
        s = features @ text
        if self.rule.get("negatives"):
            return 1 / (1 + np.exp(10 * ((features @ self.a.negatives.T).max(1) - s)))
        return s

    def best(self, text):
        """What is held beside that of unrelated texts."""
        s = self.scores(self.all, text)
        above = s.max() - s.mean()
        return {"best": s.max(), "above": above, "z": above / s.std()}[self.rule.get("verdict", "above")]

    def answer(self, text):
        """The granules that a text selects, the best first."""
        s = self.scores(self.granules, text)
        scaled = (s - s.mean()) / max(s.max() - s.mean(), 1e-9)
        rank = scaled + self.rule.get("fit", 0.6) * self.a.fit
        chosen = [int(rank.argmax())]
        if several := self.rule.get("several", 0.8):
            mask = self.a.member[chosen[0]]
            for q in np.argsort(-rank, kind="stable"):
                if scaled[q] >= several and self.a.member[q] @ mask <= 0.1 * self.a.sizes[q]:
                    chosen.append(int(q))
                    mask = np.maximum(mask, self.a.member[q])
        return chosen

    def figures(self):
        """Mean IoU by kind, the share believed by kind, and the generalised IoU of none, one and several."""
        found = {}
        for k, (kind, text) in enumerate(self.a.texts):
            matches = self.best(text) > self.chance
            iou = self.a.iou(k, self.answer(text))
            found.setdefault(kind, []).append((iou, matches, float(not matches) if kind == "absent" else iou * matches))
        out = {}
        for kind, rows in found.items():
            out[kind], out["believed " + kind], out["giou " + kind] = np.mean(rows, 0)
        out["giou"] = np.mean([out[f"giou {k}"] for k in ["absent", "one", "several"] if f"giou {k}" in out])
        return out


RULES = {
    "the default": {},
    "the best alone": {"several": 0},
    "several 0.7": {"several": 0.7},
    "several 0.9": {"several": 0.9},
    "fit 0": {"fit": 0.0},
    "fit 0.3": {"fit": 0.3},
    "fit 1": {"fit": 1.0},
    "scene's mean subtracted": {"centre": 1},
    "... and the texts'": {"centre": 1, "text-centre": 1},
    "negatives": {"negatives": 1, "verdict": "best"},
    "nothing: by the best score": {"verdict": "best"},
    "nothing: by deviations": {"verdict": "z"},
    "nothing: 90 of 100": {"share": 0.9},
    "nothing: 98 of 100": {"share": 0.98},
}
COLUMNS = ["one", "parts", "groups", "several", "believed one", "believed parts", "believed absent", "giou"]


def row(name, figures):
    """One line of a table: means over scenes, in points."""
    mean = lambda c: 100 * np.mean([f[c] for f in figures if c in f] or [np.nan])
    print(f"| {name} | {' | '.join(f'{mean(c):.1f}' for c in COLUMNS)} |", flush=True)


def inventory(folder, language):
    """Of the instances: class of the thing that owns most of its surface, the best name of `eval names`, and whether that is sure."""
    i, found = tensors(folder / f"{language}.safetensors"), json.loads((folder / f"{language}.names.json").read_text())
    truth, (means, opacity) = tensors(folder / "scene/truth/points.safetensors"), gaussians(folder / "geometry.ply")
    class_of = {p["id"]: t["class"] for t in things(folder) for p in t["parts"]}
    solid = np.flatnonzero(opacity >= 0.1)
    label = i["label"][solid[nearest_of(truth["position"][::6], means[solid])]]
    part = truth["part"][::6]
    for n in found["named"]:
        own = np.array([class_of[p] for p in part[label == n["instance"]]])
        if len(own):
            names, counts = np.unique(own, return_counts=True)
            yield names[counts.argmax()] == n["names"][0]["name"], n["sure"]


def main():
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("out", type=Path)
    options.add_argument("--bin", type=Path, default=Path("target/release"))
    o = options.parse_args()
    for use, seeds in SEEDS.items():
        folders = [(o.out / f"{family}-{seed}", family, seed) for family in FAMILIES for seed in seeds]
        for folder, family, seed in folders:
            folder.mkdir(parents=True, exist_ok=True)
            make(folder, family, seed, o.bin.resolve())
        for language in LANGUAGES:
            print(f"\n{language}, {use}: {len(folders)} scenes\n\n| | {' | '.join(COLUMNS)} |\n|---|{'---|' * len(COLUMNS)}")
            asked = [Asked(folder, language) for folder, *_ in folders]
            for name, rule in RULES.items():
                row(name, [Rule(a, rule).figures() for a in asked])
            for k in VIEWS:
                for middle in [False, True]:
                    kind = f"{'median' if middle else 'mean'} of {k or 'all'} views"
                    row(kind, [Rule(Asked(folder, language, k, middle), {}).figures() for folder, *_ in folders])
            scores = [json.loads((folder / f"{language}.score.json").read_text()) for folder, *_ in folders]
            pixels = lambda of: f"{100 * np.mean([s['query_miou'] for s in of if s]):.1f}"
            kinds = [("one", scores), ("parts", [s["parts"] for s in scores]), ("groups", [s["groups"] for s in scores])]
            print("pixels by eval score:", ", ".join(f"{kind} {pixels(of)}" for kind, of in kinds))
            named = [n for folder, *_ in folders for n in inventory(folder, language)]
            right = lambda of: f"{sum(r for r, _ in of)} of {len(of)}"
            sure, guess = [n for n in named if n[1]], [n for n in named if not n[1]]
            print(f"names: {right(named)} right, sure {right(sure)}, unsure {right(guess)}")


if __name__ == "__main__":
    sys.exit(main())
