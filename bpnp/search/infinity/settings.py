"""Every constant that tunes the search for a rotation, in one argument: what it is, its unit, and why."""

from dataclasses import dataclass, replace


@dataclass(frozen=True)
class InfinitySettings:
    """Constants of the search for a rotation.

    noise: standard deviations of image points, pixels, for which it is searched, one after the other.
    reach: standard deviations within which a point is a match. cell: of the hash table, in reaches; what is less
        certain is no match yet.
    table: pairs of catalogue directions that are kept, those with the smallest angles.
    together: image points up to which every pair of the first ones is tried; of more, one partner of each.
    patch: image points around a pair that test its rotations. narrowest: least angle of a pair, in those of its patch.
    abandoned: nats by which chance has to explain the points of the patch better for a rotation to be left.
    refined: rotations of a pair that are fitted: in `rounds` steps to the points of the patch and `sample` others, and
        in `last_rounds` to all.
    margin: nats by which a rotation may be worse than the best one without being dropped before it is weighed.
    power: share of the pairs of true matches that give their rotation. turns: pairs, at most.
    least_share: of the image points that a rotation explains, for which the pairs have to be enough where chance
        explains all that was found.
    """

    noise: tuple[float, ...] = (0.35, 1.4)
    reach: float = 3.2
    cell: float = 6.0
    table: int = 300_000
    together: int = 100
    patch: int = 20
    narrowest: float = 0.4
    abandoned: float = 2.5
    refined: int = 6
    sample: int = 200
    rounds: int = 6
    last_rounds: int = 3
    margin: float = 20.0
    power: float = 0.9
    turns: int = 400
    least_share: float = 0.25
    zoom: float = 1.02
    zoom_noise: float = 3.0
    zoom_share: float = 0.4
    zoom_rounds: int = 6
    zoom_same: float = 1e-4

    def of_a_rung(self) -> "InfinitySettings":
        """These settings where the focal length is only about right."""
        return replace(self, noise=(self.zoom_noise,), least_share=self.zoom_share)


DEFAULT = InfinitySettings()
