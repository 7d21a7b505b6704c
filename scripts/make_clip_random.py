#!/usr/bin/env python3
"""Writes a CLIP of full size with random weights, and what ONNX Runtime makes of it. It means nothing, but is as large and as slow as a real one.

    pip install numpy onnx onnxruntime
    python scripts/make_clip_random.py [--layers 12] [--patch 32] [--width 512] FOLDER

FOLDER then holds image.onnx, text.onnx and clip.json of ViT-B/16, laid out as the hub's exports: a text's end is ArgMax of its ids, and the
number of ids is open. The image half is ViT-B/32's with --patch 32, and as wide as TinyCLIP-39M's with --width 512. Beside them lie the oracles of `cargo test -p onnx-models --test full_clip`: texts.npy and images.npy, unit features
that ONNX Runtime gives the texts of tokens.json, filled with 49407 as CLIPTokenizer does, and of pictures.npy, u8 [8, 3, 224, 224].
"""
import argparse
import json
from pathlib import Path

import numpy as np
import onnxruntime
from onnx import TensorProto, helper, numpy_helper, save

ROOT = Path(__file__).resolve().parent.parent
F, I64 = TensorProto.FLOAT, TensorProto.INT64
DIMENSION, VOCABULARY, MOST, END = 512, 49408, 77, 49407
MEAN, STD = [0.48145466, 0.4578275, 0.40821073], [0.26862954, 0.26130258, 0.27577711]


class Graph:
    """Nodes and weights of one half."""

    def __init__(self, seed):
        self.nodes, self.constants, self.random, self.count = [], [], np.random.default_rng(seed), 0

    def __call__(self, op, *inputs, **attributes):
        self.count += 1
        name = f"v{self.count}"
        self.nodes.append(helper.make_node(op, list(inputs), [name], **attributes))
        return name

    def constant(self, array):
        self.count += 1
        self.constants.append(numpy_helper.from_array(np.asarray(array), f"c{self.count}"))
        return f"c{self.count}"

    def weights(self, *shape, fan):
        return self.constant(self.random.standard_normal(shape, np.float32) / np.float32(np.sqrt(fan)))

    def ints(self, *values):
        return self.constant(np.array(values, np.int64))

    def norm(self, x, width):
        scale, bias = self.constant(np.ones(width, np.float32)), self.constant(np.zeros(width, np.float32))
        return self("LayerNormalization", x, scale, bias, axis=-1, epsilon=1e-5)

    def linear(self, x, width, out):
        return self("Add", self("MatMul", x, self.weights(width, out, fan=width)), self.weights(out, fan=100))

    def block(self, x, width, heads, mask):
        """Attention and the two layers after it, each beside a way past it."""
        normed = self.norm(x, width)
        shape = self.ints(0, -1, heads, width // heads)

        def split(scale=1.0, perm=(0, 2, 1, 3)):
            y = self.linear(normed, width, width)
            y = self("Mul", y, self.constant(np.float32(scale))) if scale != 1.0 else y
            return self("Transpose", self("Reshape", y, shape), perm=perm)

        scores = self("MatMul", split((width // heads) ** -0.5), split(perm=(0, 2, 3, 1)))
        scores = self("Add", scores, mask) if mask else scores
        mixed = self("MatMul", self("Softmax", scores, axis=-1), split())
        joined = self("Reshape", self("Transpose", mixed, perm=(0, 2, 1, 3)), self.ints(0, -1, width))
        x = self("Add", x, self.linear(joined, width, width))
        hidden = self.linear(self.norm(x, width), width, 4 * width)
        gate = self("Sigmoid", self("Mul", hidden, self.constant(np.float32(1.702))))
        return self("Add", x, self.linear(self("Mul", hidden, gate), 4 * width, width))

    def write(self, path, given, output):
        self.nodes.append(helper.make_node("Identity", [output], [path.stem + "_embeds"]))
        out = helper.make_tensor_value_info(path.stem + "_embeds", F, ["batch", DIMENSION])
        graph = helper.make_graph(self.nodes, path.stem, [given], [out], self.constants)
        save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8, producer_name="random"), path)


def image(path, layers, width, heads, patch, size=224):
    g, cells = Graph(1), (size // patch) ** 2
    x = g("Conv", "pixel_values", g.weights(width, 3, patch, patch, fan=3 * patch * patch), strides=[patch, patch],
          kernel_shape=[patch, patch], dilations=[1, 1], pads=[0, 0, 0, 0], group=1)
    x = g("Transpose", g("Reshape", x, g.ints(0, width, cells)), perm=(0, 2, 1))
    batch = g("Slice", g("Shape", "pixel_values"), g.ints(0), g.ints(1), g.ints(0))
    first = g("Expand", g.weights(1, 1, width, fan=1), g("Concat", batch, g.ints(1, width), axis=0))
    x = g("Add", g("Concat", first, x, axis=1), g.weights(1, cells + 1, width, fan=1))
    x = g.norm(x, width)
    for _ in range(layers):
        x = g.block(x, width, heads, None)
    x = g.norm(g("Gather", x, g.constant(np.array(0, np.int64)), axis=1), width)
    given = helper.make_tensor_value_info("pixel_values", F, ["batch", 3, size, size])
    g.write(path, given, g("MatMul", x, g.weights(width, DIMENSION, fan=width)))


def text(path, layers, width=512, heads=8):
    g = Graph(2)
    shape = g("Shape", "input_ids")
    batch, length = (g("Slice", shape, g.ints(k), g.ints(k + 1), g.ints(0)) for k in (0, 1))
    places = g("Slice", g.weights(MOST, width, fan=1), g.ints(0), length, g.ints(0))
    x = g("Add", g("Gather", g.weights(VOCABULARY, width, fan=1), "input_ids"), places)
    least = g.constant(np.float32(np.finfo(np.float32).min))
    mask = g("Trilu", g("Expand", least, g("Concat", length, length, axis=0)), g.constant(np.array(1, np.int64)), upper=1)
    for _ in range(layers):
        x = g.block(x, width, heads, mask)
    x = g.norm(x, width)
    end = g("ArgMax", g("Cast", "input_ids", to=TensorProto.INT32), axis=-1, keepdims=1)
    zero, one = g.constant(np.array(0, np.int64)), g.constant(np.array(1, np.int64))
    row = g("Unsqueeze", g("Range", zero, g("Squeeze", batch), one), g.ints(1))
    x = g("GatherND", x, g("Concat", row, end, axis=1))
    given = helper.make_tensor_value_info("input_ids", I64, ["batch", "sequence"])
    g.write(path, given, g("MatMul", x, g.weights(width, DIMENSION, fan=width)))


def features(path, name, rows):
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    found = np.concatenate([session.run(None, {name: row[None]})[0] for row in rows])
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder to write")
    parser.add_argument("--layers", type=int, default=12, help="layers of each half [%(default)s, as ViT-B/16 has]")
    parser.add_argument("--patch", type=int, default=16, help="pixels of the image half's patches [%(default)s]")
    parser.add_argument("--width", type=int, default=768, help="width of the image half, 64 a head [%(default)s]")
    a = parser.parse_args()
    a.folder.mkdir(parents=True, exist_ok=True)
    config = {"name": f"ViT of random weights, {a.layers} layers of {a.width}, patches of {a.patch}", "dimension": DIMENSION, "image_size": 224,
              "mean": MEAN, "std": STD, "context_length": MOST}
    (a.folder / "clip.json").write_text(json.dumps(config, indent=2) + "\n")
    image(a.folder / "image.onnx", a.layers, a.width, a.width // 64, a.patch)
    text(a.folder / "text.onnx", a.layers)
    tokens = json.loads((ROOT / "crates/lib/onnx-models/testdata/tokens.json").read_text())
    ids = np.array([t["ids"] + [END] * (MOST - len(t["ids"])) for t in tokens], np.int64)
    np.save(a.folder / "texts.npy", features(a.folder / "text.onnx", "input_ids", ids))
    pictures = np.random.default_rng(3).integers(0, 256, (8, 3, 224, 224), np.uint8)
    pictures[4:] = pictures[4:, :, ::16, ::16].repeat(16, 2).repeat(16, 3)
    np.save(a.folder / "pictures.npy", pictures)
    mean, std = (np.array(v, np.float32)[:, None, None] for v in (MEAN, STD))
    np.save(a.folder / "images.npy", features(a.folder / "image.onnx", "pixel_values", (pictures.astype(np.float32) / 255 - mean) / std))
    print(f"{a.folder}/: {config['name']}")


if __name__ == "__main__":
    main()
