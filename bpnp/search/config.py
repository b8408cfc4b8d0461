"""Constants that wait to be moved to the files that use them."""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

from bpnp.poses import SAME, Tolerance


@dataclass(frozen=True)
class ImageSettings:
    """Statistics of the image points (`bpnp.search.image_statistics`).

    Attributes:
        scale_step: Factor from one scale of the residuals to the next. [factor; measured, coarser steps give the same
            evidence in half the time]
        coarsest: Largest scale, in spacings sqrt(A / m) of the points; beyond it only the outline fits. [spacings of
            the points; not tuned]
        floor: Smallest scale, in RMS angular radii of the bearings: some hundredths of a pixel of an ordinary camera.
            [RMS angular radii; convention]
        together: Distance, in scales, below which points count as one observation. [scales; convention]
        crowded: Standard deviations above the count of an even spread from which neighbours form a clump. [standard
            deviations; not tuned]
        most: Largest number of image points that are used, evenly spaced among the given ones. [points; cost]
    """

    scale_step: float = 2.0
    coarsest: float = 0.5
    floor: float = 2e-4
    together: float = 2.0
    crowded: float = 2.0
    most: int = 2000


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
    """Search for another focal length near a confident pose (`bpnp.search.competing_poses`).

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
class TimeSettings:
    """Time limits, and the time that parts of a search are expected to take.

    Attributes:
        one: Default time limit of `solve`, and of `verify`. [seconds; convention]
        of_many: Default time limit of each problem of `solve_many`. [seconds; convention]
        photo: Default time limit of a photo; the photos of cities are measured with it (docs/maps.md). [seconds;
            convention]
        ending: Time of the verdict and of the matching after a search; at most half of a limit is kept for it.
            [seconds; cost]
        ending_a_point: Time that each 2D or 3D point adds to `ending`. [seconds per point; cost]
        grace: Time by which verdict and matching may exceed a limit, before what is left of them is cut off. [seconds;
            convention]
        judging: Time to judge the pose of a photo on all points of a map after the searches; at most half of a limit is
            kept for it. [seconds; cost]
        timed_pairs: Pairs of bearings and points from which the first step of an annealing on all of them is timed.
            [count; cost]
        hypothesis: Time of a hypothesis of the enumeration before it is measured. [seconds; cost]
        least_pace: Least measured time of a hypothesis; a coarse clock may measure 0. [seconds; numerics]
        built: Time of a set of points when a stage of the enumeration begins. [seconds; cost]
        built_facing: The same for a set of points with normals. [seconds; cost]
        shortest: Time before the deadline in which no hypothesis is begun. [seconds; cost]
        scheduler: Time until a Dask scheduler must answer. [seconds; convention]
    """

    one: float = 10.0
    of_many: float = 5.0
    photo: float = 60.0
    ending: float = 4e-3
    ending_a_point: float = 1.2e-5
    grace: float = 0.3
    judging: float = 1.5
    timed_pairs: float = 3e8
    hypothesis: float = 2e-6
    least_pace: float = 1e-9
    built: float = 5e-7
    built_facing: float = 5e-6
    shortest: float = 5e-5
    scheduler: int = 10


TIME = TimeSettings()


@dataclass(frozen=True)
class InputSettings:
    """Checks of the arguments (`bpnp.search.arguments`, `bpnp.search.inputs`).

    Attributes:
        rounding: Largest error of R R^T of a rotation; others are made orthonormal. [1; numerics, float64]
        unit: Largest error of a unit length, of a rotation, and of a sum of probabilities. [1; convention]
        sure: Probability of a class from which on points match only within the class. [probability; not tuned]
        prior_deg: Default standard deviation of a given rotation about each axis. [degrees; convention]
        least_sigma_deg: Least standard deviation of an angle of a prior. [degrees; numerics, float64]
        least_sigma: Least standard deviation of a translation of a prior. [size of the scene; numerics, float64]
        widest_sigma: Standard deviation of a translation above which it is unknown. [size of the scene; numerics]
        one_pixel: Largest coordinate of image points that are refused as normalised coordinates if a camera in
            pixels is given. [pixels; convention]
        widest_row: Largest number of columns of an array of keypoints whose first two columns are positions. [columns;
            convention]
        floor_pixels: Smallest noise of an image point; no point detector is more accurate. [pixels; convention]
        least_focal: Smallest focal length in pixels. With a smaller one, such as that of an identity matrix, the unit
            of the image points is no pixel, and the smallest noise is unknown. [pixels; convention]
        off_axis_deg: Largest median angle of image points from the axis of a pinhole camera. [degrees; convention]
    """

    rounding: float = 1e-12
    unit: float = 1e-3
    sure: float = 0.97
    prior_deg: float = 10.0
    least_sigma_deg: float = 1e-6
    least_sigma: float = 1e-6
    widest_sigma: float = 1e9
    one_pixel: float = 3.0
    widest_row: int = 8
    floor_pixels: float = 0.1
    least_focal: float = 10.0
    off_axis_deg: float = 80.0


INPUTS = InputSettings()


@dataclass(frozen=True)
class ProblemSettings:
    """Record of the points and its prior (`bpnp.search.problem`, `scene`, `starts`).

    Attributes:
        bulk: Distance from the median beyond which scene points do not affect the origin and the unit. [median
            distances; not tuned]
        turned_deg: Largest standard deviation of a rotation prior with which two matches fix a pose. [degrees; not
            tuned]
        tilted: Largest motion of the image points by the tilt with which two matches fix a pose. [match radii; not
            tuned]
        radius: Radius of a match if the pixel size is unknown. [radians; not tuned]
        floors: Radius of a match if it is known: 3 pixels if the floor is a tenth of a pixel. [noise floors;
            convention]
        sigmas: Width of a prior within which all poses count as equally near. [standard deviations; convention]
        log_depths: Logarithm of the farthest over the nearest possible distance of a scene. [nats; convention]
        pairs_a_point: Largest number of pairs per point for which every pair is computed. [pairs; cost]
        likely: Least likelihood of a possible match by its classes, relative to a mean match. [ratio; not tuned]
        line: Second extent of points over the first, below which they lie on a line. [ratio; numerics, float32]
        shift_along: Weight of a shift along the view over one across it, for an RMS angular radius of one radian; at
            most 1. [per radian; not tuned]
        all_around: RMS angular radius above which bearings fill about 220 degrees or more, so that the camera is among
            the points. [radians; derived]
        aim_step: Step of the spiral of positions at which searches aim, with radii of `aim_step` times the square root
            of the number; it leaves no gaps. [RMS angular radii; not tuned]
    """

    bulk: float = 20.0
    turned_deg: float = 5.0
    tilted: float = 2.0
    radius: float = 3e-3
    floors: float = 30.0
    sigmas: float = 2.0
    log_depths: float = math.log(30.0)
    pairs_a_point: int = 32
    likely: float = 0.1
    line: float = 1e-6
    shift_along: float = 5.0
    all_around: float = 0.95
    aim_step: float = 0.16


PROBLEM = ProblemSettings()


@dataclass(frozen=True)
class MatchSettings:
    """Correspondences of a pose, and the last fit to them (`bpnp.search.possible_matches`, `matching`).

    Attributes:
        reach: Distance within which an image point has a match, and default inlier threshold; 98.9 % of the errors of
            two normal coordinates are within it. [scales of the residuals; convention]
        farthest: Distance within which a scene point counts as a possible correspondence in a weighted fit, where each
            counts by its likelihood; beyond, it is below e^-8. [scales of the residuals; derived]
        few_neighbours: Number of nearest scene points of an image point that are tried first. [points; cost]
        asked: Number of points whose neighbours are looked up, or that are assigned, between two checks of the
            deadline. [points; cost]
        assignment: Time of an optimal assignment, over the product of its numbers of points and of possible matches.
            With less time left, points get their mutual nearest neighbours. [seconds; cost]
        counting: Time of a maximum matching, over its number of possible matches. [seconds; cost]
        neighbours: Number that is tried if all of these are in reach. [points; cost]
        dense: Number of possible matches up to which all distances are computed. [matches; cost]
        fit_rounds: Rounds of the last fit, each with new matches. [rounds; not tuned]
        damping: First damping of Levenberg and Marquardt, a fraction of the diagonal. [fraction; convention]
        most_steps: Largest number of its steps, and of those of a fit of the focal length of directions. [steps;
            numerics]
        exact: Relative change of a pose, and of the sum of squares, that ends the steps. [ratio; numerics]
        triples: Largest number of triples of given matches. With a fifth of the matches correct, all of them miss a
            correct triple 3 times in 10,000. [triples; derived]
        scored: Number of given matches on which the poses of the triples are compared. [matches; cost]
        refined: Number of poses of triples that are refined. [poses; not tuned]
        steps: Steps of a refinement to given matches. [steps; numerics]
        reweighted: Number of reweightings of the given matches. [rounds; not tuned]
        wrong: Expected fraction of wrong given matches; `SearchSettings.outliers` is that of points without matches.
            [fraction; not tuned]
        converged: Difference within which refined poses are one optimum, in tolerances of equal poses. [fraction; not
            tuned]
        settled: Relative change of a sum of squares that ends these steps. [ratio; numerics]
        negligible: Sum of squares that ends them. [radians squared; numerics]
    """

    reach: float = 3.0
    farthest: float = 4.0
    few_neighbours: int = 8
    asked: int = 5000
    assignment: float = 1e-9
    counting: float = 2e-6
    neighbours: int = 64
    dense: int = 4096
    fit_rounds: int = 5
    damping: float = 1e-3
    most_steps: int = 50
    exact: float = 1e-12
    triples: int = 1000
    scored: int = 500
    refined: int = 6
    steps: int = 10
    reweighted: int = 3
    wrong: float = 0.1
    converged: float = 0.05
    settled: float = 1e-6
    negligible: float = 1e-24


MATCHES = MatchSettings()


@dataclass(frozen=True)
class NetworkSettings:
    """Poses from the assignment of a network (`bpnp.search.propose.networks`, `bpnp.search.solvers`).

    Attributes:
        far: Largest distance from the origin at which float32 is precise enough. [sizes of the scene; numerics]
        drawn: Match triples per assignment. With 2 % correct matches one in 10^5 is correct, and more nearly so.
            [triples; derived]
        sigma_deg: Standard deviation of the rotation of a network's pose. [degrees; not tuned]
        sigma_shift: Standard deviation of its translation, as a fraction of the distance. [fraction; not tuned]
        together: Largest assignment matrix of a batch on a GPU, 2D points times 3D points. [entries; cost]
        most_cells: Largest assignment matrix of a packaged matcher; larger ones take seconds. [entries; cost]
        seconds_a_square: Time of a packaged matcher, over the sum of the squared numbers of 2D and of 3D points; it is
            not asked with less time left. [seconds; cost]
        loading: Time to import torch and to load the weights. [seconds; cost]
    """

    far: float = 100.0
    drawn: int = 80_000
    sigma_deg: float = 10.0
    sigma_shift: float = 0.1
    together: int = 2**26
    most_cells: int = 2**22
    seconds_a_square: float = 2e-7
    loading: float = 2.0


NETWORKS = NetworkSettings()


class TriangleSettings(NamedTuple):
    """Minimal solvers (`bpnp.search.propose.minimal_solvers`); compiled with their loops.

    Attributes:
        flat: Squared height of a triangle over its squared longest side, at which it is a line. [ratio; numerics]
        tolerance: Largest error of the squared sides, in units of the longest. [ratio; numerics]
        rounding: Relative size of a discriminant that counts as zero. [ratio; numerics]
        level: Sine of both rays' height below which a prior vertical does not determine their depths. [1; numerics]
        upright: Horizontal fraction of the vector between two points below which it does not determine the heading.
            [fraction; numerics]
    """

    flat: float = 1e-12
    tolerance: float = 1e-6
    rounding: float = 1e-12
    level: float = 1e-6
    upright: float = 1e-3


TRIANGLES = TriangleSettings()


@dataclass(frozen=True)
class RefinerSettings:
    """Gauss-Newton in float64 (`bpnp.search.refine.gauss_newton`, `pose_model`).

    Attributes:
        ridge: Least damping, a fraction of the diagonal: unknowns that nothing fixes do not move. [fraction; numerics]
        difference: Step of central differences, the cube root of the machine precision. [fraction; derived]
        longer: Factor on the damping after a step that is taken. [factor; convention]
        shorter: Factor on the damping after a step that is not. [factor; convention]
        least_slope: Smallest derivative of the distorted by the undistorted radius at which a point is visible. [1; not
            tuned]
        undistorted: Newton steps that undistort a radius. [steps; numerics]
    """

    ridge: float = 1e-12
    difference: float = 6e-6
    longer: float = 0.1
    shorter: float = 10.0
    least_slope: float = 0.2
    undistorted: int = 20


REFINER = RefinerSettings()


@dataclass(frozen=True)
class LensSettings:
    """Fit of a lens with the pose (`bpnp.search.propose.lens`).

    Attributes:
        correspondences: Number of scene points that may correspond to each image point. [points; not tuned]
        most_zoom: Largest step of the logarithm of the scale factor. [nats; not tuned]
        most_bend: Largest step of the relative shift of the outermost point. [fraction; not tuned]
        same_zoom: Change of the logarithm of the scale factor below which no other round of steps is taken. [nats; not
            tuned]
        most_rounds: Largest number of rounds. [rounds; not tuned]
        settled_zoom: Change of the logarithm of the scale factor that ends the last steps, with all points. [nats;
            numerics]
        most_steps: Largest number of last steps. [steps; numerics]
        first: Scales of the steps before the first round. [scales of the residuals; not tuned]
        widths: Scales of the steps of each round. [scales of the residuals; not tuned]
        damping: Damping, a fraction of the diagonal of the normal equations. [fraction; numerics]
    """

    correspondences: int = 2
    most_zoom: float = 0.2
    most_bend: float = 0.1
    same_zoom: float = 0.01
    most_rounds: int = 4
    settled_zoom: float = 2e-5
    most_steps: int = 40
    first: tuple[float, ...] = (4.0,)
    widths: tuple[float, ...] = (4.0, 2.0, 2.0, 1.0, 1.0)
    damping: float = 1e-6


LENS = LensSettings()


class SymmetrySettings(NamedTuple):
    """Registration of a scene with itself (`bpnp.search.propose.symmetries`); compiled with the loops.

    Attributes:
        neighbours: Number of neighbours of a point that a base and its matches come from. [points; not tuned]
        many_neighbours: The same for scenes of more than `many` points. [points; cost]
        many: Number of points from which a scene has many. [points; cost]
        bases: Number of bases. At most (1 - 1/8)^32 = 1.4 % of the registrations miss a motion of half of the points.
            [bases; derived]
        compact: Every other base is drawn from this fraction (1 / `compact`) of a neighbourhood. [1; not tuned]
        widest: Number of triangles drawn for a base; the largest is taken. [triangles; not tuned]
        fewest: Smallest number of moved points that lie on others. Three fix a motion and are no evidence of it.
            [points; derived]
        fewest_scaled: The same for motions of another scale. [points; calibration]
        first: Number of sampled points; at least one must confirm a motion. One of 17 motions of a third of the
            points fails. [points; derived]
        bases_scaled: Largest number of bases that are matched at other scales, at most a third of all. [bases; cost]
        most_scaled: Largest number of these bases times points. [bases * points; cost]
        checked: Number of sampled points that confirm a motion before all points do. [points; cost]
        most_work: Largest number of pairs of points that are compared for all bases together, some 0.1 s; the rest is
            left out. [pairs; cost]
        confirming: Number of pairs that take as long as a sampled point. [pairs; cost]
        most_found: Number of motions of all bases together that are ranked. [motions; cost]
        refined: Number of motions, those of the largest fraction first, that are refined. [motions; cost]
        refined_scaled: The same for motions of another scale. [motions; cost]
        near_symmetry: Largest error of a point under a near symmetry, as a fraction of the extent. [fraction;
            convention]
        spacing: Largest error in spacings of the points: at a quarter of the spacing 1 to 6 % of the points lie on
            others by chance. [spacings; derived]
        flat: Largest third extent of a flat scene, as a fraction of its second extent. [fraction; not tuned]
        rounds: Rounds of the refinement: nearest points, rigid fit. [rounds; not tuned]
        same_deg: Angle between the rotations of two motions below which they can be one; their shifts must be within
            four tolerances too. [degrees; not tuned]
    """

    neighbours: int = 96
    many_neighbours: int = 48
    many: int = 500
    bases: int = 32
    compact: int = 4
    widest: int = 4
    fewest: int = 5
    fewest_scaled: int = 8
    first: int = 7
    bases_scaled: int = 16
    most_scaled: int = 2000
    checked: int = 32
    most_work: int = 30_000_000
    confirming: int = 8
    most_found: int = 4096
    refined: int = 48
    refined_scaled: int = 8
    near_symmetry: float = 0.02
    spacing: float = 0.25
    flat: float = 0.1
    rounds: int = 3
    same_deg: float = 3.0


SYMMETRIES = SymmetrySettings()


@dataclass(frozen=True)
class CollinearSettings:
    """Rotations about a line of matched points (`bpnp.search.propose.collinear`).

    Attributes:
        fewest: Smallest number of matched points on the line. [points; not tuned]
        least: Smallest fraction of the matched points on the line. A wrong pose explains at least half of its matches
            by independent coincidences, unless this fraction lies on a line. [fraction; derived]
        thin: Largest distance from the line through two points of a point that lies on it, in distances between the
            two. [1; not tuned]
        pairs: Number of pairs of points whose lines are tried. All pairs miss a line of half of the points with a
            probability of (1 - 1/4)^256. [pairs; derived]
        angles: Number of angles of a full turn. [angles; cost]
        apart: Two angles within this many steps are one, since poses are refined. [steps; not tuned]
        others: Largest number of points off the line that are rotated, the nearest ones. [points; cost]
        kept: Largest number of competing poses, those that explain the most points. [poses; cost]
    """

    fewest: int = 5
    least: float = 0.5
    thin: float = 0.05
    pairs: int = 256
    angles: int = 360
    apart: int = 2
    others: int = 500
    kept: int = 6


COLLINEAR = CollinearSettings()


@dataclass(frozen=True)
class AlarmSettings:
    """Number of false alarms (`bpnp.search.verdict.false_alarms`).

    Attributes:
        inliers: Inlier fractions w over which the likelihood ratio is averaged; finer steps give the same evidence in
            twice the time. [fractions; measured, the problems are not recorded]
        least_inliers: Smallest w if clutter or scores are given. [fraction; convention]
        most_inliers: Largest w if clutter or scores are given. [fraction; convention]
        outline: Smoothing width of the density of unrelated points; the outline beyond it is no evidence. [RMS angular
            radii; not tuned]
        smoothed: Largest number of projected points from which that density is estimated. [points; cost]
        farthest: Distance beyond which a pair does not contribute to the density of a match: e^-9. [scales; numerics]
        own: Largest factor between a scale and that of the residuals at which it is a pose's own. [factor; convention]
        rough: Smallest factor at which it is rougher (`rough_residuals`). [factor; convention]
    """

    inliers: tuple[float, ...] = (0.15, 0.4, 0.75)
    least_inliers: float = 0.02
    most_inliers: float = 0.98
    outline: float = 0.5
    smoothed: int = 256
    farthest: float = math.sqrt(18.0)
    own: float = 2.0
    rough: float = 4.0


ALARMS = AlarmSettings()


@dataclass(frozen=True)
class PrecisionSettings:
    """Covariance and tests of the residuals (`bpnp.search.verdict.covariance`, `uncertainty`).

    Attributes:
        exceeded: Probability that an error exceeds its bound, and significance level of a test. [probability;
            convention]
        far: Squared distance of a pose from its optimum, in its covariance, from which on they differ: the quantile of
            chi-squared with 6 degrees of freedom at 1 - `exceeded`. [1; derived]
        slight: Fraction of the information below which an image point hardly moves the estimate. [fraction; numerics]
        fixed: Smallest eigenvalue of the normalised information of points that fix the estimate. [1; numerics]
        blocks: Number of blocks of image points along each axis of the image. [blocks; not tuned]
    """

    exceeded: float = 1e-3
    far: float = 22.5
    slight: float = 0.01
    fixed: float = 1e-9
    blocks: int = 4


PRECISION = PrecisionSettings()


@dataclass(frozen=True)
class ReasonSettings:
    """Least differences that a reason shows (`bpnp.search.verdict.reasons`, `competitors`).

    Attributes:
        decades: Logarithm of a number of false alarms below which 0.0 is shown. [decades; convention]
        degrees: Rotation below which the shift of a pose is shown instead. [degrees; convention]
        zoom: Relative change of the focal length that is omitted. [fraction; convention]
    """

    decades: float = 0.05
    degrees: float = 0.5
    zoom: float = 0.005


REASONS = ReasonSettings()


@dataclass(frozen=True)
class SmoothingSettings:
    """Smoothing of the density map (`bpnp.search.propose.density_map`).

    Attributes:
        wide: Distance beyond which a smoothing kernel is 0. [standard deviations; numerics]
        widest: Half side of the largest density map: 120 degrees off the axis. [stereographic coordinate; convention]
        narrow: Standard deviation below which a smoothing is computed cell by cell. [cells; cost]
    """

    wide: float = 5.0
    widest: float = 2 * math.tan(math.radians(60))
    narrow: float = 4.0


SMOOTHING = SmoothingSettings()


@dataclass(frozen=True)
class FocalSettings:
    """Search for a focal length (`bpnp.search.focal_length`).

    Lengths in the image are relative to the larger image side, distortions to the distance from the principal point.

    Attributes:
        smallest: Least focal length that is tried: a field of view of 90 degrees. [image sides; convention]
        largest: Largest focal length that is tried: a field of view of 19 degrees. [image sides; convention]
        usual: Focal length that is tried first. [image sides; convention]
        step: Factor between successive focal lengths, for many points; four steps lead from `smallest` to `largest`.
            [factor; not tuned]
        step_few: Factor between successive focal lengths, for few points and for photos in maps. [factor; not tuned]
        sigmas: Half width of the range of an approximate focal length. [standard deviations; convention]
        iterations: Iterations of the first search with each focal length. [iterations; not tuned]
        alternations: Largest number of alternations of search and refinement from each focal length. [rounds; not
            tuned]
        promising: Largest log10 NFA of a failed search whose poses are refined. [decades; not tuned]
        rounds: Largest number of iterations of a refinement. [iterations; numerics]
        same: Change of the logarithm of the focal length below which a refinement stops. [nats; numerics]
        bends: Radial displacements at the image corner from which a fit of the distortion also starts. Started at zero
            distortion, too few points match to reach a large one. [fractions; not tuned]
        bend_sigma: Standard deviation of the radial displacement at the image corner by an unknown distortion.
            [fraction; not tuned]
        most_bend: Largest radial displacement at the image corner, that of `OtherFocal`. [fraction; derived]
        fewest_bent: Least number of matches for a fit of the distortion, that of `OtherFocal`. [matches; derived]
        centre_sigma: Standard deviation of the principal point, as a fraction of the distance to the image corner:
            about a quarter of a per cent of the larger image side. [fraction; not tuned]
        tangential_sigma: Standard deviation of the displacement at the image corner by a tangential coefficient, as a
            fraction of the distance to the corner. It was chosen on statue_of_liberty, whose map has one camera for
            photos of many. [fraction; calibration]
        quartic_sigma: Standard deviation of the displacement at the image corner by the second radial coefficient, as a
            fraction of the distance to the corner. [fraction; not tuned]
        least_reach: Smallest distance from the principal point to the image corner. [focal lengths; numerics]
    """

    smallest: float = 0.5
    largest: float = 3.0
    usual: float = 1.0
    step: float = 1.57
    step_few: float = 1.25
    sigmas: float = 3.0
    iterations: int = 8
    alternations: int = 3
    promising: float = -math.inf
    rounds: int = 12
    same: float = 5e-4
    bends: tuple[float, ...] = (-0.2, 0.2)
    bend_sigma: float = 0.05
    most_bend: float = OtherFocal.bend
    fewest_bent: int = OtherFocal.fewest
    centre_sigma: float = 0.004
    tangential_sigma: float = 0.002
    quartic_sigma: float = 0.01
    least_reach: float = 1e-3


FOCAL = FocalSettings()


@dataclass(frozen=True)
class RigSettings:
    """Rigs (`bpnp.search.rig`).

    Attributes:
        wide: Scale at which proposals are compared: a pose of one camera is inaccurate in another. [smallest scales;
            not tuned]
        steps: Number of decreasing scales of a refinement. [scales; not tuned]
        again: Number of Gauss-Newton steps at each. [steps; not tuned]
        most_scale: Largest step of the logarithm of the scale of the scene. [nats; not tuned]
        lens_wide: First scale of a fit of the lens. [scales of the residuals; not tuned]
        most_lens: Largest step of a lens, of its focal length or its distortion. [nats; not tuned]
        weighed: Number of the last scales at which the false alarms of poses are computed. [scales; cost]
        same_centre: Distance below which camera centres coincide, as a fraction of their largest coordinate in the rig.
            [fraction; numerics]
        proposing: Number of poses that a camera with few points proposes. [poses; cost]
        refined: Number of enumerated poses that are refined, and of distinct poses that are kept. [poses; cost]
        each_iteration: Number of poses of an iteration that are refined. [poses; cost]
        compared: Largest number of proposals whose evidence is computed. [poses; cost]
        agree_deg: Angle between the poses of two cameras below which they agree. [degrees; not tuned]
        agree_shift: Distance below which they agree, in distances of the scene. [fraction; not tuned]
        pairs: Largest number of pairs of poses that are compared. [pairs; cost]
        least_apart: Smallest baseline of two cameras that determines the scale, in distances of the scene. [fraction;
            not tuned]
    """

    wide: float = 60.0
    steps: int = 9
    again: int = 2
    most_scale: float = 1.0
    lens_wide: float = 8.0
    most_lens: float = 0.1
    weighed: int = 7
    same_centre: float = 1e-6
    proposing: int = 4000
    refined: int = 16
    each_iteration: int = 2
    compared: int = 64
    agree_deg: float = 6.0
    agree_shift: float = 0.2
    pairs: int = 50_000
    least_apart: float = 0.01


RIG = RigSettings()


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
class RankSettings:
    """Ranking of the views of a map (`bpnp.maps.views`).

    Attributes:
        cells: Cells along a side of a density image. [cells; not tuned]
        within: Fraction of the points within one unit, the reach of the points. [fraction; not tuned]
        half: Half width of the density image. [reaches; not tuned]
        fine: Standard deviation of the narrow smoothing of the contrast. [cells; not tuned]
        wide: Standard deviation of the wide smoothing of the contrast. [cells; not tuned]
        shifts: Shifts of the photo along either axis. [cells; not tuned]
        scales: Scale factors of the photo. [factors; not tuned]
        ratio: Largest ratio of the reaches of a view and of a photo with a known focal length. [ratio; not tuned]
        apart: Least fraction of a view's points that no better view sees, for it to count as another place. [fraction;
            not tuned]
    """

    cells: int = 32
    within: float = 0.9
    half: float = 1.3
    fine: float = 1.0
    wide: float = 4.0
    shifts: tuple[int, ...] = (-9, -6, -3, 0, 3, 6, 9)
    scales: tuple[float, ...] = (0.7, 0.84, 1.0, 1.2, 1.4)
    ratio: float = 1.6
    apart: float = 0.5


@dataclass(frozen=True)
class AliasingSettings:
    """Short searches near views of other points (`bpnp.maps.aliasing`).

    Attributes:
        search: Search near each view. Few of the explained image points are outliers for a competing pose. So fewer,
            more smoothed initial poses suffice than near a view that is tried.
        most_views: Largest number of views. [views; cost]
        least_other: Least fraction of a view's points that the pose does not see. [fraction; not tuned]
        fewest: Least number of such points, and of image points that the pose explains. [points; not tuned]
    """

    search: DensitySearch = DensitySearch(
        Draws(2**13, least_starts=2**13),
        Preselection((50, 300), (2**11, 2**8)),
        Narrowing(0.1, 0.015, steps=6, points=300),
        annealed=6,
    )
    most_views: int = 8
    least_other: float = 0.5
    fewest: int = 12


@dataclass(frozen=True)
class MapSettings:
    """Photos in maps (`bpnp.maps`).

    Attributes:
        most_detected: Largest number of SIFT keypoints of a photo, COLMAP's. [keypoints; convention]
        contrast: Contrast threshold of the keypoints, of three layers together: COLMAP's peak_threshold of 0.02 / 3,
            half of OpenCV's default. [intensity, 0 to 1; convention]
        most_keypoints: Largest number of keypoints that are used. Half of the 2,000 largest SIFT keypoints have a map
            point, an eighth of the next ones. [keypoints; measured, the photos are not recorded]
        once: Iterations of a search near a view. [iterations; not tuned]
        longer: Iterations of a longer search near a promising view. [iterations; not tuned]
        promising: Number of views that get a longer search if none is confident. [views; not tuned]
        likely: Largest log10 NFA with which a view gets a longer search before the next view. [decades; not tuned]
        competitors: Number of competing poses of an ambiguous solution that are judged with it on all points. [poses;
            cost]
        views_ahead: Number of views that are tried with one focal length before the next one starts. [views; not tuned]
        indexed: Smallest number of points of a map that gets an index; smaller maps open in two seconds without one.
            [points; cost]
        same_focal: Largest ratio of the focal lengths of views whose camera a photo can get. [ratio; not tuned]
        margin_deg: Margin of the cone from which a point is seen, beyond the directions of its track. A local feature
            is rarely detected far outside these. In photos of five models, 95 % of the detected points are seen from at
            most 22 degrees beyond. Of the points that project into these photos and are not detected, 21 to 85 % would
            be seen from more than 30 degrees beyond. [degrees; measured, photos of five models]
        view_deg: Standard deviation of the rotation of a photo from that of a view, about the largest angle per axis
            between photos that share a third of their points. [degrees; not tuned]
        view_shift: Standard deviation of its translation, about the largest shift of the viewed points, as a fraction
            of their distance. [fraction; not tuned]
        least_track: Least number of views of a point after a view is removed. [views; convention]
        upright_deg: Largest angle between the upward directions of upright views. [degrees; not tuned]
        least_upright: Smallest fraction of the views that agree on the direction up. [fraction; not tuned]
        in_plane: Least length of the direction up in the image plane: a steeper view has no upright side. [1; not
            tuned]
        queued: Number of photos per worker thread on a cluster: no thread waits, and the scheduler holds few. [photos;
            cost]
    """

    most_detected: int = 8192
    contrast: float = 0.02
    most_keypoints: int = 2048
    once: int = 1
    longer: int = 16
    promising: int = 3
    likely: float = -20.0
    competitors: int = 4
    views_ahead: int = 4
    indexed: int = 200_000
    same_focal: float = 1.05
    margin_deg: float = 25.0
    view_deg: float = 15.0
    view_shift: float = 0.2
    least_track: int = 2
    upright_deg: float = 30.0
    least_upright: float = 0.5
    in_plane: float = 0.5
    queued: int = 4


@dataclass(frozen=True)
class DrawingSettings:
    """Pictures of photos in maps (`bpnp.maps.localized_picture`, `verified_map`).

    Attributes:
        contrast: Fraction of the photo's contrast that is kept, so that points stand out. [fraction; convention]
        shown: Fraction of the map's points within the drawing. [per cent; convention]
        farthest: Largest distance of a camera that is drawn in place. [extents of the points; convention]
        most_points: Largest number of map points in a picture. [points; cost]
        most_points_of_page: Largest number of map points on a page. [points; cost]
        widths: Widths of photo and map. [inches; convention]
        side: Side of the drawing on a page. [pixels; convention]
    """

    contrast: float = 0.55
    shown: float = 98.0
    farthest: float = 4.0
    most_points: int = 20_000
    most_points_of_page: int = 3000
    widths: tuple[float, float] = (9.0, 6.0)
    side: float = 1000.0


RANK = RankSettings()
ALIASING = AliasingSettings()
MAPS = MapSettings()
DRAWING = DrawingSettings()


@dataclass(frozen=True)
class RansacSettings:
    """RANSAC and proposals on proposed matches, in torch (`bpnp.robust`).

    Attributes:
        chunk: Number of residuals scored at a time: 1 MiB in float32, which stays in the cache of a core. [residuals;
            cost]
        smallest_pool: Number of matches of largest weight from which the first triples of a growing pool are drawn.
            [matches; not tuned]
        subset: Number of matches of largest weight on which all hypotheses are scored. With 256, poses are lost at 10 %
            inliers. [matches; measured, the problems are not recorded]
        shortlist: Number of hypotheses that are then scored on all matches. [hypotheses; cost]
        refined: Number of hypotheses that are refined locally on the subset. [hypotheses; cost]
        local_steps: Gauss-Newton steps of these. [steps; not tuned]
        final_steps: Gauss-Newton steps of the best one on all matches. [steps; not tuned]
        damping: Damping, a fraction of the Hessian's mean diagonal. [fraction; numerics]
        fewest: Least number of hypotheses of PoseLib. It ends after 3 times the number that has a true triple with
            probability 0.9999. [hypotheses; not tuned]
        kept: Fraction of its inliers that OpenCV's refit must keep. [fraction; not tuned]
        triples: Number of triples of an assignment that are solved, for each sample of a batch. [triples; cost]
        drawn_each: Number of triples drawn for each that is solved; the widest triangles are solved. [triples; not
            tuned]
        scored: Number of matches drawn to score the proposals. [matches; cost]
        apart_deg: Smallest angle between two proposals. [degrees; not tuned]
        threshold: Residual that counts half, in root mean square distances of the image points from their mean.
            [fraction; not tuned]
    """

    chunk: int = 2**18
    smallest_pool: int = 16
    subset: int = 512
    shortlist: int = 256
    refined: int = 16
    local_steps: int = 4
    final_steps: int = 6
    damping: float = 1e-9
    fewest: int = 25
    kept: float = 0.9
    triples: int = 1024
    drawn_each: int = 4
    scored: int = 512
    apart_deg: float = 15.0
    threshold: float = 0.2


RANSAC = RansacSettings()
