#!/usr/bin/env python3
"""Where a camera stood: from a folder of photographs, or a video, to a COLMAP dataset that every stage reads.

    scripts/poses.py PHOTOGRAPHS --out FOLDER [--size 1600] [--features 3000] [--frames 120] [--least 0.8] [--seed 0] [--threads 0]

PHOTOGRAPHS is a folder of JPEG, PNG, HEIC or WebP, or one video. FOLDER then holds

    images/         the photographs, upright, at most --size pixels wide or high; of a video its sharpest frames
    sparse/0/       COLMAP's model: cameras, poses and points, z up
    poses.json      what was used, what did not fit and why, errors, seconds, versions; written last
    registered.jpg  a sheet of all photographs, those without a pose crossed out

Structure from motion is pycolmap's (packages of pipelines/poses.txt; `make poses-env`). A run that was cut goes on with the features
and matches that it has. The same seed gives the same bytes for any number of threads, with the same pycolmap on the same kind of processor.
"""
import argparse
import hashlib
import json
import os
import shutil
import signal
import sqlite3
import sys
import threading
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context, parent_process
from pathlib import Path

# Many small products: threads of the library would only wait for each other.
os.environ["OPENBLAS_NUM_THREADS"] = "1"
try:
    import numpy as np
    import pycolmap
    from PIL import Image, ImageDraw

    from capture import FEWEST, PICTURES, VIDEOS, Progress, Refused, prepare_photographs, prepare_video
except ImportError as e:
    sys.exit(f"poses: {e}: make poses-env installs what is missing, and out/poses-env/bin/python runs this")

# Up to so many photographs every pair is matched; of more, those that look alike, and neighbours of a video.
ALL_PAIRS = 60
ALIKE, NEIGHBOURS = 20, 8
# Features of a photograph by which pairs that look alike are found: the largest.
LARGEST = 256
# SIFT's threshold of contrast, and that for plain rooms where the usual finds too little in common: it is slower and less exact.
PEAKS = (0.0067, 0.0015)
# Degrees between the rays of a point, below which a camera has only turned.
TURNED = 2.0
# Degrees that a plane of a floor or table may be off what cameras say is level, and the share of the points that it must have.
LEVEL, LEVEL_SHARE = 10.0, 0.1


def looks_alike(database, views, of_video):
    """Pairs to match: of each photograph those with which most of its largest features agree, and neighbours of a video."""
    ids = {image.name: image.image_id for image in database.read_all_images()}
    largest = []
    for view in views:
        # Columns: x, y, and the 2x2 matrix, row by row, that makes a unit circle of the feature.
        points = np.asarray(database.read_keypoints(ids[view["name"]])).reshape(-1, 6)
        described = np.asarray(database.read_descriptors(ids[view["name"]]).data, dtype=np.float32).reshape(-1, 128)
        rows = described[np.argsort(-np.hypot(points[:, 2], points[:, 4]), kind="stable")[:LARGEST]]
        largest.append(rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-6))
    n = len(views)
    agree = np.zeros((n, n))
    for i in range(n):
        for j in range(i + 1, n):
            if len(largest[i]) < 2 or len(largest[j]) < 2:
                continue
            cosine = largest[i] @ largest[j].T
            there, back = cosine.argmax(1), cosine.argmax(0)
            best = cosine[np.arange(len(there)), there]
            agree[i, j] = agree[j, i] = np.count_nonzero((back[there] == np.arange(len(there))) & (best > 0.85))
    pairs = {(min(i, j), max(i, j)) for i in range(n) for j in np.argsort(-agree[i], kind="stable")[:ALIKE].tolist() if i != j}
    if of_video:
        pairs |= {(i, j) for i in range(n) for j in range(i + 1, min(i + NEIGHBOURS + 1, n))}
    return sorted(pairs)


def features_and_matches(a, work, views, of_video, peak, progress):
    path, images = work / "database.db", work / "images"
    threads = a.threads or os.cpu_count()
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.use_gpu, extraction.num_threads, extraction.max_image_size = False, threads, a.size
    extraction.sift.max_num_features, extraction.sift.peak_threshold = a.features, peak
    # Photographs are upright: a second direction of a feature finds few more pairs and costs a quarter of the matching.
    extraction.sift.max_num_orientations = 1
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "SIMPLE_RADIAL"
    with pycolmap.Database.open(path) as database:
        whole = database.num_images() == len(views)
    if not whole:
        forget(path)
        with pycolmap.Database.open(path):
            pass
        # In this order, whatever thread is done first: the numbers of photographs are the same then. One camera for each kind of photograph.
        for camera in sorted({v["camera"] for v in views}):
            names = [v["name"] for v in views if v["camera"] == camera]
            pycolmap.import_images(path, images, camera_mode=pycolmap.CameraMode.SINGLE, image_names=names, options=reader)
    progress.begin("features", len(views))
    for start in range(0, len(views), 8):
        names = [v["name"] for v in views[start : start + 8]]
        pycolmap.extract_features(path, images, image_names=names, reader_options=reader, extraction_options=extraction,
                                  device=pycolmap.Device.cpu)
        progress.step(start + len(names))
    progress.end()
    n = len(views)
    if n <= ALL_PAIRS:
        pairs = [(i, j) for i in range(n) for j in range(i + 1, n)]
    else:
        with pycolmap.Database.open(path) as database:
            pairs = looks_alike(database, views, of_video)
    match(work, [(views[i]["name"], views[j]["name"]) for i, j in pairs], threads, progress)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = a.seed
    verifier = pycolmap.GeometricVerifierOptions()
    verifier.num_threads = threads
    pycolmap.geometric_verification(path, verifier, pycolmap.ExistingMatchedPairingOptions(), verification)
    progress.end()


def match(work, pairs, threads, progress):
    """Matches of the pairs, by processes of one thread each: threads of pycolmap 4.2 that share an index lose matches now and then."""
    path = work / "database.db"
    for part in work.glob("part_*.db"):
        gather(path, part)
    some = [pairs[start : start + 50] for start in range(0, len(pairs), 50)]
    progress.begin("pairs", len(pairs))
    with ProcessPoolExecutor(min(threads, max(len(some), 1)), get_context("spawn"), begin_part, (work,)) as workers:
        try:
            for done, _ in enumerate(workers.map(match_part, [work] * len(some), some), 1):
                progress.step(min(done * 50, len(pairs)))
        except BaseException:
            workers.shutdown(cancel_futures=True)
            raise
    for part in work.glob("part_*.db"):
        gather(path, part)


def gather(path, part):
    """Moves the matches of a process into the database."""
    with sqlite3.connect(path) as database:
        database.execute("attach ? as part", (str(part),))
        database.execute("insert or ignore into matches select * from part.matches")
    database.close()
    forget(part)


def forget(database):
    """Removes a database with its log: SQLite would read the log into the next one of that name."""
    for file in database.parent.glob(database.name + "*"):
        file.unlink()


def begin_part(work):
    """A process of `match` begins: it takes a copy of the features, and ends with its parent."""
    threading.Thread(target=lambda: (parent_process().join(), os._exit(1)), daemon=True).start()
    # Its name only once it is whole: after a kill all parts are gathered.
    copy = work / f"copy_{os.getpid()}.db"
    forget(copy)
    database = sqlite3.connect(work / "database.db")
    database.execute("vacuum into ?", (str(copy),))
    database.close()
    os.rename(copy, work / f"part_{os.getpid()}.db")


def match_part(work, pairs):
    listed = work / f"pairs_{os.getpid()}.txt"
    listed.write_text("".join(f"{a} {b}\n" for a, b in pairs))
    matching, pairing = pycolmap.FeatureMatchingOptions(), pycolmap.ImportedPairingOptions()
    matching.use_gpu, matching.num_threads, matching.skip_geometric_verification = False, 1, True
    pairing.match_list_path = str(listed)
    pycolmap.match_image_pairs(work / f"part_{os.getpid()}.db", matching_options=matching, pairing_options=pairing, device=pycolmap.Device.cpu)


def largest_model(a, work, views, progress):
    """Poses and points of the photographs that fit together, and how many models there are."""
    options = pycolmap.IncrementalPipelineOptions()
    # On one thread the same matches give the same poses; on more they differ in the last digits, and are hardly sooner there.
    options.num_threads, options.random_seed = 1, a.seed
    options.min_model_size = FEWEST
    progress.begin("poses", len(views))
    models = work / "models"
    shutil.rmtree(models, ignore_errors=True)
    models.mkdir()
    placed = [2]

    def next_image():
        placed[0] += 1
        progress.step(min(placed[0], len(views)))

    found = pycolmap.incremental_mapping(work / "database.db", work / "images", models, options, next_image_callback=next_image)
    progress.end()
    best = max(found.values(), key=lambda m: m.num_reg_images(), default=None)
    return best, len(found)


def level(model, up, seed):
    """The normal of the plane that has most points (at least LEVEL_SHARE) of those that rise at most LEVEL degrees: floor or table."""
    points = np.array([p.xyz for _, p in sorted(model.points3D.items()) if p.track.length() >= 3])
    if len(points) < 100:
        return up
    noise = np.random.default_rng(seed)
    points = points[noise.permutation(len(points))[:4000]]
    near = 0.005 * np.median(np.linalg.norm(points - np.mean([i.projection_center() for i in model.images.values() if i.has_pose], 0), axis=1))
    a, b, c = points[noise.integers(0, len(points), (3, 20000))]
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    flat = np.abs(normals @ up) > np.cos(np.radians(LEVEL))
    best = max(zip(a[flat], normals[flat]), key=lambda p: np.count_nonzero(np.abs((points - p[0]) @ p[1]) < near), default=None)
    if best is None:
        return up
    (at, normal) = best
    for _ in range(5):
        on = points[np.abs((points - at) @ normal) < near]
        at = on.mean(0)
        normal = np.linalg.svd(on - at, full_matrices=False)[2][2]
    normal *= np.sign(normal @ up)
    return normal if len(on) >= LEVEL_SHARE * len(points) and normal @ up > np.cos(np.radians(LEVEL)) else up


def z_up(model, seed):
    """Turns the model so that z is up: photographs are upright, so that the cameras' axes to the right lie level; so does a floor or table."""
    rotations = [image.cam_from_world().rotation.matrix() for image in model.images.values() if image.has_pose]
    right = np.array([r[0] for r in rotations])
    up = np.linalg.eigh(right.T @ right)[1][:, 0]
    up *= np.sign(up @ -sum(r[1] for r in rotations)) or 1.0
    up = level(model, up, seed)
    side = np.cross(up, [1.0, 0, 0] if abs(up[0]) < 0.9 else [0, 1.0, 0])
    side /= np.linalg.norm(side)
    turn = np.stack([side, np.cross(up, side), up])
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(turn), np.zeros(3)))


def between_rays(model):
    """The median over points of the widest angle in degrees between two of its cameras."""
    centres = {i: image.projection_center() for i, image in model.images.items() if image.has_pose}
    widest = []
    for point in list(model.points3D.values())[:: max(1, len(model.points3D) // 2000)]:
        rays = np.array([centres[e.image_id] - point.xyz for e in point.track.elements])
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        widest.append(np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1, 1))))
    return float(np.median(widest)) if widest else 0.0


def only_turned(work, views):
    """Whether one turn about the camera's centre explains nearly every pair: K^-1 H K is a rotation for some focal length."""
    with Image.open(work / "images" / views[0]["name"]) as image:
        width, height = image.size
    with pycolmap.Database.open(work / "database.db") as database:
        geometries = [g for g in database.read_two_view_geometries()[1] if len(g.inlier_matches)]
    planar = [g.H for g in geometries if g.H is not None and np.abs(np.linalg.det(g.H)) > 1e-12]
    if len(planar) < 0.8 * max(len(geometries), 1):
        return False

    def deviation(focal):
        k = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        stretch = [np.linalg.svd(np.linalg.inv(k) @ h @ k, compute_uv=False) for h in planar]
        return np.median([s[0] / s[2] - 1 for s in stretch])

    return min(deviation(f * max(width, height)) for f in np.geomspace(0.4, 4, 60)) < 0.03


def contact_sheet(work, views, registered, path):
    """All photographs, small; a cross over those without a pose."""
    columns = min(8, len(views))
    side = 160
    sheet = Image.new("RGB", (columns * side, -(-len(views) // columns) * (side + 14)), "white")
    draw = ImageDraw.Draw(sheet)
    for i, view in enumerate(views):
        x, y = i % columns * side, i // columns * (side + 14)
        with Image.open(work / "images" / view["name"]) as image:
            image.thumbnail((side - 6, side - 6))
            sheet.paste(image, (x + 3, y + 3))
            width, height = image.size
        if view["name"] not in registered:
            draw.line([(x + 3, y + 3), (x + width, y + height)], fill="red", width=4)
            draw.line([(x + width, y + 3), (x + 3, y + height)], fill="red", width=4)
        draw.text((x + 3, y + side), view["name"][-24:], fill="black")
    sheet.save(path, quality=85)


def why_not(view, views):
    usual = float(np.median([v["sharpness"] for v in views]))
    return "blurred" if view["sharpness"] < 0.4 * usual else "too little in common with the others"


def judge(a, work, views, registered, model, models, sheet):
    """Refuses what is no capture of a scene, with what to do."""
    n, share = len(views), len(registered) / len(views)
    advice = "walk around slowly, let each photograph show two thirds of the one before, in good light"
    seen = f"; which have a pose: {sheet}"
    if model is None:
        blurred = sum(why_not(v, views) == "blurred" for v in views)
        what = f"{blurred} of {n} photographs are blurred" if blurred > n / 3 else "the photographs show too little in common"
        raise Refused(f"no poses found: {what}, or the camera only turned on the spot; {advice}{seen}")
    if only_turned(work, views) or between_rays(model) < TURNED:
        raise Refused(f"the camera only turned on the spot, or what it saw is far away or flat; take steps to the side between photographs{seen}")
    if share < a.least or len(registered) < FEWEST:
        apart = f", {models} groups that do not meet" if models > 1 else ""
        raise Refused(f"{len(registered)} of {n} photographs fit together{apart}: {a.least:.0%} are the fewest (--least); {advice}{seen}")


def key_of(a):
    """What features and matches are made from."""
    files = [a.photographs] if a.photographs.is_file() else sorted(p for p in a.photographs.iterdir() if p.suffix.lower() in PICTURES)
    stats = [[p.name, p.stat().st_size, p.stat().st_mtime_ns] for p in files]
    return json.dumps([str(a.photographs.resolve()), stats, a.size, a.features, a.frames, pycolmap.__version__])


def sha256(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


def run(a, progress):
    of_video = a.photographs.is_file()
    if not a.photographs.exists():
        raise Refused(f"{a.photographs}: no such folder or video")
    if of_video and a.photographs.suffix.lower() not in VIDEOS:
        raise Refused(f"{a.photographs}: not a video ({', '.join(sorted(VIDEOS))}); give the folder of photographs")
    others = a.out.exists() and any(p.name not in {"images", "sparse", "poses.json", "registered.jpg", ".poses"} for p in a.out.iterdir())
    unsigned = (a.out / "images").exists() and not any((a.out / own).exists() for own in ("poses.json", ".poses"))
    if (others or unsigned) and not a.overwrite:
        raise Refused(f"{a.out}: holds files of others: give an empty folder, or --overwrite")
    if hasattr(a, "memory_limit"):
        progress.warn("--memory-limit does not bound pycolmap")
    work = a.out / ".poses"
    key, kept = key_of(a), work / "key.json"
    if not kept.exists() or kept.read_text() != key:
        shutil.rmtree(work, ignore_errors=True)
        (work / "images").mkdir(parents=True)
        views = (prepare_video if of_video else prepare_photographs)(a, work / "images", progress)
        (work / "views.json").write_text(json.dumps(views))
        kept.write_text(key)
    else:
        views = json.loads((work / "views.json").read_text())
        progress.say("goes on with the photographs, features and matches of the run before")
    pycolmap.set_random_seed(a.seed)
    fainter = work / "fainter"
    for peak in PEAKS[fainter.exists() :]:
        features_and_matches(a, work, views, of_video, peak, progress)
        model, models = largest_model(a, work, views, progress)
        registered = {image.name for image in model.images.values() if image.has_pose} if model else set()
        if len(registered) >= max(a.least * len(views), FEWEST) or fainter.exists():
            break
        progress.say(f"{len(registered)} of {len(views)} photographs fit together: once more, with fainter features")
        forget(work / "database.db")
        fainter.touch()
    sheet = a.out / "registered.jpg"
    contact_sheet(work, views, registered, sheet)
    judge(a, work, views, registered, model, models, sheet)
    missing = [{"name": v["source"], "why": why_not(v, views)} for v in views if v["name"] not in registered]
    for m in missing[:10]:
        progress.warn(f"{m['name']}: no pose: {m['why']}")
    if len(missing) > 10:
        progress.warn(f"and {len(missing) - 10} more: {a.out / 'poses.json'}")
    z_up(model, a.seed)
    result = work / "result"
    shutil.rmtree(result, ignore_errors=True)
    (result / "images").mkdir(parents=True)
    (result / "sparse/0").mkdir(parents=True)
    model.write(str(result / "sparse/0"))
    for name in sorted(registered):
        shutil.copyfile(work / "images" / name, result / "images" / name)
    error = model.compute_mean_reprojection_error()
    said = {
        "photographs": len(views), "registered": len(registered), "missing": missing, "points": model.num_points3D(),
        "reprojection_error_pixels": round(error, 3), "degrees_between_rays": round(between_rays(model), 1),
        "cameras": [{"model": c.model.name, "size": [c.width, c.height], "parameters": [float(p) for p in c.params]}
                    for _, c in sorted(model.cameras.items())],
        "seconds": progress.seconds, "settings": {k: str(v) for k, v in sorted(vars(a).items()) if k not in ("quiet", "json")},
        "pycolmap": pycolmap.__version__,
        "images": {name: sha256(result / "images" / name) for name in sorted(registered)},
    }
    # poses.json says that the dataset is whole: it goes first and comes last.
    (a.out / "poses.json").unlink(missing_ok=True)
    for part in ("images", "sparse"):
        shutil.rmtree(a.out / part, ignore_errors=True)
        os.rename(result / part, a.out / part)
    (work / "poses.json").write_text(json.dumps(said, indent=1) + "\n")
    os.rename(work / "poses.json", a.out / "poses.json")
    shutil.rmtree(work)
    progress.say(f"{len(registered)} of {len(views)} photographs have a pose, {model.num_points3D()} points, {error:.2f} pixels off")
    if a.json:
        print(json.dumps({k: said[k] for k in ("photographs", "registered", "points", "reprojection_error_pixels", "seconds")}))


def main():
    p = argparse.ArgumentParser(prog="poses", description=__doc__.split("\n")[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    p.add_argument("photographs", type=Path, help="folder of photographs (JPEG, PNG, HEIC, WebP), or a video")
    p.add_argument("--out", type=Path, required=True, help="folder of the dataset to write")
    p.add_argument("--size", type=int, default=1600, help="longer side of the photographs that are kept and searched, pixels")
    p.add_argument("--features", type=int, default=3000, help="most features of a photograph")
    p.add_argument("--frames", type=int, default=120, help="most frames of a video")
    p.add_argument("--least", type=float, default=0.8, help="share of the photographs that must fit together")
    p.add_argument("--seed", type=int, default=0, help="of all random choices")
    p.add_argument("--threads", type=int, default=0, help="threads; 0 for one per core")
    p.add_argument("--quiet", action="store_true", help="warnings and errors only")
    p.add_argument("--json", action="store_true", help="print the result as JSON")
    p.add_argument("--overwrite", action="store_true", help="replace files of others in the folder")
    p.add_argument("--memory-limit", default=argparse.SUPPRESS, help=argparse.SUPPRESS)
    a = p.parse_args()
    # COLMAP's own lines go to a file.
    stream = os.fdopen(os.dup(2), "w")
    progress = Progress(a.quiet, stream)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(130))
    try:
        a.out.mkdir(parents=True, exist_ok=True)
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        run(a, progress)
    except Refused as e:
        print(f"poses: error: {e}", file=stream, flush=True)
        return 2
    except OSError as e:
        print(f"poses: error: {e.filename or a.out}: {e.strerror or e}", file=stream, flush=True)
        return 2
    except KeyboardInterrupt:
        print("poses: interrupted; the same command goes on", file=stream, flush=True)
        return 130
    except Exception as e:
        # pycolmap's own, mostly; a traceback would go where its lines go.
        print(f"poses: error: {type(e).__name__}: {' '.join(str(e).split())}; pycolmap {pycolmap.__version__}", file=stream, flush=True)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
