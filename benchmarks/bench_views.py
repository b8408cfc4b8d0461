"""Photos left out of their COLMAP map, against the points of one view, of several, or of the whole map.

    python -m benchmarks views --methods solve view-prior localize --outliers 0.5 0.75 1 fountain-P11 walkthrough
    python -m benchmarks views --methods localize --views 0 --all-points --outliers 1 fountain-P11 walkthrough

The protocol of GoMatch (Zhou et al., ECCV 2022). Methods: solve (no prior); view-prior (the pose of the first view as
`PosePrior`); localize (a map's `localize`, told the names of the views, or none with --views 0); the names of packaged
weights. --elsewhere: each photo against the views of another place, where none may be confident.
"""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from record import DATA, TIME_LIMIT, Outcome, Rows, measured, parser, solved
from view_problems import MOST_POINTS, ViewProblem, scene_problems

from bpnp import PosePrior, Solution, solve
from bpnp.maps.localize import VIEW_DEGREES, VIEW_SHARE
from bpnp.models import TrainedNet
from bpnp.models.weights import pretrained_names

REPORTED = ("fountain-P11", "south_building", "tabletop", "walk_4", "walkthrough")  # no constant was chosen on them
RIGHT_DEG = 1.0


def by_search(problem: ViewProblem, seed: int, **options: Any) -> Solution:
    pixels, camera = problem.pixels
    return solve(pixels, problem.points3d, camera, seed=seed, time_limit=TIME_LIMIT, **options)


def by_view(problem: ViewProblem, seed: int, **options: Any) -> Solution:
    return by_search(problem, seed, prior=prior_of_view(problem), **options)


def in_map(problem: ViewProblem, seed: int) -> Solution:
    views = problem.views or None
    return problem.scene.localize(*problem.pixels, views=views, seed=seed, time_limit=TIME_LIMIT)


def prior_of_view(problem: ViewProblem) -> PosePrior:
    """The first view's pose, with the uncertainty that a map assumes of a photo beside a view."""
    (view,) = problem.scene.named(problem.views[:1])
    distance = np.median(np.linalg.norm(problem.points3d @ view.rotation.T + view.translation, axis=-1))
    return PosePrior(view.rotation, view.translation, VIEW_DEGREES, VIEW_SHARE * float(distance))


def by_network(weights: str) -> Callable[[ViewProblem, int], Solution]:
    @cache
    def net() -> TrainedNet:
        return TrainedNet.from_pretrained(weights).eval()

    def solve_with(problem: ViewProblem, seed: int) -> Solution:
        search = by_view if getattr(net(), "frame", "any") == "view" else by_search
        return search(problem, seed, solver=net())

    return solve_with


METHODS: dict[str, Callable[[ViewProblem, int], Solution]] = {
    "solve": by_search, "view-prior": by_view, "localize": in_map,
    **{name: by_network(name) for name in pretrained_names()},
}  # fmt: skip


def outcomes(problems: Sequence[ViewProblem], method: str, seed: int) -> list[Outcome]:
    """What a method finds of the photos; the error of a centre in distances of the median point."""
    return [
        solved(
            one.name, one.rotation, one.translation, partial(METHODS[method], one, seed), distance=one.distance
        )
        for one in problems
    ]  # fmt: skip


def elsewhere(problems: Sequence[ViewProblem]) -> list[ViewProblem]:
    """The views of each problem with the photo of the problem that comes half of them later."""
    others = [*problems[len(problems) // 2 :], *problems[: len(problems) // 2]]
    return [
        replace(problem, points2d=other.points2d, focal=other.focal, match3d=np.full_like(problem.match3d, -1))
        for problem, other in zip(problems, others, strict=True)
    ]


def photos(
    limit: int, seed: int, *, scenes: Sequence[str] = REPORTED, data: Path = DATA, apart: bool = False, **chosen: Any
) -> list[ViewProblem]:
    """At most `limit` photos of the scenes together. chosen: options of `view_problem`."""
    each = -(-limit // len(scenes))
    problems = [problem for name in scenes for problem in scene_problems(data, name, limit=each, seed=seed, **chosen)]
    return (elsewhere(problems) if apart else problems)[:limit]


def rows(options: argparse.Namespace) -> Rows:
    for outliers in options.outliers:
        problems = photos(
            options.limit * len(options.scenes), options.seed, scenes=options.scenes, data=options.data,
            apart=options.elsewhere, views=options.views, outliers=outliers, best=options.best,
            most=None if options.all_points else MOST_POINTS,
        )  # fmt: skip
        for method in options.methods:
            name = f"{method}, {options.views} views, outliers {outliers:.0%}"
            yield name, partial(outcomes, problems, method, options.seed)


def main() -> None:
    options = parser(__doc__)
    options.add_argument("scenes", nargs="*", default=REPORTED, metavar="SCENE")
    options.add_argument("--methods", nargs="+", choices=tuple(METHODS), default=["solve"])
    options.add_argument("--views", type=int, default=1, help="0 for the whole map (default: 1)")
    options.add_argument("--outliers", type=float, nargs="+", default=[0.5, 0.75, 1.0], help="largest share of a side")
    options.add_argument("--all-points", action="store_true", help="do not thin to 1,024")
    options.add_argument("--best", action="store_true", help="of one view: the one that overlaps most")
    options.add_argument("--elsewhere", action="store_true", help="photos of other places")
    chosen = options.parse_args()
    measured(rows(chosen), chosen, RIGHT_DEG)


if __name__ == "__main__":
    main()
