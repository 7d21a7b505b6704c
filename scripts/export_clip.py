#!/usr/bin/env python3
"""Exports an open_clip model as the folder that `mask-embed embed --clip` and `eval query --clip` take.

    pip install torch open_clip_torch onnx onnxruntime
    python scripts/export_clip.py --out models/clip-vit-b-16                       (LangSplat's and OpenGaussian's model)
    python scripts/export_clip.py --model ViT-L-14 --pretrained openai --out models/clip-vit-l-14
    python scripts/export_clip.py --list

Run it where a model hub can be reached, or give --pretrained the path of a checkpoint; then copy the folder. It holds

    image.onnx   pixels f32 [n, 3, S, S] -> image_embeds f32 [n, d]
    text.onnx    input_ids i64 [n, 77]   -> text_embeds f32 [n, d]
    clip.json    name, dimension, image_size, mean, std, context_length

Neither output is scaled to unit length; the programs do that. Models with another tokenizer than CLIP's byte pairs
(SigLIP, CoCa with its own vocabulary, XLM-Roberta) are refused: the programs could not feed them. Where onnxruntime is
installed both files are run and compared with PyTorch.
"""

import argparse
import json
import pathlib
import sys


def fail(message):
    print(f"export_clip: {message}", file=sys.stderr)
    sys.exit(2)


try:
    import numpy as np
    import open_clip
    import torch
except ImportError as e:
    fail(f"the Python package {e.name} is missing: pip install torch open_clip_torch onnx onnxruntime")


class ImageEncoder(torch.nn.Module):
    def __init__(self, model):
        super().__init__()
        self.model = model

    def forward(self, pixels):
        return self.model.encode_image(pixels)


class TextEncoder(torch.nn.Module):
    def __init__(self, model):
        super().__init__()
        self.model = model

    def forward(self, input_ids):
        return self.model.encode_text(input_ids)


def export(module, example, path, input_name, output_name):
    options = dict(
        input_names=[input_name],
        output_names=[output_name],
        dynamic_axes={input_name: {0: "n"}, output_name: {0: "n"}},
        opset_version=17,
    )
    with torch.no_grad():
        expected = module(example).numpy()
        try:
            torch.onnx.export(module, (example,), str(path), dynamo=False, **options)
        except TypeError:  # before torch 2.5 there is one exporter and no choice
            torch.onnx.export(module, (example,), str(path), **options)
    try:
        import onnxruntime
    except ImportError:
        print(f"{path}: written, not compared (onnxruntime is not installed)")
        return expected.shape[1]
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    # A batch of another size than the example's, to see that the axis is free.
    twice = np.concatenate([example.numpy()] * 2)
    found = session.run([output_name], {input_name: twice})[0]
    cosine = [float(a @ b / np.linalg.norm(a) / np.linalg.norm(b)) for a, b in zip(found, np.concatenate([expected] * 2))]
    print(f"{path}: least cosine to PyTorch {min(cosine):.6f}")
    if min(cosine) < 0.9999:
        fail(f"{path} does not agree with PyTorch")
    return expected.shape[1]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", default="ViT-B-16", help="open_clip's name of the architecture (default ViT-B-16)")
    parser.add_argument(
        "--pretrained", default="laion2b_s34b_b88k", help="tag or checkpoint file (default laion2b_s34b_b88k)"
    )
    parser.add_argument("--out", type=pathlib.Path, help="folder to write")
    parser.add_argument("--list", action="store_true", help="list models and tags, then stop")
    args = parser.parse_args()
    if args.list:
        for model, tag in open_clip.list_pretrained():
            print(model, tag)
        return
    if args.out is None:
        fail("--out is missing")

    tokenizer = open_clip.get_tokenizer(args.model)
    if type(tokenizer).__name__ != "SimpleTokenizer":
        fail(f"{args.model} has the tokenizer {type(tokenizer).__name__}, not CLIP's byte pairs")
    model, _, _ = open_clip.create_model_and_transforms(args.model, pretrained=args.pretrained, precision="fp32")
    model = model.eval().float()
    torch.backends.mha.set_fastpath_enabled(False)  # a fused operator that ONNX does not have

    size = model.visual.image_size
    if isinstance(size, (tuple, list)):
        if size[0] != size[1]:
            fail(f"{args.model} takes pictures of {size}, not squares")
        size = size[0]
    length = getattr(model, "context_length", 77)
    mean = getattr(model.visual, "image_mean", None) or open_clip.OPENAI_DATASET_MEAN
    std = getattr(model.visual, "image_std", None) or open_clip.OPENAI_DATASET_STD

    args.out.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(0)
    pixels = torch.randn(2, 3, size, size)
    ids = tokenizer(["a photo of a cat", "a desk with a laptop and a kettle"], context_length=length).to(torch.int64)
    image_dim = export(ImageEncoder(model), pixels, args.out / "image.onnx", "pixels", "image_embeds")
    text_dim = export(TextEncoder(model), ids, args.out / "text.onnx", "input_ids", "text_embeds")
    if image_dim != text_dim:
        fail(f"image features have {image_dim} numbers, text features {text_dim}")
    config = {
        "name": f"{args.model} {pathlib.Path(args.pretrained).name}",
        "dimension": image_dim,
        "image_size": int(size),
        "mean": list(mean),
        "std": list(std),
        "context_length": int(length),
    }
    (args.out / "clip.json").write_text(json.dumps(config, indent=2) + "\n")
    print(f"{args.out}/: image.onnx, text.onnx, clip.json")


if __name__ == "__main__":
    main()
