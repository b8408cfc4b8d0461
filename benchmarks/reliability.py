"""How often confident poses are wrong, by family; and a diagram of what the search claims against what is observed.

    python -m benchmarks reliability --families leds shapes photos maps hard --seed 9 --limit 100 --output rows.jsonl
    python -m benchmarks reliability --draw docs/images/reliability.png rows.jsonl others.jsonl

Families: leds (the settings of `constellation`), shapes (0, 0.25 and 0.5 outliers a match), photos (against
the points of one view, 0 to 100 % outliers a side), maps (photos left out of their map, which view is not told), hard
(`hard_scenes.py`), focal (photos against one view, and planes, with a focal length 5 to 33 % wrong), focal_maps (photos
left out of their map, as wrong by each of --factors), labels (LEDs of three colours that a classifier of Gaussian
noise sees: without labels, with its likeliest class, and with its probabilities). --limit: problems of each
setting. Photos are of scenes on which no constant was chosen (`--scenes`).

Wrong: more than 3 degrees off, or the middle of the scene moved by more than a tenth of its distance, and beyond the
bound that the solution claims (`record.beyond_bound`); with a wrong focal length: the camera's centre more than a
twentieth of the distance off. sigmas: shares of the errors of the right poses, six numbers each, within 1, 2 and 3 of
their standard deviations, and the factors of these with which they would be 68, 95 and 99.7 %. A row is written as soon
as it is known; those that the file has are not solved again.
"""

import json
import time
from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import leds
import numpy as np
import pandas as pd
import shapes
from hard_scenes import CAMERA, SCENES, Drawn, wrong_focal_plane
from matplotlib.figure import Figure
from record import TIME_LIMIT, Array, Problem, beyond_bound, degrees, parser, sigmas
from scipy.special import softmax
from scipy.stats import binomtest
from view_problems import LEAST_MATCHES, REPORTED, Against, ViewProblem, scene_problems

from bpnp import Solution, solve, warm_up
from bpnp.cameras import camera_from
from bpnp.report.figures import save_figure
from bpnp.search import pool, verdict
from bpnp.search.verdict import missed
from bpnp.solving.problem import problem_from
from bpnp.solving.sources import Options, solutions_of

OUTLIERS = (0.0, 0.25, 0.5, 0.75, 1.0)
RATIOS = (0.0, 0.25, 0.5)
FACTORS = (0.67, 0.8, 0.9, 0.95, 1.05, 1.1, 1.2, 1.33)
WRONG_DEG, WRONG_SHIFT, WRONG_CENTRE = 3.0, 0.1, 0.05
COLOURS, BLUR = 3, 0.8  # classes of LEDs, and the noise of what a classifier sees of them
NORMAL = (0.6827, 0.9545, 0.9973)  # shares within 1, 2 and 3 standard deviations
GROUPS = {"right, confident": "tab:green", "right": "tab:olive", "wrong": "0.8", "wrong, confident": "tab:red"}


def of_leds(options: Any) -> Iterator[Problem]:
    for name in leds.SETTINGS:
        yield from leds.problems(name, options.limit, options.seed)


def of_shapes(options: Any) -> Iterator[Problem]:
    for ratio in RATIOS:
        chosen = f"shapes-{ratio:.2f}", options.data, options.limit, options.seed, options.time_limit
        for one in shapes.problems(*chosen):
            yield replace(one, name=f"{ratio:g} outliers a match/{one.name}")


def photos(options: Any) -> Iterator[Problem]:
    for outliers in OUTLIERS:
        for photo in in_turns(options, outliers, "view"):
            yield with_camera(f"{outliers:.0%} outliers/{photo.name}", photo, 1.0, options)


def focal(options: Any) -> Iterator[Problem]:
    for k, photo in enumerate(in_turns(options, 0.5, "view")):
        for factor in options.factors[k % 2 :: 2]:
            yield with_camera(f"photos {abs(factor - 1):.0%}/{photo.name} x {factor}", photo, factor, options)
    rng = np.random.default_rng([options.seed, 1])
    yield from with_lens("planes", (wrong_focal_plane(rng) for _ in range(options.limit)), options)


def focal_maps(options: Any) -> Iterator[Problem]:
    for photo in in_turns(options, 1.0, "map"):
        for factor in options.factors:
            yield in_map(f"maps {abs(factor - 1):.0%}/{photo.name} x {factor}", photo, factor, options)


def maps(options: Any) -> Iterator[Problem]:
    for photo in in_turns(options, 1.0, "map"):
        yield in_map(f"maps/{photo.name}", photo, 1.0, options)


def hard(options: Any) -> Iterator[Problem]:
    for draw in SCENES:
        rng = np.random.default_rng(options.seed)
        yield from with_lens(draw.__name__, (draw(rng) for _ in range(options.limit)), options)


def labels(options: Any) -> Iterator[Problem]:
    for kind in ("none", "likeliest", "probabilities"):
        for k in range(options.limit):
            rng = np.random.default_rng([options.seed, k])
            shape = ("ring", "headset", "drone", "marker")[k % 4]
            setting = leds.Setting("labels", shape, background=3, missing=0.1, least=5, normals=False)  # type: ignore[arg-type]
            shown = leds.picture(setting, 1000 * options.seed + k, rng)
            scene = rng.permutation(np.arange(len(shown.device.points3d)) % COLOURS)
            image = np.where(shown.led >= 0, scene[shown.led], rng.integers(COLOURS, size=len(shown.led)))
            score = (np.eye(COLOURS)[image] + BLUR * rng.standard_normal((len(image), COLOURS))) / BLUR**2
            known: dict[str, Any] = {"likeliest": {"labels2d": score.argmax(1), "labels3d": scene}}.get(kind, {})
            if kind == "probabilities":
                known = {"labels2d": softmax(score, 1), "labels3d": np.eye(COLOURS)[scene]}
            points = shown.pixels, shown.device.points3d, shown.camera.model
            run = partial(solve, *points, **known, seed=options.seed, time_limit=options.time_limit)
            yield Problem(f"{kind}/{k}", run, [(shown.rotation, shown.translation)], points[1])


FAMILIES = {
    "leds": of_leds, "shapes": of_shapes, "photos": photos, "maps": maps, "hard": hard, "focal": focal,
    "focal_maps": focal_maps, "labels": labels,
}  # fmt: skip


def in_turns(options: Any, outliers: float, against: Against) -> Iterator[ViewProblem]:
    """Photos of each scene in turns, so that a part of them is of all scenes; those with enough true matches."""
    known = {"against": against, "outliers": outliers, "seed": options.seed}
    turns = [scene_problems(options.data, scene, limit=options.limit, **known) for scene in options.scenes]
    for turn in zip(*turns, strict=False):
        yield from (photo for photo in turn if photo.matches >= LEAST_MATCHES)


def with_lens(name: str, scenes: Iterable[Drawn], options: Any) -> Iterator[Problem]:
    for k, (pixels, points3d, poses) in enumerate(scenes):
        run = partial(solve, pixels, points3d, CAMERA, seed=options.seed, time_limit=options.time_limit)
        yield Problem(f"{name}/{k}", run, poses, points3d)


def in_map(name: str, photo: ViewProblem, factor: float, options: Any) -> Problem:
    """A photo in its map, with a camera of `factor` times the focal length."""
    pixels, camera = photo.pixels
    known = {"seed": options.seed, "time_limit": options.time_limit}
    run = partial(photo.scene.localize, pixels, camera * [[factor], [factor], [1]], **known)
    return Problem(name, run, [photo.pose], photo.seen)


def with_camera(name: str, photo: ViewProblem, factor: float, options: Any) -> Problem:
    """A photo against one view, with the cones of the points, and a camera of `factor` times the focal length."""

    def run() -> Solution:
        camera = camera_from(np.diag([factor * photo.focal, factor * photo.focal, 1.0]))
        cones: dict[str, Any] = {"normals3d": photo.scene.cones.axes, "cosines3d": photo.scene.cones.cosines}
        problem = problem_from(photo.focal * photo.points2d, photo.points3d, camera, **cones)
        return solutions_of({0: problem}, Options(asks=False, seed=options.seed, time_limit=options.time_limit))[0]

    return Problem(name, run, [photo.pose], photo.points3d if factor == 1 else photo.seen)  # the depth of what is seen


def row_of(family: str, problem: Problem) -> dict[str, Any]:
    """What was found. claims: [log10 of the probability that a better pose was missed, whether the best one is wrong],
    whenever one exceeds chance."""
    claims: list[tuple[float, bool]] = []
    middle = np.median(problem.points3d, 0)

    def errors(rotation: Array, seen: Array) -> tuple[float, float]:
        """Degrees, and shift of the middle, seen from the camera, in distances, to the nearest of the true poses."""
        true = [(turn, turn @ middle + shift) for turn, shift in problem.poses]
        off = [(degrees(rotation, turn), float(np.linalg.norm(seen - at) / np.linalg.norm(at))) for turn, at in true]
        return min(off, default=(180.0, np.inf))

    def is_far(deg: float, shift: float) -> bool:
        return not (deg <= WRONG_DEG and shift <= WRONG_SHIFT)

    def watched(poses: Any, sets: Any, *rest: Any, independent: bool = True) -> float:
        claim = missed(poses, sets, *rest, independent=independent)
        same_scene = len(sets.points3d) == len(problem.points3d)  # not a part of a map; its origin may be another one
        if independent and same_scene and len(poses) and poses.log10_false_alarms[0] < 0:
            seen = poses.rotation[0] @ sets.middle + poses.translation[0]
            claims.append((claim, is_far(*errors(poses.rotation[0], seen))))
        return claim

    cpu = time.process_time()
    with patch.object(pool, "missed", watched), patch.object(verdict, "missed", watched):
        found = problem.solve()
    row: dict[str, Any] = {"family": family, "name": problem.name, "cpu": time.process_time() - cpu}
    deg, shift = errors(found.rotation, found.rotation @ middle + found.translation)
    outside, wrong = all(beyond_bound(found, *pose) for pose in problem.poses), is_far(deg, shift)
    centre = np.nan
    if family.startswith("focal"):
        rotation, translation = problem.poses[0]
        distance = np.linalg.norm(rotation @ middle + translation)
        centre = float(np.linalg.norm(found.centre + rotation.T @ translation) / distance)
        wrong, outside = not centre <= WRONG_CENTRE, True
    row |= {"deg": deg, "shift": shift, "centre": centre, "outside": outside, "wrong": wrong and outside}
    row |= {"verdict": found.verdict, "reason": found.reason, "alarms": found.log10_false_alarms}
    row["sigmas"] = (
        [] if is_far(deg, shift) else min((sigmas(found, *pose, middle) for pose in problem.poses), key=np.linalg.norm)
    )
    return row | {"claims": list({int(claim // 1): (claim, far) for claim, far in claims}.values())}


def summary(rows: pd.DataFrame) -> str:
    """A line for each family and setting: problems, right, confident, and of these wrong."""
    lines = []
    for (family, setting), part in rows.groupby(["family", rows.name.str.split("/").str[0]], sort=False):
        sure, wrong = part.verdict == "confident", part.wrong
        believed = (sure & ~wrong).sum() / max((~wrong).sum(), 1)
        off = np.abs([one for each in part.get("sigmas", []) if isinstance(each, list) for one in each])
        known = ""
        if len(off):
            shares = " / ".join(f"{(off <= limit).mean():.1%}" for limit in (1, 2, 3))
            known = f"; sigmas {shares}, x " + " / ".join(
                f"{np.quantile(off, share) / limit:.2f}" for limit, share in enumerate(NORMAL, 1)
            )
        lines.append(
            f"{family:7} {setting:30} {len(part):5} problems, right {1 - wrong.mean():4.0%}, confident {sure.sum():5}, "
            f"of these wrong {(sure & wrong).sum()}; {believed:4.0%} of the right, median {part.cpu.median():.3g} CPU s"
            f"{known}"
        )
    sure = rows.verdict == "confident"
    return "\n".join([*lines, f"confident {sure.sum()}, of these wrong {(sure & rows.wrong).sum()}"])


def draw(rows: pd.DataFrame, path: Path) -> None:
    """Left: claims against shares of wrong poses, in each decade a problem once, with Wilson's intervals. Right: the
    verdicts."""
    rows = rows[~rows.family.str.startswith("focal")]
    met = pd.DataFrame(
        [(max(claim, -6.0), far) for claims in rows.claims for claim, far in claims], columns=["p", "far"]
    )
    left, right = (figure := Figure(figsize=(11, 4), layout="constrained")).subplots(1, 2)
    for _, part in met.groupby(met.p // 1):
        claimed, test = (10**part.p).mean(), binomtest(int(part.far.sum()), len(part))
        low, high = test.proportion_ci(method="wilson")
        left.plot([claimed] * 3, np.maximum([low, test.statistic, high], 1e-9), "o-", color="tab:blue", markevery=[1])
        left.annotate(f"{test.k} of {test.n}", (claimed, high), ha="center", va="bottom", fontsize=7)
    left.plot([1e-6, 1], [1e-6, 1], "k--", lw=1)
    left.set(xscale="log", yscale="log", ylim=(1e-4, 2), xlabel="claimed: a better pose was missed", ylabel="wrong")
    table = pd.crosstab(rows.family, 2 * rows.wrong + (rows.verdict == "confident"), normalize="index")
    table = table.reindex(columns=[1, 0, 2, 3], fill_value=0).set_axis(list(GROUPS), axis=1)
    table.plot.barh(stacked=True, ax=right, color=GROUPS, xlim=(0, 1), ylabel="")
    right.legend(loc="lower center", bbox_to_anchor=(0.5, 1), ncol=4, fontsize=7)
    save_figure(figure, path)


def read(files: list[Path]) -> list[dict[str, Any]]:
    return [json.loads(line) for file in files if file.exists() for line in file.read_text().splitlines()]


def main() -> None:
    options = parser(__doc__)
    options.add_argument("rows", nargs="*", type=Path, help="files to sum up and draw, in place of solving problems")
    options.add_argument("--draw", type=Path, help="picture to write of the files")
    options.add_argument("--families", nargs="*", choices=FAMILIES, default=list(FAMILIES))
    options.add_argument("--scenes", nargs="*", default=REPORTED)
    options.add_argument("--factors", type=float, nargs="+", default=FACTORS, help="of wrong focal lengths")
    options.add_argument("--time-limit", type=float, default=TIME_LIMIT, help="seconds (default: %(default)s)")
    chosen = options.parse_args()
    files = chosen.rows or [chosen.output or Path("reliability.jsonl")]
    known = {(row["family"], row["name"]) for row in read(files)}
    if not chosen.rows:
        warm_up()
        files[0].parent.mkdir(parents=True, exist_ok=True)
        for family in chosen.families:
            for problem in FAMILIES[family](chosen):
                if (family, problem.name) not in known:
                    with files[0].open("a") as file:
                        file.write(json.dumps(row_of(family, problem)) + "\n")
    rows = pd.DataFrame(read(files))
    print(summary(rows))
    if chosen.draw:
        draw(rows, chosen.draw)
