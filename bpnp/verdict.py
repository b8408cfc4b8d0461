"""What a search's candidates say about themselves: whether to believe the best, to doubt it, or to give up."""

from typing import Literal

import torch

from bpnp.layers.pool import AHEAD, OTHER_DEG
from bpnp.layers.search import Candidates
from bpnp.metrics import rotation_error

Verdict = Literal["confident", "ambiguous", "failed"]


def judge(candidates: Candidates, index: int, count2d: int, count3d: int) -> tuple[Verdict, str]:
    """Verdict on sample `index`, and its reason in words.

    confident: the search ended because its best pose was safe (`bpnp.layers.pool.is_safe`).
    ambiguous: a pose more than 10 degrees away explains the count2d bearings nearly as well, within 20 nats.
    failed: no pose, or one that stands out but not at a scale at which its matches are unique.
    """
    rotation, score = candidates.rotation[index].double(), candidates.score[index].double()
    if not rotation[0].isfinite().all():
        return "failed", f"no pose fits: {count2d} 2D and {count3d} 3D points, too few or all on one line"
    if bool(candidates.stats.converged[index]):
        return "confident", "the matches are unique, or the pose leads all others and was found again and again"
    apart = rotation_error(rotation, rotation[:1].expand_as(rotation))
    others = score[(apart > OTHER_DEG) & torch.isfinite(score)]
    if len(others) and float(score[0] - others.max()) * count2d <= AHEAD:
        return "ambiguous", f"{len(others)} other poses explain the points nearly as well"
    return "failed", "the best pose stands out, but its matches are not unique; more batches or a prior may help"
