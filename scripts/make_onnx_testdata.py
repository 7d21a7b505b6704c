#!/usr/bin/env python3
"""Writes the small ONNX models that the Rust tests run. Needs the Python packages numpy and onnx.

    python3 -m venv /tmp/onnx-venv && /tmp/onnx-venv/bin/pip install numpy onnx
    /tmp/onnx-venv/bin/python scripts/make_onnx_testdata.py

crates/lib/onnx-models/testdata/ops.onnx         floats and integers in, sum, product and a value in between
crates/lib/onnx-models/testdata/argmax.onnx      where the largest id of each row is
crates/lib/onnx-models/testdata/clip/            a dual encoder whose features can be computed by hand
crates/stages/explore/testdata/slow/             a text encoder that takes most of a second for each run
crates/stages/mask-embed/testdata/sam/           a segmenter by colour with the inputs and outputs of SAM
crates/stages/mask-embed/testdata/sam2/          the same with the inputs and outputs of SAM 2.1's exports, described by model.json
crates/stages/mask-embed/testdata/efficient-sam/ the same as EfficientSAM's
crates/stages/mask-embed/testdata/sam2-hub/      the same as the Hugging Face hub's SAM 2.1
crates/stages/mask-embed/testdata/sam-hub/       and its first SAM
crates/stages/mask-embed/testdata/edge-sam/      the same as EdgeSAM's
crates/stages/mask-embed/testdata/sam-tiny/      encoder and decoder with MobileSAM's architecture and names, narrow and with random weights
crates/stages/mask-embed/testdata/panoptic-*/    panoptic segmenters by colour with the inputs and outputs of DETR, Mask2Former,
                                                 OneFormer and EoMT, and the segments of a photograph by transformers
crates/stages/mask-embed/testdata/concepts-*/    segmenters of what nouns name, by colour, with the inputs and outputs of exports of SAM 3
                                                 and EfficientSAM3, and what they see of that photograph

The segments need torch, transformers and pillow too, EoMT's a transformers that has it (4.53); without, those there stay.
"""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from onnx import TensorProto, checker, helper, numpy_helper, save

ROOT = Path(__file__).resolve().parent.parent
F, I64 = TensorProto.FLOAT, TensorProto.INT64


def value(name, kind, shape):
    return helper.make_tensor_value_info(name, kind, shape)


def constant(name, array):
    return numpy_helper.from_array(np.asarray(array), name)


def write(path, nodes, inputs, outputs, constants=()):
    graph = helper.make_graph(nodes, path.stem, inputs, outputs, list(constants))
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8, producer_name="testdata")
    checker.check_model(model)
    path.parent.mkdir(parents=True, exist_ok=True)
    save(model, path)
    print(f"{path.relative_to(ROOT)}: {path.stat().st_size} bytes")


def ops():
    """sum = a + b and product = (a + b) * 2 + b, for floats a and integers b of any number of rows."""
    node = helper.make_node
    write(
        ROOT / "crates/lib/onnx-models/testdata/ops.onnx",
        [
            node("Cast", ["b"], ["b_float"], to=F),
            node("Add", ["a", "b_float"], ["sum"]),
            node("Mul", ["sum", "two"], ["twice"]),
            node("Add", ["twice", "b_float"], ["product"]),
            node("Add", ["b", "b"], ["b_twice"]),
        ],
        [value("a", F, ["n", 3]), value("b", I64, ["n", 3])],
        [value("sum", F, ["n", 3]), value("product", F, ["n", 3]), value("b_twice", I64, ["n", 3])],
        [constant("two", np.float32(2))],
    )


def argmax():
    """Where the largest of the ids of each row is."""
    write(
        ROOT / "crates/lib/onnx-models/testdata/argmax.onnx",
        [helper.make_node("ArgMax", ["ids"], ["end"], axis=-1, keepdims=0)],
        [value("ids", I64, ["n", "l"])],
        [value("end", I64, ["n"])],
    )


def clip():
    """Image feature: mean of each channel, and 1. Text feature: how many ids are 0, 1, 2, 3 modulo 4."""
    node = helper.make_node
    folder = ROOT / "crates/lib/onnx-models/testdata/clip"
    write(
        folder / "image.onnx",
        [
            node("ReduceMean", ["pixels"], ["means"], axes=[2, 3], keepdims=0),
            node("MatMul", ["means", "weights"], ["spread"]),
            node("Add", ["spread", "bias"], ["image_embeds"]),
        ],
        [value("pixels", F, ["n", 3, 8, 8])],
        [value("image_embeds", F, ["n", 4])],
        [constant("weights", np.eye(3, 4, dtype=np.float32)), constant("bias", np.array([0, 0, 0, 1], np.float32))],
    )
    write(
        folder / "text.onnx",
        [
            node("Mod", ["input_ids", "four"], ["kind"]),
            node("Gather", ["table", "kind"], ["each"]),
            node("ReduceSum", ["each", "axis"], ["text_embeds"], keepdims=0),
        ],
        [value("input_ids", I64, ["n", 77])],
        [value("text_embeds", F, ["n", 4])],
        [
            constant("four", np.int64(4)),
            constant("table", np.eye(4, dtype=np.float32)),
            constant("axis", np.array([1], np.int64)),
        ],
    )
    config = '{\n  "name": "test-clip",\n  "dimension": 4,\n  "image_size": 8,\n  "mean": [0, 0, 0],\n  "std": [1, 1, 1]\n}\n'
    (folder / "clip.json").write_text(config)


def slow():
    """Text feature: along the first axis, once large products of zeros are made. No weights, much work."""
    node = helper.make_node
    folder = ROOT / "crates/stages/explore/testdata/slow"
    products = [node("MatMul", [f"square_{k}", f"square_{k}"], [f"square_{k + 1}"]) for k in range(24)]
    write(
        folder / "text.onnx",
        [
            node("Cast", ["input_ids"], ["floats"], to=F),
            node("ReduceMax", ["floats"], ["most"], keepdims=0),
            # From the input, or the engine would do the work when it opens the graph.
            node("Mul", ["most", "nothing"], ["zero"]),
            node("Expand", ["zero", "side"], ["square_0"]),
            *products,
            node("ReduceMax", [products[-1].output[0]], ["still_zero"], keepdims=0),
            node("ReduceMean", ["floats"], ["mean"], axes=[1]),
            node("Mul", ["mean", "axis"], ["along"]),
            node("Add", ["along", "still_zero"], ["text_embeds"]),
        ],
        [value("input_ids", I64, ["n", "l"])],
        [value("text_embeds", F, ["n", 2])],
        [
            constant("nothing", np.float32(0)),
            constant("side", np.array([1024, 1024], np.int64)),
            constant("axis", np.array([[1, 0]], np.float32)),
        ],
    )
    (folder / "clip.json").write_text('{\n  "name": "slow",\n  "dimension": 2\n}\n')


def sam():
    """The encoder shrinks the picture by 4; a mask is what has nearly the colour under the prompt.

    Four masks as SAM makes them: a threshold each on the colour distance (in units of the normalised picture), the first
    for prompts of several points. As in SAM's own export only the best of the last three is declared as an output.
    """
    node = helper.make_node
    folder = ROOT / "crates/stages/mask-embed/testdata/sam"
    write(
        folder / "encoder.onnx",
        [node("AveragePool", ["input"], ["output"], kernel_shape=[4, 4], strides=[4, 4])],
        [value("input", F, ["batch_size", 3, 1024, 1024])],
        [value("output", F, ["batch_size", 3, 256, 256])],
    )
    write(
        folder / "sam.onnx",
        [
            # Colour under the first point.
            node("Slice", ["point_coords", "zero1", "one1", "one1"], ["first_point"]),
            node("Div", ["first_point", "four"], ["cell_float"]),
            node("Cast", ["cell_float"], ["cell_xy"], to=I64),
            node("Gather", ["cell_xy", "yx"], ["cell_yx"], axis=2),
            node("Reshape", ["cell_yx", "shape_2"], ["cell"]),
            node("Transpose", ["image_embeddings"], ["channels_last"], perm=[0, 2, 3, 1]),
            node("Squeeze", ["channels_last", "zero1"], ["picture"]),
            node("GatherND", ["picture", "cell"], ["color"]),
            node("Sub", ["picture", "color"], ["difference"]),
            node("Abs", ["difference"], ["absolute"]),
            node("ReduceMax", ["absolute"], ["distance"], axes=[2], keepdims=0),
            # Four masks: logits are 20 (threshold - distance).
            node("Sub", ["thresholds", "distance"], ["margin"]),
            node("Mul", ["margin", "twenty"], ["all_masks_3d"]),
            node("Unsqueeze", ["all_masks_3d", "zero1"], ["all_masks"]),
            # The model's own opinion of each; the inputs without use here must not vanish from the graph's interface.
            node("ReduceMax", ["mask_input"], ["no_mask"], keepdims=0),
            node("ReduceMax", ["has_mask_input"], ["no_has"], keepdims=0),
            node("ReduceMax", ["point_labels"], ["label"], keepdims=0),
            node("ReduceMax", ["orig_im_size"], ["no_size"], keepdims=0),
            node("Mul", ["no_mask", "no_has"], ["nothing_1"]),
            node("Mul", ["nothing_1", "no_size"], ["nothing_2"]),
            node("Mul", ["nothing_2", "label"], ["nothing"]),
            node("Add", ["quality", "nothing"], ["all_quality"]),
            # The choice, as in SAM's export: index of the best of the last three, rows of flattened arrays.
            node("Add", ["all_quality", "reweight"], ["weighed"]),
            node("ArgMax", ["weighed"], ["best"], axis=1, keepdims=0),
            node("Flatten", ["all_masks_3d"], ["mask_rows"], axis=1),
            node("Gather", ["mask_rows", "best"], ["best_mask"]),
            node("Reshape", ["best_mask", "shape_mask"], ["best_masks"]),
            node("Unsqueeze", ["best_masks", "one1"], ["low_res_masks"]),
            node("Flatten", ["all_quality"], ["flat_quality"], axis=0),
            node("Gather", ["flat_quality", "best"], ["best_quality"], axis=1),
            node("Reshape", ["best_quality", "one1"], ["best_qualities"]),
            node("Unsqueeze", ["best_qualities", "one1"], ["iou_predictions"]),
            node("Identity", ["low_res_masks"], ["masks"]),
        ],
        [
            value("image_embeddings", F, [1, 3, 256, 256]),
            value("point_coords", F, [1, "num_points", 2]),
            value("point_labels", F, [1, "num_points"]),
            value("mask_input", F, [1, 1, 256, 256]),
            value("has_mask_input", F, [1]),
            value("orig_im_size", F, [2]),
        ],
        [
            value("masks", F, [1, 1, "height", "width"]),
            value("iou_predictions", F, [1, 1]),
            value("low_res_masks", F, [1, 1, 256, 256]),
        ],
        [
            constant("zero1", np.array([0], np.int64)),
            constant("one1", np.array([1], np.int64)),
            constant("yx", np.array([1, 0], np.int64)),
            constant("shape_2", np.array([2], np.int64)),
            constant("four", np.float32(4)),
            constant("twenty", np.float32(20)),
            constant("thresholds", np.array([0.3, 0.15, 0.6, 1.2], np.float32).reshape(4, 1, 1)),
            constant("quality", np.array([[0.5, 0.9, 0.95, 0.9]], np.float32)),
            constant("reweight", np.array([[-1000, 0, 0, 0]], np.float32)),
            constant("shape_mask", np.array([1, 256, 256], np.int64)),
        ],
    )


def by_color(points, unused):
    """Masks [4, 256, 256] and their qualities [1, 4] for a point in pixels of 1024, of the colours `picture` [1, 3, 256, 256];
    the arrays `unused` are read and change nothing."""
    node = helper.make_node
    nodes = [
        node("Reshape", [points, "every_2"], ["pairs"]),
        node("Gather", ["pairs", "zero"], ["first_point"]),
        node("Div", ["first_point", "four"], ["cell_float"]),
        node("Cast", ["cell_float"], ["cell_xy"], to=I64),
        node("Gather", ["cell_xy", "yx"], ["cell"]),
        node("Transpose", ["picture"], ["channels_last"], perm=[0, 2, 3, 1]),
        node("Squeeze", ["channels_last", "zero1"], ["colors"]),
        node("GatherND", ["colors", "cell"], ["color"]),
        node("Sub", ["colors", "color"], ["difference"]),
        node("Abs", ["difference"], ["absolute"]),
        node("ReduceMax", ["absolute"], ["distance"], axes=[2], keepdims=0),
        node("Sub", ["thresholds", "distance"], ["margin"]),
        node("Mul", ["margin", "twenty"], ["all_masks"]),
    ]
    last = "quality"
    for i, name in enumerate(unused):
        nodes += [
            node("Cast", [name], [f"float_{i}"], to=F),
            node("ReduceMax", [f"float_{i}"], [f"most_{i}"], keepdims=0),
            node("Mul", [f"most_{i}", "nothing"], [f"nothing_{i}"]),
            node("Add", [last, f"nothing_{i}"], [f"quality_{i}"]),
        ]
        last = f"quality_{i}"
    nodes.append(node("Identity", [last], ["all_quality"]))
    constants = [
        constant("every_2", np.array([-1, 2], np.int64)),
        constant("zero", np.int64(0)),
        constant("zero1", np.array([0], np.int64)),
        constant("yx", np.array([1, 0], np.int64)),
        constant("four", np.float32(4)),
        constant("twenty", np.float32(20)),
        constant("nothing", np.float32(0)),
        constant("thresholds", np.array([0.3, 0.15, 0.6, 1.2], np.float32).reshape(4, 1, 1)),
        constant("quality", np.array([[0.5, 0.9, 0.95, 0.9]], np.float32)),
    ]
    return nodes, constants


def exports():
    """Other exports' inputs and outputs, by the scripts that make them (docs/masks.md)."""
    node = helper.make_node
    pool = lambda n, to, of="image": node("AveragePool", [of], [to], kernel_shape=[n, n], strides=[n, n])
    three = [
        node("Slice", ["all_masks", "from_1", "to_4", "zero1"], ["three_masks"]),
        node("Slice", ["all_quality", "from_1", "to_4", "from_1"], ["three_scores"]),
    ]
    three_constants = [constant("from_1", np.array([1], np.int64)), constant("to_4", np.array([4], np.int64))]
    stages = ROOT / "crates/stages/mask-embed/testdata"

    folder = stages / "sam2"
    features = [("high_res_feats_0", 256), ("high_res_feats_1", 128), ("image_embed", 64)]
    feature_values = [value(name, F, [1, 3, n, n]) for name, n in features]
    encoder = [pool(1024 // n, name) for name, n in features]
    write(folder / "encoder.onnx", encoder, [value("image", F, [1, 3, 1024, 1024])], feature_values)
    nodes, constants = by_color("point_coords", ["image_embed", "high_res_feats_1", "point_labels", "mask_input", "has_mask_input"])
    write(
        folder / "decoder.onnx",
        [node("Identity", ["high_res_feats_0"], ["picture"]), *nodes, *three]
        + [node("Unsqueeze", ["three_masks", "zero1"], ["masks"]), node("Identity", ["three_scores"], ["iou_predictions"])],
        [
            *reversed(feature_values),
            value("point_coords", F, ["num_labels", "num_points", 2]),
            value("point_labels", F, ["num_labels", "num_points"]),
            value("mask_input", F, ["num_labels", 1, 256, 256]),
            value("has_mask_input", F, ["num_labels"]),
        ],
        [value("masks", F, [1, 3, 256, 256]), value("iou_predictions", F, [1, 3])],
        constants + three_constants,
    )

    # As the hub has them: more axes, other names, and for SAM 2.1 boxes, of which none is given.
    boxes = [
        # A box that is given spoils the scores.
        node("Shape", ["input_boxes"], ["extents"]),
        node("Gather", ["extents", "from_1"], ["boxes"]),
        node("Cast", ["boxes"], ["boxes_float"], to=F),
        node("Sub", ["three_scores", "boxes_float"], ["unboxed"]),
    ]
    for name, features, unboxed in [
        ("sam2-hub", [("image_embeddings.0", 256), ("image_embeddings.1", 128), ("image_embeddings.2", 64)], boxes),
        ("sam-hub", [("image_embeddings", 256), ("image_positional_embeddings", 64)], [node("Identity", ["three_scores"], ["unboxed"])]),
    ]:
        feature_values = [value(feature, F, [1, 3, n, n]) for feature, n in features]
        encoder = [pool(1024 // n, feature, "pixel_values") for feature, n in features]
        write(stages / name / "vision_encoder.onnx", encoder, [value("pixel_values", F, [1, 3, 1024, 1024])], feature_values)
        nodes, constants = by_color("input_points", [feature for feature, _ in features[1:]] + ["input_labels"])
        write(
            stages / name / "prompt_encoder_mask_decoder.onnx",
            [node("Identity", [features[0][0]], ["picture"]), *nodes, *three]
            + [node("Unsqueeze", ["three_masks", "axes"], ["pred_masks"]), *unboxed, node("Unsqueeze", ["unboxed", "zero1"], ["iou_scores"])],
            [value("input_points", F, ["batch", 1, "num_points", 2]), value("input_labels", I64, ["batch", 1, "num_points"])]
            + ([value("input_boxes", F, ["batch", "num_boxes", 4])] if unboxed is boxes else [])
            + feature_values,
            [value("iou_scores", F, [1, 1, 3]), value("pred_masks", F, [1, 1, 3, 256, 256])],
            [*constants, *three_constants, constant("axes", np.array([0, 1], np.int64))],
        )

    folder = stages / "efficient-sam"
    write(
        folder / "encoder.onnx",
        [
            node("Sub", ["batched_images", "mean"], ["centred"]),
            node("Div", ["centred", "std"], ["normed"]),
            pool(4, "image_embeddings", "normed"),
        ],
        [value("batched_images", F, ["batch", 3, "height", "width"])],
        [value("image_embeddings", F, ["batch", 3, "small_height", "small_width"])],
        [
            constant("mean", np.array([0.485, 0.456, 0.406], np.float32).reshape(1, 3, 1, 1)),
            constant("std", np.array([0.229, 0.224, 0.225], np.float32).reshape(1, 3, 1, 1)),
        ],
    )
    nodes, constants = by_color("rescaled", ["batched_point_labels"])
    write(
        folder / "decoder.onnx",
        [
            node("Cast", ["orig_im_size"], ["size"], to=F),
            node("Div", ["side", "size"], ["scale"]),
            node("Mul", ["batched_point_coords", "scale"], ["rescaled"]),
            node("Identity", ["image_embeddings"], ["picture"]),
            *nodes,
            *three,
            node("Unsqueeze", ["three_masks", "axes"], ["output_masks"]),
            node("Unsqueeze", ["three_scores", "zero1"], ["iou_predictions"]),
        ],
        [
            value("image_embeddings", F, ["batch", 3, 256, 256]),
            value("batched_point_coords", F, [1, "num_points", 1, 2]),
            value("batched_point_labels", F, [1, "num_points", 1]),
            value("orig_im_size", I64, [2]),
        ],
        [value("output_masks", F, [1, 1, 3, 256, 256]), value("iou_predictions", F, [1, 1, 3])],
        [*constants, *three_constants, constant("axes", np.array([0, 1], np.int64)), constant("side", np.float32(1024))],
    )

    folder = stages / "edge-sam"
    write(
        folder / "edge_sam_encoder.onnx",
        [pool(4, "image_embeddings")],
        [value("image", F, [1, 3, 1024, 1024])],
        [value("image_embeddings", F, [1, 3, 256, 256])],
    )
    nodes, constants = by_color("point_coords", ["point_labels"])
    write(
        folder / "edge_sam_decoder.onnx",
        [
            node("Identity", ["image_embeddings"], ["picture"]),
            *nodes,
            node("Identity", ["all_quality"], ["scores"]),
            node("Unsqueeze", ["all_masks", "zero1"], ["masks"]),
        ],
        [
            value("image_embeddings", F, [1, 3, 256, 256]),
            value("point_coords", F, [1, "num_points", 2]),
            value("point_labels", F, [1, "num_points"]),
        ],
        [value("scores", F, [1, 4]), value("masks", F, [1, 4, 256, 256])],
        constants,
    )


class Layers:
    """Operators as PyTorch's exporter writes them, with random weights."""

    def __init__(self):
        self.random = np.random.default_rng(1)
        self.nodes, self.constants = [], []

    def op(self, kind, *inputs, **attributes):
        """The name of a new value."""
        name = f"v{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, [self.name(i) for i in inputs], [name], **attributes))
        return name

    def name(self, i):
        return i if isinstance(i, str) else self.constant(f"c{len(self.constants)}", i)

    def constant(self, name, array):
        self.constants.append(constant(name, array))
        return name

    def weight(self, name, *shape):
        return self.constant(name, self.random.normal(0, shape[0] ** -0.5, shape).astype(np.float32))

    def linear(self, x, name, inputs, outputs):
        """A layer of tokens or pixels: the exporter renames its matrix."""
        product = self.op("MatMul", x, self.weight(f"onnx::MatMul_{len(self.nodes)}", inputs, outputs))
        return self.op("Add", self.weight(f"{name}.bias", outputs), product)

    def norm(self, x, name, width):
        scale = self.constant(f"{name}.weight", self.random.uniform(0.5, 1.5, width).astype(np.float32))
        return self.op("LayerNormalization", x, scale, self.weight(f"{name}.bias", width), epsilon=1e-5, axis=-1)

    def gelu(self, x):
        erf = self.op("Erf", self.op("Div", x, np.float32(2**0.5)))
        return self.op("Mul", self.op("Mul", x, self.op("Add", erf, np.float32(1))), np.float32(0.5))


class Encoder(Layers):
    """MobileSAM's encoder, TinyViT (Wu et al. 2022), narrow: one block a stage, windows of 4, 6 and 3 pixels."""

    STEM, STAGES = 8, [(12, 3, 4, 2), (40, 2, 6, 1), (8, 1, 3, 1)]  # channels, heads, side of a window, growth of the MLP

    def conv(self, x, name, inputs, outputs, side=1, stride=1, group=1, bias=True):
        weight = self.random.normal(0, (inputs * side * side / group) ** -0.5, (outputs, inputs // group, side, side)).astype(np.float32)
        inputs = [x, self.constant(f"onnx::Conv_{len(self.nodes)}" if bias else f"{name.replace('/', '.')}.weight", weight)]
        inputs += [self.weight(f"onnx::Conv_{len(self.nodes)}_bias", outputs)] if bias else []
        made = f"/{name}/Conv_output_0"
        pads = [side // 2] * 4
        self.nodes.append(helper.make_node("Conv", inputs, [made], pads=pads, strides=[stride] * 2, group=group, kernel_shape=[side] * 2))
        return made

    def separable(self, x, name, inputs, inner, outputs, stride):
        x = self.gelu(self.conv(x, f"{name}/conv1/c", inputs, inner))
        x = self.gelu(self.conv(x, f"{name}/conv2/c", inner, inner, 3, stride, inner))
        return self.conv(x, f"{name}/conv3/c", inner, outputs)

    def block(self, x, stage, side, channels, heads, window, growth):
        """Of `[1, channels, side, side]`."""
        name, width, count = f"layers.{stage}.blocks.0", channels // heads, -(-side // window)
        rows = self.op("Transpose", x, perm=[0, 2, 3, 1])
        fill = count * window - side
        padded = self.op("Pad", rows, np.array([0, 0, 0, 0, 0, fill, fill, 0]))
        windows = self.op("Transpose", self.op("Reshape", padded, np.array([count, window, count, window, channels])), perm=[0, 2, 1, 3, 4])
        windows = self.op("Reshape", windows, np.array([count * count, window * window, channels]))
        qkv = self.linear(self.norm(windows, f"{name}.attn.norm", channels), f"{name}.attn.qkv", channels, 3 * channels)
        qkv = self.op("Reshape", qkv, np.array([count * count, window * window, heads, 3 * width]))
        qkv = self.op("Transpose", qkv, perm=[0, 2, 1, 3])
        q, k, v = (self.op("Slice", qkv, np.array([i * width]), np.array([(i + 1) * width]), np.array([3])) for i in range(3))
        scores = self.op("Mul", self.op("MatMul", q, self.op("Transpose", k, perm=[0, 1, 3, 2])), np.float32(width**-0.5))
        made = f"/layers.{stage}/blocks.0/attn/Add_output_0"
        places = self.random.normal(0, 1, (heads, window * window, window * window)).astype(np.float32)
        self.nodes.append(helper.make_node("Constant", [], [f"places.{stage}"], value=constant("", places)))
        self.nodes.append(helper.make_node("Add", [scores, f"places.{stage}"], [made]))
        sums = self.op("Transpose", self.op("MatMul", self.op("Softmax", made, axis=3), v), perm=[0, 2, 1, 3])
        sums = self.op("Reshape", sums, np.array([count, count, window, window, channels]))
        sums = self.op("Transpose", self.linear(sums, f"{name}.attn.proj", channels, channels), perm=[0, 2, 1, 3, 4])
        sums = self.op("Reshape", sums, np.array([1, count * window, count * window, channels]))
        sums = self.op("Slice", sums, np.array([0, 0]), np.array([side, side]), np.array([1, 2]))
        x = self.op("Transpose", self.op("Add", rows, sums), perm=[0, 3, 1, 2])
        x = self.conv(x, f"layers.{stage}/blocks.0/local_conv/c", channels, channels, 3, 1, channels)
        rows = self.op("Transpose", x, perm=[0, 2, 3, 1])
        hidden = self.linear(self.norm(rows, f"{name}.mlp.norm", channels), f"{name}.mlp.fc1", channels, growth * channels)
        rows = self.op("Add", rows, self.linear(self.gelu(hidden), f"{name}.mlp.fc2", growth * channels, channels))
        return self.op("Transpose", rows, perm=[0, 3, 1, 2])

    def norm_of_pictures(self, x, channels):
        centred = self.op("Sub", x, self.op("ReduceMean", x, axes=[1]))
        variance = self.op("ReduceMean", self.op("Pow", centred, np.float32(2)), axes=[1])
        normed = self.op("Div", centred, self.op("Sqrt", self.op("Add", variance, np.float32(1e-6))))
        scale, shift = (self.random.uniform(0.5, 1.5, (channels, 1, 1)).astype(np.float32) for _ in range(2))
        return self.op("Add", self.op("Mul", scale, normed), shift)

    def build(self, path, outputs):
        channels, side = self.STEM, 1024
        x = self.gelu(self.conv("input", "patch_embed/seq/seq.0/c", 3, channels // 2, 3, 2))
        x = self.conv(x, "patch_embed/seq/seq.2/c", channels // 2, channels, 3, 2)
        side //= 4
        x = self.gelu(self.op("Add", self.separable(x, "layers.0/blocks.0", channels, 2 * channels, channels, 1), x))
        for i, (width, heads, window, growth) in enumerate(self.STAGES):
            stride = 1 if i == 2 else 2
            x = self.separable(x, f"layers.{i}/downsample", channels, width, width, stride)
            channels, side = width, side // stride
            x = self.block(x, i + 1, side, channels, heads, window, growth)
        x = self.norm_of_pictures(self.conv(x, "neck/neck.0", channels, outputs, bias=False), outputs)
        x = self.norm_of_pictures(self.conv(x, "neck/neck.2", outputs, outputs, 3, bias=False), outputs)
        self.nodes[-1].output[0] = "output"
        write(path, self.nodes, [value("input", F, ["batch_size", 3, 1024, 1024])], [value("output", F, ["batch_size", outputs, side, side])], self.constants)


class Decoder(Layers):
    """SAM's mask decoder (Kirillov et al. 2023, appendix A) as PyTorch's exporter writes it, narrow."""

    WIDTH, INNER, HEADS, SIDE = 16, 8, 8, 64

    def heads(self, x, width):
        split = self.op("Reshape", x, np.array([1, -1, self.HEADS, width // self.HEADS]))
        return self.op("Transpose", split, perm=[0, 2, 1, 3])

    def attention(self, name, q, k, v, inner):
        q, k, v = (self.heads(self.linear(x, f"{name}.{p}_proj", self.WIDTH, inner), inner) for x, p in ((q, "q"), (k, "k"), (v, "v")))
        scores = self.op("MatMul", q, self.op("Transpose", k, perm=[0, 1, 3, 2]))
        weights = self.op("Softmax", self.op("Div", scores, np.float32((inner / self.HEADS) ** 0.5)), axis=-1)
        sums = self.op("Transpose", self.op("MatMul", weights, v), perm=[0, 2, 1, 3])
        return self.linear(self.op("Reshape", sums, np.array([1, -1, inner])), f"{name}.out_proj", inner, self.WIDTH)

    def mlp(self, x, name, outputs):
        for i in range(3):
            n = outputs if i == 2 else self.WIDTH
            weight, bias = self.weight(f"{name}.layers.{i}.weight", n, self.WIDTH), self.weight(f"{name}.layers.{i}.bias", n)
            x = self.op("Gemm", x, weight, bias, transB=1)
            x = x if i == 2 else self.op("Relu", x)
        return x

    def enlarge(self, x, name, inputs, outputs):
        weight, bias = self.weight(f"{name}.weight", inputs, outputs, 2, 2), self.weight(f"{name}.bias", outputs)
        return self.op("ConvTranspose", x, weight, bias, strides=[2, 2], dilations=[1, 1], kernel_shape=[2, 2])

    def tokens(self):
        """Those of the predicted IoU, of four masks, and of the points."""
        place = self.op("Sub", self.op("Div", "point_coords", np.float32(512)), np.float32(1))
        angle = self.op("Mul", self.op("MatMul", place, self.weight("frequencies", 2, self.WIDTH // 2)), np.float32(2 * np.pi))
        place = self.op("Concat", self.op("Sin", angle), self.op("Cos", angle), axis=-1)
        label = self.op("Unsqueeze", "point_labels", np.array([2]))
        points = self.op("Add", self.op("Mul", place, self.op("Relu", label)), self.op("Mul", label, self.weight("label", self.WIDTH)))
        own = self.constant("own", self.random.normal(0, 1, (1, 5, self.WIDTH)).astype(np.float32))
        return self.op("Concat", own, points, axis=1)

    def build(self, folder):
        width, inner, side = self.WIDTH, self.INNER, self.SIDE
        # Inputs without use here must not vanish from the graph's interface.
        unused = [self.op("ReduceMax", i, keepdims=0) for i in ("mask_input", "has_mask_input", "orig_im_size")]
        nothing = self.op("Mul", self.op("Mul", self.op("Mul", *unused[:2]), unused[2]), np.float32(0))
        rows = self.op("Reshape", self.op("Add", "image_embeddings", nothing), np.array([1, width, side * side]))
        pixels = self.op("Transpose", rows, perm=[0, 2, 1])
        add = lambda a, b: self.op("Add", a, b)
        places = add(self.weight("columns", 1, side, width), self.weight("rows", side, 1, width))
        places = self.op("Reshape", places, np.array([1, side * side, width]))
        tokens = x = self.tokens()
        for i in range(2):
            name = f"mask_decoder.transformer.layers.{i}"
            asks = add(x, tokens) if i else x
            own = self.attention(f"{name}.self_attn", asks, asks, x, width)
            x = self.norm(add(x, own) if i else own, f"{name}.norm1", width)
            placed = add(pixels, places)
            x = add(x, self.attention(f"{name}.cross_attn_token_to_image", add(x, tokens), placed, pixels, inner))
            x = self.norm(x, f"{name}.norm2", width)
            hidden = self.op("Relu", self.linear(x, f"{name}.mlp.lin1", width, 2 * width))
            x = self.norm(add(x, self.linear(hidden, f"{name}.mlp.lin2", 2 * width, width)), f"{name}.norm3", width)
            taken = self.attention(f"{name}.cross_attn_image_to_token", placed, add(x, tokens), x, inner)
            pixels = self.norm(add(pixels, taken), f"{name}.norm4", width)
        name = "mask_decoder.transformer.final_attn_token_to_image"
        x = add(x, self.attention(name, add(x, tokens), add(pixels, places), pixels, inner))
        x = self.norm(x, "mask_decoder.transformer.norm_final_attn", width)

        picture = self.op("Reshape", self.op("Transpose", pixels, perm=[0, 2, 1]), np.array([1, width, side, side]))
        picture = self.enlarge(picture, "mask_decoder.output_upscaling.0", width, 8)
        centred = self.op("Sub", picture, self.op("ReduceMean", picture, axes=[1]))
        variance = self.op("ReduceMean", self.op("Mul", centred, centred), axes=[1])
        normed = self.op("Div", centred, self.op("Sqrt", self.op("Add", variance, np.float32(1e-6))))
        picture = add(self.op("Mul", self.weight("onnx::Mul_1", 8, 1, 1), normed), self.weight("onnx::Add_2", 8, 1, 1))
        picture = self.gelu(self.enlarge(self.gelu(picture), "mask_decoder.output_upscaling.3", 8, 4))

        token = lambda i: self.op("Gather", x, np.int64(i), axis=1)
        weights = [self.mlp(token(1 + m), f"mask_decoder.output_hypernetworks_mlps.{m}", 4) for m in range(4)]
        weights = self.op("Concat", *(self.op("Unsqueeze", w, np.array([1])) for w in weights), axis=1)
        masks = self.op("MatMul", weights, self.op("Reshape", picture, np.array([1, 4, -1])))
        quality = self.mlp(token(0), "mask_decoder.iou_prediction_head", 4)

        # The choice, as in SAM's export.
        best = self.op("ArgMax", self.op("Add", quality, np.array([[-1000, 0, 0, 0]], np.float32)), axis=1, keepdims=0)
        all_masks = self.op("Reshape", masks, np.array([1, 4, 4 * side, 4 * side]))
        chosen = self.op("Gather", self.op("Reshape", all_masks, np.array([4, 16 * side * side])), best)
        self.nodes.append(helper.make_node("Reshape", [chosen, self.name(np.array([1, 1, 4 * side, 4 * side]))], ["low_res_masks"]))
        chosen = self.op("Gather", self.op("Flatten", quality, axis=0), best, axis=1)
        self.nodes.append(helper.make_node("Reshape", [chosen, self.name(np.array([1, 1]))], ["iou_predictions"]))
        self.nodes.append(helper.make_node("Identity", ["low_res_masks"], ["masks"]))
        inputs = [
            value("image_embeddings", F, [1, width, side, side]),
            value("point_coords", F, [1, "num_points", 2]),
            value("point_labels", F, [1, "num_points"]),
            value("mask_input", F, [1, 1, 256, 256]),
            value("has_mask_input", F, [1]),
            value("orig_im_size", F, [2]),
        ]
        outputs = [
            value("masks", F, [1, 1, "height", "width"]),
            value("iou_predictions", F, [1, 1]),
            value("low_res_masks", F, [1, 1, 256, 256]),
        ]
        write(folder / "sam.onnx", self.nodes, inputs, outputs, self.constants)


def sam_tiny():
    folder = ROOT / "crates/stages/mask-embed/testdata/sam-tiny"
    decoder = Decoder()
    decoder.build(folder)
    Encoder().build(folder / "encoder.onnx", decoder.WIDTH)


# Weights of red, green and blue and a sum for the mask of each query, then logits of its classes: sky, grass, car, roof, none.
QUERIES = [
    [-4, 0, 4, -2, 9, 0, 1, 0, 0],
    [-4, 4, -3, -4, 0, 8, 0, 1, 1],
    [5, -3, -2, -6, 0, 0, 9, 1, 0],
    # The same sky, less sure: it gets too little.
    [-4, 0, 4, -1, 7, 1, 0, 0, 1],
    # Surely none.
    [1, 1, 1, 1, 0, 0, 1, 0, 9],
    # Where no other is: half of what it claims.
    [3, 3, -1, 1, 0, 0, 1, 8, 0],
    # Not sure enough.
    [4, 4, 4, 4, 1, 1, 1, 1, 1],
]
PANOPTIC_MAP = (120, 80)


def panoptic_photo():
    """96 x 64 pixels: sky over grass, a red car, a yellow roof; all fade a little to the right."""
    photo = np.zeros((64, 96, 3))
    photo[:34], photo[34:] = (70, 130, 230), (60, 170, 50)
    photo[26:54, 8:52], photo[20:38, 58:84] = (220, 40, 30), (190, 180, 40)
    return (photo * np.linspace(1.1, 0.7, 96)[:, None]).clip(0, 255).astype(np.uint8)


def panoptic_model(family, folder, size, divisor=None):
    """Masks and classes from the colours of the picture: masks of a quarter of its side, classes none in the dark."""
    node = helper.make_node
    queries = np.array(QUERIES, np.float32)
    count = len(queries)
    classes, masks = ("logits", "pred_masks") if family == "detr" else ("class_queries_logits", "masks_queries_logits")
    # In the dark each query is none.
    dark = np.zeros((3, 5), np.float32)
    dark[:, 4] = -2
    inputs, given = [value("pixel_values", F, ["batch", 3, "height", "width"])], "ones"
    if family == "detr":
        inputs.append(value("pixel_mask", I64, ["batch", 64, 64]))
    elif family == "mask2former":
        inputs.append(value("pixel_mask", I64, ["batch", "height", "width"]))
    elif family == "oneformer":
        inputs.append(value("task_inputs", I64, ["batch", 4]))
    else:
        inputs = [value("pixel_values", F, [1, 3, *size])]
    nodes = []
    if len(inputs) > 1:
        # A mask of ones, or tokens whose mean is one, change nothing.
        nodes = [node("Cast", [inputs[1].name], ["floats"], to=F), node("ReduceMean", ["floats"], ["given"], keepdims=0)]
        given = "given"
    write(
        folder / "model.onnx",
        [
            *nodes,
            node("AveragePool", ["pixel_values"], ["small"], kernel_shape=[4, 4], strides=[4, 4]),
            node("Conv", ["small", "colors", "sums"], ["each"], kernel_shape=[1, 1]),
            node("Mul", ["each", given], [masks]),
            node("ReduceMean", ["pixel_values"], ["mean"], axes=[2, 3], keepdims=0),
            node("MatMul", ["mean", "dark"], ["light"]),
            node("Add", ["of_queries", "light"], [classes]),
        ],
        inputs,
        [value(classes, F, ["batch", count, 5]), value(masks, F, ["batch", count, "small_height", "small_width"])],
        [
            constant("ones", np.float32(1)),
            constant("colors", queries[:, :3].reshape(count, 3, 1, 1)),
            constant("sums", queries[:, 3]),
            constant("dark", dark),
            constant("of_queries", queries[None, :, 4:]),
        ],
    )
    names = {str(i): name for i, name in enumerate(["sky", "grass", "car", "roof"])}
    edges = {"shortest_edge": size[0], "longest_edge": size[1]}
    preprocessor = {
        "do_normalize": True, "do_pad": family == "eomt", "do_rescale": True, "do_resize": True, "resample": 2,
        "image_mean": [0.485, 0.456, 0.406], "image_std": [0.229, 0.224, 0.225], "rescale_factor": 1 / 255,
        "size": {"height": size[0], "width": size[1]} if family == "oneformer" else edges,
    }
    preprocessor |= {"size_divisor": divisor} if divisor else {}
    described = [("config", {"model_type": family, "id2label": names}), ("preprocessor_config", preprocessor)]
    if family == "oneformer":
        described.append(("model", {"constants": {"task_inputs": [2, 0, 1, 1]}}))
    for name, content in described:
        (folder / f"{name}.json").write_text(json.dumps(content, indent=2) + "\n")


def panoptic_segments(family, folder):
    """What transformers makes of the photograph: its own picture for the graph, its own segments from the answer."""
    try:
        import torch
        import transformers
        from onnx.reference import ReferenceEvaluator
        from PIL import Image
        of = getattr(transformers, {"detr": "Detr", "mask2former": "Mask2Former", "oneformer": "OneFormer", "eomt": "Eomt"}[family] + "ImageProcessor")
    except (ImportError, AttributeError) as missing:
        print(f"SKIPPED: segments of {folder.name}: {missing}")
        return
    # OneFormer's processor wants a file of the hub; its pictures are as Mask2Former's without a divisor.
    processor = of.from_pretrained(folder) if family != "oneformer" else transformers.Mask2FormerImageProcessor.from_pretrained(folder, size_divisor=0)
    photo = panoptic_photo()
    inputs = {"pixel_values": processor(images=[photo], return_tensors="np")["pixel_values"].astype(np.float32)}
    inputs |= {"detr": {"pixel_mask": np.ones((1, 64, 64), np.int64)}, "oneformer": {"task_inputs": np.array([[2, 0, 1, 1]])}}.get(family, {})
    if family == "mask2former":
        inputs["pixel_mask"] = np.ones(inputs["pixel_values"].shape[:1] + inputs["pixel_values"].shape[2:], np.int64)
    graph = ReferenceEvaluator(str(folder / "model.onnx"))
    outputs = {name: torch.tensor(values) for name, values in zip(graph.output_names, graph.run(None, inputs))}
    result = of.post_process_panoptic_segmentation(processor, SimpleNamespace(**outputs), target_sizes=[PANOPTIC_MAP[::-1]])[0]
    # Ids from 0; EoMT's do that already.
    ids = result["segmentation"].numpy().astype(int) - (family != "eomt")
    names = json.loads((folder / "config.json").read_text())["id2label"]
    segments = [{"name": names[str(s["label_id"])], "score": s["score"]} for s in result["segments_info"]]
    print(f"{folder.name}: {segments}, {np.bincount(ids.ravel() + 1)} pixels of none and of each")
    (folder / "segments.json").write_text(json.dumps(segments, indent=2) + "\n")
    Image.fromarray(photo).save(folder / "photo.png")
    # 0 for none.
    Image.fromarray((ids + 1).astype(np.uint8)).save(folder / "ids.png")


def panoptic():
    # Heights and widths of the picture: the photograph's own, but for EoMT, which fills a square.
    for family, size, divisor in [("detr", (64, 96), None), ("mask2former", (64, 96), 32), ("oneformer", (64, 96), None), ("eomt", (96, 96), None)]:
        folder = ROOT / f"crates/stages/mask-embed/testdata/panoptic-{family}"
        panoptic_model(family, folder, size, divisor)
        panoptic_segments(family, folder)


# Words that have a colour, with their id in CLIP's vocabulary: presence, then weights of red, green and blue, a sum and a logit for
# each of three queries. The second sees the same, less surely; the third is not sure enough.
WORDS = {
    "sky": (2390, 4, [[-4, 0, 6, -3, 3], [-4, 0, 6, -2.5, 1], [-4, 0, 6, -2, -1]]),
    "grass": (5922, 4, [[-4, 6, -2, -3, 4], [-4, 6, -2, -2.5, 1], [0, 0, 0, 9, -2]]),
    "car": (1615, 3, [[5, -4, -3, -4, 2], [5, -4, -3, -3.5, 1], [0, 0, 0, 9, -2]]),
    "roof": (6449, 4, [[4, 6, -4, -3, 2], [4, 6, -4, -2.5, 1], [0, 0, 0, 9, -2]]),
    # The car by another name, less sure.
    "vehicle": (5299, 2, [[5, -4, -3, -3.5, 1], [5, -4, -3, -4, 0.5], [0, 0, 0, 9, -2]]),
    # All over, so that the others cover most of it.
    "room": (1530, 2, [[0, 0, 0, 3, 1], [0, 0, 0, 3, -1], [0, 0, 0, 3, -1]]),
}
CONCEPTS = {
    "samexporter": {
        "files": ["sam3_image_encoder", "sam3_language_encoder", "sam3_decoder"], "context": 32, "bytes": True,
        "image": [f"{name}_{i}" for name in ["vision_pos_enc", "backbone_fpn"] for i in range(3)],
        "text": ["text_attention_mask", "text_memory", "text_embeds"],
        "taken": ["language_mask", "language_features", "language_embeds"],
        "boxes": [("box_coords", F, [8, 1, 4]), ("box_labels", I64, [8, 1]), ("box_masks", TensorProto.BOOL, [1, 8])],
        "sizes": ["original_height", "original_width"], "presence": "presence_logit_dec",
    },
    # The page names no inputs for exemplars, nor outputs of the image encoder: these are made up.
    "pixl": {
        "files": [f"efficientsam3_ev_m_{name}" for name in ["image_encoder", "text_encoder", "decoder"]], "context": 16, "bytes": False,
        "image": [f"{name}_{i}" for name in ["pos", "fpn"] for i in range(3)],
        "text": ["language_padding", "language_features", "language_embeds"],
        "taken": ["language_padding", "language_features", "language_embeds"],
        "boxes": [("exemplar_boxes", F, [1, 8, 4]), ("exemplar_labels", I64, [1, 8]), ("exemplar_mask", TensorProto.BOOL, [1, 8])],
        "sizes": [], "presence": "presence_logit",
    },
}


def concepts_graphs(of, folder):
    """Three graphs: features of the picture are its colours, those of a text the words it has, a mask of each word's queries."""
    node, words = helper.make_node, len(WORDS)
    context, image, text, taken = of["context"], of["image"], of["text"], of["taken"]
    shapes = [[1, 3, 16 >> i, 24 >> i] for i in range(3)]
    begin = [node("Unsqueeze", ["image", "first"], ["one"])] if of["bytes"] else []
    floats = [node("Cast", ["one"], ["floats"], to=F), node("Div", ["floats", "half"], ["to_two"]), node("Sub", ["to_two", "unit"], ["input"])] if of["bytes"] else []
    pools = [node("AveragePool", ["input" if of["bytes"] else "image"], [image[3]], kernel_shape=[4, 4], strides=[4, 4])]
    pools += [node("AveragePool", [image[2 + i]], [image[3 + i]], kernel_shape=[2, 2], strides=[2, 2]) for i in (1, 2)]
    write(
        folder / f"{of['files'][0]}.onnx",
        [*begin, *floats, *pools, *[node("Sub", [image[3 + i]] * 2, [image[i]]) for i in range(3)]],
        [value("image", TensorProto.UINT8, [3, 64, 96]) if of["bytes"] else value("image", F, [1, 3, 64, 96])],
        [value(name, F, shape) for name, shape in zip(image, shapes * 2)],
        [constant("first", np.array([0], np.int64)), constant("half", np.float32(127.5)), constant("unit", np.float32(1))],
    )
    text_values = [(TensorProto.BOOL, [1, context]), (F, [context, 1, words]), (F, [context, 1, 2])]
    write(
        folder / f"{of['files'][1]}.onnx",
        [
            node("Equal", ["tokens", "zero"], [text[0]]),
            node("Unsqueeze", ["tokens", "last"], ["each"]),
            node("Equal", ["each", "ids"], ["is_word"]),
            node("Cast", ["is_word"], ["words"], to=F),
            node("Transpose", ["words"], [text[1]], perm=[1, 0, 2]),
            node("Cast", ["each"], ["numbers"], to=F),
            node("Transpose", ["numbers"], ["numbers_first"], perm=[1, 0, 2]),
            node("Concat", ["numbers_first", "numbers_first"], [text[2]], axis=2),
        ],
        [value("tokens", I64, [1, context])],
        [value(name, *v) for name, v in zip(text, text_values)],
        [constant("zero", np.int64(0)), constant("last", np.array([2], np.int64)), constant("ids", np.array([w[0] for w in WORDS.values()], np.int64))],
    )
    queries = np.array([w[2] for w in WORDS.values()], np.float32)
    # Nothing is present without a known word, or with a box that is not masked.
    presence = np.array([[w[1] + 4] for w in WORDS.values()], np.float32)
    boxes = [name for name, _, _ in of["boxes"]]
    write(
        folder / f"{of['files'][2]}.onnx",
        [
            node("Not", [taken[0]], ["counts"]),
            node("Cast", ["counts"], ["weights"], to=F),
            node("Unsqueeze", ["weights", "last"], ["weights_last"]),
            node("Transpose", ["weights_last"], ["weights_first"], perm=[1, 0, 2]),
            node("Mul", [taken[1], "weights_first"], ["known"]),
            node("ReduceMax", ["known"], ["words"], axes=[0], keepdims=0),
            node("MatMul", ["words", "table"], ["flat"]),
            node("Reshape", ["flat", "by_query"], ["of_queries"]),
            node("Split", ["of_queries", "parts"], ["colors", "surety"], axis=2),
            node("Add", [image[3], image[0]], ["features"]),
            node("Reshape", ["features", "by_color"], ["lines"]),
            node("Concat", ["lines", "ones"], ["with_one"], axis=1),
            node("MatMul", ["colors", "with_one"], ["planes"]),
            node("Reshape", ["planes", "by_plane"], ["pred_masks"]),
            node("Cast", [boxes[2]], ["masked"], to=F),
            node("ReduceSum", ["masked"], ["count"], keepdims=0),
            node("Cast", [boxes[1]], ["labels"], to=F),
            node("ReduceSum", ["labels"], ["sum"], keepdims=0),
            node("ReduceMax", [boxes[0]], ["corner"], keepdims=0),
            node("Sum", ["count", "sum"], ["slots"]),
            node("Mul", ["slots", "ten"], ["tens"]),
            node("Sum", ["tens", "corner", "none"], ["off"]),
            node("MatMul", ["words", "presence"], ["present"]),
            node("Add", ["present", "off"], [of["presence"]]),
            node("Identity", ["surety"], ["pred_logits"]),
            node("Identity", ["zeros"], ["pred_boxes"]),
        ],
        [
            *[value(name, I64, []) for name in of["sizes"]],
            *[value(name, F, shape) for name, shape in zip(image, shapes * 2)],
            *[value(name, *v) for name, v in zip(taken, text_values)],
            *[value(*box) for box in of["boxes"]],
        ],
        [value("pred_boxes", F, [1, 3, 4]), value("pred_logits", F, [1, 3, 1]), value("pred_masks", F, [1, 3, 16, 24]), value(of["presence"], F, [1, 1])],
        [
            constant("last", np.array([2], np.int64)), constant("table", queries.reshape(words, 15)), constant("presence", presence),
            constant("by_query", np.array([1, 3, 5])), constant("by_color", np.array([1, 3, 384])), constant("by_plane", np.array([1, 3, 16, 24])),
            constant("parts", np.array([4, 1])), constant("ones", np.ones((1, 1, 384), np.float32)),
            constant("zeros", np.zeros((1, 3, 4), np.float32)), constant("ten", np.float32(10)), constant("none", np.float32(-164)),
        ],
    )


def enlarge(plane, width, height):
    """Linearly, by the centres of pixels."""
    for axis, size in enumerate((height, width)):
        last = plane.shape[axis] - 1
        at = np.clip((np.arange(size) + 0.5) / size * (last + 1) - 0.5, 0, last)
        low = np.floor(at).astype(int)
        part = (at - low).reshape((-1, 1) if axis == 0 else (1, -1))
        plane = np.take(plane, low, axis) * (1 - part) + np.take(plane, np.minimum(low + 1, last), axis) * part
    return plane


def concepts_segments(of, folder):
    """What the graphs see of the photograph: from the surest on each gets what is free of its mask, where that is more than half."""
    from onnx.reference import ReferenceEvaluator
    from PIL import Image

    image, text, decoder = [ReferenceEvaluator(str(folder / f"{name}.onnx")) for name in of["files"]]
    sigmoid = lambda x: 1 / (1 + np.exp(-np.asarray(x, float)))
    photo = panoptic_photo().transpose(2, 0, 1)
    seen = dict(zip(of["image"], image.run(None, {"image": photo if of["bytes"] else (photo[None] / np.float32(127.5) - np.float32(1))})))
    found = []
    for word, (token, _, _) in WORDS.items():
        tokens = np.zeros((1, of["context"]), np.int64)
        tokens[0, :3] = 49406, token, 49407
        inputs = {**seen, **dict(zip(of["taken"], text.run(None, {"tokens": tokens})))}
        inputs |= {name: np.zeros(shape, np.float32) if kind == F else np.ones(shape, bool if kind == TensorProto.BOOL else np.int64) for name, kind, shape in of["boxes"]}
        inputs |= {name: np.array(1008) for name in of["sizes"]}
        _, logits, masks, presence = decoder.run(None, inputs)
        scores = sigmoid(logits[0, :, 0]) * sigmoid(presence[0, 0])
        found += [(word, score, sigmoid(enlarge(mask, *PANOPTIC_MAP))) for score, mask in zip(scores, masks[0]) if score > 0.5]
    ids, segments = np.full(PANOPTIC_MAP[::-1], -1), []
    for word, score, mask in sorted(found, key=lambda f: -f[1]):
        mask = mask > 0.5
        free = mask & (ids < 0)
        if free.sum() > 0.5 * mask.sum():
            ids[free] = len(segments)
            segments.append({"name": word, "score": float(score)})
    print(f"{folder.name}: {[(w, round(float(s), 3)) for w, s, _ in found]}, left {segments}, {np.bincount(ids.ravel() + 1)} pixels of none and of each")
    (folder / "segments.json").write_text(json.dumps(segments, indent=2) + "\n")
    Image.fromarray(panoptic_photo()).save(folder / "photo.png")
    Image.fromarray((ids + 1).astype(np.uint8)).save(folder / "ids.png")


def concepts():
    for name, of in CONCEPTS.items():
        folder = ROOT / f"crates/stages/mask-embed/testdata/concepts-{name}"
        concepts_graphs(of, folder)
        concepts_segments(of, folder)
        if name != "samexporter":
            content = dict(zip(["image", "text", "decoder"], [f"{name}.onnx" for name in of["files"]]))
            content["constants"] = {name: int(kind != F) for name, kind, _ in of["boxes"]}
            (folder / "model.json").write_text(json.dumps(content, indent=2) + "\n")


if __name__ == "__main__":
    ops()
    argmax()
    clip()
    slow()
    sam()
    exports()
    sam_tiny()
    panoptic()
    concepts()
