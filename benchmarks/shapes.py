"""Shapes, meshes and points of photos, for `solve` without a prior.

The sets are shapes (procedural, any rotation), psb (Euler angles up to 45 degrees, the paper's protocol), psb-so3, and
photos (the same number of each of the models `REPORTED`). Outliers are random points; for photos, keypoints without a
point and points that are not visible. Their ratio is relative to the matches on either side.
"""

from collections.abc import Iterator
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import Literal

import numpy as np
from record import Problem, spread
from scipy.spatial.transform import Rotation
from view_problems import REPORTED

from bpnp import solve
from bpnp.arrays import Array
from bpnp.datamodules import ColmapDataModule, MeshDataModule, Outliers
from bpnp.datamodules.shapes import normalise, procedural_shape, sample_surface

Points = tuple[str, Array, Array, Array, Array]  # name, points2d, points3d, rotation, translation
POINTS, NOISE = 400, 2 / 800


def shapes(ratio: float, limit: int, seed: int) -> Iterator[Points]:
    """Yield problems with 400 points of a shape in the unit sphere, seen from 4 to 5 units with noise of 2 pixels at a
    focal length of 800, and `ratio` times as many random points in the bounding boxes of both sides.
    """
    for k in range(limit):
        rng = np.random.default_rng([seed, k])
        points = normalise(sample_surface(procedural_shape(rng), POINTS, rng), "unit_sphere")
        rotation, translation = Rotation.random(random_state=rng).as_matrix(), rng.uniform(-0.5, 0.5, 3) + [0, 0, 4.5]
        camera = points @ rotation.T + translation
        image = camera[:, :2] / camera[:, 2:] + NOISE * rng.standard_normal((POINTS, 2))
        others = round(POINTS * ratio)
        sides = [np.concatenate([x, rng.uniform(x.min(0), x.max(0), (others, x.shape[1]))]) for x in (image, points)]
        points2d, points3d = (rng.permutation(side) for side in sides)
        yield f"shape {k}", points2d, points3d, rotation, translation


def of_data(name: str, ratio: float, limit: int, seed: int, data: Path) -> Iterator[Points]:
    """Return meshes, or photos of a model, evenly spread over all of them."""
    if name.startswith("psb"):
        rotation: Literal["so3", "euler"] = "so3" if name == "psb-so3" else "euler"
        module: MeshDataModule | ColmapDataModule = MeshDataModule(
            str(data / "psb"), test_problems=limit, seed=seed, rotation=rotation, test_outliers=Outliers(ratio=ratio)
        )
    else:
        folder = str(data / "colmap" / name)
        module = ColmapDataModule(folder, test_fraction=1.0, rotate=True, clutter=ratio, seed=seed)
    module.setup("test")
    problems = module.datasets["test"]
    for i in spread(range(len(problems)), limit):
        batch = problems.problem(i)
        values = (batch.points2d, batch.points3d, batch.rotation, batch.translation)
        yield f"{name}/{batch.ids[0]}", *(x[0].double().numpy() for x in values if x is not None)  # type: ignore[misc]


def problems(
    chosen: str, ratio: float, limit: int, seed: int, data: Path, time_limit: float | None = None
) -> Iterator[Problem]:
    """Yield at most `limit` problems of a set; `time_limit` as for `solve`."""
    if chosen == "shapes":
        drawn = shapes(ratio, limit, seed)
    else:
        scenes = REPORTED if chosen == "photos" else [chosen]
        each = -(-limit // len(scenes))
        drawn = chain.from_iterable(of_data(name, ratio, each, seed, data) for name in scenes)
    for name, points2d, points3d, rotation, translation in islice(drawn, limit):
        search = partial(solve, points2d, points3d, seed=seed, time_limit=time_limit)
        yield Problem(name, search, [(rotation, translation)], points3d)
