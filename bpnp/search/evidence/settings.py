"""Every constant that decides what is evidence and what a pose is believed on."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ImagePoints:
    """What is evidence of image points (`bpnp.search.point_sets`).

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
    """Motions of repeated structures (`bpnp.search.evidence.repetitions`).

    near: scales of the residuals within which an image point has a partner, and a moved point lies on another. share:
    of the points with a partner that must come to lie on others. fewest: points with a partner; of fewer, three that
    fix a pose are too large a part. references: points that are laid onto each of the `around` nearest ones; a motion
    may leave one of them without a counterpart. first, most: points that are moved to find motions, and to confirm
    them. confirmed, weighed, kept: motions, best first, that are confirmed, whose poses are weighed, and returned.
    compared: motions of a structure beyond which a few cannot stand for all, as some of them fits as well.
    most_missing: share of its points that a map may lack.
    """

    near: float = 3.0
    share: float = 0.5
    fewest: int = 6
    references: int = 3
    around: int = 4096
    first: int = 4
    most: int = 48
    confirmed: int = 512
    weighed: int = 24
    kept: int = 4
    compared: int = 400
    most_missing: float = 1 / 3


@dataclass(frozen=True)
class OtherFocal:
    """Where another focal length is looked for beside a confident pose (`bpnp.search.evidence.rivals`).

    step: factor from one that is tried to the next; widest: the last one. bearings: that most steps of the focal length
    are fitted to. fewest: matches; of fewer a seventh unknown explains too much.
    """

    step: float = 1.08
    widest: float = 1.6
    bearings: int = 400
    fewest: int = 24


@dataclass(frozen=True)
class Evidence:
    """When a pose is believed (`bpnp.search.verdict`). Logarithms to base 10.

    false_alarms: of the number of false alarms, at most. It is a bound; on unrelated points an exhaustive search stayed
    above 1 in 999 of 1000 cases, and never came below 0.1.
    lead: by which every alternative must be less likely: once in a thousand a wrong one is by chance. other_deg,
        other_shift: poses with rotations farther apart, or translations by this share of their length, are different.
    missed: of the probability that a better optimum was not met, at most (`bpnp.search.evidence.alternatives`).
    independent: matches that have to be coincidences for it, as many as fix a pose. another: probability that there is
        a better optimum though several starts ended at a pose that exceeds chance. look_fails: that starts around a
        wrong pose miss a better one beside it, as 40 of 922 did; again_fails: that others miss it after these, as 8 of
        29 did.
    focal_chance: with which another focal length may be significantly better by chance; with 0.001 a camera that is a
        tenth wrong is believed half as often again.
    contested, repetitions, zoomed: constants of these alternatives.
    focal: share by which a focal length that is fitted may be off, once in a thousand.
    """

    false_alarms: float = -2.0
    lead: float = 3.0
    other_deg: float = 2.0
    other_shift: float = 0.05
    missed: float = -3.0
    independent: int = 3
    another: float = 0.01
    look_fails: float = 1 / 20
    again_fails: float = 1 / 3
    focal_chance: float = 0.01
    contested: Contested = Contested()
    repetitions: Repetitions = Repetitions()
    zoomed: OtherFocal = OtherFocal()
    focal: float = 0.2
