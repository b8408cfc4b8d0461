"""How likely a pose fits by chance: the a-contrario number of false alarms, for 4 points or 10,000.

The question: were the image points unrelated to the scene, how many of all the poses that could have been tried would
fit as well as this one? Unrelated means: at scales finer than h, half the spread of the bearings, image point i falls
with the density l_i of the projected points around it, wherever those happen to lie. A pose that explains it predicts
the mixture

    x_i = 1 - w + w g_i / l_i,    g_i = sum_j N(f_i - u_j; s^2),    l_i = max(sum_j N(f_i - u_j; h^2), n / A)

u_j the direction in which the pose sees scene point j, N the normal density on the tangent plane, s the scale of the
residuals, w the share of the image points that have a partner, n the projected points in the view and A its solid
angle. For unrelated points x_i has the mean 1, so that the product of the x_i exceeds a bound b with a probability of
at most 1 / b (Markov). From this follow

    log10 NFA = log10 T - log10 mean_{s, w} prod_i x_i^(1 / c_i),

T = 2 (m)_3 (n)_3 / 6, the number of poses that fit three pairs exactly, (m)_3 = m (m - 1) (m - 2). The three largest
x_i are left out, whatever their c_i: three pairs fix the six degrees of freedom and are no evidence. c_i is the number
of image points within 2 s of point i: keypoints that lie together are one observation. The mean over a fixed set of
(s, w) counts what was looked at. A prior reduces T to the share of the poses that it allows.

Sources: A. Desolneux, L. Moisan, J.-M. Morel, Meaningful alignments, IJCV 2000; L. Moisan, B. Stival, A probabilistic
criterion to detect rigid point matches, IJCV 2004. That the likelihood ratio takes the place of a binomial tail keeps
the evidence of dense points, whose neighbours lie as close as their residuals.
"""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bpnp.compilation import compiler
from bpnp.search.point_sets import Labels, PointSets, faces, solid_angle

Array = NDArray[np.float64]
compiled = compiler(fastmath={"reassoc", "contract", "arcp", "nsz"}, error_model="numpy")

FIXING = 3  # pairs that fix a pose
SHARES = np.array([0.15, 0.4, 0.75])  # w
SCALE_STEP = 2.0  # from one s to the next
COARSEST = 0.5  # largest s, in spacings sqrt(A / m) of the image points: beyond, only the outline fits
OUTLINE = 0.5  # width of the smoothing of l, in spreads of the bearings: the outline is no evidence beyond it
MOST_SMOOTHED = 256  # projected points from which l is estimated
MOST_NEIGHBOURS = 64  # of one image point in g and c
FARTHEST = 40.0  # squared distance over s^2 beyond which a pair adds nothing to g
TOGETHER = 2.0  # distance in s below which image points are one observation
MOST_POINTS = 2000  # image points that are looked at, evenly spread over the given ones
FLOOR = 2e-4  # smallest s in spreads of the bearings: some hundredths of a pixel of an ordinary camera


def log10_false_alarms(sets: PointSets, rotation: Array, translation: Array) -> float:
    """log10 of the expected number of poses that fit unrelated points as well as (rotation, translation); see above.

    A pose under which three points or fewer are seen has the log10 of the number of tests: no evidence at all.

    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> points = rng.uniform(-1, 1, (12, 3))
    >>> seen = points + [0, 0, 6]
    >>> sets = PointSets(seen / np.linalg.norm(seen, axis=1, keepdims=True), points)
    >>> log10_false_alarms(sets, np.eye(3), np.array([0.0, 0, 6])) < -10  # the true pose
    True
    >>> log10_false_alarms(sets, np.eye(3), np.array([0.3, 0, 5])) > 0  # another one
    True
    """
    return float(log10_false_alarms_of(sets, rotation[None], translation[None])[0])


def log10_false_alarms_of(sets: PointSets, rotations: Array, translations: Array) -> Array:
    """`log10_false_alarms` (c,) of poses (c, 3, 3), (c, 3); what depends on the image alone is computed once."""
    tests = _log10_tests(sets)
    result = np.array([max(tests + sets.log10_share(r, t), 0.0) for r, t in zip(rotations, translations, strict=True)])
    if len(sets.bearings) > FIXING and len(result):
        image = _Image(sets)
        for k in range(len(result)):
            seen = _directions(sets, rotations[k], translations[k])
            if int(np.isfinite(seen[:, 0]).sum()) > FIXING:
                result[k] -= image.log_evidence(seen) / math.log(10)
    return result


def _log10_tests(sets: PointSets) -> float:
    """log10 of 2 (m)_3 (n)_3 / 3!: choices of three pairs with about two poses each; of labels that agree, if given."""
    m, n = len(sets.bearings), len(sets.points3d)
    choices = math.prod((m - i) * (n - i) / (i + 1) for i in range(FIXING))
    if sets.labels2d is not None and sets.labels3d is not None:
        groups = _label_groups(np.arange(m), sets.labels2d, sets.labels3d, n)
        choices = min(choices, float(math.comb(sum(len(rows) * len(columns) for rows, columns in groups), FIXING)))
    return math.log10(2 * max(choices, 1.0))


def _directions(sets: PointSets, rotation: Array, translation: Array) -> Array:
    """Unit directions (n, 3) in the camera's frame; NaN for a point in the camera or facing away."""
    camera = sets.points3d @ rotation.T + translation
    length = np.linalg.norm(camera, axis=-1, keepdims=True)
    seen = np.divide(camera, length, out=np.full_like(camera, np.nan), where=length > 0)
    if sets.normals3d is not None:
        seen[~faces(sets.normals3d, sets.cosines3d, camera, rotation)] = np.nan
    return seen


class _Image:
    """What the evidence of every pose has in common: the view, the scales s, and how many points lie together.

    The view is the rectangle on the tangent plane whose principal standard deviations are those of the bearings.
    """

    def __init__(self, sets: PointSets) -> None:
        bearings, m = sets.bearings, len(sets.bearings)
        self.sets = sets
        self.centre = bearings.mean(0)
        centred = bearings - self.centre
        self.spread = max(float(np.sqrt((centred**2).sum(-1).mean())), 1e-12)
        variance, axes = np.linalg.eigh(centred.T @ centred / max(len(bearings) - 1, 1))
        self.half_widths, self.axes = np.sqrt(3 * np.maximum(variance[1:], 1e-24)), axes[:, 1:]
        self.solid_angle = solid_angle(bearings)
        floor = max(sets.floor or 0.0, FLOOR * self.spread)
        coarsest = max(COARSEST * math.sqrt(self.solid_angle / m), 2 * floor)
        steps = max(3, 1 + math.ceil(math.log(coarsest / floor) / math.log(SCALE_STEP)))
        self.scales = np.geomspace(floor, coarsest, steps)
        self.chosen = np.arange(m) if m <= MOST_POINTS else np.linspace(0, m - 1, MOST_POINTS).astype(np.int64)
        crowd = _nearest(bearings, bearings[self.chosen], TOGETHER * coarsest)
        self.together = (crowd[:, None] <= TOGETHER * self.scales[:, None]).sum(-1)
        self.groups = _label_groups(self.chosen, sets.labels2d, sets.labels3d, len(sets.points3d))

    def log_evidence(self, seen: Array) -> float:
        """log mean_{s, w} prod_i x_i^(1 / c_i), the largest x_i left out, of points seen in directions (n, 3)."""
        logs = np.zeros((len(self.chosen), len(self.scales), len(SHARES)))
        for rows, columns in self.groups:
            used, bearings = seen[columns][np.isfinite(seen[columns, 0])], self.sets.bearings[self.chosen[rows]]
            near2 = _nearest(used, bearings, math.sqrt(FARTHEST) * float(self.scales[-1])) ** 2
            part = np.empty((len(rows), *logs.shape[1:]))
            _log_ratios(near2, self.density(bearings, used), self.scales, SHARES, part)
            logs[rows] = part
        fixing = np.partition(logs, len(self.chosen) - FIXING, 0)[-FIXING:]
        evidence = (logs / self.together[:, :, None]).sum(0) - np.maximum(fixing, 0).sum(0)
        return float(np.logaddexp.reduce(evidence.ravel())) - math.log(evidence.size)

    def density(self, bearings: Array, directions: Array) -> Array:
        """Directions per steradian around each bearing, smoothed by OUTLINE spreads; at least their mean density."""
        inside = (np.abs((directions - self.centre) @ self.axes) <= self.half_widths).all(-1)
        mean = max(int((inside & (directions @ self.centre > 0)).sum()), 1) / self.solid_angle
        some = directions[:: -(-len(directions) // MOST_SMOOTHED)] if len(directions) else directions
        if not len(some):
            return np.full(len(bearings), mean)
        width2 = (OUTLINE * self.spread) ** 2
        squared = np.maximum(2 - 2 * bearings @ some.T, 0)
        smooth = np.exp(squared / (-2 * width2)).sum(1) / (2 * math.pi * width2) * (len(directions) / len(some))
        return np.maximum(smooth, mean)


def _nearest(directions: Array, bearings: Array, radius: float) -> Array:
    """Chords (k, l) from each bearing to its nearest directions, ascending; infinite beyond `radius`."""
    if not len(directions):
        return np.full((len(bearings), 1), np.inf)
    count = min(len(directions), MOST_NEIGHBOURS)
    # The bound excludes what lies at it.
    chords = cKDTree(directions).query(bearings, count, distance_upper_bound=radius * (1 + 1e-9))[0]
    return np.asarray(chords).reshape(len(bearings), -1)


def _label_groups(
    chosen: Labels, labels2d: Labels | None, labels3d: Labels | None, n: int
) -> list[tuple[Labels, Labels]]:
    """Places in `chosen` and in the scene that can be partners, a group for each label in the image."""
    if labels2d is None or labels3d is None:
        return [(np.arange(len(chosen)), np.arange(n))]
    own = labels2d[chosen]
    return [
        (np.flatnonzero(own == label), np.flatnonzero((labels3d == label) | (labels3d == -1) | (label == -1)))
        for label in np.unique(own).tolist()
    ]


@compiled
def _log_ratios(near2: Array, density: Array, scales: Array, shares: Array, result: Array) -> None:
    """log x_i for every image point, scale and share, into result (k, S, W).

    near2 (k, l): squared chords to the nearest projected points, ascending. density (k,): l_i, per steradian.
    """
    count, width = near2.shape
    for i in range(count):
        for a in range(len(scales)):
            variance = scales[a] * scales[a]
            predicted = 0.0
            for j in range(width):
                if not near2[i, j] < FARTHEST * variance:
                    break
                predicted += math.exp(-0.5 * near2[i, j] / variance)
            ratio = predicted / (2 * math.pi * variance * density[i])
            for b in range(len(shares)):
                result[i, a, b] = math.log(1 - shares[b] + shares[b] * ratio)
