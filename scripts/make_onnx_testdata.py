#!/usr/bin/env python3
"""Writes the small ONNX models that the Rust tests run. Needs the Python packages numpy and onnx.

    python3 -m venv /tmp/onnx-venv && /tmp/onnx-venv/bin/pip install numpy onnx
    /tmp/onnx-venv/bin/python scripts/make_onnx_testdata.py

crates/lib/onnx-models/testdata/ops.onnx         floats and integers in, sum, product and a value in between
crates/lib/onnx-models/testdata/clip/            a dual encoder whose features can be computed by hand
crates/stages/mask-embed/testdata/sam/              a segmenter by colour with the inputs and outputs of SAM
"""

from pathlib import Path

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


if __name__ == "__main__":
    ops()
    clip()
    sam()
