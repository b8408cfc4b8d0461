"""Density-map search: preselect many initial poses by how well their projected points fall on dense bearings.

The initial poses lie around a rough pose or over all rotations. Annealing on clusters loses a pose among many outliers
even if it begins there. At scales at which 64 clusters stand for a thousand points, the true pose is no optimum. At a
scale of a few hundredths of the view it is one. Its basin is then so narrow that about 10^5 starts within the range of
a prior are needed to reach it. At a coarser scale, where chance does not fill the view yet, thousands suffice. They
are affordable because each is only scored on the map, not annealed: a point that falls at x adds

    log(w + (1 - w) d_s(x) / d_b(x)) - its mean near x,

d_s the density of the bearings smoothed by the small scale s, d_b by a larger one, w the outlier fraction. A point that
falls somewhere by chance adds nothing in the mean, even where bearings are dense. Outside the view it adds nothing.

The scale s then shrinks by steps. At each step the remaining poses are copied, each copy is moved by about s, and all
are scored again: an annealed particle filter (Deutscher, Blake, Reid, CVPR 2000). At a smaller scale a point that falls
on a bearing is more informative. The copies find the narrower optimum within the wide one.
"""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.special import ndtr, ndtri

from bpnp.runtime import in_time
from bpnp.search.hypotheses import Hypotheses
from bpnp.search.kernels.density_map import DensityMap, add_up
from bpnp.search.refine.annealing import RECIPES, anneal_on_points, perturb_about_centroid
from bpnp.search.search_frame import SearchFrame
from bpnp.search.settings import DensitySearch, DensityShape, Draws, Narrowing, Preselection
from bpnp.search.starts import PosePrior, Prior, aim_of, draw_poses

KERNEL_SIGMAS = 5.0  # distance beyond which a smoothing kernel is 0 [standard deviations; numerics]
# Half side of the largest density map: 120 degrees off the axis.
WIDEST_MAP = 2 * math.tan(math.radians(60))  # [stereographic coordinate; convention]
NARROW_CELLS = 4.0  # standard deviation below which a smoothing is computed cell by cell [cells; cost]
# Largest volume of a prior that counts as near, in multiples of the widest one with a full number of starts; the prior
# of a map view has 9.
MOST_VOLUMES = 100.0  # [volumes; calibration]
# 94 % of the poses drawn from it are.
ADMITTED_SIGMAS = 3.5  # deviation from a prior within which proposals are used [standard deviations; derived]
COPIES = 6  # number of copies of each pose from another source [poses; calibration]
# Angular distance of the points of a copy from those of its pose, in units of the RMS angular radius of the bearings.
# Optima of one basin are about as far apart.
COPIED_SCALE = 0.1  # [RMS angular radii; calibration]
LOOKUPS_A_CHECK = 4096  # number of poses scored on the density map between two checks of the deadline [poses; cost]
LOCAL = DensitySearch(  # density-map search around a pose that the search has found [`DensitySearch`; calibration]
    Draws(2**13, 10.0, 0.1, 2**13),
    Preselection((50, 300), (2**11, 2**8)),
    Narrowing(0.08, 0.015, points=600),
    annealed=12,
)
EVERYWHERE = DensitySearch(  # density-map search over all rotations [`DensitySearch`; calibration]
    Draws(2**15), Preselection((50, 300), (2**12, 2**9)), Narrowing(0.08, 0.015, points=600), annealed=12
)


def search_near(scene: SearchFrame, prior: PosePrior, density: DensitySearch | None = None) -> Hypotheses:
    """Return the distinct annealed poses of density-map searches from a prior with a translation, in the scene's frame.

    None for all searches of `settings.near`.
    """
    searches = scene.settings.near if density is None else (density,)
    starts = (
        draw_around(scene, prior, starts_of(scene, prior, one), reach_across(scene, prior, one)) for one in searches
    )
    return Hypotheses.concatenate([search_density(scene, *each) for each in zip(starts, searches, strict=True)])


def search_density(scene: SearchFrame, poses: Hypotheses, density: DensitySearch) -> Hypotheses:
    """Preselect initial poses on a density map, narrow the scale, and anneal the best.

    Copies of one initial pose count once for the basin counts.
    """
    for points, kept in zip(density.preselection.points, density.preselection.kept, strict=True):
        poses, _ = preselect(scene, poses, density.density_map, density.narrowing.first_scale, points, kept)
    steps, scale = density.narrowing, density.narrowing.first_scale
    origin = np.arange(len(poses))  # the start that each pose is a copy of
    for step in range(1, steps.steps + 1):
        if scene.deadline.passed():
            break
        scale = steps.first_scale * (steps.last_scale / steps.first_scale) ** (step / steps.steps)
        copies = perturb(scene, poses, scale, steps.copies)
        poses, chosen = preselect(
            scene, copies, density.density_map, scale, steps.points, density.preselection.kept[-1]
        )
        origin = origin[chosen // steps.copies]
    poses, origin = poses[: density.annealed], origin[: density.annealed]
    once = np.isin(np.arange(len(poses)), np.unique(origin, return_index=True)[1])
    poses = replace(poses, basin_count=np.where(once, poses.basin_count, 0))
    outliers = max(scene.settings.outliers, density.density_map.outliers)
    return anneal_on_points(scene, poses, scale * scene.spread, outliers=outliers)


def search_everywhere(scene: SearchFrame, number: int, prior: Prior | None) -> Hypotheses:
    """Run a density-map search over all rotations, or those of a prior of the scene, aimed at a position in the view.

    The position is that of the search's number, from 0. Near one position the correct pose has fewer competitors: if it
    is correct, few searches miss the pose.
    """
    density, aim = EVERYWHERE, aim_of(number)
    drawn = draw_poses(scene.spread, scene.bulk3d, density.draws.starts, RECIPES[0], prior, scene.rng, aim)
    return search_density(scene, Hypotheses.from_poses(*drawn, basin_count=1), density)


def search_around(scene: SearchFrame, pose: Hypotheses, density: DensitySearch) -> Hypotheses:
    """Run a local search around one pose in the frame of the scene, with the widest prior of the settings.

    The distinct annealed poses have basin counts of 0.
    """
    prior = PosePrior(pose.rotation[0], pose.translation[0], density.draws.wide_deg)
    sigma = density.draws.wide_shift * distance_of(scene, prior)
    return search_near(scene, prior._replace(translation_sigma=sigma), density).as_dependent()


def is_near(scene: SearchFrame, prior: PosePrior) -> bool:
    """Return True if a prior has a translation and is narrow enough for its starts to reach the right basin."""
    return prior.translation is not None and _volume(scene, prior, scene.settings.near[0]) <= MOST_VOLUMES


def starts_of(scene: SearchFrame, prior: PosePrior, density: DensitySearch) -> int:
    """Return the number of starts that covers a narrow prior as densely as `Draws.starts` cover a wide one."""
    share = min(_volume(scene, prior, density), 1.0)
    return int(np.clip(density.draws.starts * share, density.draws.least_starts, density.draws.starts))


def _volume(scene: SearchFrame, prior: PosePrior, density: DensitySearch) -> float:
    """Return the volume of the poses that a prior allows in this view, in multiples of the wide prior."""
    distance, draws = distance_of(scene, prior), density.draws
    turn = math.radians(prior.rotation_sigma_deg) / math.radians(draws.wide_deg)
    across = min(
        prior.translation_sigma, reach_across(scene, prior, density) / math.sqrt(3)
    )  # of a uniform distribution, where cut
    across /= draws.wide_across * scene.spread * distance
    return turn**3 * across**2 * prior.translation_sigma / (draws.wide_shift * distance)


def reach_across(scene: SearchFrame, prior: PosePrior, density: DensitySearch) -> float:
    """Return how far from the centre of the view the centroid of the points may lie along each axis, scene units.

    Farther away, most of the points are outside the view; a telephoto view is much narrower than most priors. Infinite
    for a rig, whose other cameras see the points too.
    """
    if scene.companions:
        return math.inf
    covariance, axis = np.cov(scene.bulk3d.T, bias=True), np.asarray(prior.rotation)[2]
    width = math.sqrt(max(float(np.trace(covariance) - axis @ covariance @ axis), 0.0))
    return density.draws.reach * math.hypot(scene.spread * distance_of(scene, prior), width)


def draw_around(scene: SearchFrame, prior: PosePrior, count: int, reach: float = math.inf) -> Hypotheses:
    """Draw poses with basin counts of 1 from a prior of the scene with a translation; the first is its mean.

    The centroid of the points is at most `reach` scene units from the centre of the view along each axis; the bound is
    extended to the mean of the prior.
    """
    mean = np.asarray(prior.rotation, np.float32)[None], np.asarray(prior.translation, np.float32)[None]
    vectors = math.radians(prior.rotation_sigma_deg) * scene.rng.standard_normal((count, 3), np.float32)
    shifts = scene.rng.standard_normal((count, 3), np.float32)
    centroid = np.asarray(prior.rotation) @ scene.bulk3d.mean(0) + np.asarray(prior.translation)
    for k in range(2):
        offset, sigma = float(centroid[k]), float(prior.translation_sigma)
        low, high = min(-reach, offset) - offset, max(reach, offset) - offset
        shifts[:, k] = _truncated(shifts[:, k], low / sigma, high / sigma)
    shifts *= np.float32(prior.translation_sigma)
    vectors[0], shifts[0] = 0, 0
    return perturb_about_centroid(scene, *mean, vectors, shifts, basin_count=1)


def _truncated(normal: NDArray[np.float32], low: float, high: float) -> NDArray[np.float32]:
    """Map standard normal values to the normal distribution between two bounds, by their quantiles."""
    first, last = ndtr(low), ndtr(high)
    return np.asarray(ndtri(first + (last - first) * ndtr(normal.astype(np.float64))), np.float32)


def select_admitted(scene: SearchFrame, poses: Hypotheses, prior: Prior | None) -> Hypotheses:
    """Select the poses of a scene within `ADMITTED_SIGMAS` standard deviations of a prior of the problem.

    All poses are returned unless it is a `PosePrior`.
    """
    if not isinstance(prior, PosePrior):
        return poses
    mean = scene.enter_prior(prior)
    assert isinstance(mean, PosePrior)
    centroid, rotation = scene.bulk3d.mean(0), np.asarray(mean.rotation)
    cosine = (np.einsum("sij,ij->s", poses.rotation, rotation) - 1) / 2
    off = np.square(np.degrees(np.arccos(np.clip(cosine, -1, 1))) / mean.rotation_sigma_deg)
    if mean.translation is not None:
        shift = poses.rotation @ centroid + poses.translation - (rotation @ centroid + np.asarray(mean.translation))
        off = off + np.square(shift / mean.translation_sigma).sum(-1)
    return poses[off <= ADMITTED_SIGMAS**2]


def perturb(scene: SearchFrame, poses: Hypotheses, scale: float, copies: int) -> Hypotheses:
    """Return each pose followed by `copies` - 1 randomly perturbed ones, with its basin count.

    The points move by an angular distance of `scale` RMS angular radii of the bearings.
    """
    vectors, shifts = np.float32(scale) * scene.rng.standard_normal((2, copies * len(poses), 3), np.float32)
    depth = np.linalg.norm(poses.rotation @ scene.bulk3d.mean(0) + poses.translation, axis=-1)
    shifts *= np.repeat(depth, copies)[:, None] * np.array([scene.spread, scene.spread, 1], np.float32)
    vectors[::copies], shifts[::copies] = 0, 0
    copied = perturb_about_centroid(scene, poses.rotation, poses.translation, vectors, shifts)
    return replace(copied, basin_count=poses.basin_count.repeat(copies))


def perturb_each(scene: SearchFrame, poses: Hypotheses) -> Hypotheses:
    """Return poses from other sources with perturbed copies; basin counts are 0, since copies are dependent."""
    return perturb(scene, poses, COPIED_SCALE, COPIES).as_dependent()


def preselect(
    scene: SearchFrame, poses: Hypotheses, shape: DensityShape, scale: float, points: int, kept: int
) -> tuple[Hypotheses, NDArray[np.int64]]:
    """Return the at most `kept` best poses on the density maps of all rig cameras, best first, and their indices.

    The bearings are smoothed by `scale` of their RMS angular radii, and `points` 3D points are scored. Fewer poses are
    scored after the deadline.
    """
    score = np.zeros(len(poses), np.float32)
    cameras = [(scene, poses.rotation, poses.translation)]
    cameras += [(x.scene, x.turn @ poses.rotation, poses.translation @ x.turn.T + x.shift) for x in scene.companions]
    views = [(density_map_of(one, shape, scale), one.seen_points(points), r, t) for one, r, t in cameras]

    def look_up(i: int, j: int) -> None:
        for density_map, seen, rotation, translation in views:
            weight, cell, own = np.empty_like(seen.b), np.empty(len(seen.b), np.int32), np.empty(j - i, np.float32)
            add_up(density_map, seen, rotation[i:j], translation[i:j], own, weight, cell)
            score[i:j] += own

    done = in_time(look_up, len(poses), scene.deadline, LOOKUPS_A_CHECK)
    best = np.arange(done)
    if len(best) > kept:  # much faster than sorting all of them
        best = best[np.sort(np.argpartition(-score[best], kept)[:kept])]
    best = best[np.argsort(-score[best], kind="stable")]
    return poses[best], best


def density_map_of(scene: SearchFrame, shape: DensityShape, scale: float) -> DensityMap:
    """Return the density map of the bearings of a scene, smoothed by `scale` of their RMS angular radii.

    The scene stores it.
    """
    if (shape, scale) not in scene.density_maps:
        scene.density_maps[shape, scale] = _draw_density_map(scene, shape, scale)
    return scene.density_maps[shape, scale]


def _draw_density_map(scene: SearchFrame, shape: DensityShape, scale: float) -> DensityMap:
    """Compute the density map that `density_map_of` stores."""
    d = scene.offsets.astype(np.float64)
    at = 2 * d[:, :2] / np.maximum(2 + d[:, 2:], 1e-9)
    scale *= scene.spread
    half = min(float(np.abs(at).max()) + 3 * scale, WIDEST_MAP)
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
    return DensityMap(np.where(inside, gain - mean, 0).astype(np.float32), np.float32(half), np.float32(per_cell))


def distance_of(scene: SearchFrame, prior: PosePrior) -> float:
    """Return the distance of the centroid of the points from the camera of the prior, at least 1e-6."""
    centroid = scene.bulk3d.mean(0)
    return max(float(np.linalg.norm(np.asarray(prior.rotation) @ centroid + np.asarray(prior.translation))), 1e-6)


def _smoothed(values: NDArray[np.float32], cells: float) -> NDArray[np.float32]:
    """Apply a Gaussian filter to values (g, g), 0 outside; `cells` is its standard deviation.

    A wide filter has two steps of half the variance, the first one to a coarser grid, as products of matrices. Sums at
    a spacing of 0.6 standard deviations are exact to 3e-6, and cost a tenth.
    """
    if cells < NARROW_CELLS:
        return np.asarray(gaussian_filter(values, cells, mode="constant"))
    step = 0.6 * cells
    away = (np.arange(len(values))[:, None] - np.arange(-3 * cells, len(values) + 3 * cells, step)) / cells
    weights = math.sqrt(step / math.pi) / cells * np.exp(-(away**2))
    kernel = np.where(np.abs(away) < KERNEL_SIGMAS, weights, 0).astype(np.float32)
    return np.asarray(kernel @ (kernel.T @ values @ kernel) @ kernel.T)
