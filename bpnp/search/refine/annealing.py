"""Stages of the search: anneal starts on coarse clusters, the best on finer ones, and few on all points."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bpnp.arrays import Array32
from bpnp.runtime import Clock, in_time, thread_count
from bpnp.search.hypotheses import KEPT_CANDIDATES, Hypotheses, select_distinct, to_problem_frame
from bpnp.search.kernels.dense import dense_scratch, descend
from bpnp.search.kernels.sparse import descend_sparse, sparse_scratch
from bpnp.search.search_frame import SearchFrame, Sides
from bpnp.search.starts import Prior, StartSampling, draw_poses

TIMED_PAIRS = 3e8  # bearings times points from which the first step on all of them is timed [count; cost]
# More cost time and rarely change the best pose.
FINE_BEARINGS = 1000  # number of bearings before the last stage, which uses all [bearings; cost]
COOLING = 0.82  # factor from one scale to the next [factor; calibration]
COOLING_PATIENCE = 3  # scales after the likeliest one before the annealing of a pose stops [scales; calibration]
STARTS = 1200  # number of starts of a full batch; 1200 leave no gap of 25 degrees [starts; derived]
# Each next batch has twice as many until it is full.
FIRST_STARTS = 48  # number of starts of the first batch, enough for easy problems [starts; calibration]
# A small batch keeps the square root of its fraction of a full one.
LEAST_KEPT = 3  # least number of poses that a stage keeps [poses; calibration]
FINISHED_POSES = 3  # candidates whose NFA each batch computes, annealed on all bearings at the end [poses; cost]
END_SCALE = 2.0  # first scale of the last stage, in scales of the pose, so that points can enter [factor; calibration]
STARTS_A_CHECK = 32  # number of starts annealed on clusters between two checks of the deadline [starts; cost]


class ClusterStage(NamedTuple):
    """Annealing of many poses on weighted clusters of both point sets."""

    clusters: int  # of each set, at most; the cost of an iteration grows with its square
    first_scale: float  # of the first iteration, in units of the RMS angular radius of the bearings
    last_scale: float  # of the last iteration, in the same unit
    iterations: int  # number of scales between the two, with one Gauss-Newton step each
    kept: int  # number of poses that the next stage receives
    apart_deg: float  # least angle between the rotations of two kept poses, degrees
    # Iterations after which only the likelier half of the poses is kept, and at least twice `kept`. Below 6 iterations,
    # this step loses correct poses in clutter.
    halvings: tuple[int, ...] = ()


COARSE = (  # first stages on clusters [`ClusterStage`; calibration]
    ClusterStage(64, 0.3, 0.1, iterations=10, kept=48, apart_deg=3.0, halvings=(6, 8)),
)
MIDDLE = (  # stages on finer clusters [`ClusterStage`; calibration]
    ClusterStage(128, 0.1, 0.065, iterations=7, kept=24, apart_deg=1.0),
    ClusterStage(256, 0.062, 0.04, iterations=7, kept=10, apart_deg=1.0),
)
# Sampling of the batches, in turn.
RECIPES = StartSampling(0.0, 0.5), StartSampling(1.0, 0.8), StartSampling(0.5, 1.2)  # [`StartSampling`; calibration]


def batch_size(number: int) -> int:
    """Return the number of starts of a batch; `number` counts batches from 0."""
    return min(STARTS, FIRST_STARTS * 2 ** min(number, 60))


def kept_by(stage: ClusterStage, starts: int) -> int:
    """Return the number of poses that a stage keeps from a batch with this number of starts."""
    return min(stage.kept, max(LEAST_KEPT, math.ceil(math.sqrt(starts / STARTS) * stage.kept)))


def multistart(scene: SearchFrame, number: int, prior: Prior | None) -> Hypotheses:
    """Run batch `number`, from 0, of starts over all rotations, or those that a prior of the scene allows."""
    recipe = RECIPES[number % len(RECIPES)]
    drawn = draw_poses(scene.spread, scene.bulk3d, batch_size(number), recipe, prior, scene.rng)
    return run_batch(scene, Hypotheses.from_poses(*drawn, basin_count=1))


def run_batch(scene: SearchFrame, starts: Hypotheses) -> Hypotheses:
    """Anneal one batch of starts, from clusters to all points."""
    stages = *COARSE, *MIDDLE
    poses = anneal_on_clusters(scene, starts, stages, len(starts))
    return anneal_on_points(scene, poses, stages[-1].last_scale * scene.spread)


def anneal_on_clusters(
    scene: SearchFrame, poses: Hypotheses, stages: Sequence[ClusterStage], starts: int
) -> Hypotheses:
    """Anneal poses on clusters, stage by stage, coarse to fine; the poses have different rotations, best first.

    The number of starts of the batch determines how many poses each stage keeps.
    """
    outlier = scene.outlier_density(scene.settings.outliers)
    for stage, clusters in zip(stages, scene.clusters([stage.clusters for stage in stages]), strict=True):
        kept = kept_by(stage, starts)
        scales = (scene.spread * np.geomspace(stage.first_scale, stage.last_scale, stage.iterations)).astype(np.float32)
        for k, part in enumerate(np.split(scales, stage.halvings)):
            if k:  # best first, since only the first ones are annealed after the deadline
                poses = poses[np.argsort(-poses.log_likelihood, kind="stable")[: max(len(poses) // 2, 2 * kept)]]
            poses = _annealed(scene, poses, clusters, part, outlier)
        poses = select_distinct(poses, scene, kept, stage.apart_deg)
    return poses


def _annealed(scene: SearchFrame, starts: Hypotheses, sides: Sides, scales: Array32, outlier: np.float32) -> Hypotheses:
    """Take one step at each scale (k,), radians; return the poses that were annealed before the deadline."""
    rotation, translation, score = starts.rotation.copy(), starts.translation.copy(), starts.log_likelihood.copy()

    def anneal(i: int, j: int) -> None:
        scratch = dense_scratch(*(len(side.label) for side in sides))
        descend(*sides, rotation[i:j], translation[i:j], scales, outlier, score[i:j], scratch)

    done = in_time(anneal, len(starts), scene.deadline, STARTS_A_CHECK)
    return replace(starts, rotation=rotation, translation=translation, log_likelihood=score)[:done]


def anneal_on_points(
    scene: SearchFrame,
    starts: Hypotheses,
    first_scale: float,
    *,
    outliers: float | None = None,
    every: bool = False,
    steps: int | None = None,
) -> Hypotheses:
    """Anneal poses on all 3D points from a first scale, radians, down to the smallest one or for some `steps`.

    The distinct poses have no NFA. The bearings are those of the fine stage, or `every` one; the expected outlier
    fraction is that of the settings unless it is given.
    """
    bearings = None if every else FINE_BEARINGS
    outliers = scene.settings.outliers if outliers is None else outliers
    rounds = max(4, math.ceil(math.log(scene.smallest_scale / first_scale) / math.log(COOLING)))
    scales = (first_scale * COOLING ** np.arange(rounds if steps is None else steps)).astype(np.float32)
    tiles, points = scene.tiles(bearings)
    tiles, outlier = tiles.with_margin(first_scale), scene.outlier_density(outliers)
    rotation, translation = starts.rotation.copy(), starts.translation.copy()
    result = np.zeros((len(starts), 3), np.float32)

    def anneal(i: int, j: int) -> None:
        pairs = 0
        while i < j:
            scratch = sparse_scratch(tiles, len(points.b), pairs)
            poses = rotation[i:j], translation[i:j]
            i += descend_sparse(tiles, points, *poses, scales, outlier, COOLING_PATIENCE, result[i:j], scratch)
            pairs = 2 * len(scratch.near.point)  # the buffer was too small for the number of close points

    done = in_time(anneal, len(starts), scene.deadline, thread_count())
    score = result[:, 0] + np.float32(math.log(1 - outliers))  # mixture factor: makes outlier fractions comparable
    ends = replace(
        starts.unweighed(),
        rotation=rotation,
        translation=translation,
        log_likelihood=score,
        match_count=result[:, 1].astype(np.float64) * min(len(scene.offsets), len(scene.points3d)),
        scale=result[:, 2],
    )
    return select_distinct(ends[:done], scene, done)


def perturb_about_centroid(
    scene: SearchFrame,
    rotation: Array32,
    translation: Array32,
    vectors: Array32,
    shifts: Array32,
    *,
    basin_count: int = 0,
) -> Hypotheses:
    """Return copies of k poses, adjacent for each, rotated by vectors (s, 3) about the centroid and shifted (s, 3).

    s is a multiple of k. With this centre, an error of the rotation moves the camera and leaves the points in view.
    """
    centroid, copies = scene.bulk3d.mean(0), len(vectors) // max(len(rotation), 1)
    perturbations = Rotation.from_rotvec(vectors).as_matrix().astype(np.float32)
    turned = (perturbations.reshape(len(rotation), 3 * copies, 3) @ rotation).reshape(-1, 3)
    seen = np.repeat(rotation @ centroid + translation, copies, 0)
    shifted = seen + shifts - (turned @ centroid).reshape(-1, 3)
    return Hypotheses.from_poses(turned.reshape(-1, 3, 3), shifted.astype(np.float32), basin_count=basin_count)


def finish(scene: SearchFrame, poses: Hypotheses, annealed: int | None = None) -> Hypotheses:
    """Anneal the first `annealed` poses, None for all, again on every bearing; the others are kept.

    Poses are distinct and best first, before and after. The best two are also annealed with each of
    `settings.end_outliers`.
    """
    settings, count = scene.settings, len(poses) if annealed is None else min(annealed, len(poses))
    runs = [(i, settings.outliers) for i in range(count)]
    runs += [(i, share) for i in range(min(2, count)) for share in settings.end_outliers]
    ends: list[Hypotheses] = []
    for i, share in runs:
        if scene.deadline.passed():
            break
        first_scale = END_SCALE * float(poses.scale[i])
        if _outlasts_deadline(scene, poses[i : i + 1], first_scale):
            break
        end = anneal_on_points(scene, poses[i : i + 1], first_scale, outliers=share, every=True)
        ends.append(end if len(ends) < count else end.as_dependent())
    return select_distinct(Hypotheses.concatenate([*ends, poses[min(len(ends), count) :]]), scene, KEPT_CANDIDATES)


def anneal_to_end(
    scene: SearchFrame, rotations: NDArray[np.float64], translations: NDArray[np.float64], scale: float
) -> Hypotheses:
    """Anneal poses (c, 3, 3), (c, 3) of a problem to the end on all points, from residuals of `scale` radians.

    The result is in the frame of the problem. After the deadline the poses are returned unchanged.
    """
    starts = Hypotheses.from_poses(*scene.enter(rotations, translations))
    starts = replace(starts, scale=np.full(len(starts), scale, np.float32))
    ends = finish(scene, starts)  # none after the deadline
    return to_problem_frame(ends if len(ends) else starts, scene)


def _outlasts_deadline(scene: SearchFrame, pose: Hypotheses, first_scale: float) -> bool:
    """Return whether annealing a pose (1,) on every bearing would last beyond the deadline; False for few points.

    The time is that of one step at the first scale, and of further ones whose close points become fewer.
    """
    if math.isinf(scene.deadline.at) or len(scene.offsets) * len(scene.points3d) < TIMED_PAIRS:
        return False
    begun = Clock.now()
    anneal_on_points(scene, pose, first_scale, every=True, steps=1)
    now = Clock.now()
    return now + (now - begun) / (1 - COOLING**2) > scene.deadline.at
