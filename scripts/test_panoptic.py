#!/usr/bin/env python3
"""DETR-ResNet-50 of full size with random weights: the program's segments of a photograph beside transformers'.

    scripts/test_panoptic.py [--photo JPEG] [--out FOLDER]

Needs PyPI torch, transformers (4.40) and pillow; without them it says SKIPPED. Both see a photograph that has the model's size
already, so that only the run of the graph and the rules can differ. The model takes 170 MB in FOLDER, and minutes to make.
"""
import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

try:
    import numpy as np
    import torch
    import transformers
    from PIL import Image
except ImportError as missing:
    print(f"SKIPPED: a panoptic model of full size: {missing} (pip install torch transformers pillow; PYTHON names another python3)")
    sys.exit(0)

ROOT = Path(__file__).resolve().parent.parent
# Random masks claim much of the photograph: what gets a hundredth of that is a segment.
RULE = {"threshold": 0.5, "mask_threshold": 0.3, "overlap": 0.01}


class Tuples(torch.nn.Module):
    def __init__(self, model):
        super().__init__()
        self.model = model

    def forward(self, pixel_values, pixel_mask):
        answer = self.model(pixel_values=pixel_values, pixel_mask=pixel_mask)
        return answer.logits, answer.pred_boxes, answer.pred_masks


def random_model(pixels):
    """DETR whose queries differ on this picture; with plain random weights all give the same mask."""
    backbone = transformers.ResNetConfig(out_features=["stage1", "stage2", "stage3", "stage4"])
    config = transformers.DetrConfig(use_timm_backbone=False, backbone=None, backbone_config=backbone, use_pretrained_backbone=False, num_labels=250)
    model = transformers.DetrForSegmentation(config).eval()
    inner, heads = model.detr.model, model.mask_head
    # What the backbone sees is nearly the same everywhere: keep the differences.
    features = inner.input_projection(inner.backbone.conv_encoder(pixels, torch.ones(1, *pixels.shape[2:], dtype=torch.int64))[-1][0])
    std, mean = torch.std_mean(features, (0, 2, 3))
    inner.input_projection.bias.sub_(mean).div_(std)
    inner.input_projection.weight.div_(std[:, None, None, None])
    # Queries look at different places.
    inner.query_position_embeddings.weight.mul_(50)
    [w.mul_(5) for w in inner.decoder.parameters() if w.dim() == 2]
    [layer.weight.mul_(8) for layer in (model.bbox_attention.q_linear, model.bbox_attention.k_linear)]
    heads.lay1.weight[:, -8:].mul_(100)
    # Logits of masks of about 1.
    heads.out_lay.bias.sub_(0.09).mul_(16)
    heads.out_lay.weight.mul_(16)
    return model


def make(photo, folder):
    torch.manual_seed(0)
    (folder / "onnx").mkdir(parents=True, exist_ok=True)
    processor = transformers.DetrImageProcessor()
    scale = min(800 / min(photo.size), 1333 / max(photo.size))
    photo = photo.resize([round(n * scale) for n in photo.size], Image.BILINEAR)
    pixels = processor(images=photo, return_tensors="pt")["pixel_values"]
    assert pixels.shape[:1:-1] == photo.size
    with torch.no_grad():
        model, inputs = random_model(pixels), (pixels, torch.ones(1, 64, 64, dtype=torch.int64))
        head, seen = model.detr.class_labels_classifier, []
        hook = head.register_forward_hook(lambda head, features, logits: seen.append(features[0]))
        answer = model(*inputs)
        hook.remove()
        # Random classes are unsure: larger weights make a dozen sure.
        while (answer.logits.softmax(-1).max(-1).values > RULE["threshold"]).sum() < 12:
            head.weight.mul_(1.2)
            answer.logits = head(seen[0])
        free = {"pixel_values": {0: "batch", 2: "height", 3: "width"}, "pixel_mask": {0: "batch"}}
        names = {"input_names": ["pixel_values", "pixel_mask"], "output_names": ["logits", "pred_boxes", "pred_masks"]}
        torch.onnx.export(Tuples(model), inputs, str(folder / "onnx/model.onnx"), dynamic_axes=free, opset_version=12, **names)
    model.config.save_pretrained(folder)
    processor.save_pretrained(folder)
    (folder / "model.json").write_text(json.dumps(RULE))
    result = processor.post_process_panoptic_segmentation(
        answer, RULE["threshold"], RULE["mask_threshold"], RULE["overlap"], target_sizes=[photo.size[::-1]])[0]
    segments = [{"name": model.config.id2label[s["label_id"]], "score": s["score"]} for s in result["segments_info"]]
    (folder / "segments.json").write_text(json.dumps(segments))
    photo.save(folder / "photo.png")
    Image.fromarray(result["segmentation"].numpy().astype(np.uint8)).save(folder / "ids.png")
    print(f"{photo.width} x {photo.height} pixels, {len(segments)} segments by transformers {transformers.__version__}", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photo", type=Path, default=ROOT / "../shared/data/desk/images/input_0001.jpg", help="any photograph")
    parser.add_argument("--out", type=Path, default=ROOT / "out/panoptic-random", help="where the model is written, or was by an earlier run")
    args = parser.parse_args()
    if not (args.out / "ids.png").exists():
        make(Image.open(args.photo).convert("RGB"), args.out)
    test = ["cargo", "test", "--release", "-p", "mask-embed", "--test", "full_panoptic", "--", "--ignored", "--nocapture"]
    subprocess.run(test, cwd=ROOT, env={**os.environ, "PANOPTIC_TEST": str(args.out.resolve())}, check=True)


if __name__ == "__main__":
    main()
