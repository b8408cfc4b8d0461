"""What a solution shows of itself."""

import numpy as np
from planted import plant

import bpnp

PLANTED = plant(1, 40, seed=2)


def test_a_solution_is_drawn_with_a_cross_on_every_image_point() -> None:
    solution = bpnp.solve(PLANTED.points2d[0].numpy(), PLANTED.points3d[0].numpy())
    lines = {line.get_label(): line.get_xydata() for line in solution.plot().axes[0].get_lines()}
    crosses = np.asarray(lines["3D points, matched"])
    seen = np.asarray(lines["image points"])
    distance = np.linalg.norm(seen[:, None] - crosses, axis=-1)
    assert distance.min(1).max() < 1e-6


def test_the_text_of_a_solution_is_short_and_has_its_pose() -> None:
    solution = bpnp.solve(PLANTED.points2d[0].numpy(), PLANTED.points3d[0].numpy())
    text = repr(solution)
    assert len(text.splitlines()) <= 10
    assert text.startswith("Solution(confident: ")
    assert all(f"{value:.6f}" in text for value in solution.rotation.ravel())
    assert "matches: 40 of 40" in text
