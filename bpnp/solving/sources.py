"""Where the candidate poses of a solution come from: the search, a trained module, or one after the other."""

import time
from collections.abc import Iterator, Mapping
from functools import partial
from typing import NamedTuple

import numpy as np
import roma
import torch
from torch import Tensor, nn

from bpnp.geometry import is_finite
from bpnp.models import TrainedNet
from bpnp.search.many import Candidates, Progress, search_candidates
from bpnp.search.starts import GravityPrior, PosePrior
from bpnp.search.verdict import Verdict, judge
from bpnp.solving.priors import Prior
from bpnp.solving.problem import Array, Problem
from bpnp.solving.scoring import merged, scored
from bpnp.types import Batch

ESTIMATES = ("refined", "ransac", "pnp")  # of a prediction, the one to trust most first
NET_SIGMA_DEG, NET_SIGMA_SHIFT = 10.0, 0.1  # of a net's pose; the latter of its distance from the scene
NET_BATCHES = 4  # of starts around a net's pose
GPU_PAIRS, GPU_CELLS = 64, 2**26  # solved together by a module: pairs, and pairs x 2D points x 3D points


class Options(NamedTuple):
    """What applies to all pairs; see `bpnp.solve`."""

    clutter: float | None
    seed: int
    time_limit: float | None
    device: torch.device
    progress: Progress | None


class Found(NamedTuple):
    """The candidates of one pair around the problem's origin, best first, without empty slots, and the verdict."""

    rotation: Array
    translation: Array
    score: Array
    scale: Array
    verdict: Verdict
    reason: str
    iterations: int
    residual: float
    converged: bool
    seconds: float


def found_by(
    module: nn.Module | None, problems: Mapping[int, Problem], priors: Mapping[int, Prior | None], options: Options
) -> Iterator[tuple[int, Found]]:
    """The candidates of each problem, by its number: of a module, or of the search."""
    together = module is not None and options.device.type != "cpu"
    for group in _groups(problems) if together else [[number] for number in problems]:
        start = time.perf_counter()
        if module is None:
            found = [_searched(problems[i], i, priors[i], options) for i in group]
        else:
            found = _asked(module, [problems[i] for i in group], options)
        seconds = (time.perf_counter() - start) / len(group)
        for i, candidates in zip(group, found, strict=True):
            yield i, _found(candidates, problems[i], seconds)


def _groups(problems: Mapping[int, Problem]) -> Iterator[list[int]]:
    """Pairs of similar size, to solve together."""
    group: list[int] = []
    cells = {i: len(problem.bearings) * len(problem.points3d) for i, problem in problems.items()}
    for i in sorted(problems, key=cells.__getitem__):
        if group and (len(group) == GPU_PAIRS or cells[i] * (len(group) + 1) > GPU_CELLS):
            yield group
            group = []
        group.append(i)
    if group:
        yield group


def _searched(problem: Problem, number: int, prior: Prior | None, options: Options) -> Candidates:
    """The search, after a net's pose around it: unless what that finds is certain, everywhere too."""
    run = partial(
        search_candidates,
        torch.as_tensor(problem.bearings)[None],
        torch.as_tensor(problem.local3d)[None],
        clutter=options.clutter,
        seed=options.seed,
        time_limit=options.time_limit,
        device=options.device,
        progress=None if options.progress is None else partial(_report, options.progress, number),
    )
    if not isinstance(prior, TrainedNet):
        return run(prior=_around_origin(prior, problem))
    known = _net_prior(prior, problem, options)
    if known is None:
        return run()
    around = run(prior=known, max_batches=NET_BATCHES)
    return around if _certain(problem, around) else merged(problem, around, run())


def _certain(problem: Problem, around: Candidates) -> bool:
    """Starts around one pose that end alike prove little; matches that are unique prove themselves."""
    if not bool(around.stats.converged[0]):
        return False
    return bool(scored(problem, _host(around.rotation[0]), _host(around.translation[0])).stats.converged[0])


def _report(report: Progress, number: int, _: int, batch: int, seconds: float) -> None:
    report(number, batch, seconds)


def _around_origin(prior: PosePrior | GravityPrior | None, problem: Problem) -> PosePrior | GravityPrior | None:
    if not isinstance(prior, PosePrior) or prior.translation is None:
        return prior
    return prior._replace(translation=prior.translation + prior.rotation @ torch.as_tensor(problem.origin))


def _net_prior(net: TrainedNet, problem: Problem, options: Options) -> PosePrior | None:
    """The net's pose, None if it has none."""
    (asked,) = _asked(net, [problem], options)
    rotation, translation = asked.rotation[0, 0], asked.translation[0, 0]
    if not rotation.isfinite().all():
        return None
    centre = rotation @ torch.as_tensor(problem.local3d.mean(0)) + translation
    return PosePrior(rotation, translation, NET_SIGMA_DEG, NET_SIGMA_SHIFT * float(centre.norm()) + 1e-12)


def _asked(module: nn.Module, members: list[Problem], options: Options) -> list[Candidates]:
    """The poses of a module's prediction, scored; of points that are not in front of the camera it hears nothing."""
    seen = [problem.points2d[problem.usable] for problem in members]
    batch = Batch.from_arrays(
        [points[np.isfinite(points).all(-1)].astype(np.float32) for points in seen],
        [problem.local3d.astype(np.float32) for problem in members],
    ).to(options.device)
    training = module.training
    try:
        with torch.no_grad():
            poses = module.to(options.device).eval()(batch).poses
    finally:
        module.train(training)
    if not poses:
        raise ValueError(f"expected a pose from the `solver` {type(module).__name__}, got a prediction without one")
    order = sorted(poses, key=lambda name: ESTIMATES.index(name) if name in ESTIMATES else len(ESTIMATES))
    rotation = _host(torch.stack([poses[name].rotation for name in order], 1))
    translation = _host(torch.stack([poses[name].translation for name in order], 1))
    return [scored(problem, *pose) for problem, *pose in zip(members, rotation, translation, strict=True)]


def _found(candidates: Candidates, problem: Problem, seconds: float) -> Found:
    """The filled slots, as rotations to the last digit, and the verdict."""
    verdict, reason = judge(candidates, 0, len(problem.bearings), len(problem.points3d))
    rotation, translation = candidates.rotation[0].double(), candidates.translation[0].double()
    filled = is_finite(rotation, translation)
    stats = candidates.stats
    return Found(
        rotation=roma.special_procrustes(rotation[filled]).numpy(),
        translation=translation[filled].numpy(),
        score=_host(candidates.score[0][filled]),
        scale=_host(candidates.scale[0][filled]),
        verdict=verdict,
        reason=reason,
        iterations=int(stats.iterations[0]),
        residual=float(stats.residual[0]),
        converged=bool(stats.converged[0]),
        seconds=seconds,
    )


def _host(values: Tensor) -> Array:
    return values.detach().cpu().double().numpy()
