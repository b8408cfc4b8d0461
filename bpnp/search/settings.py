"""Every constant that tunes the search, in one argument: what it is, its unit, and why it has this value.

Those of the evidence are in `bpnp.search.evidence.settings`.
"""

import math
from dataclasses import dataclass, replace

from bpnp.search.evidence.settings import Evidence


@dataclass(frozen=True)
class Recipe:
    """How the starts of a batch are drawn around the weak-perspective pose.

    off_centre: 0 puts the mean of the 3D points on the mean bearing; 1, any 3D point, for cameras that see a part.
    log_depth: the depth is multiplied by exp(u), u uniform in [-log_depth, log_depth].
    """

    off_centre: float
    log_depth: float


@dataclass(frozen=True)
class ClusterStage:
    """Annealing of many poses on weighted clusters of both sides.

    clusters: of each side, at most; one iteration costs their number squared.
    first_scale, last_scale: in spreads of the bearings. iterations: from one to the other, a Gauss-Newton step each.
    kept: poses that go on to the next stage. apart_deg: least angle between their rotations.
    halvings: iterations after which the likelier half goes on, and twice `kept` at least; after fewer than 6 it lacks
        right poses in clutter.
    """

    clusters: int
    first_scale: float
    last_scale: float
    iterations: int
    kept: int
    apart_deg: float
    halvings: tuple[int, ...] = ()


Stages = tuple[ClusterStage, ...]


@dataclass(frozen=True)
class FineStage:
    """Annealing of a few poses on all 3D points, to the scale at which the likelihood is largest.

    bearings: used before the last stage, which uses all; more cost time and hardly change which pose is best.
    smallest_scale: radians, a tenth of a pixel at a focal length of 500 pixels; relative_smallest: in spreads of the
        bearings, for narrow views. The smallest of both and of `Problem.floor` is the end of the annealing.
    cooling: factor from one scale to the next. patience: scales after the likeliest one before a pose is left.
    """

    bearings: int = 1000
    smallest_scale: float = 2e-4
    relative_smallest: float = 1e-3
    cooling: float = 0.82
    patience: int = 3


@dataclass(frozen=True)
class Draws:
    """How many starts are drawn around a rough pose.

    starts: around one with a standard deviation of `wide_deg` and `wide_shift` (of the distance), or more; these leave
    few gaps over the width of a basin. A narrower one gets as many as lie as densely, and `least_starts` at least.
    """

    starts: int = 2**16
    wide_deg: float = 12.0
    wide_shift: float = 0.12
    least_starts: int = 2**14


@dataclass(frozen=True)
class Screens:
    """Which starts go on: `kept` of them each time that so many 3D `points` are looked up in the raster."""

    points: tuple[int, ...] = (300, 5000)
    kept: tuple[int, ...] = (2**13, 2**10)


@dataclass(frozen=True)
class Narrowing:
    """From the scale of the screening to one at which poses are annealed.

    first_scale, last_scale: of the smoothed bearings, in spreads of the bearings; from 0.12 on chance fills the view,
        at 0.03 the gaps between the starts are wider than the basins. steps: from one to the other, with factors above
        0.7, below which the narrower optimum is lost more often; 0 for the first scale alone.
    copies: of a pose at each step. points: 3D points that are looked up there.
    """

    first_scale: float = 0.06
    last_scale: float = 0.011
    steps: int = 5
    copies: int = 16
    points: int = 1500


@dataclass(frozen=True)
class RasterShape:
    """A raster of the view. background: scales of the density that is chance. cells: a scale; most_cells: a side.
    outliers: share of the bearings without a partner, at least. inside: of the largest density of the smoothed
    bearings; less is outside the view."""

    background: float = 8.0
    cells: float = 2.0
    most_cells: int = 1024
    outliers: float = 0.85
    inside: float = 0.05


@dataclass(frozen=True)
class RasterSearch:
    """One raster search (`bpnp.search.raster_search`): draw, screen, narrow, and anneal so many poses."""

    draws: Draws = Draws()
    screens: Screens = Screens()
    narrowing: Narrowing = Narrowing()
    raster: RasterShape = RasterShape()
    annealed: int = 40


@dataclass(frozen=True)
class Schedule:
    """In which order starts are drawn, and how many (`bpnp.search.schedule`).

    turns: at most. enumerated: of points few enough to be enumerated, where that leaves a doubt; clusters hide nothing
        of them, so that more turns end where these did. around: from a guess of the pose, before all others. near: with
        a rough prior before it may be wrong.
    unaided: batches and raster searches before proposals are asked for. starts_a_search: of a batch, that take as long
        as a raster search of all rotations. around_each: poses of a source that
        raster searches are made around, no two turned by less than `apart_deg`, until `in_vain` of them better nothing.
        looks: in vain around a pose that exceeds chance, at most.
    """

    turns: int = 400
    enumerated: int = 12
    around: int = 4
    near: int = 12
    unaided: int = 10
    starts_a_search: int = 96
    around_each: int = 6
    apart_deg: float = 10.0
    in_vain: int = 3
    looks: int = 3


@dataclass(frozen=True)
class Facing:
    """From where a point with a normal is seen (`bpnp.search.kernels.sides`).

    softness: cosines from the cone's edge to where a point is seen fully, or hardly; annealed poses are some degrees
    off, and so are normals. unseen: weight of a point that should not be seen. extent: of the scene, that counts as
    much in a cluster as a radian between normals.
    """

    softness: float = 0.2
    unseen: float = 0.02
    extent: float = 0.5


@dataclass(frozen=True)
class SearchSettings:
    """All of it; the stages are described in docs/search.md.

    schedule: the order of the sources, and the budget. recipes: of batches, in turn. starts: of a full one; 1200 leave
        no gap of 25 deg. first_starts: of the first batch; each next one has twice as many until it is full. Easy
        problems need no more. A small batch hands on the square root of its share of a full one from stage to stage,
        and least_kept at least.
    near, beside, zoomed, proposed, everywhere: raster searches around a prior, around a pose that was met, around one
        that is a step of the focal length away, from proposed poses, and from poses of all rotations.
    most_volumes: of a prior against the widest that has as many starts as it needs; a map view's has 9. admitted:
        standard deviations of a prior within which a proposed pose is tried, 94 % of those drawn from it.
    least_annealed: points of the smaller side; fewer are enumerated only: they have no smooth optimum.
    outliers: share of the points without a partner that the assignment expects where the caller gives none.
    end_outliers: shares that the best poses are annealed with in the last stage too, and the likelihood chooses.
    least_outliers: of the caller's share; without any slack a single outlier would be forced into a match.
    end_scale: where the last stage begins, in scales of the pose; wide enough to let other points in.
    finished: candidates that are weighed after each batch, and annealed on all bearings in the end. kept: candidates,
        from turn to turn. refined_directly: starts of `refine_poses` that need no clusters.
    copied, copies, copied_scale: of the first so many poses that come from elsewhere, so many copies are annealed too,
        whose points fall so many spreads of the bearings beside its own: about what separates optima of one basin.
    same_deg, same_shift: poses closer than both, in degrees and extents of the scene, are one.
    sampled, lloyd_iterations: points a cluster from which cluster centres are computed, and iterations.
    starts_a_check, lookups_a_check: starts that are annealed on clusters, and looked up in a raster, between two looks
        at the clock, if time is limited.
    """

    schedule: Schedule = Schedule()
    starts: int = 1200
    first_starts: int = 48
    least_kept: int = 3
    recipes: tuple[Recipe, ...] = (Recipe(0.0, 0.5), Recipe(1.0, 0.8), Recipe(0.5, 1.2))
    coarse: Stages = (ClusterStage(64, 0.3, 0.1, iterations=10, kept=48, apart_deg=3.0, halvings=(6, 8)),)
    middle: Stages = (
        ClusterStage(128, 0.1, 0.065, iterations=7, kept=24, apart_deg=1.0),
        ClusterStage(256, 0.062, 0.04, iterations=7, kept=10, apart_deg=1.0),
    )
    fine: FineStage = FineStage()
    near: tuple[RasterSearch, ...] = tuple(
        RasterSearch(screens=Screens((100, 1000)), narrowing=Narrowing(first, points=600), annealed=12)
        for first in (0.06, 0.03)  # the finer one where keypoints are dense and few points are seen
    )
    beside: RasterSearch = RasterSearch(
        Draws(2**13, 10.0, 0.1, 2**13),
        Screens((50, 300), (2**11, 2**8)),
        Narrowing(0.08, 0.015, points=600),
        annealed=12,
    )
    zoomed: RasterSearch = RasterSearch(
        Draws(2**10, 3.0, 0.04, 2**10),
        Screens((300,), (2**5,)),
        Narrowing(0.04, 0.015, steps=3, points=600),
        annealed=3,
    )
    proposed: RasterSearch = RasterSearch()
    everywhere: RasterSearch = RasterSearch(
        Draws(2**15), Screens((50, 300), (2**12, 2**9)), Narrowing(0.08, 0.015, points=600), annealed=12
    )
    facing: Facing = Facing()
    evidence: Evidence = Evidence()
    most_volumes: float = 100.0
    admitted: float = 3.5
    least_annealed: int = 12
    outliers: float = 0.3
    end_outliers: tuple[float, ...] = (0.03, 0.6)
    least_outliers: float = 0.02
    finished: int = 3
    refined_directly: int = 8
    copied: int = 4
    copies: int = 6
    copied_scale: float = 0.1
    end_scale: float = 2.0
    kept: int = 8
    same_deg: float = 3.0
    same_shift: float = 0.05
    sampled: int = 8
    lloyd_iterations: int = 5
    starts_a_check: int = 32
    lookups_a_check: int = 4096

    def __post_init__(self) -> None:
        if min(self.schedule.turns, self.starts, self.first_starts) < 1 or not self.recipes:
            raise ValueError(
                "expected one or more `turns`, `starts`, `first_starts` and `recipes`, got "
                f"{self.schedule.turns}, {self.starts}, {self.first_starts} and {len(self.recipes)}; "
                "try SearchSettings()"
            )
        if not all(0 < share < 1 for share in (self.outliers, *self.end_outliers)):
            raise ValueError(f"expected shares of outliers in (0, 1), got {self.outliers} and {self.end_outliers}")

    def limited(self, turns: int) -> "SearchSettings":
        """These settings with so many turns at most."""
        return replace(self, schedule=replace(self.schedule, turns=turns))

    def expecting(self, clutter: float) -> "SearchSettings":
        """These settings where the share of the points without a partner is known. Raises ValueError outside [0, 1).

        It is expected in all stages and the only one tried at the end.
        """
        if not 0 <= clutter < 1:
            raise ValueError(f"expected `clutter` in [0, 1), a share of the points, got {clutter}")
        return replace(self, outliers=max(clutter, self.least_outliers), end_outliers=())

    def batch(self, number: int) -> int:
        """Starts of a batch, counted from 0."""
        return min(self.starts, self.first_starts * 2 ** min(number, 60))

    def kept_by(self, stage: ClusterStage, starts: int) -> int:
        """How many poses of a batch of so many starts a stage hands on."""
        return min(stage.kept, max(self.least_kept, math.ceil(math.sqrt(starts / self.starts) * stage.kept)))


DEFAULT = SearchSettings()
