"""Constants that wait to be moved to the files that use them."""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

from bpnp.poses import SAME, Tolerance


@dataclass(frozen=True)
class Contested:
    """Conditions under which a far pose competes with the best one (`unrelated_competitor`).

    Attributes:
        far: Smallest distance, in multiples of `Evidence.same`; nearer poses slide along the same lines and surfaces.
            [multiples of `Evidence.same`; calibration]
        most: Largest evidence of an image point, nats: that of a match among 100 scene points at the finest scale.
            [nats; derived]
        alone: A pose is no repetition of the best one from this ratio on: points that only it explains, over points
            that only the best one explains. [ratio; calibration]
        same: Fraction of the matches of a pose that coincide with those of the best one; from it on, they agree.
            [fraction; calibration]
    """

    far: float = 5.0
    most: float = 13.0
    alone: float = 0.5
    same: float = 0.5


@dataclass(frozen=True)
class Repetitions:
    """Motions that map a scene onto itself (`bpnp.search.propose.repetitions`).

    Attributes:
        fewest: Smallest number of matched points; with fewer, the three that fix a pose are too large a part. [points;
            derived]
        share: Smallest fraction of the matched points that a motion maps. [fraction; calibration]
        share_of_scene: Smallest fraction of all points that a motion of a whole scene maps. [fraction; calibration]
        symmetric: Fraction of the matched points from which a motion could by itself explain a better pose. [fraction;
            calibration]
        hiding: Fraction of the matched points that a motion which was not compared has to map to hide a better pose. A
            motion maps at least 0.9 of the matches of a wrong pose onto those of the correct one. [fraction;
            calibration]
        whole: Largest number of points of a scene that is registered as a whole, once for all problems of it. [points;
            cost]
        bases_of_scene: Number of bases of that registration. A motion of a third of the points is missed by at most (1
            - 1/27)^128 = 0.8 % of the registrations. [bases; derived]
        around: Number of points nearest to the matched ones that these are registered with, in a larger scene. [points;
            cost]
        many: Number of points up to which such a registration has `bases` bases; with more, `fewer_bases`. [points;
            cost]
        bases: Number of bases with few points. [bases; cost]
        fewer_bases: Number of bases with many points. A motion of nine tenths of the matches is missed by (1 - 0.9^3)^8
            = 3e-5 of the registrations. [bases; derived]
        factor: Largest ratio of the sizes of a part and its copy, in a registration of at most `many` points. [factor;
            not tuned]
        kept: Largest number of competing poses; those with the fewest false alarms are kept. [poses; cost]
        scored_points: Number of points, times poses, that are scored between two checks of the deadline. [points; cost]
        most_missing: Largest fraction of its points that a map may lack. [fraction; not tuned]
    """

    fewest: int = 6
    share: float = 0.3
    share_of_scene: float = 0.2
    symmetric: float = 0.5
    hiding: float = 0.8
    whole: int = 64
    bases_of_scene: int = 128
    around: int = 4096
    many: int = 500
    bases: int = 16
    fewer_bases: int = 8
    factor: float = 4.0
    kept: int = 6
    scored_points: int = 100_000
    most_missing: float = 1 / 3


@dataclass(frozen=True)
class OtherFocal:
    """Search for another focal length near a confident pose (`bpnp.search.verdict.rivals.lens`).

    Attributes:
        step: Factor from one focal length to the next. [factor; calibration]
        widest: Largest factor on the given focal length; its inverse is the smallest. [factor; calibration]
        bearings: Largest number of bearings that most steps are fitted to. [bearings; cost]
        fewest: Smallest number of matches; with fewer, a seventh unknown fits their noise. [matches; calibration]
        bend: Largest radial distortion, as a fraction of the distance of the outermost image point from the axis.
            [fraction; convention]
        bend_deg: Rotation, degrees, from which poses with radial distortion are different. [degrees; convention]
        bend_shift: Shift, in distances of the scene, from which poses with radial distortion are different. [fraction;
            convention]
    """

    step: float = 1.08
    widest: float = 1.6
    bearings: int = 400
    fewest: int = 24
    bend: float = 0.5
    bend_deg: float = 1.0
    bend_shift: float = 0.02


@dataclass(frozen=True)
class Evidence:
    """Conditions of a confident pose (`bpnp.search.verdict.decide`). Logarithms have base 10.

    Attributes:
        false_alarms: Largest log of the number of false alarms (NFA). The NFA is an upper bound: on unrelated points,
            an exhaustive search stayed above 1 in 999 of 1000 cases and never fell below 0.1. [decades; derived]
        margin: Smallest margin to every competing pose; by chance a wrong pose has it once in a thousand cases.
            [decades; convention]
        same: Tolerance within which two poses are the same. [`Tolerance`; convention]
        missed: Largest log of the miss probability of a better optimum (`bpnp.search.verdict.competitors`). [decades;
            convention]
        independent: Number of matches that must be coincidences for a better optimum to exist, as many as fix a pose.
            [matches; derived]
        another: Probability of a better optimum although several initial poses ended at a significant one.
            [probability; calibration]
        uncompared: Probability that a better pose of a symmetric scene is not among those of its motions. [probability;
            measured, symmetric objects of `benchmarks completeness`]
        look_fails: Probability that a local search around a wrong pose misses a better one near it: 40 of 922 did.
            [probability; calibration]
        again_fails: Probability that a further local search misses it as well: 8 of 29 did. [probability; calibration]
        focal_chance: Significance level of a test for another focal length. With 0.001, cameras with a focal length off
            by a tenth are accepted 1.5 times as often. [probability; calibration]
        contested: Constants of the competing far poses.
        repetitions: Constants of the competing poses of a repeated structure.
        other_focal: Constants of the competing focal lengths.
        focal: Largest 99.9 % bound of a fitted focal length, as a fraction. The distance has the same error, and from
            `same.shift` on the pose is a different one. [fraction; derived]
        focal_few: Bound as `focal` for an object: a scene of at most `Repetitions.whole` points that is no map, such as
            LEDs. Its rotation is correct long before its distance. The reason gives the bound. [fraction; convention]
        scale: Largest 99.9 % bound of the scale of a rig's scene, as a fraction. [fraction; convention]
    """

    false_alarms: float = -2.0
    margin: float = 3.0
    same: Tolerance = SAME
    missed: float = -3.0
    independent: int = 3
    another: float = 0.01
    uncompared: float = 1e-3
    look_fails: float = 1 / 20
    again_fails: float = 1 / 3
    focal_chance: float = 0.01
    contested: Contested = Contested()
    repetitions: Repetitions = Repetitions()
    other_focal: OtherFocal = OtherFocal()
    focal: float = 0.05
    focal_few: float = 1.0
    scale: float = 0.2


class Stage(NamedTuple):
    """Block of hypotheses: the `near2d` nearest of an image point with the `near3d` nearest of a scene point.

    Attributes:
        matches: Matches of a hypothesis: 3, or 2 where a prior lets two matches fix a pose. [matches; derived]
        near2d: Neighbours of an image point. [points; calibration]
        near3d: Neighbours of a scene point. [points; calibration]
        reach: Largest residual of a match before the pose is refined, in match radii. [match radii; calibration]
    """

    matches: int
    near2d: int
    near3d: int
    reach: float


@dataclass(frozen=True)
class StartSampling:
    """Sampling of initial poses around the weak-perspective pose.

    Attributes:
        off_centre: 0 puts the centroid of the 3D points on the mean bearing. 1 puts a random 3D point there, for
            cameras that see a part of the scene. Values between interpolate. [fraction; calibration]
        log_depth: The depth is multiplied by exp(u), u uniform in [-log_depth, log_depth]. [nats; calibration]
    """

    off_centre: float
    log_depth: float


@dataclass(frozen=True)
class ClusterStage:
    """Annealing of many poses on weighted clusters of both point sets.

    Attributes:
        clusters: Number of clusters of each set, at most; the cost of an iteration grows with its square. [clusters;
            calibration]
        first_scale: Scale of the first iteration, in units of the RMS angular radius of the bearings. [RMS angular
            radii; calibration]
        last_scale: Scale of the last iteration, in the same unit. [RMS angular radii; calibration]
        iterations: Number of scales between the two, with one Gauss-Newton step each. [iterations; calibration]
        kept: Number of poses that the next stage receives. [poses; calibration]
        apart_deg: Least angle between the rotations of two kept poses, degrees. [degrees; calibration]
        halvings: Iterations after which only the likelier half of the poses is kept, and at least twice `kept`. Below 6
            iterations, this step loses correct poses in clutter. [iterations; calibration]
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
    """Annealing of a few poses on all 3D points, to the scale with the largest likelihood.

    The annealing ends at the least of `smallest_scale`, `relative_smallest` and `Problem.floor`.

    Attributes:
        bearings: Number of bearings before the last stage, which uses all. More cost time and rarely change the best
            pose. [bearings; cost]
        smallest_scale: Radians; 2e-4 is a tenth of a pixel at a focal length of 500 pixels. [radians; convention]
        relative_smallest: In units of the RMS angular radius of the bearings, for narrow views. [RMS angular radii;
            convention]
        cooling: Factor from one scale to the next. [factor; calibration]
        patience: Number of scales after the likeliest one before the annealing of a pose stops. [scales; calibration]
    """

    bearings: int = 1000
    smallest_scale: float = 2e-4
    relative_smallest: float = 1e-3
    cooling: float = 0.82
    patience: int = 3


@dataclass(frozen=True)
class Draws:
    """Number of initial poses around a rough pose.

    Attributes:
        starts: Number for a prior with the standard deviations `wide_deg`, `wide_shift` and `wide_across`, or larger
            ones. These leave few gaps over the width of a basin. A narrower prior gets fewer, at the same density.
            [poses; calibration]
        wide_deg: Standard deviation of the rotation, degrees. [degrees; calibration]
        wide_shift: Standard deviation of the translation along the view, as a fraction of the distance. [fraction;
            calibration]
        least_starts: Least number of initial poses. [poses; calibration]
        wide_across: Standard deviation of the translation across the view, in RMS angular radii of the bearings: that
            of `wide_shift` where that radius is 0.3. Basins shrink with the view in these directions. [RMS angular
            radii; derived]
        reach: Largest distance of the centroid of the points from the centre of the view, in RMS angular radii of the
            bearings and the points. In 13 of 14 calibration photos it was at most 0.83 of the former. [RMS angular
            radii; calibration]
    """

    starts: int = 2**16
    wide_deg: float = 12.0
    wide_shift: float = 0.12
    least_starts: int = 2**14
    wide_across: float = 0.4
    reach: float = 0.7


@dataclass(frozen=True)
class Preselection:
    """Preselection of initial poses on the density map, in steps.

    Attributes:
        points: Number of 3D points that each step scores. [points; calibration]
        kept: Number of poses that each step keeps. [poses; calibration]
    """

    points: tuple[int, ...] = (300, 5000)
    kept: tuple[int, ...] = (2**13, 2**10)


@dataclass(frozen=True)
class Narrowing:
    """Sequence of scales from the preselection to the annealing.

    Attributes:
        first_scale: Smoothing of the bearings at the first step, in units of their RMS angular radius. From 0.12 on,
            chance fills the view. At 0.03, the gaps between the initial poses are wider than the basins. [RMS angular
            radii; calibration]
        last_scale: Smoothing at the last step, in the same unit. [RMS angular radii; calibration]
        steps: Number of steps; 0 for the first scale alone. Below a factor of 0.7 from step to step, the narrower
            optimum is lost more often. [steps; calibration]
        copies: Number of copies of each pose at each step. [poses; calibration]
        points: Number of 3D points that each step scores. [points; calibration]
    """

    first_scale: float = 0.06
    last_scale: float = 0.011
    steps: int = 5
    copies: int = 16
    points: int = 1500


@dataclass(frozen=True)
class DensityShape:
    """Density map of the view.

    Attributes:
        background: Standard deviation of the background density, in multiples of the scale. [scales; calibration]
        cells: Number of cells per scale. [cells; calibration]
        most_cells: Largest number of cells per side. [cells; cost]
        outliers: Outlier fraction of the map; also the least outlier fraction of the annealing that follows. [fraction;
            calibration]
        inside: Fraction of the largest background density below which a cell is outside the view. [fraction;
            calibration]
    """

    background: float = 8.0
    cells: float = 2.0
    most_cells: int = 1024
    outliers: float = 0.85
    inside: float = 0.05


@dataclass(frozen=True)
class DensitySearch:
    """One density-map search (`bpnp.search.propose.density_map`): draw, preselect, narrow, anneal.

    Attributes:
        draws: Number of initial poses.
        preselection: Preselection of the initial poses.
        narrowing: Scales from the preselection to the annealing.
        density_map: Density map of the view.
        annealed: Number of poses that are annealed at the end. [poses; calibration]
    """

    draws: Draws = Draws()
    preselection: Preselection = Preselection()
    narrowing: Narrowing = Narrowing()
    density_map: DensityShape = DensityShape()
    annealed: int = 40


@dataclass(frozen=True)
class Schedule:
    """Order and number of the steps of a search (`bpnp.search.plan`).

    Attributes:
        iterations: Number of iterations, at most. [iterations; convention]
        enumerated: Number of iterations, at most, for points few enough to be enumerated. Clusters keep every one of so
            small a set, and further iterations end at the same poses. [iterations; calibration]
        around: Number of batches around a guess of the pose, before all others. [batches; calibration]
        near: Number of steps near a rough prior before the search treats the prior as possibly wrong. [steps;
            calibration]
        unaided: Number of rounds without a significant pose before proposals are requested. [rounds; calibration]
        starts_a_search: Starts in a batch that take as long as one density-map search over all rotations. [starts;
            measured, CPU time of both]
        around_each: Number of poses of a source that density-map searches are made around, at most. [poses;
            calibration]
        apart_deg: Least angle between the rotations of these poses, degrees. [degrees; calibration]
        in_vain: Number of consecutive searches without a better pose after which the other poses of the source are
            skipped. [searches; calibration]
        local_searches: Number of local searches around a significant pose that find nothing better, at most. [searches;
            calibration]
        proposed_after: Number of steps near a prior after which proposals are requested. [steps; not tuned]
    """

    iterations: int = 400
    enumerated: int = 12
    around: int = 4
    near: int = 12
    unaided: int = 10
    starts_a_search: int = 96
    around_each: int = 6
    apart_deg: float = 10.0
    in_vain: int = 3
    local_searches: int = 3
    proposed_after: int = 4


@dataclass(frozen=True)
class Facing:
    """Visibility of points with normals (`bpnp.search.kernels.sides`).

    Attributes:
        softness: Difference of the cosine between the edge of the viewing cone and full or least visibility. Poses
            during the annealing are some degrees off, and so are normals. [1; calibration]
        unseen: Least weight of a point, for a point outside its viewing cone. [weight; calibration]
        extent: Distance, in extents of the scene, that clustering treats like one radian between normals. [extents of
            the scene; calibration]
    """

    softness: float = 0.2
    unseen: float = 0.02
    extent: float = 0.5


@dataclass(frozen=True)
class SearchSettings:
    """All settings of the search; docs/search.md describes the stages.

    Attributes:
        schedule: Order of the sources of poses, and the budget.
        starts: Number of starts of a full batch; 1200 leave no gap of 25 degrees. [starts; derived]
        first_starts: Number of starts of the first batch, enough for easy problems. Each next batch has twice as many
            until it is full. [starts; calibration]
        least_kept: Least number of poses that a stage keeps. A small batch keeps the square root of its fraction of a
            full one. [poses; calibration]
        recipes: Sampling of the batches, in turn. [`StartSampling`; calibration]
        coarse: First stages on clusters. [`ClusterStage`; calibration]
        middle: Stages on finer clusters. [`ClusterStage`; calibration]
        fine: Annealing on all points.
        near: Density-map searches around a prior. [`DensitySearch`; chosen on photos of south_building, which
            docs/results.md reports too]
        local: Density-map search around a pose that the search has found.
        focal_step: Density-map search around a pose at the next step of the focal length.
        proposed: Density-map search from proposed poses.
        everywhere: Density-map search over all rotations.
        facing: Visibility of points with normals.
        evidence: Constants of the verdict.
        most_volumes: Largest volume of a prior that counts as near, in multiples of the widest one with a full number
            of starts; the prior of a map view has 9. [volumes; calibration]
        admitted: Standard deviations of a prior within which proposed poses are used; 94 % of the poses drawn from it.
            [standard deviations; derived]
        least_annealed: Least number of points of the smaller set for annealing. Fewer points have no smooth optimum and
            are only enumerated. [points; calibration]
        outliers: Outlier fraction of the annealing if the caller gives none. [fraction; calibration]
        end_outliers: Other outlier fractions with which the last stage anneals the best poses; the likelihood chooses.
            [fractions; calibration]
        least_outliers: Lower bound of the caller's outlier fraction. Without it, a single outlier would be forced into
            a match. [fraction; convention]
        finished: Number of candidates whose NFA each batch computes and that are annealed on all bearings at the end.
            [poses; cost]
        refined_directly: Number of initial poses of `refine_poses`, at most, that need no clusters. [poses; cost]
        copied: Number of poses from other sources, the best first, that are also copied. [poses; calibration]
        copies: Number of copies of each of them. [poses; calibration]
        copied_scale: Angular distance of the points of a copy from those of its pose, in units of the RMS angular
            radius of the bearings. Optima of one basin are about as far apart. [RMS angular radii; calibration]
        end_scale: Scale at which the last stage begins, in multiples of the scale of the pose, so that other points can
            enter. [factor; calibration]
        kept: Number of candidates that a search keeps from one iteration to the next. [poses; cost]
        same_deg: Angle below which two poses can be the same, degrees. [degrees; convention]
        same_shift: Shift below which they can be, in extents of the scene; both conditions are necessary. [extents of
            the scene; convention]
        sampled: Number of points per cluster from which the cluster centres are computed. [points; cost]
        lloyd_iterations: Number of iterations of the clustering. [iterations; cost]
        starts_a_check: Number of starts annealed on clusters between two checks of the deadline. [starts; cost]
        lookups_a_check: Number of poses scored on the density map between two checks of the deadline. [poses; cost]
        warming: Number of points of the problem that compiles the loops. [points; convention]
    """

    schedule: Schedule = Schedule()
    starts: int = 1200
    first_starts: int = 48
    least_kept: int = 3
    recipes: tuple[StartSampling, ...] = (StartSampling(0.0, 0.5), StartSampling(1.0, 0.8), StartSampling(0.5, 1.2))
    coarse: Stages = (ClusterStage(64, 0.3, 0.1, iterations=10, kept=48, apart_deg=3.0, halvings=(6, 8)),)
    middle: Stages = (
        ClusterStage(128, 0.1, 0.065, iterations=7, kept=24, apart_deg=1.0),
        ClusterStage(256, 0.062, 0.04, iterations=7, kept=10, apart_deg=1.0),
    )
    fine: FineStage = FineStage()
    near: tuple[DensitySearch, ...] = tuple(
        DensitySearch(preselection=Preselection((100, 1000), kept), narrowing=Narrowing(first, points=600), annealed=12)
        # The finer one is for dense keypoints and few visible points; in its narrower basins, ranks are less certain.
        for first, kept in ((0.06, (2**13, 2**10)), (0.03, (2**13, 2**11)))
    )
    local: DensitySearch = DensitySearch(
        Draws(2**13, 10.0, 0.1, 2**13),
        Preselection((50, 300), (2**11, 2**8)),
        Narrowing(0.08, 0.015, points=600),
        annealed=12,
    )
    focal_step: DensitySearch = DensitySearch(
        Draws(2**10, 3.0, 0.04, 2**10),
        Preselection((300,), (2**5,)),
        Narrowing(0.04, 0.015, steps=3, points=600),
        annealed=3,
    )
    proposed: DensitySearch = DensitySearch()
    everywhere: DensitySearch = DensitySearch(
        Draws(2**15), Preselection((50, 300), (2**12, 2**9)), Narrowing(0.08, 0.015, points=600), annealed=12
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
    warming: int = 8

    def __post_init__(self) -> None:
        if min(self.schedule.iterations, self.starts, self.first_starts) < 1 or not self.recipes:
            raise ValueError(
                f"`iterations` is {self.schedule.iterations}, `starts` {self.starts}, `first_starts` "
                f"{self.first_starts} and the number of `recipes` {len(self.recipes)}; each must be 1 or more"
            )
        if not all(0 < share < 1 for share in (self.outliers, *self.end_outliers)):
            raise ValueError(
                f"`outliers` is {self.outliers} and `end_outliers` {self.end_outliers}; all must be between 0 and 1"
            )

    def limited(self, iterations: int) -> "SearchSettings":
        """Return a copy of these settings with at most this number of iterations."""
        return replace(self, schedule=replace(self.schedule, iterations=iterations))

    def expecting(self, clutter: float) -> "SearchSettings":
        """Return a copy of these settings for a given outlier fraction.

        All stages use this fraction, and the last stage tries no other.

        Args:
            clutter: Fraction of the points without a correspondence, in [0, 1).

        Raises:
            ValueError: If `clutter` is outside [0, 1).
        """
        if not 0 <= clutter < 1:
            raise ValueError(f"`clutter` is {clutter}; it is a fraction of the points, 0 or more and below 1")
        return replace(self, outliers=max(clutter, self.least_outliers), end_outliers=())

    def batch(self, number: int) -> int:
        """Return the number of starts of a batch; `number` counts batches from 0."""
        return min(self.starts, self.first_starts * 2 ** min(number, 60))

    def kept_by(self, stage: ClusterStage, starts: int) -> int:
        """Return the number of poses that a stage keeps from a batch with this number of starts."""
        return min(stage.kept, max(self.least_kept, math.ceil(math.sqrt(starts / self.starts) * stage.kept)))


DEFAULT = SearchSettings()


@dataclass(frozen=True)
class AliasingSettings:
    """Short searches near views of other points (`bpnp.maps.aliasing`).

    Attributes:
        search: Search near each view. Few of the explained image points are outliers for a competing pose. So fewer,
            more smoothed initial poses suffice than near a view that is tried.
    """

    search: DensitySearch = DensitySearch(
        Draws(2**13, least_starts=2**13),
        Preselection((50, 300), (2**11, 2**8)),
        Narrowing(0.1, 0.015, steps=6, points=300),
        annealed=6,
    )


ALIASING = AliasingSettings()
