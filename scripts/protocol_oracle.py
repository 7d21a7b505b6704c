#!/usr/bin/env python3
"""Scores by the protocols of docs/protocols.md, written from their specification and not from the programs.

    pip install "numpy<2" opencv-python-headless==4.10.0.84
    python scripts/protocol_oracle.py lerf LABELS PREDICTIONS [--averaging frames] [--truth pictures]
    python scripts/protocol_oracle.py pictures LABELS            (writes LABELS/gt/<frame>/<category>.jpg)
    python scripts/protocol_oracle.py scannet GEOMETRY INSTANCES TEXTS SCAN [--association nearest]

Prints JSON. The tests of crates/stages/eval run it where this Python and these packages are, and expect equality to 1e-6.
Of OpenCV, 4.8 to 4.10: other versions fill some border pixels differently.
"""

import argparse
import glob
import json
import os

import cv2
import numpy as np


def load_labels(folder):
    for path in sorted(glob.glob(os.path.join(folder, "*.json"))):
        with open(path) as f:
            data = json.load(f)
        yield os.path.splitext(os.path.basename(path))[0], data


def rasterise(data):
    shape = (data["info"]["height"], data["info"]["width"])
    masks = {}
    for o in data["objects"]:
        one = np.zeros(shape, np.uint8)
        if o["segmentation"]:
            cv2.fillPoly(one, [np.array(o["segmentation"]).astype(np.int32)], 1)
        masks[o["category"]] = masks.get(o["category"], np.zeros(shape, bool)) | (one > 0)
    return masks


def lerf(args):
    pairs = []
    for frame, data in load_labels(args.labels):
        if args.truth == "polygons":
            truth = rasterise(data)
        else:
            truth = {
                os.path.splitext(os.path.basename(p))[0]: cv2.imread(p, cv2.IMREAD_GRAYSCALE) > 10
                for p in sorted(glob.glob(os.path.join(args.labels, "gt", frame, "*.jpg")))
            }
        for category in sorted(truth):
            stem = os.path.join(args.predictions, f"{frame}_{category}")
            iou = 0.0
            if os.path.exists(stem + ".png"):
                p = cv2.imread(stem + ".png", cv2.IMREAD_GRAYSCALE) > 10
                union = np.sum(p | truth[category])
                iou = np.sum(p & truth[category]) / union if union else 0.0
            pairs.append({"frame": frame, "category": category, "iou": float(iou)})
    groups = [pairs]
    if args.averaging == "frames":
        groups = [[p for p in pairs if p["frame"] == f] for f in sorted({p["frame"] for p in pairs})]

    def mean(score):
        return float(np.mean([np.mean([score(p) for p in g]) for g in groups]))

    return {
        "miou": mean(lambda p: p["iou"]),
        "macc25": mean(lambda p: p["iou"] > 0.25),
        "macc50": mean(lambda p: p["iou"] > 0.5),
        "pairs": pairs,
    }


def pictures(args):
    for frame, data in load_labels(args.labels):
        os.makedirs(os.path.join(args.labels, "gt", frame), exist_ok=True)
        for category, mask in rasterise(data).items():
            cv2.imwrite(os.path.join(args.labels, "gt", frame, category + ".jpg"), mask.astype(np.uint8) * 255)
    return {}


def read_ply(path):
    """The vertices of a binary little-endian PLY as a record array."""
    types = {"float": "<f4", "uchar": "u1", "ushort": "<u2", "int": "<i4"}
    with open(path, "rb") as f:
        fields, count, element = [], 0, None
        for line in iter(f.readline, b"end_header\n"):
            words = line.decode().split()
            if words[0] == "element":
                element = words[1]
                count = int(words[2]) if element == "vertex" else count
            elif words[0] == "property" and element == "vertex":
                fields.append((words[2], types[words[1]]))
        dtype = np.dtype(fields)
        return np.frombuffer(f.read(dtype.itemsize * count), dtype)


def read_safetensors(path):
    types = {"F32": np.float32, "I32": np.int32, "U32": np.uint32, "U64": np.uint64}
    with open(path, "rb") as f:
        size = int.from_bytes(f.read(8), "little")
        header = json.loads(f.read(size))
        body = f.read()
    return {
        k: np.frombuffer(body[v["data_offsets"][0] : v["data_offsets"][1]], types[v["dtype"]]).reshape(v["shape"])
        for k, v in header.items()
        if k != "__metadata__"
    }


NAMES = {
    1: "wall", 2: "floor", 3: "cabinet", 4: "bed", 5: "chair", 6: "sofa", 7: "table", 8: "door", 9: "window",
    10: "bookshelf", 11: "picture", 12: "counter", 14: "desk", 16: "curtain", 24: "refrigerator",
    28: "showercurtain", 33: "toilet", 34: "sink", 36: "bathtub",
}  # fmt: skip
SETS = {
    19: sorted(NAMES),
    15: [i for i in sorted(NAMES) if i not in (11, 24, 28, 36)],
    10: [1, 2, 4, 5, 6, 7, 8, 9, 10, 33],
}


def average_precision(truth, predicted, confidence, least, threshold):
    def groups(labels):
        return {int(i): labels == i for i in np.unique(labels) if i >= 0 and np.sum(labels == i) >= least}

    gts, preds = groups(truth), groups(predicted)
    if not gts:
        return None
    iou = {(t, p): np.sum(g & m) / np.sum(g | m) for t, g in gts.items() for p, m in preds.items()}
    outcomes, first, missed = [], set(), 0
    for t in sorted(gts):
        mine = [p for p in sorted(preds) if iou[t, p] > threshold and p not in first]
        if not mine:
            missed += 1
            continue
        first.add(mine[0])
        scores = [float(confidence[p]) for p in mine]
        scores.remove(max(scores))
        outcomes += [(max(float(confidence[p]) for p in mine), 1)] + [(s, 0) for s in scores]
    counted = np.isin(truth, list(gts))
    for p, m in preds.items():
        if not any(iou[t, p] > threshold for t in gts) and np.mean(~counted[m]) <= threshold:
            outcomes.append((float(confidence[p]), 0))
    hits = sum(h for _, h in outcomes)
    curve = []
    for cut in sorted({s for s, _ in outcomes}):
        shown = [h for s, h in outcomes if s >= cut]
        curve.append((sum(shown) / len(shown), sum(shown) / (hits + missed)))
    curve.append((1.0, 0.0))
    recall = [curve[0][1]] + [r for _, r in curve] + [0.0]
    steps = np.convolve(recall, [-0.5, 0, 0.5], "valid")
    return float(np.dot([p for p, _ in curve], steps))


def scannet(args):
    g, inst = read_ply(args.geometry), read_safetensors(args.instances)
    with open(args.texts) as f:
        texts = json.load(f)
    [labels_path] = glob.glob(os.path.join(args.scan, "*.labels.ply"))
    v = read_ply(labels_path)
    xyz = np.stack([v["x"], v["y"], v["z"]], 1).astype(np.float64)
    means = np.stack([g["x"], g["y"], g["z"]], 1).astype(np.float64)
    opacity = 1 / (1 + np.exp(-g["opacity"].astype(np.float64)))
    speaks = opacity >= 0.1
    gaussian, counts = np.arange(len(v)), np.ones(len(v), bool)
    if args.association == "one-to-one":
        counts = speaks
    else:
        ids = np.nonzero(speaks)[0]
        gaussian = np.array([ids[np.argmin(np.sum((means[ids] - p) ** 2, 1))] for p in xyz])
    label, descriptor = inst["label"], inst["descriptor"].astype(np.float64)
    norms = np.linalg.norm(descriptor, axis=1)
    described = (norms > 0) & (inst["support"] >= 2)
    out = {"sets": {}}
    for size, ids in SETS.items():
        t = np.array([texts[NAMES[i]] for i in ids], np.float64)
        t /= np.linalg.norm(t, axis=1, keepdims=True)
        similarity = np.where(described[:, None], (descriptor / np.where(norms > 0, norms, 1)[:, None]) @ t.T, 0.0)
        known = described[np.maximum(label, 0)] & (label >= 0)
        cls = np.where(known, np.argmax(similarity, 1)[np.maximum(label, 0)], 0)
        truth = np.array([ids.index(int(i)) if int(i) in ids else -1 for i in v["label"]])
        predicted, keep = cls[gaussian], (truth >= 0) & counts
        ious, recalls = [], []
        for c in range(size):
            is_c, said_c = keep & (truth == c), keep & (predicted == c)
            if is_c.any():
                both = np.sum(is_c & said_c)
                ious.append(both / np.sum(is_c | said_c))
                recalls.append(both / np.sum(is_c))
        out["sets"][str(size)] = {
            "miou": float(np.mean(ious)) if ious else None,
            "macc": float(np.mean(recalls)) if recalls else None,
        }
    [segs] = glob.glob(os.path.join(args.scan, "*.0.010000.segs.json"))
    [aggregation] = glob.glob(os.path.join(args.scan, "*.aggregation.json"))
    with open(segs) as f:
        segments = json.load(f)["segIndices"]
    with open(aggregation) as f:
        owner = {s: o["objectId"] for o in json.load(f)["segGroups"] for s in o["segments"]}
    truth = np.where(counts, np.array([owner.get(s, -1) for s in segments]), -1)
    predicted = label[gaussian]
    valid = truth >= 0
    best = []
    for t in np.unique(truth[valid]):
        is_t = truth == t
        others = [valid & (predicted == p) for p in np.unique(predicted[valid & (predicted >= 0)])]
        best.append(max([np.sum(is_t & o) / np.sum(is_t | o) for o in others], default=0.0))
    out["instances"] = {
        "miou": float(np.mean(best)),
        "acc25": float(np.mean(np.array(best) > 0.25)),
        "acc50": float(np.mean(np.array(best) > 0.5)),
        "ap25": average_precision(truth, predicted, inst["score"], 100, 0.25),
        "ap50": average_precision(truth, predicted, inst["score"], 100, 0.5),
    }
    return out


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    c = commands.add_parser("lerf")
    c.add_argument("labels")
    c.add_argument("predictions")
    c.add_argument("--averaging", default="objects", choices=["objects", "frames"])
    c.add_argument("--truth", default="polygons", choices=["polygons", "pictures"])
    c.set_defaults(run=lerf)
    c = commands.add_parser("pictures")
    c.add_argument("labels")
    c.set_defaults(run=pictures)
    c = commands.add_parser("scannet")
    for name in ["geometry", "instances", "texts", "scan"]:
        c.add_argument(name)
    c.add_argument("--association", default="one-to-one", choices=["one-to-one", "nearest"])
    c.set_defaults(run=scannet)
    args = parser.parse_args()
    print(json.dumps(args.run(args)))


if __name__ == "__main__":
    main()
