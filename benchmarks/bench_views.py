"""Photos left out of their COLMAP map, against the points of one view, of several, or of the whole map.

    python -m benchmarks views --methods solve localize --outliers 0.5 0.75 1 fountain-P11 walkthrough
    python -m benchmarks views --methods localize --views 0 --all-points --outliers 1 fountain-P11 walkthrough

The protocol of GoMatch (Zhou et al., ECCV 2022). Methods: solve (no prior); localize (a map's `localize`, told the
names of the views, or none with --views 0). --elsewhere: each photo against the views of another place, where none may
be confident.
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from record import DATA, TIME_LIMIT, Problem, Rows, measured, parser
from view_problems import MOST_POINTS, REPORTED, ViewProblem, scene_problems

from bpnp import Solution, solve

RIGHT_DEG = 1.0


def by_search(photo: ViewProblem, **options: float) -> Solution:
    pixels, camera = photo.pixels
    return solve(pixels, photo.points3d, camera, **options)  # type: ignore[arg-type]


def in_map(photo: ViewProblem, **options: float) -> Solution:
    return photo.scene.localize(*photo.pixels, views=photo.views or None, **options)  # type: ignore[arg-type]


METHODS = {"solve": by_search, "localize": in_map}


def problems(photos: Sequence[ViewProblem], method: str, seed: int) -> Iterator[Problem]:
    """Of photos by a method; the error of a centre in distances of the median point."""
    for photo in photos:
        search = partial(METHODS[method], photo, seed=seed, time_limit=TIME_LIMIT)
        yield Problem(photo.name, search, [photo.pose], photo.points3d, photo.distance)


def elsewhere(photos: Sequence[ViewProblem]) -> list[ViewProblem]:
    """The views of each problem with the photo of the problem that comes half of them later."""
    others = [*photos[len(photos) // 2 :], *photos[: len(photos) // 2]]
    return [
        replace(photo, points2d=other.points2d, focal=other.focal, match3d=np.full_like(photo.match3d, -1))
        for photo, other in zip(photos, others, strict=True)
    ]


def photos(
    limit: int, seed: int, *, scenes: Sequence[str] = REPORTED, data: Path = DATA, apart: bool = False,
    views: int = 1, outliers: float = 1.0, best: bool = False, most: int | None = MOST_POINTS,
) -> list[ViewProblem]:  # fmt: skip
    """At most `limit` photos of the scenes together. apart: of other places. The rest: as `view_problem` has it."""
    chosen = {"views": views, "outliers": outliers, "best": best, "most": most, "seed": seed}
    each = -(-limit // len(scenes))
    drawn = [photo for name in scenes for photo in scene_problems(data, name, limit=each, **chosen)]
    return (elsewhere(drawn) if apart else drawn)[:limit]


def rows(options: argparse.Namespace) -> Rows:
    chosen = {"scenes": options.scenes, "data": options.data, "apart": options.elsewhere, "views": options.views}
    chosen |= {"best": options.best, "most": None if options.all_points else MOST_POINTS}
    for outliers in options.outliers:
        drawn = photos(options.limit * len(options.scenes), options.seed, outliers=outliers, **chosen)
        for method in options.methods:
            name = f"{method}, {options.views} views, outliers {outliers:.0%}"
            yield name, partial(problems, drawn, method, options.seed)


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
