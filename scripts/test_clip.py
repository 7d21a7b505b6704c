#!/usr/bin/env python3
"""make clip beside a hub of our own: testdata/clip-tiny in the layout of the Hugging Face hub, whole, cut, wrong, missing, redirected."""
import hashlib
import json
import subprocess
import sys
import tempfile
import threading
import time
from multiprocessing.pool import ThreadPool
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import fetch_clip

ROOT = Path(__file__).resolve().parent.parent
TINY, OTHER = ROOT / "testdata/clip-tiny", ROOT / "crates/lib/onnx-models/testdata/clip"
PICTURES = {"do_center_crop": True, "crop_size": {"height": 64, "width": 64}, "size": {"shortest_edge": 64}, "rescale_factor": 1 / 255,
            "image_mean": [0.48145466, 0.4578275, 0.40821073], "image_std": [0.26862954, 0.26130258, 0.27577711]}
WORDS = {"tokenizer_class": "CLIPTokenizer", "model_max_length": 77, "pad_token": "<|endoftext|>"}
# Most bytes of an answer of the hub that cuts connections.
CUT = 150_000
# Bytes that the client keeps at a time.
CHUNK = 1 << 14


# The commit that the hub's list is of.
SHA = "0123456789" * 4
# Descriptions of pictures and words that are none.
ODD = {"list": [], "text": "\x1b[2J", "deep": None, "mean": PICTURES | {"image_mean": "\x1b[2J"}, "size": PICTURES | {"crop_size": [[64]]},
       "scale": PICTURES | {"rescale_factor": "1/255"}, "none": {}}


class Hub(BaseHTTPRequestHandler):
    """/<fault>/api/models/<owner>/<model>/revision/<revision>, and /<fault>/<owner>/<model>/resolve/<commit>/<file>."""

    asked = []

    def log_message(self, *_):
        pass

    def do_HEAD(self):
        self.do_GET()

    def data(self, fault, name):
        """The bytes of a file, if the hub has it."""
        ending = "_fp16" if fault == "half" else ""
        graph = {f"onnx/vision_model{ending}.onnx": "image.onnx", f"onnx/text_model{ending}.onnx": "text.onnx"}.get(name)
        if name == "onnx/text_model.onnx_data" and fault == "apart":
            return b"weights"
        if graph and not (fault == "missing" and graph == "text.onnx"):
            return ((OTHER if fault == "halves" and graph == "text.onnx" else TINY) / graph).read_bytes()
        odd = fault.removeprefix("odd-")
        pictures = ODD.get(odd, PICTURES)
        words = {"siglip": WORDS | {"tokenizer_class": "SiglipTokenizer"}, "escapes": WORDS | {"tokenizer_class": "\x1b]0;x\x07\n\u202e"}}
        described = {"preprocessor_config.json": pictures, "tokenizer_config.json": words.get(fault, WORDS)}
        if name in described:
            return b"[" * 100_000 if odd == "deep" else json.dumps(described[name]).encode()
        return None

    def listed(self, fault):
        """The hub's list of its files."""
        names = ["README.md", "preprocessor_config.json", "tokenizer_config.json", "onnx/text_model.onnx_data"]
        names += [f"onnx/{half}_model{ending}.onnx" for half in ("vision", "text") for ending in ("", "_fp16")]
        siblings = []
        for name in names:
            data = self.data(fault, name)
            if data is not None:
                sha = hashlib.sha256(b"another file" if fault == "wrong" else data).hexdigest()
                size = {"huge": 10 ** 12, "nosize": None, "negative": -1, "sizetext": "9"}.get(fault, len(data))
                lfs = {"sha256": sha, "size": size, "pointerSize": 130} if name.endswith(".onnx") else None
                siblings.append({"rfilename": name, "size": size, "blobId": "0", "lfs": lfs})
        wrong = {"files-number": 7, "files-text": "\x1b[2J", "files-none": None, "files-names": [{"rfilename": ["a"], "size": 1}],
                 "files-lfs": [{"rfilename": n, "size": 1, "lfs": [1]} for n in names]}
        siblings += [{"rfilename": "\x1b[2J\n../../x", "size": 1}] if fault == "escapes" else []
        return {"id": "some/tiny", "sha": SHA, "siblings": wrong.get(fault, siblings)}

    def do_GET(self):
        fault, name = self.path.split("/")[1], self.path.split(f"/resolve/{SHA}/")[-1]
        start = int(self.headers.get("Range", "bytes=0-")[len("bytes="):-1])
        looked = self.command == "HEAD"
        Hub.asked += [] if looked else [(fault, name, start)]
        graph = name.endswith(".onnx")
        if fault == "private":
            self.send_response(401)
            self.send_header("X-Error-Message", "\x1b[2J no")
            return self.end_headers()
        if "/api/models/" in self.path:
            data = {"list-list": b"[]", "list-text": b'"\\u001b[2J"', "list-html": b"<html>\x1b[2J"}.get(fault) or json.dumps(self.listed(fault)).encode()
            start = 0
        else:
            data = self.data(fault, name)
        if data is None:
            return self.send_error(404)
        if fault == "redirect" and graph and looked:
            self.send_response(302)
            sha = hashlib.sha256(data).hexdigest()
            for key, value in [("X-Linked-Etag", f'"{sha}"'), ("X-Linked-Size", len(data)), ("Content-Length", 0), ("X-Repo-Commit", SHA),
                               ("Location", f"http://127.0.0.1:{self.server.server_port}{self.path.replace('/redirect/', '/cut/')}")]:
                self.send_header(key, str(value))
            return self.end_headers()
        if start >= len(data):
            return self.send_error(416)
        start = 0 if fault == "norange" else start
        self.send_response(206 if start else 200)
        if looked or not (fault == "endless-list" and "/api/" in self.path or fault == "endless" and graph):
            self.send_header("Content-Length", str(len(data) - start))
        self.send_header("ETag", f'"{hashlib.sha256(data).hexdigest()}"')
        self.send_header("X-Repo-Commit", SHA)
        self.end_headers()
        if looked:
            return
        self.close_connection = True
        try:
            if fault == "endless-list" or fault == "endless" and graph:
                while True:
                    self.wfile.write(b" " * (1 << 20))
            if fault in ("slow", "stalled") and graph:
                self.wfile.write(data[:CUT if fault == "stalled" else 0])
                for byte in data:
                    self.wfile.write(bytes([byte]))
                    time.sleep(0.1)
            once = fault == "once" and sum(n == name for f, n, _ in Hub.asked if f == "once") > 1
            cut = {"cut": CUT, "norange": CUT, "drip": 1, "once": None if once else CUT}.get(fault) if graph else None
            self.wfile.write(data[start:][:cut])
        except (BrokenPipeError, ConnectionResetError):
            pass


def main():
    with tempfile.TemporaryDirectory() as work:
        own = Path(work) / "own"
        own.mkdir()
        (own / "image.onnx").write_bytes(b"mine")
        said = subprocess.run([sys.executable, ROOT / "scripts/fetch_clip.py", own], capture_output=True, text=True)
        assert said.returncode == 2 and "did not come from here" in said.stderr, said.stderr
    try:
        fetch_clip.environment()
    except fetch_clip.Refused as e:
        print(f"SKIPPED: make clip beside a hub of our own: {e}")
        return
    server = ThreadingHTTPServer(("127.0.0.1", 0), Hub)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    with tempfile.TemporaryDirectory() as work:
        work = Path(work)

        def fetch(fault, folder, *more):
            line = [ROOT / "scripts/fetch_clip.py", work / folder, "--hub", f"http://127.0.0.1:{server.server_port}/{fault}", "--repo", "some/tiny"]
            done = subprocess.run([sys.executable, *line, *more], capture_output=True, text=True, timeout=120)
            assert "\x1b" not in done.stderr, (fault, done.stderr)
            return done

        def same(folder):
            return all((work / folder / f).read_bytes() == (TINY / f).read_bytes() for f in ("image.onnx", "text.onnx"))

        for fault in ("whole", "cut", "redirect", "once", "apart", "half"):
            done = fetch(fault, fault, *(["--variant", "fp16"] if fault == "half" else []))
            assert done.returncode == 0 and same(fault), (fault, done.stderr)
            assert not (work / fault / "fetched").exists()
        assert {at for fault, name, at in Hub.asked if (fault, name) == ("cut", "onnx/vision_model.onnx")} >= {0, CUT // CHUNK * CHUNK}, "a cut download goes on where it was"
        assert (work / "apart/text_model.onnx_data").read_bytes() == b"weights", "weights that lie apart keep their name"
        assert "holds some/tiny: give" in fetch("half", "whole", "--variant", "fp16").stderr, "another variant is another model"
        assert "pad_id" not in (work / "whole/clip.json").read_text()
        source = json.loads((work / "redirect/source.json").read_text())
        assert source["files"]["text.onnx"]["sha256"] == hashlib.sha256((TINY / "text.onnx").read_bytes()).hexdigest()
        # What is there is checked, and fetched no more.
        before = len(Hub.asked)
        assert fetch("whole", "whole").returncode == 0 and len(Hub.asked) == before
        (work / "whole/text.onnx").write_bytes(b"damaged")
        said = fetch("whole", "whole")
        assert said.returncode == 2 and "text.onnx: not the file that was fetched" in said.stderr, said.stderr
        assert (work / "whole/text.onnx").read_bytes() == b"damaged", "nothing is replaced"
        refusals = {"wrong": "not the file that the hub promises", "missing": "has no onnx/text_model.onnx", "private": "401",
                    "siglip": "SiglipTokenizer, not CLIP's byte pairs", "halves": "two halves are of different models",
                    # What a hub may do on purpose.
                    "huge": "has 1000000000000 bytes by the hub's list", "nosize": "has None bytes", "negative": "has -1 bytes",
                    "sizetext": "has 9 bytes", "escapes": "not CLIP's byte pairs", "endless": "too large", "endless-list": "/endless-list",
                    "slow": "fewer than 65536 bytes came in 3.0 s", "drip": "IncompleteRead(1 bytes read",
                    "norange": "IncompleteRead(150000 bytes"}
        refusals |= {f"list-{kind}": "some/tiny" for kind in ("list", "text", "html")}
        refusals |= {f"files-{kind}": "some/tiny" for kind in ("number", "text", "none", "names", "lfs")}
        refusals |= {f"odd-{kind}": "" for kind in ODD}
        with ThreadPool(2) as pool:
            answers = pool.map(lambda fault: fetch(fault, fault, "--patience", "3"), refusals)
        for (fault, expected), said in zip(refusals.items(), answers):
            assert said.returncode == 2 and expected in said.stderr and said.stderr.count("\n") == 1, (fault, said.stderr)
            assert not (work / fault / "text.onnx").exists(), fault
        # A download that was killed: what came is kept. Files of another model are not taken for this one's.
        part = work / "killed/fetched"
        line = [sys.executable, ROOT / "scripts/fetch_clip.py", work / "killed", "--repo", "some/tiny", "--hub"]
        began = subprocess.Popen([*line, f"http://127.0.0.1:{server.server_port}/stalled"], stderr=subprocess.PIPE)
        while not any(p.stat().st_size for p in part.rglob("*.incomplete")):
            assert began.poll() is None, began.stderr.read()
            time.sleep(0.05)
        began.kill()
        began.communicate()
        assert fetch("whole", "killed").returncode == 0 and same("killed")
        assert any(f == "whole" and n == "onnx/vision_model.onnx" and at > 0 for f, n, at in Hub.asked), "what came before the kill is kept"
        (work / "mixed/fetched/onnx").mkdir(parents=True)
        (work / "mixed/fetched/onnx/vision_model.onnx").write_bytes(b"another model")
        assert fetch("whole", "mixed").returncode == 0 and same("mixed")
        # The programs read it.
        checked = subprocess.run([ROOT / "target/release/mask-embed", "check", "--clip", work / "cut"], capture_output=True, text=True)
        assert checked.returncode == 0 and "some/tiny" in checked.stderr, checked.stderr
    server.shutdown()
    print("ok: make clip fetches a CLIP model, goes on after cuts, and refuses what does not fit")


if __name__ == "__main__":
    main()
