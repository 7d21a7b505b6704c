#!/usr/bin/env python3
"""Says what is in the artifacts of a run. Needs numpy only.

    examples/read_artifacts.py out/demo
"""
import json
import struct
import sys
from pathlib import Path

import numpy as np

TYPES = {"F32": "<f4", "F64": "<f8", "F16": "<f2", "I32": "<i4", "U32": "<u4", "U64": "<u8", "U8": "u1"}


def read(path):
    """Tensors of a safetensors file by name, and the provenance (docs/artifacts.md)."""
    data = Path(path).read_bytes()
    (length,) = struct.unpack("<Q", data[:8])
    header = json.loads(data[8 : 8 + length])
    provenance = json.loads(header.pop("__metadata__")["cags"])
    body = data[8 + length :]
    tensors = {
        name: np.frombuffer(body[t["data_offsets"][0] : t["data_offsets"][1]], TYPES[t["dtype"]]).reshape(t["shape"])
        for name, t in header.items()
    }
    return tensors, provenance


def main(run):
    for name in ["graph", "footprints", "features", "instances"]:
        if not (Path(run) / f"{name}.safetensors").exists():
            continue  # features are made only where something reads them
        tensors, provenance = read(Path(run) / f"{name}.safetensors")
        print(f"{name}: made by {provenance['program']}")
        for key, t in tensors.items():
            print(f"    {key} {t.dtype} {list(t.shape)}")
    label = read(Path(run) / "instances.safetensors")[0]["label"]
    ids, counts = np.unique(label[label >= 0], return_counts=True)
    for i in np.argsort(-counts)[:5]:
        print(f"instance {ids[i]}: {counts[i]} Gaussians")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(sys.argv[1])
