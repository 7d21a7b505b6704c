#!/usr/bin/env python3
"""Trains the small text-image dual encoder of the demo and the tests, and writes it as a CLIP-shaped ONNX pair.

Image encoder: pixels f32 [n,3,64,64] -> f32 [n,64].  Text encoder: CLIP BPE ids i64 [n,77] -> f32 [n,64].
It learns from crops of masks of synthetic scenes, cut by the same code that cuts them in the pipeline, and from what
the scenes' truth says of each mask.  It knows those things and no others: it is no substitute for a real CLIP.

    make clip-tiny                     (makes the scenes and crops, then runs this script)
    python scripts/train_clip_tiny.py --crops out/clip-tiny --out testdata/clip-tiny

Needs PyPI numpy, jax (CPU) and onnx.  --crops is a folder with, per scene S, S/crops.safetensors (pixels u8
[n,3,64,64], view u32 [n], mask u32 [n], view names in its metadata), S/scene/truth/masks.json and S/scene/truth/scene.json.
The token ids of every caption lie in the metadata of the crops, so that training and inference share one tokenizer.
"""

import argparse
import json
import pathlib
import struct
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

DIM = 64  # of the shared space
WORD = 48  # of a word
SIZE = 64  # pixels
CONTEXT = 77
VOCABULARY = 49408
START, END = 49406, 49407
CHANNELS = [16, 32, 64, 96, 128]
MEAN = np.array([0.48145466, 0.4578275, 0.40821073], np.float32)
STD = np.array([0.26862954, 0.26130258, 0.27577711], np.float32)


# ---------------------------------------------------------------------------------------------------------------- data


def read_safetensors(path):
    raw = path.read_bytes()
    (n,) = struct.unpack("<Q", raw[:8])
    header = json.loads(raw[8 : 8 + n])
    kinds = {"U8": np.uint8, "U32": np.uint32, "F32": np.float32, "I32": np.int32}
    out = {}
    for name, t in header.items():
        if name == "__metadata__":
            out[name] = json.loads(t["cags"])
            continue
        a, b = t["data_offsets"]
        out[name] = np.frombuffer(raw[8 + n + a : 8 + n + b], kinds[t["dtype"]]).reshape(t["shape"])
    return out


def captions_of(mask, objects, rng_phrases):
    """Texts that describe a mask: its caption, and for a whole thing also its class alone."""
    texts = [mask["caption"]]
    if mask["kind"] == "whole" and len(mask["instances"]) == 1:
        thing = objects[mask["instances"][0]]
        texts += [thing["name"], thing["class"], f"{thing['color']} {thing['class']}".strip()]
    return sorted(set(texts))


def load(folder):
    pixels, texts, scenes, tokens = [], [], [], {}
    for s, path in enumerate(sorted(folder.glob("*/crops.safetensors"))):
        crops = read_safetensors(path)
        views = crops["__metadata__"]["extra"]["views"]
        tokens.update(crops["__metadata__"]["extra"]["tokens"])
        masks = json.loads((path.parent / "scene/truth/masks.json").read_text())
        objects = json.loads((path.parent / "scene/truth/scene.json").read_text())["objects"]
        for i in range(len(crops["pixels"])):
            mask = masks[views[crops["view"][i]]][crops["mask"][i]]
            pixels.append(crops["pixels"][i])
            texts.append(captions_of(mask, objects, None))
            scenes.append(s)
    return np.stack(pixels), texts, np.array(scenes), dict(sorted(tokens.items()))


# --------------------------------------------------------------------------------------------------------------- model


def init(rows, key):
    keys = iter(jax.random.split(key, 40))
    p, s = {}, {}
    last = 3
    for i, c in enumerate(CHANNELS):
        k = 5 if i == 0 else 3
        p[f"conv{i}"] = jax.random.normal(next(keys), (c, last, k, k)) * np.sqrt(2 / (last * k * k))
        p[f"gain{i}"], p[f"bias{i}"] = jnp.ones(c), jnp.zeros(c)
        s[f"mean{i}"], s[f"var{i}"] = jnp.zeros(c), jnp.ones(c)
        last = c
    p["image_w"] = jax.random.normal(next(keys), (2 * last, DIM)) * np.sqrt(1 / (2 * last))
    p["word"] = jax.random.normal(next(keys), (rows, WORD)) * 0.3
    p["pair"] = jax.random.normal(next(keys), (64, WORD, 3)) * np.sqrt(2 / (3 * WORD))
    p["pair_bias"] = jnp.zeros(64)
    p["text_w"] = jax.random.normal(next(keys), (WORD + 64, DIM)) * np.sqrt(1 / (WORD + 64))
    p["log_scale"] = jnp.log(10.0)
    return p, s


def encode_image(p, s, x, train):
    new = {}
    for i in range(len(CHANNELS)):
        stride = 2
        x = jax.lax.conv_general_dilated(x, p[f"conv{i}"], (stride, stride), "SAME")
        if train:
            mean, var = x.mean((0, 2, 3)), x.var((0, 2, 3))
            new[f"mean{i}"] = 0.95 * s[f"mean{i}"] + 0.05 * mean
            new[f"var{i}"] = 0.95 * s[f"var{i}"] + 0.05 * var
        else:
            mean, var = s[f"mean{i}"], s[f"var{i}"]
        scale = (p[f"gain{i}"] / jnp.sqrt(var + 1e-5))[:, None, None]
        x = jax.nn.relu((x - mean[:, None, None]) * scale + p[f"bias{i}"][:, None, None])
    x = jnp.concatenate([x.mean((2, 3)), x.max((2, 3))], 1)
    return x @ p["image_w"], new


def encode_text(p, rows):
    e = p["word"][rows] * (rows > 0)[..., None]  # row 0: start, end, padding
    pairs = jax.lax.conv_general_dilated(e.transpose(0, 2, 1), p["pair"], (1,), "SAME")
    pairs = jax.nn.relu(pairs + p["pair_bias"][:, None]).max(2)
    return jnp.concatenate([e.sum(1), pairs], 1) @ p["text_w"]


def unit(x):
    return x / (jnp.linalg.norm(x, axis=-1, keepdims=True) + 1e-6)


def loss_fn(p, s, x, rows, same):
    a, new = encode_image(p, s, x, True)
    logits = unit(a) @ unit(encode_text(p, rows)).T * jnp.exp(p["log_scale"])
    target = same / same.sum(1, keepdims=True)
    forward = -(target * jax.nn.log_softmax(logits, 1)).sum(1).mean()
    target = same / same.sum(0, keepdims=True)
    backward = -(target * jax.nn.log_softmax(logits, 0)).sum(0).mean()
    return (forward + backward) / 2, new


@jax.jit
def step(p, s, m, v, t, lr, x, rows, same):
    (loss, new), g = jax.value_and_grad(loss_fn, has_aux=True)(p, s, x, rows, same)
    tree = jax.tree_util.tree_map
    m = tree(lambda m, g: 0.9 * m + 0.1 * g, m, g)
    v = tree(lambda v, g: 0.999 * v + 0.001 * g * g, v, g)
    fix1, fix2 = 1 - 0.9**t, 1 - 0.999**t
    p = tree(lambda p, m, v: p - lr * ((m / fix1) / (jnp.sqrt(v / fix2) + 1e-8) + 1e-4 * p), p, m, v)
    return p, new, m, v, loss


def augment(x, rng):
    """Flips, shifts, shrinks and changes the light of crops u8 [n,3,S,S]; black stays black, as outside a mask."""
    out = np.zeros(x.shape, np.float32)
    for i, crop in enumerate(x):
        crop = crop.astype(np.float32) / 255
        if rng.random() < 0.5:
            crop = crop[:, :, ::-1]
        size = int(SIZE * rng.uniform(0.75, 1.0))
        index = (np.arange(size) + 0.5) * SIZE / size
        index = index.astype(int)
        crop = crop[:, index][:, :, index]
        y, z = rng.integers(0, SIZE - size + 1, 2)
        light = rng.uniform(0.8, 1.2) * rng.uniform(0.95, 1.05, (3, 1, 1))
        if rng.random() < 0.3:  # a corner is hidden by another thing
            h, w = rng.integers(size // 8, size // 2, 2)
            top, left = rng.integers(0, size - h), rng.integers(0, size - w)
            crop = crop.copy()
            crop[:, top : top + h, left : left + w] = 0
        out[i, :, y : y + size, z : z + size] = np.clip(crop * light, 0, 1)
    return (out - MEAN[:, None, None]) / STD[:, None, None]


# -------------------------------------------------------------------------------------------------------------- export


def export(p, s, table, out):
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    def save(nodes, inputs, weights, path):
        init = [numpy_helper.from_array(np.asarray(v), k) for k, v in weights.items()]
        y = helper.make_tensor_value_info("embedding", TensorProto.FLOAT, ["n", DIM])
        graph = helper.make_graph(nodes, path.stem, inputs, [y], init)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
        model.ir_version = 8
        onnx.checker.check_model(model)
        path.write_bytes(model.SerializeToString())

    f32 = lambda a: np.asarray(a, np.float32)
    nodes, weights, x = [], {}, "pixels"
    for i in range(len(CHANNELS)):
        gain = f32(p[f"gain{i}"]) / np.sqrt(f32(s[f"var{i}"]) + 1e-5)  # batch normalisation folded into the weights
        weights[f"w{i}"] = f32(p[f"conv{i}"]) * gain[:, None, None, None]
        weights[f"b{i}"] = f32(p[f"bias{i}"]) - f32(s[f"mean{i}"]) * gain
        k = weights[f"w{i}"].shape[-1]
        before = (k - 2) // 2  # "SAME" with stride 2 on an even size pads k - 2 in all, the smaller half first
        pads = [before, before, k - 2 - before, k - 2 - before]
        nodes.append(helper.make_node("Conv", [x, f"w{i}", f"b{i}"], [f"c{i}"], strides=[2, 2], pads=pads, dilations=[1, 1]))
        nodes.append(helper.make_node("Relu", [f"c{i}"], [f"r{i}"]))
        x = f"r{i}"
    nodes += [
        helper.make_node("ReduceMean", [x], ["mean"], axes=[2, 3], keepdims=0),
        helper.make_node("ReduceMax", [x], ["max"], axes=[2, 3], keepdims=0),
        helper.make_node("Concat", ["mean", "max"], ["pooled"], axis=1),
        helper.make_node("MatMul", ["pooled", "image_w"], ["embedding"]),
    ]
    weights["image_w"] = f32(p["image_w"])
    pixels = helper.make_tensor_value_info("pixels", TensorProto.FLOAT, ["n", 3, SIZE, SIZE])
    save(nodes, [pixels], weights, out / "image.onnx")

    word = f32(p["word"]).copy()
    word[0] = 0
    weights = {
        "table": table.astype(np.int32),
        "word": word,
        "pair": f32(p["pair"]),
        "pair_bias": f32(p["pair_bias"]),
        "text_w": f32(p["text_w"]),
    }
    nodes = [
        # A text is read up to its end, as CLIP does: what follows is the id 0, which means nothing.
        helper.make_node("Equal", ["ids", "end_mark"], ["is_end"]),
        helper.make_node("Cast", ["is_end"], ["ends"], to=TensorProto.FLOAT),
        helper.make_node("CumSum", ["ends", "along"], ["ended"], exclusive=1),
        helper.make_node("Sub", ["one", "ended"], ["within"]),
        helper.make_node("Relu", ["within"], ["counts"]),
        helper.make_node("Cast", ["counts"], ["counts_wide"], to=TensorProto.INT64),
        helper.make_node("Mul", ["ids", "counts_wide"], ["read"]),
        helper.make_node("Gather", ["table", "read"], ["rows"], axis=0),
        helper.make_node("Gather", ["word", "rows"], ["e"], axis=0),
        helper.make_node("ReduceSum", ["e", "axis"], ["sum"], keepdims=0),
        helper.make_node("Transpose", ["e"], ["et"], perm=[0, 2, 1]),
        helper.make_node("Conv", ["et", "pair", "pair_bias"], ["pairs"], pads=[1, 1], strides=[1], dilations=[1]),
        helper.make_node("Relu", ["pairs"], ["active"]),
        helper.make_node("ReduceMax", ["active"], ["top"], axes=[2], keepdims=0),
        helper.make_node("Concat", ["sum", "top"], ["pooled"], axis=1),
        helper.make_node("MatMul", ["pooled", "text_w"], ["embedding"]),
    ]
    weights |= {"axis": np.array([1], np.int64), "along": np.array(1, np.int64), "end_mark": np.array(49407, np.int64), "one": np.array(1, np.float32)}
    ids = helper.make_tensor_value_info("ids", TensorProto.INT64, ["n", CONTEXT])
    save(nodes, [ids], weights, out / "text.onnx")


# ---------------------------------------------------------------------------------------------------------------- main


def main():
    ap = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ap.add_argument("--crops", type=pathlib.Path, required=True, help="folder of scenes with crops and truth")
    ap.add_argument("--out", type=pathlib.Path, required=True, help="folder for image.onnx and text.onnx")
    ap.add_argument("--steps", type=int, default=3000, help="training steps (default 3000)")
    ap.add_argument("--batch", type=int, default=192, help="crops a step (default 192)")
    ap.add_argument("--seed", type=int, default=0, help="seed (default 0)")
    args = ap.parse_args()

    pixels, texts, scenes, tokens = load(args.crops)  # tokens: text -> list of CLIP ids without start and end
    known = sorted({i for ids in tokens.values() for i in ids})
    spare = 64  # rows that all other ids share by their remainder: unknown words differ, and mean nothing
    table = 1 + len(known) + np.arange(VOCABULARY) % spare
    table[known] = 1 + np.arange(len(known))
    table[[0, START, END]] = 0
    if 0 in known:
        sys.exit("token 0 is used by a caption and cannot be padding")
    rows_of = {t: table[np.array([START, *ids[: CONTEXT - 2], END] + [0] * (CONTEXT - 2 - len(ids)))] for t, ids in tokens.items()}

    rng = np.random.default_rng(args.seed)
    held = scenes % 10 == 9
    pool, test = np.flatnonzero(~held), np.flatnonzero(held)
    all_texts = sorted({t for ts in texts for t in ts})
    print(f"{len(pixels)} crops of {scenes.max() + 1} scenes, {len(test)} held out, {len(all_texts)} texts, {len(known)} words")

    # Rare captions must be seen too: draw a text first, by the square root of how often it occurs, then one of its crops.
    by_text = {}
    for i in pool:
        for t in texts[i]:
            by_text.setdefault(t, []).append(i)
    names = sorted(by_text)
    weight = np.sqrt([len(by_text[t]) for t in names])
    weight /= weight.sum()

    p, s = init(1 + len(known) + spare, jax.random.PRNGKey(args.seed))
    m = jax.tree_util.tree_map(jnp.zeros_like, p)
    v = jax.tree_util.tree_map(jnp.zeros_like, p)
    started = time.time()
    for t in range(1, args.steps + 1):
        drawn = [names[i] for i in rng.choice(len(names), args.batch, p=weight)]
        crops = [by_text[t_][rng.integers(len(by_text[t_]))] for t_ in drawn]
        same = np.array([[b in texts[i] for b in drawn] for i in crops], np.float32)
        rows = np.stack([rows_of[d] for d in drawn])
        lr = 2e-3 * min(1, t / 100) * 0.5 * (1 + np.cos(np.pi * t / args.steps))
        p, s, m, v, loss = step(p, s, m, v, t, lr, augment(pixels[crops], rng), rows, same)
        if t % 100 == 0 or t == args.steps:
            print(f"step {t}/{args.steps} loss {float(loss):.4f} {time.time() - started:.0f} s", flush=True)

    # Retrieval on scenes never trained on: is the best of all whole-thing names one of the crop's own texts?
    plain = (pixels[test].astype(np.float32) / 255 - MEAN[:, None, None]) / STD[:, None, None]
    a = np.concatenate([unit(encode_image(p, s, plain[i : i + 256], False)[0]) for i in range(0, len(plain), 256)])
    b = np.asarray(unit(encode_text(p, np.stack([rows_of[t] for t in all_texts]))))
    best = (a @ b.T).argmax(1)
    print(f"held-out crops whose best of {len(all_texts)} texts is right: {np.mean([all_texts[j] in texts[i] for i, j in zip(test, best)]):.3f}")
    args.out.mkdir(parents=True, exist_ok=True)
    export(p, s, table, args.out)
    size = sum((args.out / f).stat().st_size for f in ("image.onnx", "text.onnx"))
    print(f"wrote {args.out}/image.onnx and text.onnx, {size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
