#!/usr/bin/env python3
"""Puts the objects of a scene into Blender: each one's Gaussians as points, with its name, and its box.

    examples/take_objects.sh out/demo out/taken
    blender --python examples/blender_objects.py -- out/taken      # Blender 4.0 or later
    python3 examples/blender_objects.py -- out/taken               # without Blender: says what it would do

Blender shows Gaussians as points; an add-on for splats draws them.
"""
import json
import sys
from pathlib import Path


def things(folder):
    """Of each object: its name, its PLY, and the matrix that makes its box of a cube with sides of 2."""
    for o in json.loads((folder / "scene.json").read_text())["objects"]:
        name = f"{o['name']['text'] if o['name'] else 'object'} {o['id']}"
        box = o["box"]
        columns = [[half * v for v in axis] for half, axis in zip(box["half_size"], box["axes"])] + [box["center"]]
        matrix = [[columns[c][r] for c in range(4)] for r in range(3)] + [[0, 0, 0, 1]]
        yield name, folder / "objects" / f"object_{o['id']:04}.ply", matrix, o


def into_blender(folder):
    import bpy
    from mathutils import Matrix

    for name, ply, matrix, told in things(folder):
        bpy.ops.wm.ply_import(filepath=str(ply), forward_axis="Y", up_axis="Z")
        points = bpy.context.object
        points.name, points["id"], points["score"] = name, told["id"], told["score"]
        box = bpy.data.objects.new(f"{name} box", None)
        box.empty_display_type, box.matrix_world = "CUBE", Matrix(matrix)
        bpy.context.collection.objects.link(box)


def main(folder):
    if "bpy" in sys.modules or "Blender" in sys.executable:
        return into_blender(folder)
    for name, ply, matrix, _ in things(folder):
        print(f"{name}: {ply}, {ply.stat().st_size} bytes, box around {[round(row[3], 3) for row in matrix[:3]]}")


if __name__ == "__main__":
    if "--" not in sys.argv or sys.argv[-1] == "--":
        sys.exit(__doc__)
    main(Path(sys.argv[-1]))
