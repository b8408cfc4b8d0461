"""Every photo of a scene against a map that was built without it: by its keypoints alone, and with descriptors.

python benchmarks/bench_left_out.py --data ../shared/data --maps runs/left-out castle-P30 fountain-P11
Methods: views (the three views given that share most points with the photo), map (none given); views-sift and map-sift,
the same with SIFT descriptors, a ratio test and PoseLib.
pycolmap builds a map for each photo on the first run and keeps it in --maps. Truth: the pose in the model of all
photos, aligned by the views that both models have. Keypoints: OpenCV's SIFT for the first two, those of COLMAP's
database for the others. Seconds are those of matching and of the pose, without detection. Rows in --output are kept:
a run that was interrupted goes on where it was.
"""

import argparse
import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from bench_views import turned_by
from descriptor_poses import Array, DescribedMap
from rebuilt_maps import PhotoScene, aligned

from bpnp import SceneMap
from bpnp.maps.photos import detected_keypoints

CAMERA = (1379.7, 1382.1, 760.3, 503.4)  # of the photos at half size, pixels
VIEWS = 3
METHODS = ("views", "map", "views-sift", "map-sift")
Answer = tuple[Array, Array, str]  # rotation, translation, verdict


def answers(
    scene: PhotoScene,
    photo: str,
    place: SceneMap,
    views: list[str],
    methods: Sequence[str],
    *,
    scored: bool,
    **search: Any,
) -> dict[str, Callable[[], Answer]]:
    """What finds the photo, by method; reading and detecting is done before.

    scored: whether the search is told the scales of the keypoints. search: options of `SceneMap.localize`.
    """
    found = detected_keypoints(scene.photos / photo)
    described = DescribedMap(scene.without(photo), scene.database) if any("sift" in m for m in methods) else None

    def by_keypoints(views: list[str] | None) -> Answer:
        camera = ("PINHOLE", scene.camera)
        solution = place.localize(found.pixels, camera, views=views, scores=found.scores if scored else None, **search)
        return solution.rotation, solution.translation, solution.verdict

    def by_descriptors(views: list[str] | None) -> Answer:
        assert described is not None
        return described.localize(photo, scene.camera, views)

    def one(method: str) -> Callable[[], Answer]:
        solve = by_descriptors if method.endswith("-sift") else by_keypoints
        return lambda: solve(views if method.startswith("views") else None)

    return {method: one(method) for method in methods}


def turn_rows(scene: PhotoScene, photo: str, full: SceneMap, methods: Sequence[str], **search: Any) -> list[dict]:
    """A row for each method, for one photo that is left out of its map."""
    place = SceneMap.from_colmap(scene.without(photo))
    shared = full.visibility @ full.visibility[[full.view_numbers[photo]]].toarray()[0]
    likely = [full.views[i].name for i in np.argsort(-shared, kind="stable")]
    views = [name for name in likely if name != photo and name in place.view_numbers][:VIEWS]
    (true,) = full.named([photo])
    distance = float(np.median(np.linalg.norm(full.points3d[true.points] - true.centre, axis=1)))
    there = aligned(place, full)
    rows = []
    for method, solve in answers(scene, photo, place, views, methods, **search).items():
        start, cpu = time.perf_counter(), time.process_time()
        rotation, translation, verdict = solve()
        seconds, cpu = time.perf_counter() - start, time.process_time() - cpu
        turn, centre = there.pose(rotation, translation)
        found = bool(np.isfinite(rotation).all())
        rows.append(
            {
                "photo": f"{scene.photos.name}/{photo}",
                "method": method,
                "map": [len(place.views), len(place.points3d)],
                "rotation_deg": turned_by(turn @ true.rotation.T) if found else 180.0,
                "centre_percent": float(100 * np.linalg.norm(centre - true.centre) / distance) if found else np.inf,
                "verdict": verdict,
                "seconds": seconds,
                "cpu_seconds": cpu,
            }
        )
    return rows


def summary(rows: Sequence[dict]) -> str:
    turns, centres = (np.array([row[key] for row in rows]) for key in ("rotation_deg", "centre_percent"))
    sure = np.array([row["verdict"] == "confident" for row in rows])
    wall, cpu = (np.mean([row[key] for row in rows]) for key in ("seconds", "cpu_seconds"))
    return (
        f"{rows[0]['method']:10s} {len(rows)} photos  <1 deg {100 * (turns < 1).mean():.0f} %  median "
        f"{np.median(turns):.3f} deg, centre {np.median(centres):.3f} %  confident {100 * sure.mean():.0f} %, of these "
        f"over 2 deg {int((sure & (turns > 2)).sum())}  {wall:.1f} s, {cpu:.1f} CPU s"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", metavar="SCENE")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--maps", type=Path, default=Path("runs/left-out"), help="folder of the maps that are built")
    parser.add_argument("--camera", type=float, nargs=4, default=CAMERA, metavar=("FX", "FY", "CX", "CY"))
    parser.add_argument(
        "--features", type=int, default=2048, help="of a photo in the maps, the largest (default: 2048)"
    )
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=METHODS)
    parser.add_argument("--limit", type=int, help="photos of a scene, evenly spread (default: all)")
    parser.add_argument("--time-limit", type=float, help="seconds of a search (default: none)")
    parser.add_argument("--unscored", action="store_true", help="try all keypoints that are detected, not the largest")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, help="JSON to write the rows to")
    options = parser.parse_args()
    kept_rows = options.output is not None and options.output.is_file()
    rows: list[dict] = json.loads(options.output.read_text()) if kept_rows else []
    for name in options.scenes:
        kept = options.maps / f"{name}-{options.features}"
        scene = PhotoScene(options.data / "photos" / name, kept, tuple(options.camera), options.features)
        full = SceneMap.from_colmap(scene.full())
        names = [photo for photo in scene.names() if photo in full.view_numbers]
        count = min(options.limit or len(names), len(names))
        for photo in (names[int(k * len(names) / count)] for k in range(count)):
            before = {row["method"] for row in rows if row["photo"] == f"{name}/{photo}"}
            methods = [method for method in options.methods if method not in before]
            if not methods:
                continue
            search = {"time_limit": options.time_limit, "seed": options.seed, "scored": not options.unscored}
            done = turn_rows(scene, photo, full, methods, **search)
            for row in done:
                print(f"{row['photo']:24s} {summary([row])}", flush=True)
            rows += done
            if options.output:
                options.output.parent.mkdir(parents=True, exist_ok=True)
                options.output.write_text(json.dumps(rows, indent=1) + "\n")
        for method in options.methods:
            own = [row for row in rows if row["method"] == method and row["photo"].startswith(f"{name}/")]
            print(f"{name:16s} {summary(own)}", flush=True)


if __name__ == "__main__":
    main()
