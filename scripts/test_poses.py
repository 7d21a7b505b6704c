#!/usr/bin/env python3
"""Tests of scripts/poses.py on a room that is drawn here: floor, walls and a box with random patterns, seen from known poses."""
import json
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import av
import numpy as np
import pillow_heif
import pycolmap
from film import similarity
from PIL import Image

pillow_heif.register_heif_opener()
ROOT = Path(__file__).resolve().parent.parent
WIDTH, HEIGHT, FOCAL = 400, 300, 330.0
# Corner, and the two edges, of each rectangle; z is up.
BOX = [([-0.5, -0.5, 0], [1, 0, 0], [0, 0, 0.8]), ([-0.5, 0.5, 0], [1, 0, 0], [0, 0, 0.8]), ([-0.5, -0.5, 0], [0, 1, 0], [0, 0, 0.8]),
       ([0.5, -0.5, 0], [0, 1, 0], [0, 0, 0.8]), ([-0.5, -0.5, 0.8], [1, 0, 0], [0, 1, 0])]
ROOM = [([-4, -4, 0], [8, 0, 0], [0, 8, 0]), ([-4, 4, 0], [8, 0, 0], [0, 0, 4]), ([-4, -4, 0], [8, 0, 0], [0, 0, 4]),
        ([4, -4, 0], [0, 8, 0], [0, 0, 4]), ([-4, -4, 0], [0, 8, 0], [0, 0, 4])]


def pattern(seed, side):
    """Noise at several sizes: something to find at any distance."""
    noise = np.random.default_rng(seed)
    sums = np.zeros((side, side, 3), np.float32)
    for size in (8, 32, 128):
        part = Image.fromarray(noise.integers(0, 255, (size, size, 3), dtype=np.uint8)).resize((side, side), Image.Resampling.BICUBIC)
        sums += np.asarray(part, np.float32)
    return sums / 3


SURFACES = [(*(np.array(v, float) for v in r), pattern(i, 512)) for i, r in enumerate(BOX + ROOM)]


def look(eye, at):
    """Rotation, camera from world, of a camera at `eye` that looks at `at`; x right, y down."""
    forward = np.subtract(at, eye) / np.linalg.norm(np.subtract(at, eye))
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def picture(eye, rotation):
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    rays = np.stack([x / FOCAL, y / FOCAL, np.ones_like(x)], -1) @ rotation
    nearest, out = np.full(x.shape, np.inf), np.zeros((*x.shape, 3), np.float32)
    for corner, u, v, texture in SURFACES:
        normal = np.cross(u, v)
        along = rays @ normal
        t = ((corner - eye) @ normal) / np.where(np.abs(along) < 1e-9, 1e-9, along)
        at = eye + t[..., None] * rays - corner
        a, b = (at @ u) / (u @ u), (at @ v) / (v @ v)
        seen = (t > 1e-6) & (t < nearest) & (a >= 0) & (a < 1) & (b >= 0) & (b < 1)
        nearest[seen] = t[seen]
        out[seen] = texture[(b[seen] * 512).astype(int), (a[seen] * 512).astype(int)]
    return out.astype(np.uint8)


def walk(count, share=0.4, roll=0.0):
    """Poses on an arc around the box, a little up and down, `roll` degrees off level."""
    c, s = np.cos(np.radians(roll)), np.sin(np.radians(roll))
    turns = np.linspace(0, 2 * np.pi * share, count)
    eyes = [np.array([2.4 * np.cos(t), 2.4 * np.sin(t), 1.3 + 0.2 * np.sin(5 * t)]) for t in turns]
    return [(eye, [[c, -s, 0], [s, c, 0], [0, 0, 1]] @ look(eye, [0, 0, 0.4])) for eye in eyes]


def run(source, out, *more, code=0, settings="pass"):
    """Runs poses.py, with other values of its constants where `settings` gives them."""
    program = f"import sys; sys.path.insert(0, {str(ROOT / 'scripts')!r}); import poses; {settings}; sys.exit(poses.main())"
    done = subprocess.run([sys.executable, "-c", program, source, "--out", out, "--json", *map(str, more)], capture_output=True, text=True)
    assert done.returncode == code, (done.returncode, done.stderr)
    return done


def off(model, truth):
    """Largest differences from the truth after the best similarity: degrees, and share of the extent."""
    found = pycolmap.Reconstruction(model)
    pairs = [(i.projection_center(), i.cam_from_world().rotation.matrix(), *truth[Path(i.name).stem]) for i in found.images.values() if i.has_pose]
    ours, theirs = (np.array([p[k] for p in pairs]) for k in (0, 2))
    scale, turn, shift = similarity(ours, theirs)
    angles = [np.degrees(np.arccos(np.clip((np.trace(r @ turn.T @ t.T) - 1) / 2, -1, 1))) for _, r, _, t in pairs]
    tilt = np.degrees(np.arccos(np.clip(turn[2, 2], -1, 1)))
    away = np.linalg.norm(scale * ours @ turn.T + shift - theirs, axis=1)
    return max(angles), away.max() / np.linalg.norm(theirs - theirs.mean(0), axis=1).max(), tilt


def photographs(folder, poses, name="img_{:02}.jpg"):
    folder.mkdir()
    for i, (eye, rotation) in enumerate(poses):
        Image.fromarray(picture(eye, rotation)).save(folder / name.format(i), quality=97)
    return {name.format(i)[:-4]: pose for i, pose in enumerate(poses)}


def test_photographs(home):
    # Held askew: the floor says where up is.
    truth = photographs(home / "photos", walk(16, roll=6))
    # On their side as phones write them, in every format, and one of something else. HEIC says itself how it is turned.
    exif = Image.Exif()
    exif[0x0112] = 6
    for i, kind in ((3, "jpg"), (4, "png"), (5, "webp"), (6, "heic")):
        upright = Image.open(home / f"photos/img_{i:02}.jpg")
        (home / f"photos/img_{i:02}.jpg").unlink()
        side = {} if kind == "heic" else {"exif": exif}
        (upright.transpose(Image.Transpose.ROTATE_90) if side else upright).save(home / f"photos/img_{i:02}.{kind}", quality=97, **side)
    Image.fromarray(np.full((HEIGHT, WIDTH, 3), 90, np.uint8)).save(home / "photos/wall.jpg")
    said = run(home / "photos", home / "a", "--threads", 1)
    assert "wall.jpg: no pose" in said.stderr, said.stderr
    result = json.loads(said.stdout)
    assert (result["photographs"], result["registered"]) == (17, 16) and result["reprojection_error_pixels"] < 0.8, result
    angle, centre, tilt = off(home / "a/sparse/0", truth)
    assert angle < 0.3 and centre < 0.01 and tilt < 0.5, (angle, centre, tilt)
    assert sorted(p.stem for p in (home / "a/images").iterdir()) == sorted(truth)
    for i in (3, 4, 5, 6):
        read = np.asarray(Image.open(home / f"a/images/img_{i:02}.jpg"), float)
        assert read.shape == (HEIGHT, WIDTH, 3) and np.abs(read - picture(*truth[f"img_{i:02}"])).mean() < 12, i
    # The same bytes for another number of threads, and after a kill while pairs are matched.
    process = subprocess.Popen([sys.executable, ROOT / "scripts/poses.py", home / "photos", "--out", home / "b"], stderr=subprocess.PIPE, text=True)
    while not any((home / "b/.poses").glob("pairs_*.txt")) and process.poll() is None:
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not (home / "b/poses.json").exists()
    assert "goes on with" in run(home / "photos", home / "b", "--threads", 2).stderr
    for file in ("cameras.bin", "images.bin", "points3D.bin"):
        assert (home / "a/sparse/0" / file).read_bytes() == (home / "b/sparse/0" / file).read_bytes(), file


def test_video(home):
    poses = walk(90)
    with av.open(str(home / "walk.mp4"), "w") as container:
        stream = container.add_stream("mpeg4", rate=15, width=WIDTH, height=HEIGHT, bit_rate=8_000_000)
        for i, (eye, rotation) in enumerate(poses):
            pixels = picture(eye, rotation)
            if i % 3 == 1:
                # Every third is blurred, and must not be taken.
                pixels = np.mean([np.roll(pixels, s, 1) for s in range(12)], axis=0).astype(np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        container.mux(stream.encode())
    # Pairs are chosen, as of more photographs than 60.
    run(home / "walk.mp4", home / "v", "--frames", 20, settings="poses.ALL_PAIRS, poses.ALIKE, poses.NEIGHBOURS = 8, 3, 3")
    names = sorted(p.stem for p in (home / "v/images").iterdir())
    assert len(names) >= 18 and all(int(n[6:]) % 3 != 1 for n in names), names
    angle, centre, tilt = off(home / "v/sparse/0", {f"frame_{i:06}": pose for i, pose in enumerate(poses)})
    assert angle < 1 and centre < 0.03 and tilt < 3, (angle, centre, tilt)


def test_refusals(home):
    """Each in one line that says what to do."""
    def refused(source, *words, more=()):
        out = home / f"out_{len(list(home.iterdir()))}"
        lines = [l for l in run(source, out, "--quiet", *more, code=2).stderr.splitlines() if "warning" not in l]
        assert len(lines) == 1 and all(w in lines[0] for w in words), lines
        assert not (out / "poses.json").exists() and not (out / "sparse").exists()
        return out

    refused(home / "nowhere", "no such folder")
    (home / "empty").mkdir()
    refused(home / "empty", "0 photographs")
    eye = np.array([2.4, 0, 1.3])
    photographs(home / "turned", [(eye, look(eye, eye + [-np.cos(t), np.sin(t), -0.1])) for t in np.linspace(-0.5, 0.5, 12)])
    refused(home / "turned", "turned")
    # Two rooms that share nothing, the second one the first in a mirror: neither is the scene.
    photographs(home / "apart", walk(8, 0.2))
    for i, (eye, rotation) in enumerate(walk(7, 0.2)):
        Image.fromarray(picture(eye, rotation)[:, ::-1].copy()).save(home / f"apart/other_{i}.jpg", quality=97)
    sheet = refused(home / "apart", "8 of 15 photographs fit together, 2 groups that do not meet", "walk around slowly")
    assert Image.open(sheet / "registered.jpg").size[0] > 400
    (home / "cut").mkdir()
    for file in (home / "turned").iterdir():
        shutil.copy(file, home / "cut")
    whole = (home / "cut/img_05.jpg").read_bytes()
    (home / "cut/img_05.jpg").write_bytes(whole[: len(whole) // 2])
    refused(home / "cut", "img_05.jpg", "not a readable picture")
    (home / "text.mp4").write_text("no video")
    refused(home / "text.mp4", "text.mp4", "not a readable video")
    (home / "mine").mkdir()
    (home / "mine/letter.txt").write_text("keep me")
    assert "holds files of others" in run(home / "turned", home / "mine", code=2).stderr and (home / "mine/letter.txt").exists()


if __name__ == "__main__":
    for test in (test_photographs, test_video, test_refusals):
        with tempfile.TemporaryDirectory() as home:
            start = time.monotonic()
            test(Path(home))
            print(f"{test.__name__}: ok, {time.monotonic() - start:.0f} s", flush=True)
    print("3 passed, 0 failed")
