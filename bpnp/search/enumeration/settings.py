"""Constants of the enumeration: meaning, unit and the reason for each value."""

import math
from dataclasses import dataclass
from typing import NamedTuple

from bpnp.poses import SAME


class Stage(NamedTuple):
    """Block of hypotheses: the `near2d` nearest of an image point with the `near3d` nearest of a scene point.

    Attributes:
        matches: Matches of a hypothesis: 3, or 2 where a prior lets two matches fix a pose.
        near2d: Neighbours of an image point.
        near3d: Neighbours of a scene point.
        reach: Largest residual of a match before the pose is refined, in match radii.
    """

    matches: int
    near2d: int
    near3d: int
    reach: float


class Rules(NamedTuple):
    """Constants of the compiled loops, compiled with them.

    Attributes:
        cells: Cells along a side of the grid of the image points.
        matched_cosine: Smallest cosine between a normal and the line of sight at which a point can have a match.
        expected_cosine: Smallest cosine at which a point with a normal is expected to be seen.
        ladder: Number of radii 1, 1/2, 1/4 ... at which matches are counted.
        missed: Nats subtracted for each expected but missing point; one in five is missed.
        lacking: Matches subtracted from a hypothesis for each expected but missing point.
        behind: Matches that a hypothesis may lack against the best one of its stage and still be refined.
        skipped: Matches of the best pose from which its own triples are not solved again.
        counted: Basin count of the best pose that this requires too.
        tighter: Factor of the radius from one step of a refinement to the next.
        final: Steps of a refinement at its last radius.
        same_trace: Smallest trace of the rotation between two poses that are the same (`Tolerance`).
        same_shift: Largest shift between them, as a fraction of the scene's distance.
    """

    cells: int = 48
    matched_cosine: float = math.cos(math.radians(87.0))
    expected_cosine: float = math.cos(math.radians(72.0))
    ladder: int = 5
    missed: float = 1.5
    lacking: float = 0.25
    behind: float = 1.0
    skipped: int = 5
    counted: int = 12
    tighter: float = 0.55
    final: int = 3
    same_trace: float = 1 + 2 * math.cos(math.radians(SAME.degrees))
    same_shift: float = SAME.shift


@dataclass(frozen=True)
class EnumerationSettings:
    """Constants of the enumeration.

    Attributes:
        most_products: Largest number of image points times scene points that are enumerated: 60 x 60.
        most_products_known: The limit where a prior lets two matches fix a pose.
        stages: Blocks of hypotheses, in their order; those of two matches need a prior that lets two fix a pose.
        kept: Distinct poses that are kept.
        safe: Margin in nats, over chance and over any other pose, at which the search ends at once.
        patience: Hypotheses after which the required margin has fallen linearly to 0. After twice as many the search
            ends with any significant pose.
        look: Hypotheses between checks of the best pose once it is significant.
        chunk: Hypotheses between checks before.
        most: Largest number of hypotheses.
        widest: Largest radius within which points are matched to a predicted pose, in match radii.
        near_nats: Evidence in nats by which a competing pose may be behind the best.
        seen_witnesses: Preverification points that are seen, if the image points are spread evenly over the scene.
        fewest_witnesses: Fewest preverification points of a hypothesis.
        most_witnesses: Most preverification points of a hypothesis.
        witness_chances: Expected chance matches of these points from which two, and three, matches are required.
        sigmas: Standard deviations of a prior beyond which no pose is tried.
        prior_weight: Match radii that weigh as much as one standard deviation of a prior. Noise is a tenth to a third
            of a radius.
    """

    most_products: int = 4000
    most_products_known: int = 250_000
    stages: tuple[Stage, ...] = (
        *(Stage(2, *near, 0.6) for near in ((5, 9), (9, 16), (63, 63))),
        *(Stage(2, 63, 63, 2.0), Stage(3, 3, 5, 0.5), Stage(3, 4, 7, 0.5), Stage(3, 3, 5, 2.0)),
        *(Stage(3, *near, reach) for near in ((5, 9), (8, 13), (24, 32), (63, 63)) for reach in (0.5, 2.0)),
    )
    kept: int = 16
    safe: float = math.log(1e6)
    patience: int = 25_000
    look: int = 3_000
    chunk: int = 20_000
    most: int = 200_000
    widest: float = 12.0
    near_nats: float = 25.0
    seen_witnesses: float = 3.0
    fewest_witnesses: int = 10
    most_witnesses: int = 32
    witness_chances: tuple[float, float] = (0.05, 0.3)
    sigmas: float = 4.0
    prior_weight: float = 0.1


RULES = Rules()
DEFAULT = EnumerationSettings()
