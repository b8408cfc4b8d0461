"""Synthetic maps beside COLMAP models: statistics of a photo's keypoints against one view's points, and a picture.

python benchmarks/bench_map_statistics.py --data ../shared/data --pairs 20 --picture docs/images/maps.png
Rows: quantiles 0.1 / 0.5 / 0.9 over the pairs of a kind or a scene. Distances to the nearest neighbour and counts in
cells are those of 300 points at most, so that dense and sparse photos can be compared.
"""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from view_pairs import Array, scene_pairs

from bpnp.datamodules.synthetic_maps.maps import KINDS, LONG_SIDE, MapOptions, draw_map_problem

SCENES = ("castle-P30", "fountain-P11", "south_building", "statue_of_liberty", "walkthrough", "sceaux_castle_txt")
MOST = 300  # points that a density is measured with
NEAR_PX = 3.0  # of an image with 1200 pixels on its longer side


class Points(NamedTuple):
    """Keypoints (m, 2), map points (n, 3), the keypoint (n,) of each or -1, and the map points seen by the camera."""

    points2d: Array
    points3d: Array
    match3d: NDArray[np.int64]
    camera: Array

    @property
    def true2d(self) -> NDArray[np.bool_]:
        mask = np.zeros(len(self.points2d), bool)
        mask[self.match3d[self.match3d >= 0]] = True
        return mask

    @property
    def true3d(self) -> NDArray[np.bool_]:
        return self.match3d >= 0

    @property
    def corners(self) -> Array:
        """Lowest and highest image coordinates (2, 2), but for the outermost hundredth."""
        return np.percentile(self.points2d, [1, 99], axis=0)


def real(data: Path, scene: str, count: int) -> list[Points]:
    pairs = scene_pairs(data, scene, limit=count, views=1, outliers=1.0)
    return [
        Points(pair.points2d, pair.points3d, pair.match3d, pair.points3d @ pair.rotation.T + pair.translation)
        for pair in pairs
    ]


def synthetic(kind: str, count: int) -> list[Points]:
    options = MapOptions(num_points=1024, outliers=1.0, views=(1, 1), kinds={kind: 1.0})
    drawn = []
    for number in range(count):
        pair = draw_map_problem(kind, options, np.random.default_rng([7, number]))
        match = np.where(np.arange(len(pair.points3d)) < pair.matched, np.arange(len(pair.points3d)), -1)
        camera = pair.points3d @ pair.rotation.T + pair.translation
        drawn.append(Points(pair.points2d.astype(float), pair.points3d.astype(float), match, camera))
    return drawn


def thinned(points: Array) -> Array:
    return points if len(points) <= MOST else np.random.default_rng(0).permutation(points)[:MOST]


def spacing2d(points: Points, chosen: NDArray[np.bool_]) -> float:
    """Median distance to the nearest neighbour, as a ratio to that of points spread at random: 0.94."""
    few = thinned(points.points2d[chosen])
    area = np.prod(np.diff(points.corners, axis=0))
    return float(np.median(cKDTree(few).query(few, k=2)[0][:, 1]) * 2 * np.sqrt(len(few) / area))


def clustering2d(points: Points, chosen: NDArray[np.bool_]) -> float:
    """Variance over mean of the counts in 8 x 8 cells, for 300 points: 1 for points spread at random."""
    few = thinned(points.points2d[chosen])
    counts = np.histogram2d(few[:, 0], few[:, 1], bins=8, range=points.corners.T)[0]
    return float(1 + (counts.var() / counts.mean() - 1) * MOST / len(few))


def spacing3d(points: Points) -> float:
    """Median distance to the nearest neighbour times the root of the number, in units of the robust radius."""
    few = thinned(points.points3d)
    radius = np.median(np.linalg.norm(few - np.median(few, 0), axis=1))
    return float(np.median(cKDTree(few).query(few, k=2)[0][:, 1]) / radius * np.sqrt(len(few)))


def farthest(points: Points) -> float:
    """95th percentile of the distance from the median, over the median distance."""
    distance = np.linalg.norm(points.points3d - np.median(points.points3d, 0), axis=1)
    return float(np.quantile(distance, 0.95) / np.median(distance))


def axes3d(points: Points, which: int) -> float:
    """Shortest (0) or middle (1) over longest axis of the points within four radii."""
    offset = points.points3d - np.median(points.points3d, 0)
    distance = np.linalg.norm(offset, axis=1)
    lengths = np.sqrt(np.linalg.eigvalsh(np.cov(offset[distance < 4 * np.median(distance)].T)))
    return float(lengths[which] / lengths[2])


def depth_range(points: Points) -> float:
    """90th over 10th percentile of the true points' depths."""
    return float(np.divide(*np.quantile(points.camera[points.true3d, 2], [0.9, 0.1])))


def true_area(points: Points) -> float:
    """Area of the box around the true keypoints over that around all."""
    inner = np.percentile(points.points2d[points.true2d], [2, 98], axis=0)
    return float(np.prod(np.diff(inner, axis=0)) / np.prod(np.diff(points.corners, axis=0)))


def projected_outliers(points: Points) -> Array:
    """(k, 2) of the map points without a partner that are projected into the image."""
    camera = points.camera[~points.true3d]
    image = camera[camera[:, 2] > 0, :2] / camera[camera[:, 2] > 0, 2:]
    low, high = points.corners
    return image[((image > low) & (image < high)).all(1)]


def near_keypoints(points: Points) -> float:
    """Share of these with a keypoint within three pixels, of an image 1200 wide."""
    outliers = projected_outliers(points)
    if not len(outliers):
        return np.nan
    limit = NEAR_PX / LONG_SIDE * np.diff(points.corners, axis=0).max()
    return float((cKDTree(points.points2d).query(outliers)[0] < limit).mean())


def apart(points: Points, *, side3d: bool) -> float:
    """Median distance from a point without a partner to the nearest true one, over that between true ones."""
    all_points, true = (points.points3d, points.true3d) if side3d else (points.points2d, points.true2d)
    if true.all():
        return np.nan
    tree = cKDTree(all_points[true])
    between = np.median(tree.query(all_points[true], k=2)[0][:, 1])
    return float(np.median(tree.query(all_points[~true])[0]) / between)


STATISTICS: dict[str, Callable[[Points], float]] = {
    "keypoints": lambda p: len(p.points2d),
    "map points": lambda p: len(p.points3d),
    "true share, 2D": lambda p: p.true2d.mean(),
    "true share, 3D": lambda p: p.true3d.mean(),
    "spacing, 2D": lambda p: spacing2d(p, np.ones(len(p.points2d), bool)),
    "spacing, true 2D": lambda p: spacing2d(p, p.true2d),
    "clustering, 2D": lambda p: clustering2d(p, np.ones(len(p.points2d), bool)),
    "clustering, true 2D": lambda p: clustering2d(p, p.true2d),
    "area of true 2D": true_area,
    "spacing, 3D": spacing3d,
    "farthest, 3D": farthest,
    "shortest axis": lambda p: axes3d(p, 0),
    "middle axis": lambda p: axes3d(p, 1),
    "depth range": depth_range,
    "half image": lambda p: float(np.diff(p.corners, axis=0).max() / 2),
    "3D outliers in image": lambda p: len(projected_outliers(p)) / max(1, int((~p.true3d).sum())),
    "... near a keypoint": near_keypoints,
    "2D outliers apart": lambda p: apart(p, side3d=False),
    "3D outliers apart": lambda p: apart(p, side3d=True),
}  # fmt: skip


def table(sets: dict[str, list[Points]]) -> str:
    """One row a statistic, one column a set."""
    lines = ["| |" + "|".join(sets) + "|", "|---" * (len(sets) + 1) + "|"]
    for name, statistic in STATISTICS.items():
        cells = (np.nanquantile([statistic(points) for points in sets[column]], [0.1, 0.5, 0.9]) for column in sets)
        lines.append(
            f"| {name} | "
            + " | ".join(" / ".join(f"{x:.2g}" if x < 100 else f"{x:.0f}" for x in cell) for cell in cells)
            + " |"
        )
    return "\n".join(lines)


def draw(sets: dict[str, list[Points]], path: Path) -> None:
    """Keypoints of one pair of each set, true ones in colour, and the map from above, longest axes in the plane."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(2.1 * len(sets), 4.4), layout="constrained")
    axes = figure.subplots(2, len(sets))
    for k, (name, pairs) in enumerate(sets.items()):
        points = pairs[len(pairs) // 2]
        offset = points.points3d - np.median(points.points3d, 0)
        near = np.linalg.norm(offset, axis=1) < 5 * np.median(np.linalg.norm(offset, axis=1))
        flat = offset @ np.linalg.eigh(np.cov(offset[near].T))[1][:, :0:-1]
        for axis, places, true in (
            (axes[0, k], points.points2d * [1, -1], points.true2d),
            (axes[1, k], flat, points.true3d),
        ):
            axis.scatter(*places[~true].T, s=0.6, c="0.65", linewidths=0)
            axis.scatter(*places[true].T, s=1.2, c="C0", linewidths=0)
            axis.set(xticks=[], yticks=[], aspect="equal")
        reach = np.abs(flat[near]).max()
        axes[1, k].set(xlim=(-reach, reach), ylim=(-reach, reach))
        axes[0, k].set_title(name, fontsize=8)
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--pairs", type=int, default=20, help="of each kind and scene (default: 20)")
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    for sets in (
        {scene: real(options.data, scene, options.pairs) for scene in SCENES},
        {kind: synthetic(kind, options.pairs) for kind in KINDS},
    ):
        print(table(sets), end="\n\n")
        if options.picture:
            part = "real" if SCENES[0] in sets else "synthetic"
            draw(sets, options.picture.with_stem(f"{options.picture.stem}-{part}"))


if __name__ == "__main__":
    main()
