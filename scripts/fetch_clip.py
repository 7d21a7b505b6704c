#!/usr/bin/env python3
"""Fetches a CLIP model as ONNX from the Hugging Face hub, or a mirror of it, into a folder that `--clip` takes. Needs no PyTorch.

    scripts/fetch_clip.py [FOLDER] [--repo Xenova/clip-vit-base-patch16] [--variant fp16] [--hub https://huggingface.co] [--revision main]

The repository must have the hub's usual layout: onnx/vision_model.onnx, onnx/text_model.onnx, preprocessor_config.json,
tokenizer_config.json. --variant fp16 takes vision_model_fp16.onnx and text_model_fp16.onnx, half as large. FOLDER (models/clip) then holds

    image.onnx, text.onnx   the two graphs, and *.onnx_data beside them where the hub keeps their weights apart
    clip.json               size, mean and standard deviation of pictures, most ids of texts
    source.json             repository, revision, and size and SHA-256 of each file

The hub's own client does the work, in out/hub (needs PyPI once). A download that was cut goes on where it was. Files that are there and
have the sizes and sums of source.json are not fetched again; others are never replaced. A hub that sends more than it lists, or next to
nothing, is left. `make clip` is this with CLIP_REPO, VARIANT and HUB; the default is OpenAI's ViT-B/16 (600 MB, fp16 300 MB).
"""
import argparse
import errno
import hashlib
import json
import multiprocessing
import os
import resource
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
HOME = ROOT / "out/hub"
# Later versions begin a killed download anew.
CLIENT = "huggingface_hub==0.36.*"
GRAPHS = {"image.onnx": "onnx/vision_model", "text.onnx": "onnx/text_model"}
CONFIGS = ("preprocessor_config.json", "tokenizer_config.json")
# Most bytes of a model (the largest CLIPs have 10 GB), of a description, and of the client's memory.
MODEL, CONFIG, MEMORY = 16 << 30, 1 << 20, 1 << 30
# Fewest bytes that must come in the time of --patience.
LEAST = 1 << 16


class Refused(Exception):
    """What a person has to know, in one line."""


def one_line(what):
    """A text from anywhere as one short line without control characters."""
    line = " ".join(str(what).split())
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in line)[:600]


def environment():
    """The Python that has the hub's client; made where it is not there."""
    python = HOME / "bin/python"
    steps = [[sys.executable, "-m", "venv", HOME], [python, "-m", "pip", "install", "-q", "--disable-pip-version-check", CLIENT]]
    for step in steps if not (HOME / "made").exists() else []:
        done = subprocess.run(step, capture_output=True, text=True)
        if done.returncode:
            why = (done.stderr or done.stdout).strip().splitlines() or ["no word why"]
            raise Refused(f"{HOME}: cannot install {CLIENT} from PyPI: {why[-1]}")
    (HOME / "made").touch()
    return python


def sum_of(path):
    digest = hashlib.sha256()
    with open(path, "rb") as f:
        while block := f.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def chosen(a, siblings):
    """The files to fetch, in order: where each lies on the hub, its bytes and SHA-256 by the hub's list, and its name in the folder."""
    listed = {s.rfilename: (s.size, s.lfs.sha256 if s.lfs else None) for s in siblings}
    ending = f"_{a.variant}" if a.variant else ""
    remotes = {name: name for name in CONFIGS}
    for name, graph in GRAPHS.items():
        remotes[f"{graph}{ending}.onnx"] = name
        # A graph names the file of its weights, so that keeps its name.
        weights = f"{graph}{ending}.onnx_data"
        remotes |= {weights: Path(weights).name} if weights in listed else {}
    files = []
    for remote, name in remotes.items():
        if remote not in listed:
            raise Refused(f"{a.repo}: has no {remote}: is it spelt so, and of the hub's layout?")
        size, sha256 = listed[remote]
        most = CONFIG if name in CONFIGS else MODEL
        if type(size) is not int or not 0 <= size <= most:
            raise Refused(f"{a.repo}: {remote} has {size} bytes by the hub's list, expected at most {most}")
        if sha256 is not None and not (isinstance(sha256, str) and len(sha256) == 64):
            raise Refused(f"{a.repo}: {remote} has the SHA-256 {sha256} by the hub's list")
        files.append((remote, size, sha256, name))
    total, free = sum(f[1] for f in files), shutil.disk_usage(a.folder).free
    if total > min(MODEL, free):
        raise Refused(f"{a.repo}: has {total} bytes by the hub's list, expected at most {min(MODEL, free)}: {free} are free")
    return files


def on_disk(folder):
    """Bytes of all files in a folder. One that is renamed meanwhile may be missed."""
    files = [Path(at) / name for at, _, names in os.walk(folder) for name in names]
    return sum(os.stat(f).st_size for f in files if f.exists())


def is_too_much(error):
    """Whether more bytes came than there should be."""
    return getattr(error, "errno", None) == errno.EFBIG or "Consistency check" in str(error)


def client(a, part, answer, parent):
    """In a process of its own: fetches the files into `part` with the hub's client, and answers with their list or with why not."""
    try:
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    except (ValueError, OSError):
        pass  # a system without this limit
    def follow():
        while os.getppid() == parent:
            time.sleep(0.2)
        os._exit(2)  # the program was killed

    threading.Thread(target=follow, daemon=True).start()
    try:
        from huggingface_hub import HfApi, constants

        # What came of a chunk before a cut is lost.
        constants.DOWNLOAD_CHUNK_SIZE = 1 << 14
        api = HfApi(endpoint=a.hub, token=False)
        info = api.model_info(a.repo, revision=a.revision, files_metadata=True)
        files = chosen(a, info.siblings)
        for remote, size, *_ in files:
            # Not a byte more is written than is listed; the client's own notes are small.
            if remote not in CONFIGS:
                configuration(a, part)  # what does not fit is not worth 600 MB
            resource.setrlimit(resource.RLIMIT_FSIZE, (max(size, CONFIG), resource.RLIM_INFINITY))
            had = -1
            while True:
                try:
                    api.hf_hub_download(a.repo, remote, revision=str(info.sha), local_dir=part)
                    break
                except OSError as e:
                    # A try that brought something is followed by another.
                    before, had = had, max(had, on_disk(part))
                    if had <= before or is_too_much(e):
                        raise
        said = {"files": files}
    except Refused as e:
        said = {"why": str(e)}
    except BaseException as e:
        said = {"why": f"{a.hub} {a.repo}: {one_line(e)[:300] or type(e).__name__}: is it spelt so, public, and of the hub's layout? Or run it again"}
        # What has too many bytes cannot go on.
        if is_too_much(e):
            shutil.rmtree(part)
    answer.send_bytes(json.dumps(said).encode())


def fetched(a, part):
    """What `client` answers, as long as bytes come."""
    answer, theirs = multiprocessing.get_context("fork").Pipe(False)
    process = multiprocessing.get_context("fork").Process(target=client, args=(a, part, theirs, os.getpid()), daemon=True)
    process.start()
    theirs.close()
    had, since = 0, time.monotonic()
    try:
        while not answer.poll(0.5):
            now = on_disk(part)
            if now >= had + LEAST:
                had, since = now, time.monotonic()
            if time.monotonic() - since > a.patience:
                raise Refused(f"{a.hub}: fewer than {LEAST} bytes came in {a.patience} s; run it again: it goes on where it was")
        said = json.loads(answer.recv_bytes())
    except EOFError:
        raise Refused(f"{a.hub}: the hub's client ended without a word; run it again") from None
    finally:
        process.kill()
        process.join()
    if "why" in said:
        raise Refused(said["why"])
    return said["files"]


def configuration(a, part):
    """clip.json of the hub's preprocessor_config.json and tokenizer_config.json. The programs check its numbers."""
    pictures, words = (json.loads((part / name).read_text()) for name in CONFIGS)
    kind = words.get("tokenizer_class", "CLIPTokenizer")
    if kind not in ("CLIPTokenizer", "CLIPTokenizerFast"):
        raise Refused(f"{a.repo}: its tokenizer is {kind}, not CLIP's byte pairs: the programs could not feed it")
    if abs(pictures.get("rescale_factor", 1 / 255) - 1 / 255) > 1e-6:
        raise Refused(f"{a.repo}: preprocessor_config.json scales pixels by {pictures['rescale_factor']}, not 1/255")
    size = pictures.get("crop_size" if pictures.get("do_center_crop", True) and "crop_size" in pictures else "size", 224)
    if isinstance(size, dict):
        sides = {size[k] for k in ("shortest_edge", "height", "width") if k in size}
        if len(sides) != 1:
            raise Refused(f"{a.repo}: preprocessor_config.json asks for pictures of {size}, not squares")
        size = sides.pop()
    normal, length = pictures.get("do_normalize", True), words.get("model_max_length", 77)
    return {
        "name": a.repo,
        "image_size": size,
        "mean": pictures["image_mean"] if normal else [0.0, 0.0, 0.0],
        "std": pictures["image_std"] if normal else [1.0, 1.0, 1.0],
        "context_length": length if length < 4096 else 77,
    }


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
    parser.add_argument("--patience", type=float, default=60, help="seconds in which 64 kB must come [60]")
    parser.add_argument("--quiet", action="store_true", help="no progress")
    a = parser.parse_args()
    folder = a.folder
    if complete(folder, a):
        print(f"{folder}/: {a.repo} is there")
        return
    if Path(sys.prefix).resolve() != HOME.resolve():
        python = environment()
        os.execv(python, [python, *sys.argv])
    # The client reads these where it is imported. Its other way of fetching, Xet, cannot go on where it was.
    os.environ |= {"HF_ENDPOINT": a.hub, "HF_HUB_DISABLE_XET": "1", "HF_HUB_DISABLE_TELEMETRY": "1", "HF_HUB_VERBOSITY": "error"}
    if a.quiet or not sys.stderr.isatty():
        os.environ["HF_HUB_DISABLE_PROGRESS_BARS"] = "1"
    # Graphs are whole, and a pair that fits, before they have their names.
    part = folder / "fetched"
    part.mkdir(parents=True, exist_ok=True)
    files = {}
    for remote, size, sha256, name in fetched(a, part):
        path = part / remote
        found, held = path.stat().st_size, sum_of(path)
        if found != size or held != (sha256 or held):
            shutil.rmtree(part)
            said = f"found {found} bytes of SHA-256 {held}, expected {size} of {sha256 or 'any'}"
            raise Refused(f"{a.repo}: {remote} is not the file that the hub promises: {said}; run it again")
        if name not in CONFIGS:
            path.rename(part / name)
            files[name] = {"bytes": found, "sha256": held}
    (part / "clip.json").write_text(json.dumps(configuration(a, part), indent=2) + "\n")
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
    except Exception as e:
        print(f"make clip: {'' if isinstance(e, (Refused, OSError)) else f'{type(e).__name__}: '}{one_line(e)}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)
