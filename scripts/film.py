#!/usr/bin/env python3
"""A scene of synth-scene as a hand would film it, and its truth for the poses that are found: how well scripts/poses.py does.

    scripts/film.py film SCENE OUT           # OUT.mp4: a video; a folder: JPEGs. Blur along the camera's shake, exposure that drifts
    scripts/film.py sheet SCENE OUT.jpg      # a good walk through it and three bad ones: docs/images/capture.jpg
    scripts/film.py compare SCENE POSES      # poses found beside the true ones, after the best similarity, as JSON; and where SCENE
                                             # has a truth, POSES/found, moved to it, and POSES/exact: the same frames with either poses

SCENE may be any COLMAP dataset for `compare`, or a transforms.json. It runs with out/poses-env/bin/python.
"""
import argparse
import json
import shutil
from pathlib import Path

import av
import numpy as np
import pycolmap
from PIL import Image, ImageDraw

# Standard deviation of the blur's length in pixels of a photograph 800 wide, and of the exposure in stops.
BLUR, STOPS = 2.5, 0.35


def drift(rng, count, width, dim):
    """Smooth noise of standard deviation 1, [count][dim], over about `width` frames."""
    steps = rng.standard_normal((count + 6 * width, dim))
    kernel = np.exp(-0.5 * (np.arange(-3 * width, 3 * width + 1) / width) ** 2)
    kernel /= np.sqrt((kernel**2).sum())
    return np.stack([np.convolve(steps[:, d], kernel, "valid")[:count] for d in range(dim)], 1)


def shaken(pixels, move, gain):
    """The mean of a picture moved along `move` (x, y in pixels) while the shutter is open, in linear light, times `gain`; uint8."""
    linear = (pixels / 255.0) ** 2.2
    samples = max(1, int(np.ceil(np.hypot(*move))) + 1)
    shifts = [tuple(np.round(move * t).astype(int)) for t in np.linspace(-0.5, 0.5, samples)]
    reach = max(abs(int(s)) for xy in shifts for s in xy)
    padded = np.pad(linear, ((reach, reach), (reach, reach), (0, 0)), mode="edge")
    height, width = pixels.shape[:2]
    mean = sum(padded[reach + y : reach + y + height, reach + x : reach + x + width] for x, y in shifts) / len(shifts)
    return (255 * np.clip(mean * gain, 0, 1) ** (1 / 2.2) + 0.5).astype(np.uint8)


def film(scene, out, seed):
    files = sorted((scene / "images").iterdir())
    rng = np.random.default_rng(seed)
    width, height = Image.open(files[0]).size
    moves, gains = drift(rng, len(files), 2, 2) * BLUR * width / 800, 2.0 ** (STOPS * drift(rng, len(files), 15, 1)[:, 0])
    frames = (shaken(np.asarray(Image.open(f).convert("RGB")), m, g) for f, m, g in zip(files, moves, gains))
    if out.suffix != ".mp4":
        out.mkdir(parents=True)
        for file, pixels in zip(files, frames):
            Image.fromarray(pixels).save(out / f"{file.stem}.jpg", quality=93)
        return
    with av.open(str(out), "w") as container:
        stream = container.add_stream("mpeg4", rate=15, width=width, height=height, bit_rate=12_000_000)
        for pixels in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        container.mux(stream.encode())


def turned(image, degrees):
    """The middle of a picture as a camera sees it that was turned to the side on the spot; a field of view of 66 degrees."""
    width, height = image.size
    focal, t = width / 2 / np.tan(0.575), np.radians(degrees)
    k = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    turn = np.array([[np.cos(t), 0, np.sin(t)], [0, 1, 0], [-np.sin(t), 0, np.cos(t)]])
    h = k @ turn @ np.linalg.inv(k)
    h /= h[2, 2]
    seen = image.transform(image.size, Image.Transform.PERSPECTIVE, h.ravel()[:8].tolist(), Image.Resampling.BILINEAR)
    return seen.crop((width // 4, height // 4, 3 * width // 4, 3 * height // 4))


def sheet(scene, out):
    files = sorted((scene / "images").iterdir())
    pictures = [Image.open(f).convert("RGB") for f in files[: len(files) * 2 // 3]]
    n = len(pictures)
    good = pictures[:6]
    rows = {
        "good: a step to the side each time, most of the picture seen twice": good,
        "bad: the camera turns on the spot": [turned(pictures[0], a) for a in np.linspace(-12, 12, 6)],
        "bad: too far apart": [pictures[i * n // 6] for i in range(6)],
        "bad: blurred": [Image.fromarray(shaken(np.asarray(p), np.array([0.05, 0.02]) * p.width, 1.0)) for p in good],
    }
    width, height, text = 180, 135, 18
    whole = Image.new("RGB", (6 * width, len(rows) * (height + text)), "white")
    draw = ImageDraw.Draw(whole)
    for y, (title, row) in enumerate(rows.items()):
        draw.text((4, y * (height + text) + 3), title, fill="black")
        for x, picture in enumerate(row):
            whole.paste(picture.resize((width - 4, height - 4), Image.Resampling.LANCZOS), (x * width, y * (height + text) + text))
    whole.save(out, quality=72, optimize=True)


def true_poses(scene):
    """Centre and rotation (camera from world) by stem, in the photographs' order; and the COLMAP model, where there is one."""
    if (scene / "transforms.json").exists():
        poses = {}
        for frame in json.loads((scene / "transforms.json").read_text())["frames"]:
            m = np.array(frame["transform_matrix"])
            m = m / m[3, 3]
            axes = m[:3, :3] / np.linalg.norm(m[:3, 0])
            poses[Path(frame["file_path"]).stem] = (m[:3, 3], (axes * [1, -1, -1]).T)
        return dict(sorted(poses.items())), None
    model = pycolmap.Reconstruction(scene / "sparse/0")
    images = sorted(model.images.values(), key=lambda i: i.name)
    return {Path(i.name).stem: (i.projection_center(), i.cam_from_world().rotation.matrix()) for i in images}, model


def similarity(ours, theirs):
    """Scale, rotation and shift that take points `ours` to `theirs`, [n][3], by least squares."""
    a, b = ours - ours.mean(0), theirs - theirs.mean(0)
    left, sizes, right = np.linalg.svd(b.T @ a)
    sign = np.array([1, 1, np.sign(np.linalg.det(left @ right))])
    turn = left * sign @ right
    scale = (sizes * sign).sum() / (a**2).sum()
    return scale, turn, theirs.mean(0) - scale * turn @ ours.mean(0)


def compare(scene, poses):
    truth, model = true_poses(scene)
    stems = list(truth)
    found = {i.name: i for i in pycolmap.Reconstruction(poses / "sparse/0").images.values() if i.has_pose}
    # Frames of a video have their number in the name.
    true_stem = {n: stems[int(Path(n).stem[6:])] if n.startswith("frame_") and Path(n).stem not in truth else Path(n).stem for n in found}
    ours = np.array([i.projection_center() for i in found.values()])
    theirs = np.array([truth[true_stem[n]][0] for n in found])
    scale, turn, shift = similarity(ours, theirs)
    degrees = [np.degrees(np.arccos(np.clip((np.trace(i.cam_from_world().rotation.matrix() @ turn.T @ truth[true_stem[n]][1].T) - 1) / 2, -1, 1)))
               for n, i in found.items()]
    away = np.linalg.norm(scale * ours @ turn.T + shift - theirs, axis=1)
    extent = np.linalg.norm(theirs - theirs.mean(0), axis=1).max()
    said = {"cameras": len(found), "degrees_median": np.median(degrees), "degrees_most": max(degrees), "extent_median": np.median(away) / extent,
            "extent_most": away.max() / extent, "scale": scale, "z_off_degrees": np.degrees(np.arccos(np.clip(turn[2, 2], -1, 1)))}
    print(json.dumps({k: round(float(v), 5) for k, v in said.items()}))
    if not (scene / "truth/points.safetensors").exists():
        return
    by_stem = {Path(i.name).stem: i for i in model.images.values()}
    name_of = {by_stem[s].image_id: n for n, s in true_stem.items()}
    for image in list(model.images.values()):
        if image.image_id in name_of:
            image.name = name_of[image.image_id]
        else:
            model.deregister_frame(image.frame_id)
    ours_moved = pycolmap.Reconstruction(poses / "sparse/0")
    ours_moved.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d(turn), shift))
    for name, which in (("found", ours_moved), ("exact", model)):
        folder = poses / name
        shutil.rmtree(folder, ignore_errors=True)
        (folder / "sparse/0").mkdir(parents=True)
        shutil.copytree(scene / "truth", folder / "truth")
        shutil.copytree(poses / "images", folder / "images")
        which.write(str(folder / "sparse/0"))


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("what", choices=["film", "sheet", "compare"])
    p.add_argument("scene", type=Path, help="folder of synth-scene, or of a dataset with true poses")
    p.add_argument("other", type=Path, help="film and sheet: what to write; compare: the folder that poses.py wrote")
    p.add_argument("--seed", type=int, default=0, help="of blur and exposure [0]")
    a = p.parse_args()
    {"film": lambda: film(a.scene, a.other, a.seed), "sheet": lambda: sheet(a.scene, a.other), "compare": lambda: compare(a.scene, a.other)}[a.what]()


if __name__ == "__main__":
    main()
