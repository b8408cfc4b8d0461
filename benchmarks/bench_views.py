"""Photos against the points of k map views, by the protocol of GoMatch (ECCV 2022): AUC at 1, 5 and 10 px and more.

python benchmarks/bench_views.py --data ../shared/data --methods solve view-prior --outliers 0.5 0.75 1 castle-P30
Methods: solve; default (the same, with a packaged matcher where the search is in doubt); localize (a map's `localize`
with the names of the k views, or none); view-prior (the first view's pose as `PosePrior`), auto (the same, with the
packaged matcher where the search is in doubt); rough-prior (4 degrees and 4 % of the distance off, 2 s);
the packaged networks by themselves, in the axes that they expect; learned (around the pose of one); oracle (RANSAC on
the true pairs). Photos are left out of their map.
All are told the cones from which the points are seen, but localize and learned; --known: these, and the
lengths of the tracks, or nothing. --elsewhere: each photo against the views of another scene; none may be confident.
"""

import argparse
import json
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import poselib
from scipy.spatial.transform import Rotation
from view_pairs import LEAST_PAIRS, MOST_POINTS, Array, ViewPair, disturbed, scene_pairs

from bpnp import PosePrior, solve
from bpnp.cameras import camera_from
from bpnp.maps.localize import VIEW_DEGREES, VIEW_SHARE
from bpnp.models import TrainedNet
from bpnp.models.weights import pretrained_names
from bpnp.solving.problem import problem_from
from bpnp.solving.sources import Options, solutions_of

AUC_PX = (1.0, 5.0, 10.0)
ROUGH_DEGREES, ROUGH_SHARE, ROUGH_SECONDS = 4.0, 0.04, 2.0
KNOWN: set[str] = {"cones", "tracks"}  # what `solve`, `view-prior` and `rough-prior` are told of the points
Answer = tuple[Array, Array, str]  # rotation, translation, verdict


def by_search(pair: ViewPair, prior: PosePrior | None, seed: int, time_limit: float | None, **options: Any) -> Answer:
    known: dict[str, Any] = {}
    if "cones" in KNOWN:
        known |= {"normals3d": pair.cones.axes, "cosines3d": pair.cones.cosines}
    if "tracks" in KNOWN:
        known |= {"scores3d": pair.scores3d}
    camera = camera_from(np.diag([pair.focal, pair.focal, 1.0]))
    problem = problem_from(pair.focal * pair.points2d, pair.points3d, camera, prior=prior, **known)
    found = solutions_of({0: problem}, Options(seed=seed, time_limit=time_limit, **options))[0]
    return found.rotation, found.translation, found.verdict


def plain(pair: ViewPair, seed: int, time_limit: float | None, *, asks: bool = False) -> Answer:
    return by_search(pair, None, seed, time_limit, asks=asks)


def view_prior(pair: ViewPair, seed: int, time_limit: float | None, *, asks: bool = False) -> Answer:
    return by_search(pair, prior_of_view(pair), seed, time_limit, asks=asks)


def in_map(pair: ViewPair, seed: int, time_limit: float | None) -> Answer:
    camera = np.diag([pair.focal, pair.focal, 1.0])
    found = pair.scene.localize(
        pair.focal * pair.points2d, camera, views=pair.views or None, seed=seed, time_limit=time_limit
    )  # fmt: skip
    return found.rotation, found.translation, found.verdict


def rough_prior(pair: ViewPair, seed: int, time_limit: float | None) -> Answer:
    pose = disturbed(pair, ROUGH_DEGREES, ROUGH_SHARE, np.random.default_rng(seed))
    return by_search(pair, prior_at(pair, *pose, ROUGH_DEGREES, ROUGH_SHARE), seed, time_limit or ROUGH_SECONDS)


def prior_of_view(pair: ViewPair) -> PosePrior:
    (view,) = pair.scene.named(pair.views[:1])
    return prior_at(pair, view.rotation, view.translation, VIEW_DEGREES, VIEW_SHARE)


def prior_at(pair: ViewPair, rotation: Array, translation: Array, degrees: float, share: float) -> PosePrior:
    """A prior whose translation is known to within `share` of the median distance of the points."""
    distance = np.median(np.linalg.norm(pair.points3d @ rotation.T + translation, axis=-1))
    return PosePrior(rotation, translation, degrees, share * float(distance))


def learned(pair: ViewPair, seed: int, time_limit: float | None) -> Answer:
    camera = np.diag([pair.focal, pair.focal, 1.0])
    found = solve(
        pair.focal * pair.points2d, pair.points3d, camera, prior="learned", seed=seed, time_limit=time_limit
    )  # fmt: skip
    return found.rotation, found.translation, found.verdict


def by_network(weights: str, pair: ViewPair, seed: int, time_limit: float | None) -> Answer:
    net = trained(weights)
    prior = prior_of_view(pair) if getattr(net, "frame", "any") == "view" else None
    return by_search(pair, prior, seed, time_limit, solver=net)


@cache
def trained(weights: str) -> TrainedNet:
    return TrainedNet.from_pretrained(weights).eval()


def oracle(pair: ViewPair, seed: int, time_limit: float | None) -> Answer:
    del time_limit
    seen = pair.match3d >= 0
    camera = {"model": "PINHOLE", "width": 1, "height": 1, "params": [pair.focal, pair.focal, 0.0, 0.0]}
    pose, _ = poselib.estimate_absolute_pose(
        pair.focal * pair.points2d[pair.match3d[seen]], pair.points3d[seen], camera, {"seed": seed}, {}
    )
    return np.asarray(pose.R), np.asarray(pose.t), "confident"


METHODS: dict[str, Callable[[ViewPair, int, float | None], Answer]] = {
    "solve": plain, "default": partial(plain, asks=True), "localize": in_map,
    "view-prior": view_prior, "auto": partial(view_prior, asks=True),
    "rough-prior": rough_prior, "learned": learned, "oracle": oracle,
    **{name: partial(by_network, name) for name in pretrained_names()},
}  # fmt: skip


def measured(pair: ViewPair, method: str, seed: int, time_limit: float | None) -> dict[str, object]:
    """One photo's errors, verdict and seconds."""
    start, cpu = time.perf_counter(), time.process_time()
    rotation, translation, verdict = METHODS[method](pair, seed, time_limit)
    seconds, cpu = time.perf_counter() - start, time.process_time() - cpu
    found = bool(np.isfinite(rotation).all())
    centre, truth = -rotation.T @ translation, -pair.rotation.T @ pair.translation
    return {
        "photo": pair.name,
        "points": [len(pair.points2d), len(pair.points3d), pair.true_pairs],
        "rotation_deg": turned_by(rotation @ pair.rotation.T) if found else 180.0,
        "centre": float(np.linalg.norm(centre - truth)) if found else np.inf,
        "reprojection_px": pair.reprojection_error(rotation, translation) if found else np.inf,
        "verdict": verdict,
        "seconds": seconds,
        "cpu_seconds": cpu,
    }  # fmt: skip


def elsewhere(pairs: Sequence[ViewPair]) -> list[ViewPair]:
    """The views of each pair with the photo of the pair that comes half of them later."""
    others = [*pairs[len(pairs) // 2 :], *pairs[: len(pairs) // 2]]
    return [
        replace(pair, points2d=other.points2d, focal=other.focal, match3d=np.full_like(pair.match3d, -1))
        for pair, other in zip(pairs, others, strict=True)
    ]


def turned_by(rotation: Array) -> float:
    """Angle of a rotation, degrees."""
    return float(np.degrees(Rotation.from_matrix(rotation).magnitude()))


def area_under_recall(errors: Array, threshold: float) -> float:
    """Mean over t in (0, threshold] of the share of errors below t, in percent; exact for the step function."""
    return float(100 * np.clip(1 - errors / threshold, 0, None).mean())


def summary(rows: Sequence[dict]) -> dict[str, object]:
    pixels, degrees, centre = (
        np.array([row[key] for row in rows]) for key in ("reprojection_px", "rotation_deg", "centre")
    )
    sure = np.array([row["verdict"] == "confident" for row in rows])
    return {
        "photos": len(rows),
        "too_few_pairs": int(sum(row["points"][2] < LEAST_PAIRS for row in rows)),
        "auc_px": {str(px): area_under_recall(pixels, px) for px in AUC_PX},
        "under_1_deg": float((degrees < 1).mean()),
        "under_10_deg": float((degrees < 10).mean()),
        "rotation_q_deg": np.percentile(degrees, (25, 50, 75)).tolist(),
        "centre_q": np.percentile(centre, (25, 50, 75)).tolist(),
        "confident": float(sure.mean()),
        "confident_over_2_deg": int((sure & (degrees > 2)).sum()),
        "seconds_mean": float(np.mean([row["seconds"] for row in rows])),
        "cpu_seconds_mean": float(np.mean([row["cpu_seconds"] for row in rows])),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", metavar="SCENE")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--methods", nargs="+", choices=tuple(METHODS), default=["solve"])
    parser.add_argument("--views", type=int, default=1, help="k, 0 for the whole map (default: 1)")
    parser.add_argument(
        "--outliers", type=float, nargs="+", default=[0.5, 0.75, 1.0], help="largest share of each side"
    )
    parser.add_argument("--all-points", action="store_true", help="do not thin to 1,024")
    parser.add_argument("--best", action="store_true", help="for k = 1 the view that overlaps most, not a random one")
    parser.add_argument("--elsewhere", action="store_true", help="photos of other scenes, with two or more scenes")
    parser.add_argument("--limit", type=int, default=12, help="photos of a scene (default: 12)")
    parser.add_argument(
        "--known", nargs="*", choices=sorted(KNOWN), default=["cones"], help="of the points (default: cones)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the views, the thinning, rough poses and the search")
    parser.add_argument("--time-limit", type=float)
    parser.add_argument("--output", type=Path, help="JSON to write the rows to")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    KNOWN.intersection_update(options.known)
    results = []
    for outliers in options.outliers:
        chosen = {"limit": options.limit, "views": options.views, "best": options.best, "seed": options.seed}
        chosen |= {"most": None if options.all_points else MOST_POINTS}
        pairs = [
            pair
            for name in options.scenes
            for pair in scene_pairs(options.data, name, outliers=outliers, **chosen)
        ]  # fmt: skip
        if options.elsewhere:
            pairs = elsewhere(pairs)
        for method in options.methods:
            rows = [measured(pair, method, options.seed, options.time_limit) for pair in pairs]
            row = {"method": method, "views": options.views, "outliers": outliers} | summary(rows)
            print(line(row), flush=True)
            for name in options.scenes if len(options.scenes) > 1 else ():
                part = [one for one in rows if str(one["photo"]).startswith(f"{name}/")]
                print(f"    {name:20s} {line(row | summary(part))}", flush=True)
            results.append(row | {"rows": rows})
            if options.output:
                options.output.parent.mkdir(parents=True, exist_ok=True)
                options.output.write_text(json.dumps(results, indent=1) + "\n")


def line(row: dict) -> str:
    auc = " / ".join(f"{value:.0f}" for value in row["auc_px"].values())
    turn = " / ".join(f"{value:.3g}" for value in row["rotation_q_deg"])
    what = f"{row['method']:12s} k {row['views']:2d}  o {100 * row['outliers']:.0f} %  {row['photos']} photos"
    spent = f"{row['seconds_mean']:.1f} s, {row['cpu_seconds_mean']:.1f} CPU s"
    under = f"<1 deg {100 * row['under_1_deg']:.0f} %  <10 deg {100 * row['under_10_deg']:.0f} %"
    sure = f"confident {100 * row['confident']:.0f} %, wrong {row['confident_over_2_deg']}"
    return f"{what}  AUC {auc}  {under}  rotation {turn} deg  {sure}  {spent}"


if __name__ == "__main__":
    main()
