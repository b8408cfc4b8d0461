"""Multistart: a batch of starts over all rotations, or those that a prior allows, annealed from clusters to points."""

import math
from dataclasses import replace

import numpy as np

from bpnp.search.annealing import run_batch
from bpnp.search.candidates import Candidates
from bpnp.search.scene import Scene
from bpnp.search.settings import Stages
from bpnp.search.sources.raster import distance_of, drawn_around
from bpnp.search.starts import PosePrior, Prior, draw_poses


def multistart(scene: Scene, number: int, prior: Prior | None) -> tuple[Candidates, float]:
    """Distinct poses of one batch of starts, counted from 0, and its share of a full one."""
    settings = scene.settings
    recipe = settings.recipes[number % len(settings.recipes)]
    drawn = draw_poses(scene.spread, scene.bulk3d, settings.batch(number), recipe, prior, scene.rng)
    poses = Candidates.unscored(*drawn, hits=1)
    return run_batch(scene, poses, settings.coarse), len(poses) / settings.starts


def multistart_near(scene: Scene, prior: PosePrior) -> Candidates:
    """Distinct poses of a full batch of starts drawn from a rough pose with a translation."""
    poses = drawn_around(scene, prior, scene.settings.starts)
    return run_batch(scene, poses, cooled(scene.settings.coarse, prior, scene))


def cooled(stages: Stages, prior: PosePrior, scene: Scene) -> Stages:
    """The stages at scales no wider than the prior: from hotter ones the starts leave what is known."""
    depth = distance_of(scene, prior)
    turned = math.radians(prior.rotation_sigma_deg) * float(np.sqrt(scene.bulk3d.var(0).sum())) / depth
    width = math.hypot(prior.translation_sigma / depth, turned) / scene.spread
    most = float(np.clip(width, stages[-1].last_scale, stages[0].first_scale))
    return tuple(
        replace(stage, first_scale=min(stage.first_scale, most), last_scale=min(stage.last_scale, most))
        for stage in stages
    )
