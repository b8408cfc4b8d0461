"""Raster search: of many starts, around a rough pose or over all rotations, those go on whose points fall on bearings
more often than chance lets them.

Annealing on clusters loses a pose among many outliers even if it begins there: at scales at which 64 clusters stand for
a thousand points the true pose is no optimum. At a scale of a few hundredths of the view it is one, in a basin so
narrow that it takes some 10^5 starts to hit within the range of a prior; at a coarser one, where chance does not fill
the view yet, thousands do. They are affordable because each is only looked up, not annealed: a point that falls at x
adds

    log(w + (1 - w) d_s(x) / d_b(x)) - its mean near x,

d_s the density of the bearings smoothed by the small scale s, d_b by a larger one, w the share of outliers. So a point
adds nothing in the mean if it falls where it does by chance, wherever the bearings are dense, and nothing outside.

The scale s then shrinks by steps. At each the poses that are left are copied, each copy moved about as far as s, and
all are looked up again: an annealed particle filter (Deutscher, Blake, Reid, CVPR 2000). At a smaller scale a point
that falls on a bearing tells more, and the copies find the narrower optimum within the wide one.
"""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from bpnp.loops.parallel import in_time
from bpnp.search.annealing import anneal_on_points, turned_about_middle
from bpnp.search.hypotheses import Hypotheses
from bpnp.search.kernels.raster import Raster, add_up
from bpnp.search.scene import Scene
from bpnp.search.settings import RasterSearch, RasterShape
from bpnp.search.starts import PosePrior, Prior, aim_of, draw_poses

WIDE = 5.0  # standard deviations of a smoothing beyond which its kernel is 0
WIDEST = 2 * math.tan(math.radians(60))  # half a raster's side: 120 degrees off the axis, where a view is all around
NARROW = 4.0  # cells of the raster, of the standard deviation of a smoothing that is added up cell by cell


def search_near(scene: Scene, prior: PosePrior, rule: RasterSearch | None = None) -> Hypotheses:
    """Poses from starts drawn from a prior with a translation: the likeliest of them by a raster, annealed.

    rule: None for those of the settings, one after the other.
    """
    rules = scene.settings.near if rule is None else (rule,)
    starts = (drawn_around(scene, prior, starts_of(scene, prior, one)) for one in rules)
    return Hypotheses.concatenate([raster_search(scene, *each) for each in zip(starts, rules, strict=True)])


def raster_search(scene: Scene, poses: Hypotheses, rule: RasterSearch) -> Hypotheses:
    """Distinct poses from those starts under which most points fall on bearings by a raster, annealed."""
    for points, kept in zip(rule.screens.points, rule.screens.kept, strict=True):
        poses, _ = looked_up(scene, poses, rule.raster, rule.narrowing.first_scale, points, kept)
    steps, scale = rule.narrowing, rule.narrowing.first_scale
    origin = np.arange(len(poses))  # the start that each pose is a copy of
    for step in range(1, steps.steps + 1):
        if scene.deadline.passed():
            break
        scale = steps.first_scale * (steps.last_scale / steps.first_scale) ** (step / steps.steps)
        copies = moved(scene, poses, scale, steps.copies)
        poses, chosen = looked_up(scene, copies, rule.raster, scale, steps.points, rule.screens.kept[-1])
        origin = origin[chosen // steps.copies]
    poses, origin = poses[: rule.annealed], origin[: rule.annealed]
    once = np.isin(np.arange(len(poses)), np.unique(origin, return_index=True)[1])
    poses = replace(poses, basin_count=np.where(once, poses.basin_count, 0))
    outliers = max(scene.settings.outliers, rule.raster.outliers)
    return anneal_on_points(scene, poses, scale * scene.spread, outliers=outliers)


def search_everywhere(scene: Scene, number: int, prior: Prior | None) -> Hypotheses:
    """Distinct poses from as many starts as for a wide prior, but over all rotations, aimed at one place of the view.

    number: of the search, counted from 0, on which the place depends. Near one place the right pose competes with fewer
    others, and where it is the right one few searches of all rotations miss it.
    """
    settings = scene.settings
    rule, aim = settings.everywhere, aim_of(number)
    drawn = draw_poses(scene.spread, scene.bulk3d, rule.draws.starts, settings.recipes[0], prior, scene.rng, aim)
    return raster_search(scene, Hypotheses.from_poses(*drawn, basin_count=1), rule)


def search_beside(scene: Scene, pose: Hypotheses, rule: RasterSearch) -> Hypotheses:
    """Distinct poses around one, as far as the rule's widest prior reaches; their basin counts are 0."""
    prior = PosePrior(pose.rotation[0], pose.translation[0], rule.draws.wide_deg)
    sigma = rule.draws.wide_shift * distance_of(scene, prior)
    return search_near(scene, prior._replace(translation_sigma=sigma), rule).as_dependent()


def is_near(scene: Scene, prior: PosePrior) -> bool:
    """Whether a prior is narrow enough for starts around it to meet the basin of the right pose."""
    return (
        prior.translation is not None and _volume(scene, prior, scene.settings.near[0]) <= scene.settings.most_volumes
    )


def starts_of(scene: Scene, prior: PosePrior, rule: RasterSearch) -> int:
    """As many starts as lie as densely around a narrow prior as `Draws.starts` do around a wide one."""
    share = min(_volume(scene, prior, rule), 1.0)
    return int(np.clip(rule.draws.starts * share, rule.draws.least_starts, rule.draws.starts))


def _volume(scene: Scene, prior: PosePrior, rule: RasterSearch) -> float:
    """Of the poses that a prior allows, in that of the rule's wide one."""
    wide = math.radians(rule.draws.wide_deg), rule.draws.wide_shift * distance_of(scene, prior)
    return (math.radians(prior.rotation_sigma_deg) / wide[0]) ** 3 * (prior.translation_sigma / wide[1]) ** 3


def drawn_around(scene: Scene, prior: PosePrior, count: int) -> Hypotheses:
    """Poses drawn from the prior, the first one its mean."""
    mean = np.asarray(prior.rotation, np.float32)[None], np.asarray(prior.translation, np.float32)[None]
    vectors = math.radians(prior.rotation_sigma_deg) * scene.rng.standard_normal((count, 3), np.float32)
    shifts = np.float32(prior.translation_sigma) * scene.rng.standard_normal((count, 3), np.float32)
    vectors[0], shifts[0] = 0, 0
    return turned_about_middle(scene, *mean, vectors, shifts, basin_count=1)


def admitted(scene: Scene, poses: Hypotheses, prior: Prior | None) -> Hypotheses:
    """Return the poses within `settings.admitted` standard deviations of a `PosePrior` of the problem; all without."""
    if not isinstance(prior, PosePrior):
        return poses
    mean = scene.enter_prior(prior)
    assert isinstance(mean, PosePrior)
    middle, rotation = scene.bulk3d.mean(0), np.asarray(mean.rotation)
    cosine = (np.einsum("sij,ij->s", poses.rotation, rotation) - 1) / 2
    off = np.square(np.degrees(np.arccos(np.clip(cosine, -1, 1))) / mean.rotation_sigma_deg)
    if mean.translation is not None:
        shift = poses.rotation @ middle + poses.translation - (rotation @ middle + np.asarray(mean.translation))
        off = off + np.square(shift / mean.translation_sigma).sum(-1)
    return poses[off <= scene.settings.admitted**2]


def moved(scene: Scene, poses: Hypotheses, scale: float, copies: int) -> Hypotheses:
    """Each pose and copies of it whose points fall about `scale`, in spreads of the bearings, beside its own."""
    vectors, shifts = np.float32(scale) * scene.rng.standard_normal((2, copies * len(poses), 3), np.float32)
    depth = np.linalg.norm(poses.rotation @ scene.bulk3d.mean(0) + poses.translation, axis=-1)
    shifts *= np.repeat(depth, copies)[:, None] * np.array([scene.spread, scene.spread, 1], np.float32)
    vectors[::copies], shifts[::copies] = 0, 0
    copied = turned_about_middle(scene, poses.rotation, poses.translation, vectors, shifts)
    return replace(copied, basin_count=poses.basin_count.repeat(copies))


def around_each(scene: Scene, poses: Hypotheses) -> Hypotheses:
    """Copies of poses that come from elsewhere; basin counts 0, since that copies end alike is no evidence."""
    return moved(scene, poses, scene.settings.copied_scale, scene.settings.copies).as_dependent()


def looked_up(
    scene: Scene, poses: Hypotheses, shape: RasterShape, scale: float, points: int, kept: int
) -> tuple[Hypotheses, NDArray[np.int64]]:
    """The `kept` poses under which so many points fall best on the bearings, of all companions too, best first, and
    their places."""
    score = np.zeros(len(poses), np.float32)
    cameras = [(scene, poses.rotation, poses.translation)]
    cameras += [(x.scene, x.turn @ poses.rotation, poses.translation @ x.turn.T + x.shift) for x in scene.companions]
    views = [(raster_of(one, shape, scale), one.seen_points(points), r, t) for one, r, t in cameras]

    def look_up(i: int, j: int) -> None:
        for raster, seen, rotation, translation in views:
            weight, cell, own = np.empty_like(seen.b), np.empty(len(seen.b), np.int32), np.empty(j - i, np.float32)
            add_up(raster, seen, rotation[i:j], translation[i:j], own, weight, cell)
            score[i:j] += own

    done = in_time(look_up, len(poses), scene.deadline, scene.settings.lookups_a_check)
    best = np.arange(done)
    if len(best) > kept:  # much faster than to sort all of them
        best = best[np.sort(np.argpartition(-score[best], kept)[:kept])]
    best = best[np.argsort(-score[best], kind="stable")]
    return poses[best], best


def raster_of(scene: Scene, shape: RasterShape, scale: float) -> Raster:
    """The raster of a scene's bearings, smoothed by a scale in spreads of them; the scene keeps it."""
    if (shape, scale) not in scene.rasters:
        scene.rasters[shape, scale] = _drawn_raster(scene, shape, scale)
    return scene.rasters[shape, scale]


def _drawn_raster(scene: Scene, shape: RasterShape, scale: float) -> Raster:
    d = scene.offsets.astype(np.float64)
    at = 2 * d[:, :2] / np.maximum(2 + d[:, 2:], 1e-9)
    scale *= scene.spread
    half = min(float(np.abs(at).max()) + 3 * scale, WIDEST)
    cells = min(math.ceil(2 * half * shape.cells / scale), shape.most_cells)
    per_cell = cells / (2 * half)
    within = (np.abs(at) < half).all(1)
    place = np.minimum(((at[within] + half) * per_cell).astype(np.int64), cells - 1)
    place = place[:, 1] * cells + place[:, 0]
    counts = np.bincount(place, scene.image.weights[within], cells**2).reshape(cells, cells).astype(np.float32)
    wide = shape.background * scale * per_cell
    near, around = _smoothed(counts, scale * per_cell), _smoothed(counts, wide)
    inside = around > shape.inside * around.max()
    inside[[0, -1]] = inside[:, [0, -1]] = False
    gain = np.log(shape.outliers + (1 - shape.outliers) * near / np.where(inside, around, 1))
    seen = inside.astype(np.float32)
    mean = _smoothed(seen * gain, wide) / np.maximum(_smoothed(seen, wide), 1e-6)
    return Raster(np.where(inside, gain - mean, 0).astype(np.float32), np.float32(half), np.float32(per_cell))


def distance_of(scene: Scene, prior: PosePrior) -> float:
    """Of the middle of the points from the camera of the prior."""
    middle = scene.bulk3d.mean(0)
    return max(float(np.linalg.norm(np.asarray(prior.rotation) @ middle + np.asarray(prior.translation))), 1e-6)


def _smoothed(values: NDArray[np.float32], cells: float) -> NDArray[np.float32]:
    """Values (g, g), 0 around them, after a Gaussian filter with a standard deviation of so many cells.

    A wide filter in two steps of half the variance, the first one to a coarser grid, as products of matrices: sums at a
    spacing of 0.6 standard deviations are exact to 3e-6, and cost a tenth.
    """
    if cells < NARROW:
        return np.asarray(gaussian_filter(values, cells, mode="constant"))
    step = 0.6 * cells
    away = (np.arange(len(values))[:, None] - np.arange(-3 * cells, len(values) + 3 * cells, step)) / cells
    kernel = np.where(np.abs(away) < WIDE, math.sqrt(step / math.pi) / cells * np.exp(-(away**2)), 0).astype(np.float32)
    return np.asarray(kernel @ (kernel.T @ values @ kernel) @ kernel.T)
