"""Try an installed wheel outside of the checkout: solve, load packaged weights, and write input for `bpnp solve`.

`make wheel` runs it.
"""

import numpy as np

import bpnp
from bpnp.examples import load

example = load("photo")
solution = bpnp.solve(example.points2d, example.points3d, example.camera)
print(bpnp.__file__, solution.verdict, f"{example.rotation_error_deg(solution.rotation):.2f} deg")
bpnp.BPnPNet.from_pretrained("procedural-so3")
for name in ("points2d", "points3d", "camera"):
    np.savetxt(f"{name}.csv", getattr(example, name), delimiter=",")
