#!/usr/bin/env python3
"""scan.py PREFIX OUT: photographs and the truth of a scanned room of coloured vertices (needs numpy, scipy, safetensors, blake3, pillow).

PREFIX_vert.npy: x y z in metres, z up, red green blue 0 to 255; PREFIX_ins_label.npy: instance, 0 for none; PREFIX_sem_label.npy: class
of NYU40. VoteNet's prepared ScanNet has such files. Each vertex becomes a flat Gaussian; gs-geom views renders OUT (--views, BIN).
"""
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
from blake3 import blake3
from PIL import Image
from safetensors.numpy import save
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

BIN = Path(os.environ.get("BIN", "target/release"))
# NYU40's classes, from 0.
CLASSES = ("none,wall,floor,cabinet,bed,chair,sofa,table,door,window,bookshelf,picture,counter,blinds,desk,shelf,curtain,dresser,pillow,mirror,"
           "rug,clothes,ceiling,books,refrigerator,television,paper,towel,shower curtain,box,whiteboard,person,nightstand,toilet,sink,lamp,"
           "bathtub,bag,structure,furniture,thing").split(",")
BACKGROUND = ("wall", "floor", "ceiling")
SH0 = 0.28209479177387814


def discs(vertices):
    """Flat Gaussians at coloured vertices, as columns of a 3DGS PLY."""
    places, colours = vertices[:, :3].astype(np.float64), vertices[:, 3:] / 255
    distance, near = cKDTree(places).query(places, 13, workers=-1)
    spacing = np.minimum(distance[:, 3:7].mean(1), 3 * np.median(distance[:, 3:7]))
    around = places[near] - places[near].mean(1, keepdims=True)
    _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    turns = np.roll(Rotation.from_matrix(axes).as_quat(), 1, axis=1)  # w first
    # The first axis is the normal.
    scales = np.log(np.stack([0.05 * spacing, 0.8 * spacing, 0.8 * spacing], 1))
    opacity = np.full((len(places), 1), np.log(0.99 / 0.01))
    return np.concatenate([places, (colours - 0.5) / SH0, opacity, scales, turns], 1)


def write_ply(path, gaussians):
    names = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(gaussians)}\n"
    head += "".join(f"property float {n}\n" for n in names) + "end_header\n"
    path.write_bytes(head.encode() + gaussians.astype("<f4").tobytes())


def write_things(out, gaussians, thing, work):
    """Writes OUT/truth/views: the thing of each pixel, -1 for none. Each thing is rendered in a colour of its own; mixed ones are none."""
    count = thing.max() + 2
    steps = int(np.ceil(count ** (1 / 3)))
    palette = np.stack(np.meshgrid(*[np.linspace(0, 1, steps)] * 3), -1).reshape(-1, 3)[:count]
    coloured = gaussians.copy()
    coloured[:, 3:6] = (palette[thing + 1] - 0.5) / SH0
    write_ply(work, coloured)
    render = ["render", "--views", "all", "--scene", out, "--geometry", work, "--out", f"{work}.views", "--overwrite", "--quiet"]
    subprocess.run([BIN / "gs-geom", *render], check=True)
    (out / "truth/views").mkdir(exist_ok=True)
    for picture in sorted(Path(f"{work}.views").rglob("*.png")):
        colours = np.asarray(Image.open(picture).convert("RGB")) / 255
        distance, nearest = cKDTree(palette).query(colours, workers=-1)
        things = np.where(distance < 0.3 / max(steps - 1, 1), nearest - 1, -1)
        np.save(out / f"truth/views/{picture.stem}.npy", things.astype(np.int32))


def main():
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    prefix, out, more = sys.argv[1], Path(sys.argv[2]), sys.argv[3:]
    vertices, instance, classes = (np.load(f"{prefix}_{what}.npy") for what in ("vert", "ins_label", "sem_label"))
    gaussians = discs(vertices)
    out.parent.mkdir(parents=True, exist_ok=True)
    write_ply(Path(f"{out}.discs.ply"), gaussians)
    views = ["views", "--geometry", f"{out}.discs.ply", "--out", out, "--up", "0,0,1", "--look", "inside-out", *more]
    subprocess.run([BIN / "gs-geom", *views], check=True)
    # Things are numbered anew: those without vertices go.
    ids, thing = np.unique(instance, return_inverse=True)
    thing = thing.astype(np.int32) - int(ids[0] == 0)
    objects = []
    for i, of in enumerate(ids[ids > 0]):
        kind = CLASSES[np.bincount(classes[instance == of]).argmax()]
        objects.append({"id": i, "name": f"{kind} {of}", "class": kind, "color": "", "background": kind in BACKGROUND, "parts": []})
    (out / "truth").mkdir(exist_ok=True)
    (out / "truth/scene.json").write_text(json.dumps({"objects": objects, "parameters": {"scan": Path(prefix).name}}))
    write_things(out, gaussians, thing, Path(f"{out}.things.ply"))
    none = np.full(len(thing), -1, np.int32)
    tensors = {"position": np.ascontiguousarray(vertices[:, :3], np.float32), "instance": thing, "part": none, "class": none}
    # An artifact's checksum is that of the file with zeros in its place: docs/artifacts.md.
    about = {"checksum": "0" * 64, "format": "truth-points", "version": 1, "program": "scan.py", "parameters": {}, "inputs": {}, "extra": {}}
    file = save(tensors, {"cags": json.dumps(about, separators=(",", ":"))})
    (out / "truth/points.safetensors").write_bytes(file.replace(b"0" * 64, blake3(file).hexdigest().encode(), 1))


if __name__ == "__main__":
    main()
