"""Multistart: a batch of starts over all rotations, or those that a prior allows, annealed from clusters to points."""

from bpnp.search.annealing import run_batch
from bpnp.search.candidates import Candidates
from bpnp.search.scene import Scene
from bpnp.search.starts import Prior, draw_poses


def multistart(scene: Scene, number: int, prior: Prior | None) -> tuple[Candidates, float]:
    """Distinct poses of one batch of starts, counted from 0, and its share of a full one."""
    settings = scene.settings
    recipe = settings.recipes[number % len(settings.recipes)]
    drawn = draw_poses(scene.spread, scene.bulk3d, settings.batch(number), recipe, prior, scene.rng)
    poses = Candidates.unscored(*drawn, hits=1)
    return run_batch(scene, poses), len(poses) / settings.starts
