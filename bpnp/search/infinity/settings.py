"""Every constant that tunes the search for a rotation, in one argument: what it is, its unit, and why."""

from dataclasses import dataclass


@dataclass(frozen=True)
class InfinitySettings:
    """Constants of the search for a rotation.

    noise: standard deviations of image points, pixels, for which it is searched, one after the other.
    reach: standard deviations within which a point is a match. cell: of the hash table, in reaches; what is less
        certain is no match yet.
    around: image points around one whose turn about it has to agree. narrowest: least distance of them, in those by
        which a chord may be off, so that their azimuths are known to a tenth.
    first, promising: of these, how many nearest ones choose how many directions, which all of them look at.
    refined: rotations of a point that are fitted: in `rounds` steps to the points around it, then in `last_rounds` to
        `sample` others too, and to all.
    contests: share of the nats of the best rotation that one of a sample of the points has to have to be fitted to all.
    power: share of the true matches that give their rotation. turns: image points that are tried, at most.
    rougher: of the noise that is searched for, how much more matches may show before a larger one is.
    strained: matches, at most, that are asked whether another camera explains them better.
    least_share: of the image points that a rotation explains, for which those that were tried have to be enough
        where chance explains all that was found.
    """

    noise: tuple[float, ...] = (0.35, 1.4)
    reach: float = 3.2
    cell: float = 4.0
    around: int = 24
    narrowest: float = 10.0
    first: int = 8
    promising: int = 384
    refined: int = 4
    sample: int = 200
    rounds: int = 6
    last_rounds: int = 3
    contests: float = 0.7
    power: float = 0.9
    turns: int = 200
    rougher: float = 1.2
    strained: int = 1000
    least_share: float = 0.25
    zoom: float = 1.02
    zoom_noise: float = 3.0
    zoom_share: float = 0.4
    zoom_rounds: int = 6
    zoom_same: float = 1e-4


DEFAULT = InfinitySettings()
