"""Golden masks of cv2.fillPoly for crates/stages/eval's polygon rasteriser.

    pip install numpy opencv-python-headless==4.10.0.84
    python scripts/make_fillpoly_cases.py > crates/stages/eval/testdata/fillpoly.json

Each case: image size, vertices as floats (cast to int32 as LERF-OVS scorers do: truncation toward zero), and the
filled pixels as runs [y, first x, last x].
"""

import json
import math
import random

import cv2
import numpy as np


def runs(mask):
    out = []
    for y, row in enumerate(mask):
        x, w = 0, len(row)
        while x < w:
            if row[x]:
                end = x
                while end + 1 < w and row[end + 1]:
                    end += 1
                out.append([y, x, end])
                x = end
            x += 1
    return out


def fill(width, height, polygon):
    mask = np.zeros((height, width), np.uint8)
    if polygon:
        cv2.fillPoly(mask, [np.array(polygon).astype(np.int32)], 1)
    return mask


def main():
    rng = random.Random(7)
    shapes = [
        ("triangle", 40, 30, [[3.2, 4.9], [35.7, 8.1], [12.5, 27.3]]),
        ("rectangle", 20, 20, [[2, 3], [17, 3], [17, 12], [2, 12]]),
        ("bowtie", 40, 30, [[2, 2], [37, 27], [37, 2], [2, 27]]),
        ("star", 48, 48, [[24 + 22 * math.sin(k * 0.8 * math.pi), 24 - 22 * math.cos(k * 0.8 * math.pi)] for k in range(5)]),
        ("point", 10, 10, [[4.9, 5.1]]),
        ("segment", 30, 20, [[2.5, 3.5], [26.9, 14.2]]),
        ("horizontal", 20, 10, [[3, 4], [15, 4], [9, 4]]),
        ("vertical", 10, 20, [[4, 3], [4, 15], [4, 9]]),
        ("negative truncates toward zero", 20, 20, [[-0.9, -0.9], [9.9, -0.5], [9.9, 9.9], [-0.7, 9.9]]),
        ("leaves on every side", 30, 24, [[-12, 10], [14, -15], [45, 12], [16, 41]]),
        ("leaves far", 30, 24, [[-400, 300], [14, -900], [777, 12]]),
        ("outside", 20, 20, [[25, 3], [40, 3], [30, 15]]),
        ("covers all", 16, 12, [[-5, -5], [30, -5], [30, 30], [-5, 30]]),
        ("repeated vertices", 30, 30, [[3, 3], [3, 3], [25, 5], [25, 5], [14, 26], [14, 26], [3, 3]]),
        ("thin sliver", 60, 20, [[1, 1], [58, 9], [57, 10]]),
    ]
    for k in range(9):
        w, h, n = rng.randint(20, 90), rng.randint(20, 70), rng.randint(3, 14)
        over = 0 if k < 5 else 15
        shapes.append((f"random {k}", w, h, [[round(rng.uniform(-over, w - 1 + over), 2), round(rng.uniform(-over, h - 1 + over), 2)] for _ in range(n)]))
    for k in range(3):  # like an annotator's outline: many vertices round a blob
        w, h = 96, 72
        pts = [[round(w / 2 + (20 + 14 * rng.random()) * math.cos(a), 2), round(h / 2 + (15 + 12 * rng.random()) * math.sin(a), 2)] for a in [2 * math.pi * i / 40 for i in range(40)]]
        shapes.append((f"outline {k}", w, h, pts))
    cases = [
        {"name": name, "width": w, "height": h, "polygon": [[round(float(x), 4), round(float(y), 4)] for x, y in p]}
        for name, w, h, p in shapes
    ]
    for case in cases:
        case["runs"] = runs(fill(case["width"], case["height"], case["polygon"]))
    print("[")
    print(",\n".join(json.dumps(c, separators=(",", ":")) for c in cases))
    print("]")


if __name__ == "__main__":
    main()
