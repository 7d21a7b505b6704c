#!/usr/bin/env python3
"""Rules of queries, each alone against the default, on synthetic scenes in both languages: the tables of docs/results/queries.md.

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


def make(folder, family, seed, bin):
    """The scene, its geometry, and its instances in each language; what is there is kept."""

    def run(program, *arguments):
        subprocess.run([bin / program, *map(str, arguments), "--quiet", "--overwrite"], check=True, stderr=subprocess.DEVNULL)

    scene, shape = folder / "scene", [*SCENE, "--family", family, "--seed", seed]
    at = {name: folder / f"{name}.safetensors" for name in ["footprints", "graph", "features"]}
    geometry = folder / "geometry.ply"
    if not (scene / "label/absent").is_dir():
        run("synth-scene", "--out", scene, *shape)
    if not geometry.exists():
        run("gs-geom", "train", "--scene", scene, "--out", geometry, *TRAIN)
    masks = scene / "language_features"
    if not at["features"].exists():
        made = ["--footprints", at["footprints"], "--graph", at["graph"]]
        run("graph-precompute", "--scene", scene, "--geometry", geometry, "--masks", masks, *made)
        run("feat-train", "--geometry", geometry, *made, "--out", at["features"])
    for language in LANGUAGES:
        own = folder / language
        if not (own / "masks.json").exists():
            run("synth-scene", "--masks-to", own, *shape, "--language", language)
        out = folder / f"{language}.safetensors"
        if not out.exists():
            inputs = [v for name, path in at.items() for v in ["--" + name, path]]
            run("cluster-match", "--scene", scene, "--geometry", geometry, *inputs, "--masks", own, "--out", out)


def tensors(path):
    """All arrays of a safetensors file."""
    data = path.read_bytes()
    (size,) = struct.unpack("<Q", data[:8])
    types = {"F32": "<f4", "I32": "<i4", "U32": "<u4"}
    body = data[8 + size :]
    read = lambda v: np.frombuffer(body[slice(*v["data_offsets"])], types[v["dtype"]]).reshape(v["shape"])
    return {k: read(v) for k, v in json.loads(data[8 : 8 + size]).items() if k != "__metadata__"}


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


class Asked:
    """What can be asked of a scene, what may answer, and how well each answer would do."""

    def __init__(self, folder, language, instances=None):
        i = tensors(instances or folder / f"{language}.safetensors")
        truth = {k: v[::6] for k, v in tensors(folder / "scene/truth/points.safetensors").items()}
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
        things = [t for t in json.loads((folder / "scene/truth/scene.json").read_text())["objects"]]
        parts = lambda chosen, name=None: [p["id"] for t in chosen for p in t["parts"] if name in (None, p["name"])]
        named = {t["name"]: [t] for t in things if not t["background"]}
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
                    "several": lambda: parts([t for t in things if t["class"] == text and not t["background"]]),
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
        return {"best": s.max(), "above": above, "z": above / s.std()}[self.rule.get("verdict", "best")]

    def answer(self, text):
        """The granules that a text selects, the best first."""
        s = self.scores(self.granules, text)
        scaled = (s - s.mean()) / max(s.max() - s.mean(), 1e-9)
        rank = scaled + self.rule.get("fit", 0.6) * self.a.fit
        chosen = [int(rank.argmax())]
        if self.rule.get("several"):
            mask = self.a.member[chosen[0]]
            for q in np.argsort(-rank, kind="stable"):
                if scaled[q] >= self.rule["several"] and self.a.member[q] @ mask <= 0.1 * self.a.sizes[q]:
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
    "the best alone": {},
    "scene's mean subtracted": {"centre": 1},
    "... and the texts'": {"centre": 1, "text-centre": 1},
    "negatives": {"negatives": 1},
    "fit 0": {"fit": 0.0},
    "fit 0.3": {"fit": 0.3},
    "fit 1": {"fit": 1.0},
    "fit 1.5": {"fit": 1.5},
    "centred, fit 0.3": {"centre": 1, "fit": 0.3},
    "centred, fit 1": {"centre": 1, "fit": 1.0},
    "nothing: 90 of 100": {"share": 0.9},
    "nothing: 98 of 100": {"share": 0.98},
    "nothing: above the mean": {"verdict": "above"},
    "nothing: z": {"verdict": "z"},
    "centred, 90 of 100": {"centre": 1, "share": 0.9},
    "centred, 98 of 100": {"centre": 1, "share": 0.98},
    "centred, z": {"centre": 1, "verdict": "z"},
    "several 0.7": {"several": 0.7},
    "several 0.8": {"several": 0.8},
    "several 0.85": {"several": 0.85},
    "several 0.9": {"several": 0.9},
    "centred, several 0.8": {"centre": 1, "several": 0.8},
    "centred, several 0.9": {"centre": 1, "several": 0.9},
}
COLUMNS = ["one", "parts", "groups", "several", "believed one", "believed parts", "believed several", "believed absent", "giou"]


def main():
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("out", type=Path)
    options.add_argument("--bin", type=Path, default=Path("target/release"))
    o = options.parse_args()
    for language in LANGUAGES:
        for use, seeds in SEEDS.items():
            asked = []
            for family in FAMILIES:
                for seed in seeds:
                    folder = o.out / f"{family}-{seed}"
                    folder.mkdir(parents=True, exist_ok=True)
                    make(folder, family, seed, o.bin.resolve())
                    asked.append(Asked(folder, language))
            print(f"\n{language}, {use}: {len(asked)} scenes\n\n| | {' | '.join(COLUMNS)} |\n|---|{'---|' * len(COLUMNS)}")
            for name, rule in RULES.items():
                all = [Rule(a, rule).figures() for a in asked]
                mean = lambda c: 100 * np.mean([f[c] for f in all if c in f] or [np.nan])
                print(f"| {name} | {' | '.join(f'{mean(c):.1f}' for c in COLUMNS)} |", flush=True)


if __name__ == "__main__":
    sys.exit(main())
