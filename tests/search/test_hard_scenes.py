"""Repeated structures and points that depend on each other: no wrong pose is called confident."""

from collections.abc import Callable

import hard_scenes
import numpy as np
import pytest
from planted import degrees_between

from bpnp import solve

HARD = (
    hard_scenes.board, hard_scenes.stairs, hard_scenes.wallpaper, hard_scenes.ending_facade, hard_scenes.colonnade,
    hard_scenes.lines, hard_scenes.helix, hard_scenes.clumps,
)  # fmt: skip


@pytest.mark.parametrize("draw", HARD, ids=lambda draw: draw.__name__)
def test_a_confident_pose_is_right(draw: Callable[[np.random.Generator], hard_scenes.Drawn]) -> None:
    """Equal parts have several valid poses; along lines and curves points agree by chance.

    Points that have nothing in common have no correct pose.
    """
    rng = np.random.default_rng(3)
    for _ in range(2):
        pixels, scene, poses = draw(rng)
        found = solve(pixels, scene, hard_scenes.CAMERA, time_limit=1.5)
        if found.verdict == "confident":
            assert poses, "nothing is right"
            rotation, translation = poses[0]
            assert degrees_between(found.rotation, rotation) < 3
            centroid = np.median(scene, 0)
            seen, true = found.rotation @ centroid + found.translation, rotation @ centroid + translation
            assert np.linalg.norm(seen - true) < 0.1 * np.linalg.norm(true)


def test_a_facade_with_a_door_in_view_stays_confident() -> None:
    """Its windows repeat, and what is around the door tells where it is seen."""
    pixels, scene, [(rotation, _)] = hard_scenes.facade_with_door(np.random.default_rng(4))
    found = solve(pixels, scene, hard_scenes.CAMERA)
    assert found.verdict == "confident"
    assert degrees_between(found.rotation, rotation) < 1
