"""Constants that wait to be moved to the files that use them."""

from dataclasses import dataclass

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
