"""Another content of the same lattice: a marker, a text or a display of the same kind that shows something else.

Any two markers of a kind share many points, so such a pose fits far better than chance. The motions of the scene show
it: unmatched image points lie where motions carry scene points, and hardly more scene points are matched than motions
carry onto others.
"""

import math

import numpy as np
from scipy.spatial import cKDTree
from scipy.stats import binom

from bpnp.arrays import Array
from bpnp.search.image_statistics import Outline
from bpnp.search.possible_matches import MATCH_REACH
from bpnp.search.verdict.decide import Case
from bpnp.search.verdict.limits import LEAST_MARGIN
from bpnp.search.verdict.reasons import objection

FEWEST_ON_SITES = 2  # unmatched image points on empty places of the lattice; one is chance [points; not tuned]
MOST_MOVED = 400_000  # number of points, times motions, up to which a scene is examined [points; cost]


def other_content(case: Case) -> Case:
    """Return a case against which speaks that the image may show another content of the scene's lattice."""
    problem, seen = case.problem, case.explained
    motions = case.symmetry.of(case.candidates)
    motions = motions.select(motions.scale == 1)
    left = problem.bearings[problem.image.chosen[~seen.near]]
    if len(left) < FEWEST_ON_SITES or not 0 < 2 * len(motions.scale) * len(problem.points3d) <= MOST_MOVED:
        return case
    rotation, translation = case.pose
    own = case.directions
    outline = Outline(problem.image, own)
    moved = np.concatenate([motions.apply(problem.points3d), motions.inverse().apply(problem.points3d)])
    shown = moved @ rotation.T + translation
    shown /= np.maximum(np.linalg.norm(shown, axis=-1, keepdims=True), 1e-300)
    reach = MATCH_REACH * case.match_scale
    among = outline.contains(shown)
    away = cKDTree(own[np.isfinite(own[:, 0])]).query(shown)[0]
    sites, left = shown[among & (away > 2 * reach)], left[outline.contains(left)]
    if not len(sites) or len(left) < FEWEST_ON_SITES:
        return case
    count = int((cKDTree(sites).query(left)[0] < reach).sum())
    cells = np.unique(np.round(sites @ problem.image.axes / (2 * reach)), axis=0)
    by_chance = min(len(cells) * math.pi * reach**2 / outline.area, 1.0)
    if count < FEWEST_ON_SITES or binom.logsf(count - 1, len(left), by_chance) > -LEAST_MARGIN * math.log(10):
        return case
    visible = np.isfinite(own[:, 0])
    shared = ((among & (away < 2 * reach)).sum(0) + 1) / (among.sum(0) + 2)
    matched = len(np.unique(seen.points[seen.near]))
    decades = log10_tail(shared[visible], matched) + math.log10(len(moved))
    return case if decades <= -LEAST_MARGIN else case.against(objection("other_content", count=count))


def log10_tail(probabilities: Array, least: int) -> float:
    """Return log10 of the probability that at least so many of independent events (n,) occur.

    >>> round(log10_tail(np.full(10, 0.5), 10), 4)  # 2^-10
    -3.0103
    """
    counts = np.zeros(len(probabilities) + 1)
    counts[0] = 1.0
    for p in probabilities.tolist():
        counts[1:] = counts[1:] * (1 - p) + counts[:-1] * p
        counts[0] *= 1 - p
    return math.log10(max(float(counts[least:].sum()), 1e-300))
