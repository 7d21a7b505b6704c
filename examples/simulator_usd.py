#!/usr/bin/env python3
"""Makes a stage for a robot simulator of the objects of a scene: they fall, the rest of the scene stands still.

    examples/take_objects.sh out/demo out/taken
    examples/simulator_usd.py out/taken          # writes out/taken/simulation.usda beside scene.usda

The stage refers to scene.usda, which has the Gaussians and a convex collider of each object, and adds a physics scene, and to each
object that is not wider than half of the scene a rigid body with a mass (1000 kg per cubic metre; a unit is a metre unless the
scene knows better). Things fall along -z, which scene.usda is turned to. OpenUSD opens the stage and finds the bodies; no simulator has run it.
"""
import json
import sys
from pathlib import Path

DENSITY = 1000.0


def main(folder):
    scene = json.loads((folder / "scene.json").read_text())
    metres = scene["metres_per_unit"] or 1.0
    wide = max(h for o in scene["objects"] for h in o["box"]["half_size"])
    lines = ["#usda 1.0", "(", '    defaultPrim = "World"', f"    metersPerUnit = {metres:.9g}", '    upAxis = "Z"', ")", "",
             'def Xform "World" (', "    prepend references = @./scene.usda@", ")", "{", '    def PhysicsScene "physics"', "    {",
             f"        float physics:gravityMagnitude = {9.81 / metres:.6g}", "    }"]
    moving = [o for o in scene["objects"] if max(o["box"]["half_size"]) < 0.5 * wide]
    for o in moving:
        mass = DENSITY * o["volume"] * metres**3
        lines += ["", f'    over "object_{o["id"]:04}" (', '        prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI"]', "    )", "    {",
                  f"        float physics:mass = {max(mass, 1e-4):.6g}", "    }"]
    out = folder / "simulation.usda"
    out.write_text("\n".join([*lines, "}", ""]))
    print(f"{out}: {len(moving)} of {len(scene['objects'])} objects can move")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
