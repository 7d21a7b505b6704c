#!/usr/bin/env python3
"""panoptic_faults.py SCENE MASKS OUT --faults N: id maps with classes, as a panoptic model of some quality would add (needs numpy, scipy).

SCENE has truth/scene.json and truth/views (synth-scene, scan.py), MASKS SAM's id maps of it. Faults as published for such models: soft
borders, small segments missing or taken by a neighbour, neighbours of one class merged, wrong classes. Prints the panoptic quality
that is left (PQ, in percent). Where the model sees nothing, level classes takes SAM's large masks, as mask-embed does.
"""
import argparse
import json
from pathlib import Path

import numpy as np
from scipy import ndimage

# Classes of COCO's panoptic labels that scenes here have: things, counted one by one, and stuff, one segment a class.
THINGS = ("bed chair sofa table desk television laptop book refrigerator toilet sink bottle bowl cup mug knife fork clock vase plant bag ball "
          "oven stove toy").split()
STUFF = {"wall": "wall", "floor": "floor", "ceiling": "ceiling", "door": "door", "window": "window", "curtain": "curtain",
         "blinds": "curtain", "pillow": "pillow", "cabinet": "cabinet", "dresser": "cabinet", "nightstand": "cabinet", "shelf": "shelf",
         "bookshelf": "shelf", "counter": "counter", "towel": "towel", "mirror": "mirror", "lamp": "light", "rug": "rug",
         "box": "cardboard", "paper": "paper"}
# Chance that a segment of 2 % of the picture is missing (smaller ones more), that a class is wrong, that neighbours of a class are merged;
# pixels by which borders waver.
FAULTS = {0: (0, 0, 0, 0), 1: (0.25, 0.1, 0.3, 3), 2: (0.4, 0.15, 0.4, 5), 3: (0.6, 0.2, 0.5, 6), 4: (0.8, 0.3, 0.6, 8)}
LEAST = 100


def class_of(name):
    """A class of THINGS, or of STUFF with whether it is one; None where COCO has none. The last words tell: "stack of books"."""
    words = [w.rstrip("s") if w.rstrip("s") in THINGS else w for w in name.split()]
    thing = next((w for w in reversed(words) if w in THINGS), None)
    return (thing, False) if thing else (STUFF[words[-1]], True) if words[-1] in STUFF else None


def true_segments(view, classes):
    """Class and pixels of each segment that a perfect model would see."""
    found = {}
    for thing in np.unique(view[view >= 0]):
        if kind := classes[thing]:
            key = kind if kind[1] else (*kind, thing)
            found[key] = found.get(key, False) | (view == thing)
    return [(key[0], pixels) for key, pixels in found.items() if pixels.sum() >= LEAST]


def near(pixels, size):
    return ndimage.binary_dilation(pixels, iterations=size)


def seen(truth, shape, faults, rng, classes):
    """What a model with these faults sees: index of the segment for each pixel, -1 for none, and the segments' classes."""
    missing, wrong, merged, soft = faults
    now = [[kind, pixels.copy()] for kind, pixels in truth]
    for i, (kind, pixels) in enumerate(now):
        other = next((o for o in now[:i] if o[1].any() and o[0] == kind and (near(pixels, 4) & o[1]).any()), None)
        if other and rng.random() < merged:
            other[1] |= pixels
            now[i][1] = np.zeros_like(pixels)
    now = [s for s in now if s[1].any()]
    chance = [missing * min(2.5, max(0.35, (0.02 / s[1].mean()) ** 0.35)) for s in now]
    lost = [rng.random() < c for c in chance]
    kept = [s for s, gone in zip(now, lost) if not gone]
    for (_, pixels), gone in zip(now, lost):
        if gone and kept and rng.random() < 0.5:
            shared = [(near(pixels, 5) & other).sum() for _, other in kept]
            if max(shared):
                kept[int(np.argmax(shared))][1] |= pixels
    best, ids = np.zeros(shape), np.full(shape, -1)
    for i, (_, pixels) in enumerate(kept):
        # A signed distance from the border that wavers.
        inside = ndimage.distance_transform_edt(pixels) - ndimage.distance_transform_edt(~pixels)
        grid = rng.normal(size=(shape[0] // 24 + 2, shape[1] // 24 + 2))
        inside = ndimage.uniform_filter(inside, max(1, 2 * soft)) + 1.7 * soft * ndimage.zoom(grid, 24, order=1)[:shape[0], :shape[1]]
        ids[inside > best] = i
        best = np.maximum(best, inside)
    kinds = [str(rng.choice(classes)) if rng.random() < wrong else kind for kind, _ in kept]
    for i in range(len(kept)):
        if (ids == i).sum() < LEAST:
            ids[ids == i] = -1
    return ids, kinds


def quality(truth, ids, kinds, sums):
    """Adds the true positives' IoU, true positives, false positives and false negatives of a view, as panoptic quality counts them."""
    void = ~np.any([pixels for _, pixels in truth], axis=0) if truth else np.ones(ids.shape, bool)
    found = set()
    for i, kind in enumerate(kinds):
        own = ids == i
        if not own.any():
            continue
        ious = [(own & p).sum() / ((own & ~void) | p).sum() if k == kind and j not in found else 0 for j, (k, p) in enumerate(truth)]
        if ious and max(ious) > 0.5:
            found.add(int(np.argmax(ious)))
            sums[0] += max(ious)
            sums[1] += 1
        elif (own & void).sum() <= 0.5 * own.sum():
            sums[2] += 1
    sums[3] += len(truth) - len(found)


def with_classes(sam, ids, kinds):
    """SAM's id maps with level classes, filled by SAM's large masks, and an empty level concepts; the names by mask."""
    height, width = sam.shape[1:]
    rows, columns = (((np.arange(n) + 0.5) * m / n).astype(int) for n, m in zip((height, width), ids.shape))
    ids = ids[rows][:, columns]
    first = int(sam.max()) + 1
    level = np.full((height, width), -1.0)
    names = {}
    for i in np.unique(ids[ids >= 0]):
        level[ids == i] = first + len(names)
        names[first + len(names)] = {"name": kinds[i], "score": 0.8}
    free = (ids < 0) & (sam[3] >= 0)
    _, dense = np.unique(sam[3][free], return_inverse=True)
    level[free] = first + len(names) + dense
    return np.concatenate([sam, [level, np.full_like(level, -1)]]).astype(np.float32), names


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("masks", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--faults", type=int, default=2, choices=FAULTS, help="0 for none, up to 4 [2]")
    parser.add_argument("--seed", type=int, default=0)
    a = parser.parse_args()
    objects = json.loads((a.scene / "truth/scene.json").read_text())["objects"]
    classes = [class_of(o["class"]) for o in objects]
    there = sorted({kind[0] for kind in classes if kind})
    rng, sums = np.random.default_rng(a.seed), [0, 0, 0, 0]
    a.out.mkdir(parents=True, exist_ok=True)
    for file in sorted((a.scene / "truth/views").glob("*.npy")):
        truth = true_segments(np.load(file), classes)
        ids, kinds = seen(truth, np.load(file).shape, FAULTS[a.faults], rng, there)
        quality(truth, ids, kinds, sums)
        maps, names = with_classes(np.load(a.masks / f"{file.stem}_s.npy"), ids, kinds)
        np.save(a.out / f"{file.stem}_s.npy", maps)
        (a.out / f"{file.stem}_s.json").write_text(json.dumps({"facts": {"names": names}}))
    print(f"{100 * sums[0] / max(sums[1] + 0.5 * (sums[2] + sums[3]), 1):.1f}")


if __name__ == "__main__":
    main()
