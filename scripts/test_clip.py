#!/usr/bin/env python3
"""make clip beside a hub of our own: testdata/clip-tiny in the layout of the Hugging Face hub, whole, cut, wrong, missing, redirected."""
import hashlib
import json
import subprocess
import sys
import tempfile
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
TINY, OTHER = ROOT / "testdata/clip-tiny", ROOT / "crates/lib/onnx-models/testdata/clip"
PICTURES = {"do_center_crop": True, "crop_size": {"height": 64, "width": 64}, "size": {"shortest_edge": 64}, "rescale_factor": 1 / 255,
            "image_mean": [0.48145466, 0.4578275, 0.40821073], "image_std": [0.26862954, 0.26130258, 0.27577711]}
WORDS = {"tokenizer_class": "CLIPTokenizer", "model_max_length": 77, "pad_token": "<|endoftext|>"}
# Most bytes of an answer of the hub that cuts connections.
CUT = 150_000


class Hub(BaseHTTPRequestHandler):
    """/<fault>/<owner>/<model>/resolve/<revision>/<file>."""

    asked = []

    def log_message(self, *_):
        pass

    def do_HEAD(self):
        self.do_GET()

    def do_GET(self):
        fault, name = self.path.split("/")[1], self.path.split("/resolve/main/")[-1]
        start = int(self.headers.get("Range", "bytes=0-")[len("bytes="):-1])
        looked = self.command == "HEAD"
        Hub.asked += [] if looked else [(fault, name, start)]
        ending = "_fp16" if fault == "half" else ""
        graph = {f"onnx/vision_model{ending}.onnx": "image.onnx", f"onnx/text_model{ending}.onnx": "text.onnx"}.get(name)
        if name.endswith("_data") or not graph and name.startswith("onnx/"):
            if fault != "apart":
                return self.send_error(404)
            data = b"weights"
        elif graph:
            data = ((OTHER if fault == "halves" and graph == "text.onnx" else TINY) / graph).read_bytes()
        else:
            words = WORDS | ({"tokenizer_class": "SiglipTokenizer"} if fault == "siglip" else {})
            data = json.dumps(PICTURES if name == "preprocessor_config.json" else words).encode()
        if fault == "missing" and graph == "text.onnx" or fault == "private":
            return self.send_error(404)
        if fault in ("redirect", "wrong") and graph:
            self.send_response(302)
            sha = hashlib.sha256(data if fault == "redirect" else b"another file").hexdigest()
            for key, value in [("X-Linked-Etag", f'"{sha}"'), ("X-Linked-Size", len(data)), ("Content-Length", 0),
                               ("Location", self.path.replace(f"/{fault}/", "/cut/" if fault == "redirect" else "/whole/"))]:
                self.send_header(key, str(value))
            return self.end_headers()
        if start >= len(data):
            return self.send_error(416)
        start = 0 if fault == "norange" else start
        self.send_response(206 if start else 200)
        self.send_header("Content-Length", str(len(data) - start))
        self.end_headers()
        if looked:
            return
        once = fault == "once" and sum(n == name for f, n, _ in Hub.asked if f == "once") > 1
        self.wfile.write(data[start:start + CUT if fault == "cut" else start + 1000 if fault == "once" and graph and not once else None])
        self.close_connection = True


def main():
    server = ThreadingHTTPServer(("127.0.0.1", 0), Hub)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    with tempfile.TemporaryDirectory() as work:
        work = Path(work)

        def fetch(fault, folder, *more):
            line = [ROOT / "scripts/fetch_clip.py", work / folder, "--hub", f"http://127.0.0.1:{server.server_port}/{fault}", "--repo", "some/tiny"]
            return subprocess.run([sys.executable, *line, *more], capture_output=True, text=True, timeout=120)

        def same(folder):
            return all((work / folder / f).read_bytes() == (TINY / f).read_bytes() for f in ("image.onnx", "text.onnx"))

        for fault in ("whole", "cut", "redirect", "once", "apart", "half"):
            done = fetch(fault, fault, *(["--variant", "fp16"] if fault == "half" else []))
            assert done.returncode == 0 and same(fault), (fault, done.stderr)
            assert not (work / fault / "fetched").exists()
        assert ("cut", "onnx/vision_model.onnx", CUT) in Hub.asked, "a cut download goes on where it was"
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
        (work / "own").mkdir()
        (work / "own/image.onnx").write_bytes(b"mine")
        said = fetch("whole", "own")
        assert said.returncode == 2 and "did not come from here" in said.stderr, said.stderr
        refusals = {"wrong": "not the file that the hub promises", "missing": "onnx/text_model.onnx: 404", "private": "404",
                    "siglip": "SiglipTokenizer, not CLIP's byte pairs", "halves": "two halves are of different models"}
        for fault, expected in refusals.items():
            said = fetch(fault, fault)
            assert said.returncode == 2 and expected in said.stderr and said.stderr.count("\n") == 1, (fault, said.stderr)
            assert not (work / fault / "text.onnx").exists(), fault
        # A download that was killed: what came is kept. Another repository's part is not mixed with it.
        part = work / "killed/fetched"
        part.mkdir(parents=True)
        (part / "asked").write_text(f"some/tiny fp32 main http://127.0.0.1:{server.server_port}/whole\n")
        (part / "image.onnx").write_bytes((TINY / "image.onnx").read_bytes()[:5000])
        assert fetch("whole", "killed").returncode == 0 and same("killed")
        assert ("whole", "onnx/vision_model.onnx", 5000) in Hub.asked
        (work / "mixed/fetched").mkdir(parents=True)
        (work / "mixed/fetched/image.onnx").write_bytes(b"another model")
        assert fetch("whole", "mixed").returncode == 0 and same("mixed")
        # The programs read it.
        checked = subprocess.run([ROOT / "target/release/mask-embed", "check", "--clip", work / "cut"], capture_output=True, text=True)
        assert checked.returncode == 0 and "some/tiny" in checked.stderr, checked.stderr
    server.shutdown()
    print("ok: make clip fetches a CLIP model, goes on after cuts, and refuses what does not fit")


if __name__ == "__main__":
    main()
