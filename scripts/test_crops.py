#!/usr/bin/env python3
"""The pixels that CLIP is shown beside those of LangSplat's and open_clip's preprocessing.

    scripts/test_crops.py [--measure]    (--measure prints the differences)

Needs PyPI numpy, pillow and opencv-python-headless; without them it says SKIPPED. The photographs are one made here and, where
../shared/data/desk is, those of testdata/desk with their masks drawn by hand.
"""
import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

try:
    import cv2
    import numpy as np
    from PIL import Image, ImageDraw
except ImportError as missing:
    print(f"SKIPPED: crops beside LangSplat's and open_clip's: {missing} (pip install numpy pillow opencv-python-headless; PYTHON names another python3)")
    sys.exit(0)

ROOT = Path(__file__).resolve().parent.parent
DESK, LABELS = ROOT / "../shared/data/desk", ROOT / "testdata/desk"
MASK_EMBED = Path(os.environ.get("BIN", ROOT / "target/release")) / "mask-embed"
SIZE = 224
# OpenAI's constants, which open_clip and LangSplat use.
MEAN, STD = np.array([0.48145466, 0.4578275, 0.40821073]), np.array([0.26862954, 0.26130258, 0.27577711])
CROPS = ["black", "mean", "box10", "box20"]


def run(*args):
    done = subprocess.run([MASK_EMBED, *map(str, args)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def read_safetensors(path):
    data = path.read_bytes()
    length = int.from_bytes(data[:8], "little")
    header = json.loads(data[8:8 + length])
    kinds = {"U8": np.uint8, "U32": np.uint32}
    read = {}
    for name, of in header.items():
        if name == "__metadata__":
            (provenance,) = of.values()
            read["views"] = json.loads(provenance)["extra"]["views"]
        else:
            start, end = (8 + length + o for o in of["data_offsets"])
            read[name] = np.frombuffer(data[start:end], kinds[of["dtype"]]).reshape(of["shape"])
    return read


def synthetic(folder):
    """A photograph of waves, edges and grain, and a label picture of round, long, large, small and cut-off masks."""
    width, height = 640, 480
    y, x = np.mgrid[:height, :width]
    waves = [np.sin(x / 9 + y / 31), np.sin(x / 23 - y / 7), np.sin((x + y) / 13)]
    photo = np.stack([90 + 60 * w + 40 * ((x // 37 + y // 23) % 2) for w in waves], 2) + [50, 0, -30]
    photo = photo + np.random.default_rng(0).normal(0, 6, photo.shape)
    Image.fromarray(photo.clip(0, 255).astype(np.uint8)).save(folder / "v0.png")
    frame = {"file_path": "v0.png", "transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]}
    (folder / "transforms.json").write_text(json.dumps({"camera_angle_x": 0.9, "w": width, "h": height, "frames": [frame]}))
    labels = Image.new("L", (width, height))
    draw = ImageDraw.Draw(labels)
    for i, box in enumerate([(40, 30, 420, 340), (90, 80, 180, 150), (450, 60, 520, 130), (430, 200, 630, 214), (30, 360, 47, 470),
                             (590, 400, 639, 479), (200, 380, 410, 460), (0, 0, 30, 300), (560, 20, 583, 41)]):
        draw.ellipse(box, fill=i + 1)
    return {"v0": (folder / "v0.png", labels)}


def desk():
    """Photograph and label picture of each view that testdata/desk has polygons of."""
    views = {}
    for path in sorted(LABELS.glob("*.json")):
        of = json.loads(path.read_text())
        labels = Image.new("L", (of["info"]["width"], of["info"]["height"]))
        draw = ImageDraw.Draw(labels)
        # Large things first: the mouse lies on its pad.
        things = sorted(of["objects"], key=lambda o: -(o["bbox"][2] - o["bbox"][0]) * (o["bbox"][3] - o["bbox"][1]))
        for i, thing in enumerate(things):
            draw.polygon([tuple(p) for p in thing["segmentation"]], fill=i + 1)
        views[path.stem] = (DESK / "images" / of["info"]["name"], labels)
    return views


def square(photo, mask, crop, last=1):
    """The picture of a mask before it is resized, by numpy alone; without `last` the box lacks its last row and column, as LangSplat's."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    y0, y1, x0, x1 = rows[0], rows[-1] + last, columns[0], columns[-1] + last
    fill = np.zeros(3) if crop == "black" else np.floor(photo.reshape(-1, 3).mean(0) + 0.5)
    if crop.startswith("box"):
        dy, dx = (int(np.floor(n * int(crop[3:]) / 100 + 0.5)) for n in (y1 - y0, x1 - x0))
        y0, x0, y1, x1 = max(y0 - dy, 0), max(x0 - dx, 0), min(y1 + dy, photo.shape[0]), min(x1 + dx, photo.shape[1])
        cut = photo[y0:y1, x0:x1]
    else:
        cut = np.where(mask[:, :, None], photo, fill.astype(np.uint8))[y0:y1, x0:x1]
    h, w = cut.shape[:2]
    side = max(h, w)
    out = np.empty((side, side, 3), np.uint8)
    out[:] = fill
    out[(side - h) // 2:(side - h) // 2 + h, (side - w) // 2:(side - w) // 2 + w] = cut
    return out


def opencv(picture):
    """As LangSplat resizes."""
    return cv2.resize(picture, (SIZE, SIZE), interpolation=cv2.INTER_LINEAR)


def pillow(picture, how):
    """As torchvision, and so open_clip, resizes; its CenterCrop takes all of a square."""
    return np.asarray(Image.fromarray(picture).resize((SIZE, SIZE), how))


def half_a_pixel(picture):
    """What linear interpolation gives that takes the centre of a pixel for its corner."""
    at = (np.arange(SIZE, dtype=np.float32) * picture.shape[0] / SIZE).astype(np.float32)
    return cv2.remap(picture, *np.meshgrid(at, at), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


class Differences:
    """Absolute differences of pixels, by what is compared and whether the crops are grown or shrunk to the model's size."""

    def __init__(self):
        self.of = {}

    def add(self, what, kind, ours, theirs):
        self.of.setdefault((what, kind), []).append(np.abs(ours.astype(int) - theirs).ravel())

    def figures(self, what, kind):
        d = np.concatenate(self.of[what, kind])
        return d.mean(), np.percentile(d, 99), d.max()

    def table(self):
        lines = ["| beside | crops | pictures | mean | 99 of 100 | most |", "|---|---|---|---|---|---|"]
        for what, kind in sorted(self.of):
            mean, nearly_all, most = self.figures(what, kind)
            lines.append(f"| {what} | {kind} | {len(self.of[what, kind])} | {mean:.2f} | {nearly_all:.0f} | {most} |")
        return "\n".join(lines)


def compare(name, scene, views, work, shrink):
    """All crops of a scene beside the same by numpy, OpenCV and Pillow. The id maps are `shrink` times smaller than the photographs."""
    folder = work / f"{name}-{shrink}"
    labels, masks, out = folder / "labels", folder / "masks", folder / "crops.safetensors"
    labels.mkdir(parents=True)
    for stem, (_, picture) in views.items():
        picture.resize((picture.width // shrink, picture.height // shrink), Image.NEAREST).save(labels / f"{stem}.png")
    run("import", "--labels", labels, "--out", masks)
    found = Differences()
    read = {v: (np.asarray(Image.open(photo).convert("RGB")), np.load(masks / f"{v}_s.npy")[0]) for v, (photo, _) in views.items()}
    for crop in CROPS:
        run("crops", "--scene", scene, "--masks", masks, "--out", out, "--overwrite", "--size", SIZE, "--resolution", 1, "--crop", crop)
        crops = read_safetensors(out)
        for pixels, view, mask_id in zip(crops["pixels"], crops["view"], crops["mask"]):
            photo, ids = read[crops["views"][view]]
            # The other levels hold the same masks again.
            if not (ids == mask_id).any():
                continue
            at = [((2 * np.arange(n) + 1) * m) // (2 * n) for n, m in zip(photo.shape, ids.shape)]
            mask = (ids == mask_id)[np.ix_(*at)]
            ours, whole = pixels.transpose(1, 2, 0), square(photo, mask, crop)
            kind = "grown" if whole.shape[0] <= SIZE else "shrunk"
            linear = pillow(whole, Image.BILINEAR)
            found.add("the same by Pillow", kind, ours, linear)
            found.add("open_clip", kind, ours, pillow(whole, Image.BICUBIC))
            if crop == "black":
                found.add("LangSplat with the whole box", kind, ours, opencv(whole))
                found.add("LangSplat", kind, ours, opencv(square(photo, mask, crop, 0)))
            # What must not pass for the same.
            found.add("half a pixel off", kind, ours, half_a_pixel(whole))
            found.add("blue for red", kind, ours, linear[:, :, ::-1])
    return found


# Largest mean and largest 99th percentile of the differences, of 255. The first two are the same rule, but for rounding; shrunk,
# OpenCV leaves pixels out; open_clip's curve is another; LangSplat's box lacks a row and a column.
BOUNDS = {
    ("the same by Pillow", "grown"): (0.2, 1), ("the same by Pillow", "shrunk"): (0.2, 1),
    ("LangSplat with the whole box", "grown"): (0.2, 1), ("LangSplat with the whole box", "shrunk"): (1.5, 16),
    ("open_clip", "grown"): (1, 8), ("open_clip", "shrunk"): (1, 8),
    ("LangSplat", "grown"): (6, 96), ("LangSplat", "shrunk"): (3, 40),
}
WRONG = ["half a pixel off", "blue for red"]


def check(name, found, measure):
    if measure:
        print(f"\n{name}\n\n{found.table()}")
    for (what, kind), bounds in BOUNDS.items():
        mean, nearly_all, _ = found.figures(what, kind)
        assert mean <= bounds[0] and nearly_all <= bounds[1], f"{name}: {what}, {kind}: off by {mean}, {nearly_all}; expected at most {bounds}"
    for kind in ("grown", "shrunk"):
        for what in WRONG:
            mean, nearly_all, _ = found.figures(what, kind)
            assert mean > 1 and nearly_all > 8, f"{name}: {what}, {kind}, would not be noticed: {mean}, {nearly_all}"


def normalised(work, scene, views):
    """What the model reads: a graph that gives the mean of each channel, and 1, with the constants that stand where no clip.json is."""
    clip, masks, out = work / "clip", work / "synthetic-1/masks", work / "features"
    clip.mkdir()
    shutil.copy(ROOT / "crates/lib/onnx-models/testdata/clip/image.onnx", clip)
    run("embed", "--scene", scene, "--masks", masks, "--clip", clip, "--out", out, "--resolution", 1)
    run("crops", "--scene", scene, "--masks", masks, "--out", work / "8.safetensors", "--size", 8, "--resolution", 1)
    crops, features = read_safetensors(work / "8.safetensors"), np.load(out / "v0_f.npy")
    for pixels, mask_id in zip(crops["pixels"], crops["mask"]):
        expected = np.append(((pixels / 255).mean((1, 2)) - MEAN) / STD, 1)
        error = np.abs(features[mask_id] - expected / np.linalg.norm(expected)).max()
        assert error < 1e-5, f"mask {mask_id}: the model reads other numbers than open_clip's, by {error}"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--measure", action="store_true", help="print the differences")
    measure = parser.parse_args().measure
    with tempfile.TemporaryDirectory() as work:
        work = Path(work)
        scene = work / "scene"
        scene.mkdir()
        views = synthetic(scene)
        for shrink in (1, 2):
            check(f"synthetic, maps 1/{shrink}", compare("synthetic", scene, views, work, shrink), measure)
        normalised(work, scene, views)
        if DESK.exists():
            check("the desk", compare("desk", DESK, desk(), work, 1), measure)
        else:
            print("SKIPPED: crops of real photographs: no ../shared/data/desk")
    print("ok: what CLIP is shown is what LangSplat and open_clip would show it, but for what docs/masks.md says")


if __name__ == "__main__":
    main()
