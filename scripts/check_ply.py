#!/usr/bin/env python3
"""Reads two 3DGS PLYs with PyPI's plyfile, an independent reader, and compares them property by property.

    pip install numpy plyfile
    scripts/check_ply.py ONE.ply OTHER.ply

Properties that one file lacks must be zero in the other (normals, spherical harmonics of a lower degree). Values that are
not finite in the first file are counted apart: infinite opacity logits are read as 50 and -50. Exit code 1 when a value
differs.
"""

import sys

import numpy as np
from plyfile import PlyData


def main(one, other):
    a, b = (PlyData.read(path)["vertex"].data for path in (one, other))
    if len(a) != len(b):
        print(f"{len(a)} and {len(b)} Gaussians")
        return 1
    worst, infinite = 0, 0
    for name in dict.fromkeys(a.dtype.names + b.dtype.names):
        column = lambda v: v[name].astype(np.float64) if name in v.dtype.names else np.zeros(len(v))
        finite = np.isfinite(column(a))
        infinite += np.count_nonzero(~finite)
        worst = max(worst, np.abs(column(a) - column(b))[finite].max(initial=0))
    print(f"{len(a)} Gaussians, {len(a.dtype.names)} and {len(b.dtype.names)} properties, largest difference {worst:g}, {infinite} not finite")
    return int(worst > 0)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    sys.exit(main(*sys.argv[1:]))
