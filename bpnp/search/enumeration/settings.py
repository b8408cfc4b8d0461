"""Every constant that tunes the enumeration, in one argument: what it is, its unit, and why it has this value."""

import math
from dataclasses import dataclass
from typing import NamedTuple

from bpnp.poses import SAME


class Stage(NamedTuple):
    """A block of hypotheses: the `near2d` nearest of an image point with the `near3d` nearest of a scene point.

    matches: of a hypothesis, 3, or 2 where a prior lets them fix a pose. reach: radii within which a point counts for
    such a pose, before it is refined.
    """

    matches: int
    near2d: int
    near3d: int
    reach: float


class Rules(NamedTuple):
    """Constants of the compiled loops, which are compiled with them.

    cells: of the grid of the image points, a side.
    matched_cosine: of the angle between a normal and the line of sight; beyond, a point has no match.
    expected_cosine: up to this angle a point is expected to be seen. ladder: radii 1, 1/2, 1/4 ... at which matches are
    counted. missed: nats that an expected but missing point costs: one in five is missed. lacking: matches that it
    takes away from a hypothesis. behind: matches that a hypothesis may have less than any other had, to be refined.
    skipped: matches of the best pose from which its own triples are not solved again, counted: its basin count then.
    tighter, final: factor of the radius from one step of a refinement to the next, and steps at the last one.
    same_trace, same_shift: poses are the same (`Tolerance`) if the trace of the turn between them is larger and the
    shift smaller than this fraction of the scene's distance.
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

    most_products: image points times scene points up to which points are few: 60 x 60. most_products_known: the same
    where a prior lets two matches fix a pose.

    stages: what is tried, one after the other; those of two matches only where a prior lets two fix a pose.
    kept: distinct poses. safe: nats beyond chance and ahead of
    any other pose at which the search ends at once; after `patience` hypotheses none are asked for, and after twice
    as many it ends with any pose that exceeds chance. look, chunk: hypotheses between looks at the best pose, when
    it exceeds chance and before. most: hypotheses in all. widest: radii within which points are matched to a
    predicted pose. near_nats: of evidence; a pose that has so much less than the best is no rival.

    seen_witnesses: points that check a hypothesis and are seen, if the image points are spread evenly over the scene;
    fewest_witnesses, most_witnesses: that check one. witness_chances: of so many matches of them by chance one, or two,
    are not enough. sigmas: of a prior, beyond which no pose is looked for. prior_weight: radii that one standard
    deviation of a prior weighs as much as: noise is a tenth to a third of a radius.
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
