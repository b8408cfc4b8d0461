"""Augmentation of problems: subsets, clutter, occlusion, outliers, rotation, a random order."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import pad

from bpnp.checks import check_within
from bpnp.datamodules.keyed_random import Generators, Key, Purpose, generators, permutations, rotations, uniform
from bpnp.datamodules.problem import Counts
from bpnp.poses import MIN_POINTS
from bpnp.types import Batch

Side = Literal["both", "2d", "3d"]
SideOrRandom = Literal["both", "2d", "3d", "random"]
NumberOrRange = float | tuple[float, float]  # a number, or (low, high) for one drawn uniformly for each problem
SIDES = ("2d", "both", "3d")  # the order in which `_on_sides` numbers them


@dataclass(frozen=True)
class Outliers:
    """Synthetic outliers and occlusion of a problem. The defaults change nothing.

    Args:
        ratio: Ratio of synthetic outliers to matches, rho: int(rho * matches) points are added, uniform in the
            axis-aligned bounding box of the matched points of that side; 1 makes half of the points outliers. Two
            numbers, [low, high], draw it uniformly for each problem.
        side: Side that gets the outliers: "both", "2d" or "3d", or "random" for one of the three in each problem.
        occlusion: Fraction of the matches that lose one of their two points, so that the other has no correspondence; a
            number or [low, high], as ratio. At least 4 matches are left.
        occluded_side: Side of the lost points: "2d", "3d", "both" for half of the matches on each side, or "random".

    Raises:
        ValueError: An option is out of range.
    """

    ratio: NumberOrRange = 0.0
    side: SideOrRandom = "both"
    occlusion: NumberOrRange = 0.0
    occluded_side: SideOrRandom = "2d"

    def __post_init__(self) -> None:
        check_within(0, math.inf, ratio=self.ratio)
        check_within(0, 1, occlusion=self.occlusion)
        if bounds(self.occlusion)[1] == 1:
            raise ValueError(
                f"`occlusion` is {self.occlusion}; it must be below 1, such as 0.1, which hides one point in ten"
            )
        for name in ("side", "occluded_side"):
            if getattr(self, name) not in (*SIDES, "random"):
                raise ValueError(f'`{name}` is {getattr(self, name)!r}; it is one of "both", "2d", "3d", "random"')


@dataclass(frozen=True)
class Augmentation:
    """Options of `augment`; a value out of range is a ValueError."""

    # Largest number of matches; of more, a random subset is taken. Default: None, all matches.
    max_points: int | None = None
    # Number of points without a correspondence to keep, as a ratio to the matches kept, or all if there are fewer; inf
    # for all.
    clutter: float = math.inf
    clutter_side: Side = "both"  # side that keeps them, "both", "2d" or "3d"
    rotate: bool = False  # rotate the 3D points about their origin by a uniformly random rotation
    outliers: Outliers = field(default_factory=Outliers)  # synthetic outliers and occlusion

    def __post_init__(self) -> None:
        if self.max_points is not None and self.max_points < MIN_POINTS:
            raise ValueError(f"`max_points` is {self.max_points}; it must be {MIN_POINTS} or more")
        check_clutter(self.clutter)
        if self.clutter_side not in SIDES:
            raise ValueError(f'`clutter_side` is {self.clutter_side!r}; it is one of "both", "2d", "3d"')

    @property
    def clutter_by_side(self) -> tuple[float, float]:
        """`clutter` of the 2D side and of the 3D side."""
        return 0.0 if self.clutter_side == "3d" else self.clutter, 0.0 if self.clutter_side == "2d" else self.clutter

    def sizes(self, counts: Counts) -> NDArray[np.int64]:
        """Return an upper bound of the number of points on the larger side of each augmented problem (k,)."""
        matched = counts.matched if self.max_points is None else np.minimum(counts.matched, self.max_points)
        extra2d, extra3d = (
            np.minimum(count - counts.matched, np.rint(ratio * np.maximum(matched, 1)))
            for count, ratio in zip((counts.points2d, counts.points3d), self.clutter_by_side, strict=True)
        )
        added = np.floor(bounds(self.outliers.ratio)[1] * matched)
        return (matched + np.maximum(extra2d, extra3d) + added).astype(np.int64)


class SideCounts(NamedTuple):
    """Numbers of points on one side of each augmented problem, (b, 1) each."""

    matched: Tensor  # points of the chosen matches that remain on this side
    hidden: Tensor  # chosen matches whose point on this side is hidden
    extra: Tensor  # clutter: points without a correspondence that are kept
    outliers: Tensor  # synthetic


def augment(batch: Batch, how: Augmentation, keys: Sequence[Key]) -> Batch:
    """Choose the points of each problem of `stack_problems`, on the CPU, add outliers, and shuffle both sides.

    A result depends only on the problem and its key, not on its batch or its padding. Rotations and translations keep
    their dtype. Raise ValueError if the problems have no `match3d` or no pose.
    """
    if batch.match3d is None or batch.rotation is None:
        raise ValueError("the problems have no `match3d` or no pose, which the augmentation needs")
    matched = batch.match3d >= 0
    total = matched.sum(-1, keepdim=True)
    true, side2d, side3d = _amounts(how, total, batch, generators(keys, Purpose.AMOUNTS))
    # Order both sides alike: matches in one random order, then points without a correspondence.
    order3d = _matches_first_order(generators(keys, Purpose.CHOICE), matched, batch.mask3d)
    alike = torch.equal(batch.mask2d, batch.mask3d)
    matched2d = pad(matched, (0, batch.points2d.shape[1] - matched.shape[1]))
    order2d = order3d if alike else _matches_first_order(generators(keys, Purpose.CHOICE), matched2d, batch.mask2d)
    points2d = _choose_points(batch.points2d, order2d, true, total, side2d, generators(keys, Purpose.OUTLIERS2D))
    points3d = _choose_points(batch.points3d, order3d, true, total, side3d, generators(keys, Purpose.OUTLIERS3D))
    points2d, mask2d, order2d = _shuffle_points(points2d, side2d, generators(keys, Purpose.ORDER2D))
    points3d, mask3d, order3d = _shuffle_points(points3d, side3d, generators(keys, Purpose.ORDER3D))
    slots2d = torch.arange(order2d.shape[1], device=order2d.device).expand_as(order2d)
    match3d = torch.empty_like(order2d).scatter_(1, order2d, slots2d).gather(1, order3d.clamp(max=len(slots2d[0]) - 1))
    rotation, origin = batch.rotation, batch.origin
    if how.rotate:  # scene points become S p, so the rotation becomes R S^T
        scene_rotation = rotations(generators(keys, Purpose.TURN))
        points3d = (points3d.double() @ scene_rotation.mT).to(points3d)
        rotation = rotation @ scene_rotation.mT.to(rotation)
        origin = None if origin is None else (scene_rotation.to(origin) @ origin[..., None]).squeeze(-1)
    return replace(
        batch,
        points2d=points2d,
        points3d=points3d,
        mask2d=mask2d,
        mask3d=mask3d,
        match3d=torch.where(order3d < true, match3d, -1),
        rotation=rotation,
        origin=origin,
    )


def check_clutter(clutter: float) -> None:
    """Raise ValueError for a ratio below 0, or NaN."""
    if not clutter >= 0:
        raise ValueError(f"`clutter` is {clutter}; it must be 0 or more, such as 0.5, which adds half as many points")


def bounds(value: NumberOrRange) -> tuple[float, float]:
    """Return (low, high) of a number or of the limits of a drawn number."""
    low, high = value if isinstance(value, (tuple, list)) else (value, value)
    return low, high


def _amounts(
    how: Augmentation, total: Tensor, batch: Batch, random: Generators
) -> tuple[Tensor, SideCounts, SideCounts]:
    """Return the number of matches that remain of `total`, and the numbers of points of both sides."""
    ratio, side, occlusion, occluded = uniform(random, 4).unsqueeze(-1).unbind(1)
    chosen = total if how.max_points is None else total.clamp(max=how.max_points)
    hidden = (_draw_amount(how.outliers.occlusion, occlusion) * chosen).round().long()
    hidden = torch.minimum(hidden, chosen - MIN_POINTS).clamp(min=0)
    true = chosen - hidden
    hidden2d, hidden3d = _on_sides(how.outliers.occluded_side, occluded)
    hidden2d = torch.where(hidden3d, torch.where(hidden2d, hidden // 2, 0), hidden)
    added = (_draw_amount(how.outliers.ratio, ratio) * true).long()
    added2d, added3d = _on_sides(how.outliers.side, side)
    extra2d, extra3d = (
        torch.minimum((clutter * chosen.clamp(min=1)).round().clamp(max=2**31).long(), count[:, None] - total)
        for clutter, count in zip(how.clutter_by_side, (batch.count2d, batch.count3d), strict=True)
    )
    return (
        true,
        SideCounts(chosen - hidden2d, hidden2d, extra2d, added * added2d),
        SideCounts(true + hidden2d, torch.zeros_like(hidden), extra3d, added * added3d),
    )


def _draw_amount(value: NumberOrRange, uniform: Tensor) -> Tensor:
    low, high = bounds(value)
    return low + (high - low) * uniform


def _on_sides(side: SideOrRandom, uniform: Tensor) -> tuple[Bool[Tensor, "b 1"], Bool[Tensor, "b 1"]]:
    """Return masks of the 2D side and of the 3D side; for "random", 2d, both and 3d are equally likely."""
    number = (3 * uniform).long() if side == "random" else torch.full_like(uniform, SIDES.index(side)).long()
    return number < 2, number > 0


def _matches_first_order(random: Generators, matched: Tensor, mask: Tensor) -> Int[Tensor, "b n"]:
    """Return indices: matches in random order, then other points in random order, then padding."""
    return permutations(random, mask.shape[1], group=2 - mask.long() - matched.long())


def _choose_points(
    points: Float[Tensor, "b n d"], order: Tensor, true: Tensor, total: Tensor, side: SideCounts, random: Generators
) -> Float[Tensor, "b k d"]:
    """Return the points of the matches, then points without a correspondence, then outliers, then arbitrary points."""
    natural = side.matched + side.extra
    slot = torch.arange(int((natural + side.outliers).max()), device=points.device)
    rank = torch.where(slot < side.matched, slot + side.hidden * (slot >= true), total + slot - side.matched)
    chosen = gather_points(points, order.gather(1, rank.clamp(max=order.shape[1] - 1)))
    if not side.outliers.any():
        return chosen
    is_match = (slot < true)[..., None]
    low = chosen.where(is_match, math.inf).amin(1, keepdim=True)
    high = chosen.where(is_match, -math.inf).amax(1, keepdim=True)
    fraction = uniform(random, chosen[0].numel()).view_as(chosen).to(chosen)
    return torch.where((slot < natural)[..., None], chosen, low + (high - low) * fraction)


def _shuffle_points(points: Tensor, side: SideCounts, random: Generators) -> tuple[Tensor, Tensor, Tensor]:
    """Return the points in random order with zeros as padding, the mask of real points, and the order."""
    slot = torch.arange(points.shape[1], device=points.device)
    mask = slot < side.matched + side.extra + side.outliers
    order = permutations(random, len(slot), group=1 - mask.long())
    return gather_points(points, order) * mask[..., None], mask, order


def gather_points(points: Float[Tensor, "b n d"], order: Int[Tensor, "b k"]) -> Float[Tensor, "b k d"]:
    """Return the points at the given indices of each row."""
    rows = torch.arange(len(points), device=points.device)[:, None] * points.shape[1]
    return points.flatten(0, 1).index_select(0, (order + rows).flatten()).view(*order.shape, points.shape[2])
