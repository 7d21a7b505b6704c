#!/usr/bin/env python3
"""Fetches a CLIP model as ONNX from the Hugging Face hub, or a mirror of it, into a folder that `--clip` takes. Needs no PyTorch.

    scripts/fetch_clip.py [FOLDER] [--repo Xenova/clip-vit-base-patch16] [--variant fp16] [--hub https://huggingface.co] [--revision main]

The repository must have the hub's usual layout: onnx/vision_model.onnx, onnx/text_model.onnx, preprocessor_config.json,
tokenizer_config.json. --variant fp16 takes vision_model_fp16.onnx and text_model_fp16.onnx, half as large. FOLDER (models/clip) then holds

    image.onnx, text.onnx   the two graphs, and *.onnx_data beside them where the hub keeps their weights apart
    clip.json               size, mean and standard deviation of pictures, most ids of texts
    source.json             repository, revision, and size and SHA-256 of each file

A download that was cut goes on where it was. Files that are there and have the sizes and sums of source.json are not fetched again;
others are never replaced. `make clip` is this with CLIP_REPO, VARIANT and HUB; the default is OpenAI's ViT-B/16 (600 MB, fp16 300 MB).
"""
import argparse
import hashlib
import http.client
import json
import shutil
import subprocess
import sys
import time
import urllib.error
import urllib.parse
import urllib.request
from pathlib import Path

GRAPHS = {"image.onnx": "onnx/vision_model", "text.onnx": "onnx/text_model"}
# Tries of one file. A try that gets something is followed by another however often that happens.
TRIES = 4
ROOT = Path(__file__).resolve().parent.parent


class Refused(Exception):
    """What a person has to know, in one line."""


def address(a, name):
    return f"{a.hub.rstrip('/')}/{a.repo}/resolve/{urllib.parse.quote(a.revision, safe='')}/{name}"


class Promises(urllib.request.HTTPRedirectHandler):
    """Keeps what the hub says of a file before it sends us to where the file lies."""

    def __init__(self):
        self.headers = {}

    def redirect_request(self, req, fp, code, msg, headers, newurl):
        self.headers.update({k.lower(): v for k, v in headers.items()})
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def request(url, start=0):
    """An open answer from byte `start` on, its headers, and whether it begins there."""
    promises = Promises()
    asked = urllib.request.Request(url, headers={"User-Agent": "cags", **({"Range": f"bytes={start}-"} if start else {})})
    try:
        answer = urllib.request.build_opener(promises).open(asked, timeout=60)
    except urllib.error.HTTPError as e:
        if e.code == 416:  # there are no more bytes
            return None, promises.headers, True
        raise
    headers = promises.headers | {k.lower(): v for k, v in answer.headers.items()}
    return answer, headers, answer.status == 206 or start == 0


def exists(url):
    try:
        with urllib.request.urlopen(urllib.request.Request(url, method="HEAD", headers={"User-Agent": "cags"}), timeout=60):
            return True
    except urllib.error.HTTPError as e:
        if e.code in (403, 404):
            return False
        raise Refused(f"{url}: {e.code} {e.reason}: run it again") from None
    except OSError as e:
        raise Refused(f"{url}: {getattr(e, 'reason', e)}: run it again") from None


def sum_of(path):
    digest = hashlib.sha256()
    with open(path, "rb") as f:
        while block := f.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def progress(name, done, total, since, first):
    seconds = max(time.monotonic() - since, 1e-3)
    rate = (done - first) / seconds
    left = f", {(total - done) / rate:.0f} s left" if total and rate > 0 else ""
    of = f" of {total / 1e6:.1f}" if total else ""
    print(f"\r{name}: {done / 1e6:.1f}{of} MB, {rate / 1e6:.1f} MB/s{left}   ", end="", file=sys.stderr, flush=True)


def fetch(url, path, show):
    """Writes what lies at `url` to `path`, from where an earlier try was cut; size and sum are those that the hub promises."""
    tries, total, promised, why = TRIES, None, None, "nothing came"
    size = lambda: path.stat().st_size if path.exists() else 0
    while tries:
        start = size()
        try:
            answer, headers, whole = request(url, start)
            linked = headers.get("x-linked-etag", "").strip('"')
            promised = linked if len(linked) == 64 else promised
            if answer is None:
                total = int(headers.get("x-linked-size", start))
                break
            with answer, open(path, "ab" if whole else "wb") as out:
                first = done = start if whole else 0
                length = headers.get("x-linked-size") or (done + int(headers["content-length"]) if "content-length" in headers else None)
                total = int(length) if length else total
                since = shown = time.monotonic()
                while block := answer.read(1 << 18):
                    out.write(block)
                    done += len(block)
                    if show and time.monotonic() - shown > 0.5:
                        shown = time.monotonic()
                        progress(path.name, done, total, since, first)
            if total is None or done >= total:
                break
            why = f"{done} of {total} bytes came"
        except urllib.error.HTTPError as e:
            why = f"{e.code} {e.reason}"
            if e.code < 500:
                raise Refused(f"{url}: {why}: is the repository spelt so, public, and of the hub's layout?") from None
        except (OSError, http.client.HTTPException) as e:
            why = str(getattr(e, "reason", e))
        # What brought something may be tried for ever.
        tries = TRIES if size() > start else tries - 1
        time.sleep(0.2 if size() > start else 1)
    else:
        raise Refused(f"{url}: {why}; run it again: it goes on where it was")
    found = sum_of(path)
    if (total or size()) != size() or found != (promised or found):
        said = f"found {size()} bytes of SHA-256 {found}, expected {total or size()} of {promised or 'any'}"
        path.unlink()
        raise Refused(f"{url}: not the file that the hub promises: {said}; run it again")
    return {"bytes": size(), "sha256": found}


def text(a, folder, name):
    path = folder / Path(name).name
    path.unlink(missing_ok=True)
    fetch(address(a, name), path, False)
    try:
        return json.loads(path.read_text())
    except ValueError as e:
        raise Refused(f"{address(a, name)}: not JSON: {e}") from None


def configuration(a, pictures, words):
    """clip.json of the hub's preprocessor_config.json and tokenizer_config.json."""
    kind = words.get("tokenizer_class", "CLIPTokenizer")
    if kind.removesuffix("Fast") != "CLIPTokenizer":
        raise Refused(f"{a.repo}: its tokenizer is {kind}, not CLIP's byte pairs: the programs could not feed it")
    if abs(pictures.get("rescale_factor", 1 / 255) - 1 / 255) > 1e-6:
        raise Refused(f"{a.repo}: preprocessor_config.json scales pixels by {pictures['rescale_factor']}, not 1/255")
    size = pictures.get("crop_size" if pictures.get("do_center_crop", True) and "crop_size" in pictures else "size", 224)
    if isinstance(size, dict):
        sides = {size[k] for k in ("shortest_edge", "height", "width") if k in size}
        if len(sides) != 1:
            raise Refused(f"{a.repo}: preprocessor_config.json asks for pictures of {size}, not squares")
        size = sides.pop()
    length = words.get("model_max_length", 77)
    normal = pictures.get("do_normalize", True)
    return {
        "name": a.repo,
        "image_size": size,
        "mean": pictures["image_mean"] if normal else [0.0, 0.0, 0.0],
        "std": pictures["image_std"] if normal else [1.0, 1.0, 1.0],
        "context_length": length if length < 4096 else 77,
    }


def remote_files(a):
    """Where on the hub the files of the folder lie. All are looked for before the first is fetched."""
    ending = f"_{a.variant}" if a.variant else ""
    files = {}
    for name, graph in GRAPHS.items():
        remote = f"{graph}{ending}.onnx"
        if not exists(address(a, remote)):
            raise Refused(f"{address(a, remote)}: 404 Not Found: is the repository spelt so, public, and of the hub's layout?")
        files[name] = remote
        # A graph names the file of its weights, so that keeps its name.
        if exists(address(a, f"{remote}_data")):
            files[f"{Path(remote).name}_data"] = f"{remote}_data"
    return files


def complete(folder, a):
    """Whether the folder holds a model already. One that is damaged, or that somebody else put there, is refused, not replaced."""
    there = [f for f in (*GRAPHS, "clip.json") if (folder / f).exists()]
    source = folder / "source.json"
    if not there and not source.exists():
        return False
    if not source.exists():
        raise Refused(f"{folder}: {', '.join(there)} did not come from here: give another folder, or move them away")
    made = json.loads(source.read_text())
    if (made["repository"], made.get("variant")) != (a.repo, a.variant):
        held = " ".join(filter(None, [made["repository"], made.get("variant")]))
        raise Refused(f"{folder}: holds {held}: give another folder for {a.repo}{f' {a.variant}' if a.variant else ''}, or delete this one")
    for name, file in made["files"].items():
        path = folder / name
        if not path.exists() or path.stat().st_size != file["bytes"] or sum_of(path) != file["sha256"]:
            raise Refused(f"{path}: not the file that was fetched (source.json has its size and SHA-256): delete the folder and run it again")
    return True


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", type=Path, default=Path("models/clip"), help="folder to write [models/clip]")
    parser.add_argument("--repo", default="Xenova/clip-vit-base-patch16", help="repository on the hub [%(default)s]")
    parser.add_argument("--variant", choices=["fp16"], help="weights of 16 bits, half as large [32 bits]")
    parser.add_argument("--hub", default="https://huggingface.co", help="the hub, or a mirror of it [%(default)s]")
    parser.add_argument("--revision", default="main", help="branch, tag or commit [%(default)s]")
    parser.add_argument("--quiet", action="store_true", help="no progress")
    a = parser.parse_args()
    folder = a.folder
    if complete(folder, a):
        print(f"{folder}/: {a.repo} is there")
        return
    # Graphs are whole, and a pair that fits, before they have their names.
    part = folder / "fetched"
    asked, begun = f"{a.repo} {a.variant or 'fp32'} {a.revision} {a.hub}\n", part / "asked"
    if part.exists() and not (begun.exists() and begun.read_text() == asked):
        shutil.rmtree(part)
    part.mkdir(parents=True, exist_ok=True)
    begun.write_text(asked)
    config = configuration(a, text(a, part, "preprocessor_config.json"), text(a, part, "tokenizer_config.json"))
    remotes = remote_files(a)
    files = {name: fetch(address(a, remote), part / name, not a.quiet and sys.stderr.isatty()) for name, remote in remotes.items()}
    (part / "clip.json").write_text(json.dumps(config, indent=2) + "\n")
    files["clip.json"] = {"bytes": (part / "clip.json").stat().st_size, "sha256": sum_of(part / "clip.json")}
    check = ROOT / "target/release/mask-embed"
    if check.exists():
        checked = subprocess.run([check, "check", "--clip", part], stderr=subprocess.PIPE, text=True)
        if checked.returncode:
            raise Refused(checked.stderr.strip().removeprefix("mask-embed: error: "))
    for name in files:
        (part / name).rename(folder / name)
    source = {"repository": a.repo, "variant": a.variant, "revision": a.revision, "hub": a.hub, "files": files}
    (folder / "source.json").write_text(json.dumps(source, indent=2) + "\n")
    shutil.rmtree(part)
    print(f"{folder}/: image.onnx, text.onnx and clip.json of {a.repo}")


if __name__ == "__main__":
    try:
        main()
    except Refused as e:
        print(f"make clip: {e}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)
