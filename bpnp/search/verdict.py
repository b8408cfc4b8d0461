"""What a search's candidates say about themselves: whether to believe the best, to doubt it, or to give up."""

import math
from typing import Literal

import torch

from bpnp.metrics.errors import rotation_error
from bpnp.search.candidates import AHEAD, OTHER_DEG
from bpnp.search.many import Candidates

Verdict = Literal["confident", "ambiguous", "failed"]


def judge(candidates: Candidates, index: int, count2d: int, count3d: int) -> tuple[Verdict, str]:
    """Verdict on sample `index`, and its reason in words.

    confident: the search ended because its best pose was safe (`bpnp.search.candidates.is_safe`).
    ambiguous: the best pose fits about as closely as the bearings lie, but others may come close.
    failed: no pose, or only one whose residuals are larger than that, as a wrong pose of a like shape has.
    """
    rotation, score = candidates.rotation[index].double(), candidates.score[index].double()
    if not rotation[0].isfinite().all():
        return "failed", f"no pose fits: {count2d} 2D and {count3d} 3D points, too few or all on one line"
    if bool(candidates.stats.converged[index]):
        return "confident", "the matches are unique, or the pose leads all others and was found again and again"
    if not bool(candidates.plausible[index]):
        return "failed", "no pose fits closely; more batches, more time or a prior may help"
    apart = rotation_error(rotation, rotation[:1].expand_as(rotation))
    others = score[(apart > OTHER_DEG) & torch.isfinite(score)]
    gap = float(score[0] - others.max()) * count2d if len(others) else math.inf
    if gap <= AHEAD:
        return "ambiguous", f"another pose explains the points nearly as well, {gap:.0f} nats behind"
    return "ambiguous", "the pose fits and leads, but too few batches of starts came upon it to be sure"
