"""Every constant that decides what is evidence and what a pose is believed on."""

from dataclasses import dataclass

from bpnp.poses import SAME, Tolerance


@dataclass(frozen=True)
class ImageSettings:
    """What is evidence of image points (`bpnp.search.image_statistics`).

    scale_step: from one scale of the residuals to the next. coarsest: scale in spacings sqrt(A / m) of the points;
    beyond, only the outline fits. floor: smallest scale in spreads of the bearings, some hundredths of a pixel of an
    ordinary camera. together: distance in scales below which points are one observation. crowded: standard deviations
    by which the points around one exceed those of an even spread before it is a clump. most: that are looked at,
    evenly spread over the given ones.
    """

    scale_step: float = 2.0
    coarsest: float = 0.5
    floor: float = 2e-4
    together: float = 2.0
    crowded: float = 2.0
    most: int = 2000


@dataclass(frozen=True)
class Contested:
    """When a far pose contests the best one (`bpnp.search.evidence.alternatives.contesting`).

    near: scales of the residuals within which an image point has a partner, and two partners are in one place. far:
    times as far as a different pose; nearer ones slide along the same lines and surfaces. most: nats of evidence of an
    image point, what 100 scene points leave to one that is met to the finest scale. alone: share of the points that the
    first pose alone explains; a pose that explains so many alone is no repetition of it. same: share of a pose's
    partners in the places of those of another from which both say the same of the scene.
    """

    near: float = 3.0
    far: float = 5.0
    most: float = 13.0
    alone: float = 0.5
    same: float = 0.5


@dataclass(frozen=True)
class Repetitions:
    """Motions that map a scene onto itself (`bpnp.search.evidence.repetitions`).

    near: scales of the residuals within which an image point has a match, and a moved point lies on another.
    fewest: matched points; with fewer, three that fix a pose are too large a part.
    share: smallest fraction of the matched points that a motion maps, share_of_scene: the same of a whole scene.
    symmetric: fraction of the matched points; a motion that maps more of them could by itself explain a better pose.
    whole: points up to which a scene is registered as a whole, once for all problems of it; bases_of_scene: of that, a
        motion of a third of the points is missed by (1 - 1/27)^128 = 0.8 % of the registrations, at most.
    around: points nearest to the matched ones that these are registered with. bases, fewer_bases: of such a
        registration, with up to `many` points and with more: a motion of nine tenths of the matches is missed by
        (1 - 0.9^3)^8 = 3e-5 of the latter.
    kept: competing poses, those with the fewest false alarms. most_missing: fraction of its points that a map may lack.
    """

    near: float = 3.0
    fewest: int = 6
    share: float = 0.3
    share_of_scene: float = 0.2
    symmetric: float = 0.5
    whole: int = 64
    bases_of_scene: int = 128
    around: int = 4096
    many: int = 500
    bases: int = 16
    fewer_bases: int = 8
    kept: int = 6
    most_missing: float = 1 / 3


@dataclass(frozen=True)
class OtherFocal:
    """Where another focal length is looked for beside a confident pose (`bpnp.search.evidence.rivals`).

    step: factor from one that is tried to the next; widest: the last one. bearings: that most steps of the focal length
    are fitted to. fewest: matches; of fewer a seventh unknown explains too much. bend: largest radial distortion, as
    a fraction of the distance of the outermost image point from the axis. bend_deg, bend_shift: with radial distortion,
    poses farther apart are different, in degrees and in distances of the scene.
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
    """When a pose is believed (`bpnp.search.verdict`). Logarithms to base 10.

    false_alarms: of the number of false alarms, at most. It is a bound; on unrelated points an exhaustive search stayed
    above 1 in 999 of 1000 cases, and never came below 0.1.
    lead: by which every alternative must be less likely: once in a thousand a wrong one is by chance. same: poses
        that are farther apart are different.
    missed: of the probability that a better optimum was not met, at most (`bpnp.search.evidence.alternatives`).
    independent: matches that have to be coincidences for it, as many as fix a pose. another: probability that there is
        a better optimum though several starts ended at a pose that exceeds chance. uncompared: probability that a
        better pose of a symmetric scene is not among those that its motions give. look_fails: that starts around a
        wrong pose miss a better one beside it, as 40 of 922 did; again_fails: that others miss it after these, as 8 of
        29 did.
    focal_chance: with which another focal length may be significantly better by chance; with 0.001 a camera that is a
        tenth wrong is believed half as often again.
    contested, repetitions, zoomed: constants of these alternatives.
    focal: fraction by which a focal length that is fitted may be off, once in a thousand; with it the distance is off,
        and by `same.shift` the pose is a different one. focal_few: the same of an object, a scene of at
        most `Repetitions.whole` points that is no map, such as LEDs: its rotation is right long before its distance.
        The reason says how far the focal length may be off; beyond a factor of two it is open. scale: the same of the
        scale of a rig's scene.
    """

    false_alarms: float = -2.0
    lead: float = 3.0
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
    zoomed: OtherFocal = OtherFocal()
    focal: float = 0.05
    focal_few: float = 1.0
    scale: float = 0.2
