#!/usr/bin/env python3
"""Writes crates/lib/onnx-models/testdata/tokens.json: 80 texts of all lengths with the ids that CLIPTokenizer of transformers gives them.

    pip install transformers ftfy regex open_clip_torch      (of open_clip only the vocabulary is used)
    python scripts/make_tokens.py
"""
import gzip
import importlib.util
import json
import tempfile
from pathlib import Path

from transformers import CLIPTokenizer

OUT = Path(__file__).resolve().parent.parent / "crates/lib/onnx-models/testdata/tokens.json"
ODD = ["", "a", "mug", "coffee mug", "A  Photo of\na CAT", "it's Anna's; they'll", "hello world!", "3D-print, 50% off: 12.5 kg", "¿dónde?",
       "café", "cafe\u0301", "nai\u0308ve", "Müller's Straße", "コーヒーカップ", "咖啡杯", "кружка", "🪴 plant", "e-mail@example.org", "C++ & C#", "x_y (z) [w]"]
WORDS = "red mug on the wooden table beside a large green plant with round leaves near that old television and its remote control".split()


def tokenizer(folder):
    """CLIPTokenizer of the vocabulary that open_clip ships."""
    package = Path(importlib.util.find_spec("open_clip").origin).parent
    merges = gzip.open(package / "bpe_simple_vocab_16e6.txt.gz").read().decode().split("\n")[1:49152 - 256 - 2 + 1]
    kept = [*range(ord("!"), ord("~") + 1), *range(ord("¡"), ord("¬") + 1), *range(ord("®"), ord("ÿ") + 1)]
    letters = [chr(c) for c in kept] + [chr(256 + n) for n in range(256 - len(kept))]
    names = letters + [c + "</w>" for c in letters] + [m.replace(" ", "") for m in merges] + ["<|startoftext|>", "<|endoftext|>"]
    (folder / "vocab.json").write_text(json.dumps({name: i for i, name in enumerate(names)}))
    (folder / "merges.txt").write_text("#version: 0.2\n" + "\n".join(merges) + "\n")
    return CLIPTokenizer(str(folder / "vocab.json"), str(folder / "merges.txt"))


def main():
    lengths = [*range(1, 59), 75, 90]
    texts = ODD + [" ".join(WORDS[(n + k) % len(WORDS)] for k in range(n)) for n in lengths]
    with tempfile.TemporaryDirectory() as folder:
        encode = tokenizer(Path(folder))
        ids = [encode(text, truncation=True, max_length=77)["input_ids"] for text in texts]
    lines = [json.dumps({"text": text, "ids": own}, ensure_ascii=False) for text, own in zip(texts, ids)]
    OUT.write_text("[\n" + ",\n".join(lines) + "\n]\n")
    print(f"{len(texts)} texts of {min(map(len, ids))} to {max(map(len, ids))} ids")


if __name__ == "__main__":
    main()
