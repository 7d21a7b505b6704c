"""What scripts/poses.py reads: photographs, or the sharpest frames of a video, as upright JPEGs."""
import json
import shutil
import time

import numpy as np
import pillow_heif
from PIL import Image, ImageOps

pillow_heif.register_heif_opener()
PICTURES = {".jpg", ".jpeg", ".png", ".heic", ".heif", ".webp"}
VIDEOS = {".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi"}
# Photographs that a model must have, whatever their share.
FEWEST = 6
FOCAL_35MM, MAKE, MODEL, EXIF_IFD = 0xA405, 0x010F, 0x0110, 0x8769


class Refused(Exception):
    """What a person has to know, in one line."""


class Progress:
    """Lines of progress with rate and time left, at most one in two seconds."""

    def __init__(self, quiet, stream):
        self.quiet, self.stream, self.seconds, self.name = quiet, stream, {}, None

    def begin(self, name, total):
        self.name, self.total, self.start, self.said = name, total, time.monotonic(), time.monotonic()

    def step(self, done):
        now = time.monotonic()
        if not self.quiet and done and now - self.said >= 2:
            rate = done / (now - self.start)
            left = max(self.total - done, 0) / rate
            self.say(f"{self.name} {done} of {self.total}, {rate:.1f} a second, {left:.0f} s left")
            self.said = now

    def end(self):
        self.seconds[self.name] = round(time.monotonic() - self.start, 1)
        self.say(f"{self.name}: {self.seconds[self.name]} s")

    def say(self, text):
        if not self.quiet:
            print(f"poses: {text}", file=self.stream, flush=True)

    def warn(self, text):
        print(f"poses: warning: {text}", file=self.stream, flush=True)


def grey(image):
    """A small grey picture, [height][width], 0 to 1."""
    small = image.convert("L")
    small.thumbnail((640, 640))
    return np.asarray(small, dtype=np.float32) / 255


def sharpness(g):
    """Variance of the Laplacian, by that of the picture: blur lowers it, contrast does not."""
    laplacian = g[1:-1, :-2] + g[1:-1, 2:] + g[:-2, 1:-1] + g[2:, 1:-1] - 4 * g[1:-1, 1:-1]
    return float(laplacian.var() / max(g.var(), 1e-6))


def prepare_photographs(a, folder, progress):
    """Writes upright copies into `folder`; a list of name, source, sharpness, and the key of its camera."""
    files = sorted(p for p in a.photographs.iterdir() if p.suffix.lower() in PICTURES and not p.name.startswith("."))
    if len(files) < FEWEST:
        raise Refused(f"{a.photographs}: {len(files)} photographs (JPEG, PNG, HEIC, WebP) in this folder; {FEWEST} are the fewest, 30 or more are good")
    stems = [p.stem for p in files]
    views = []
    progress.begin("photographs", len(files))
    for done, file in enumerate(files, 1):
        # A name that lists of pairs and of masks can hold.
        stem = file.stem if stems.count(file.stem) == 1 else file.name.replace(".", "_")
        try:
            with Image.open(file) as image:
                image.load()
                exif = image.getexif()
                fine = exif.get_ifd(EXIF_IFD)
                turned = exif.get(0x0112, 1) != 1
                camera = [exif.get(MAKE), exif.get(MODEL), fine.get(FOCAL_35MM)]
                upright = ImageOps.exif_transpose(image)
                as_it_is = image.format == "JPEG" and not turned and max(image.size) <= a.size and image.mode == "RGB"
                name = "_".join(stem.split()) + ".jpg"
                if as_it_is:
                    shutil.copyfile(file, folder / name)
                else:
                    upright = upright.convert("RGB")
                    upright.thumbnail((a.size, a.size), Image.Resampling.LANCZOS)
                    upright.save(folder / name, quality=95, exif=upright.getexif())
                views.append({"name": name, "source": str(file.name), "sharpness": sharpness(grey(upright)),
                              "camera": json.dumps([*upright.size, *map(str, camera)])})
        except (OSError, SyntaxError, ValueError) as e:
            raise Refused(f"{file}: not a readable picture ({e}): copy it again, or take it out") from None
        progress.step(done)
    progress.end()
    if len({v["name"].lower() for v in views}) < len(views):
        raise Refused(f"{a.photographs}: two photographs have the same name but for blanks or capitals: rename them")
    return views


def prepare_video(a, folder, progress):
    """As prepare_photographs, of the sharpest frame of each stretch in which the picture moves by as much."""
    import av

    def frames(container):
        try:
            for frame in container.decode(video=0):
                # Phones say in the stream how it is to be turned.
                yield np.rot90(frame.to_ndarray(format="rgb24"), round((getattr(frame, "rotation", 0) or 0) / 90))
        except av.error.FFmpegError as e:
            raise Refused(f"{a.photographs}: the video cannot be decoded ({e}): copy it again") from None

    try:
        with av.open(str(a.photographs)) as container:
            if not container.streams.video:
                raise Refused(f"{a.photographs}: no video in this file")
            total = container.streams.video[0].frames
            progress.begin("frames looked at", total or 1)
            moved, sharp, last = [], [], None
            for done, pixels in enumerate(frames(container), 1):
                image = Image.fromarray(pixels)
                tiny = np.asarray(image.convert("L").resize((64, 48), Image.Resampling.BOX), dtype=np.float32) / 255
                moved.append(0.0 if last is None else float(np.abs(tiny - last).mean()))
                sharp.append(sharpness(grey(image)))
                last = tiny
                progress.step(done)
        progress.end()
    except av.error.FFmpegError as e:
        raise Refused(f"{a.photographs}: not a readable video ({e})") from None
    if len(moved) < FEWEST:
        raise Refused(f"{a.photographs}: {len(moved)} frames; film for ten seconds or more")
    # A part of the motion counts by time: where nothing moves, frames are taken all the same.
    steps = np.array(moved) + 0.2 * np.mean(moved) + 1e-6
    at = np.cumsum(steps) / steps.sum()
    count = min(a.frames, len(moved))
    chosen = {max(np.flatnonzero((at > i / count - 1e-9) & (at <= (i + 1) / count + 1e-9)), key=lambda f: sharp[f], default=None)
              for i in range(count)} - {None}
    views = []
    progress.begin("frames kept", len(chosen))
    with av.open(str(a.photographs)) as container:
        for index, pixels in enumerate(frames(container)):
            if index in chosen:
                image = Image.fromarray(np.ascontiguousarray(pixels))
                image.thumbnail((a.size, a.size), Image.Resampling.LANCZOS)
                name = f"frame_{index:06}.jpg"
                image.save(folder / name, quality=95)
                views.append({"name": name, "source": f"frame {index}", "sharpness": sharp[index], "camera": "video"})
                progress.step(len(views))
    progress.end()
    progress.say(f"{len(views)} of {len(moved)} frames are taken: the sharpest as the camera moves on")
    return views
