"""The stages of the search: starts annealed on coarse clusters, the best on finer ones, few on all points."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from bpnp.compilation import in_threads
from bpnp.search.candidates import Candidates, best_distinct, merged
from bpnp.search.kernels.dense import descend
from bpnp.search.kernels.grid import build_grid, descend_sparse
from bpnp.search.scene import Scene
from bpnp.search.settings import Batch, ClusterStage, Recipe
from bpnp.search.starts import Prior, draw_poses


@dataclass(frozen=True)
class Deadline:
    """When to stop, in seconds of `time.monotonic`. A stage that has begun ends what it is at and drops the rest."""

    at: float = math.inf

    @classmethod
    def after(cls, seconds: float | None) -> "Deadline":
        """So many seconds from now; None: never."""
        return cls() if seconds is None else cls(time.monotonic() + seconds)

    def passed(self) -> bool:
        return time.monotonic() >= self.at


def run_batch(
    scene: Scene,
    size: Batch,
    recipe: Recipe,
    prior: Prior | None,
    best: Candidates,
    outliers: float,
    deadline: Deadline,
) -> Candidates:
    """One batch of starts, from clusters to all points, and beside them starts around the best poses so far."""
    rotation, translation = draw_poses(scene.spread, scene.bulk3d, size.starts, recipe, prior, scene.rng)
    starts = Candidates.unscored(rotation, translation, hits=1)
    coarse = anneal_on_clusters(scene, starts, size.coarse, recipe.first_scale, outliers, deadline)
    poses = Candidates.concatenated([coarse, shaken(scene, best)])
    return _anneal_further(scene, poses, size.middle, outliers, deadline)


def refine_batch(scene: Scene, starts: Candidates, outliers: float, deadline: Deadline) -> Candidates:
    """From a few poses, and from poses shaken around them, through the finer clusters to all points."""
    around = Candidates.concatenated([starts, shaken(scene, starts)])
    clustered = _anneal_further(scene, around, scene.settings.middle, outliers, deadline)
    # A start that is right already needs no clusters, which would only shake it.
    first_scale = scene.settings.middle.last_scale * scene.spread
    direct = anneal_on_points(scene, starts, first_scale, outliers, deadline, bearings=scene.settings.fine.bearings)
    return merged([clustered, direct], scene)


def _anneal_further(
    scene: Scene, poses: Candidates, middle: ClusterStage, outliers: float, deadline: Deadline
) -> Candidates:
    """From coarse poses through the finer clusters to all points."""
    settings = scene.settings
    poses = anneal_on_clusters(scene, poses, middle, settings.coarse.last_scale, outliers, deadline)
    first_scale = settings.middle.last_scale * scene.spread
    return anneal_on_points(scene, poses, first_scale, outliers, deadline, bearings=settings.fine.bearings)


def anneal_on_clusters(
    scene: Scene, starts: Candidates, stage: ClusterStage, first_scale: float, outliers: float, deadline: Deadline
) -> Candidates:
    """The likeliest distinct poses that `starts` reach on the stage's clusters, best first; translations may be alike.

    first_scale: in spreads of the bearings.
    """
    bearings, points = scene.clusters(stage.clusters)
    sides, outlier = (tuple(bearings), tuple(points)), scene.outlier_density(outliers)
    scales = (scene.spread * np.geomspace(first_scale, stage.last_scale, stage.iterations)).astype(np.float32)
    rotation, translation, score = starts.rotation.copy(), starts.translation.copy(), starts.score.copy()

    def anneal(i: int, j: int) -> None:
        descend(*sides, rotation[i:j], translation[i:j], scales, outlier, score[i:j])

    done = in_time(anneal, len(starts), deadline, scene.settings.starts_a_check)
    ends = replace(starts, rotation=rotation, translation=translation, score=score)[:done]
    return best_distinct(ends, scene, stage.kept, degrees=stage.apart_deg, shift=math.inf)


def anneal_on_points(
    scene: Scene, starts: Candidates, first_scale: float, outliers: float, deadline: Deadline, *, bearings: int | None
) -> Candidates:
    """Distinct poses that `starts` reach on all 3D points and the first `bearings` bearings (None for all).

    first_scale: radians.
    """
    fine = scene.settings.fine
    rounds = max(4, math.ceil(math.log(scene.smallest_scale / first_scale) / math.log(fine.cooling)))
    scales = (first_scale * fine.cooling ** np.arange(rounds)).astype(np.float32)
    image, points = scene.sides(bearings)
    grid, outlier = build_grid(image, float(scales[-1])), scene.outlier_density(outliers)
    rotation, translation = starts.rotation.copy(), starts.translation.copy()
    result = np.empty((len(starts), 3), np.float32)

    def anneal(i: int, j: int) -> None:
        descend_sparse(
            tuple(grid), tuple(points), rotation[i:j], translation[i:j], scales, outlier, fine.patience, result[i:j]
        )

    done = in_time(anneal, len(starts), deadline, torch.get_num_threads())
    score = result[:, 0] + np.float32(math.log(1 - outliers))  # the mixture's factor, for shares to be compared
    ends = replace(
        starts, rotation=rotation, translation=translation, score=score, matched=result[:, 1], scale=result[:, 2],
        log10_false_alarms=np.full(len(starts), math.nan),
    )  # fmt: skip
    return best_distinct(ends[:done], scene, done)


def shaken(scene: Scene, poses: Candidates) -> Candidates:
    """Starts around the best poses; those of a batch that end there are no evidence for it, hence no hits."""
    shaking = scene.settings.shaking
    rotation = np.repeat(poses.rotation[: shaking.poses], shaking.copies, 0)
    vector = math.radians(shaking.rotation_deg) * scene.rng.standard_normal((len(rotation), 3))
    translation = np.repeat(poses.translation[: shaking.poses], shaking.copies, 0)
    depth = np.linalg.norm(translation, axis=-1, keepdims=True)
    moved = translation + shaking.translation * depth * scene.spread * scene.rng.standard_normal(translation.shape)
    turned = Rotation.from_rotvec(vector).as_matrix() @ rotation
    return Candidates.unscored(turned.astype(np.float32), moved.astype(np.float32))


def finish(
    scene: Scene,
    poses: Candidates,
    outliers: float,
    deadline: Deadline,
    others: tuple[float, ...] | None = None,
    annealed: int | None = None,
) -> Candidates:
    """One or more poses, annealed once more on every bearing, the best two with several shares of outliers.

    others: these shares beside `outliers`; None for `settings.end_outliers`. annealed: of the poses, from the best one;
    the rest stay as they are. None for all.
    """
    shares = scene.settings.end_outliers if others is None else others
    rest = poses[len(poses) if annealed is None else annealed :]
    poses = poses[: len(poses) - len(rest)]
    runs = [(i, outliers) for i in range(len(poses))]
    runs += [(i, share) for i in range(min(2, len(poses))) for share in shares]
    ends: list[Candidates] = []
    for i, share in runs:
        if deadline.passed():
            ends.append(poses[len(ends) :])  # as they are
            break
        pose = poses[i : i + 1]
        first_scale = scene.settings.end_scale * float(pose.scale[0])
        ends.append(anneal_on_points(scene, pose, first_scale, share, deadline, bearings=None))
    return best_distinct(Candidates.concatenated([*ends, rest]), scene, scene.settings.kept)


def in_time(work: Callable[[int, int], None], count: int, deadline: Deadline, at_once: int) -> int:
    """Run work(first, last) on shares of range(count) in threads; how many were done when the deadline passed.

    The first `at_once` are always done.
    """
    step = count if math.isinf(deadline.at) else at_once
    done = 0
    while done < count and not (done and deadline.passed()):
        last = min(done + step, count)
        in_threads(lambda i, j, first=done: work(first + i, first + j), last - done)  # type: ignore[misc]
        done = last
    return done
