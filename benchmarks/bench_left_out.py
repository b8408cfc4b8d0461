"""Raw photos against a map that was built without them: keypoints alone, and SIFT descriptors for comparison.

    python -m benchmarks left_out castle-P30 fountain-P11 --limit 6

Rows of a scene: views (the three views that share most points are given), map (none is given); views-sift and map-sift,
the same with SIFT descriptors, a ratio test and PoseLib; words-sift, with the ten views that a bag of visual words
retrieves (Sivic and Zisserman, ICCV 2003). pycolmap builds a map for each photo in the first run and keeps it in
--maps. Ground truth: the pose in the model of all photos, aligned by the views that both models have.
"""

import argparse
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import poselib
import pycolmap
from numpy.typing import NDArray
from rebuilt_maps import PhotoScene, align
from record import Problem, Row, parser, run, spread
from scipy.cluster.vq import kmeans2, vq
from view_problems import median_distance

from bpnp import SceneMap, Solution
from bpnp.arrays import Array
from bpnp.datamodules.colmap.model_files import read_records
from bpnp.maps.photos import detected_keypoints

CAMERA = (1379.7, 1382.1, 760.3, 503.4)  # of the photos at half size, pixels
FEATURES = 2048  # of a photo in the maps, the largest
VIEWS = 3
RIGHT_DEG = 1.0
RATIO = 0.8  # largest ratio of the distances to the nearest descriptor and to that of another point (Lowe 2004)
THRESHOLD_PX = 8.0  # of an inlier
LEAST_INLIERS = 12  # of a pose that counts as confident, the limit of hloc
AT_ONCE = 256  # descriptors of the photo in one product
WORDS, ROUNDS, EVERY = 512, 5, 4  # words of the vocabulary; rounds of k-means; it uses every fourth descriptor
RETRIEVED = 10  # views


class DescribedMap:
    """Descriptors of a model's observations, from the database that it was built from, and the visual words of its
    views: word centres, inverse document frequencies, and a unit vector of weighted words per view.
    """

    def __init__(self, model: Path, database: Path) -> None:
        records, self.features, self.views = read_records(model), features_of(database), {}
        self.points3d = np.full((records.point_ids.max() + 1, 3), np.nan)
        self.points3d[records.point_ids] = records.points3d
        for image in records.images:
            seen = image.point_ids >= 0
            self.views[image.name] = self.features[image.name][1][seen], image.point_ids[seen]
        described = [descriptors for descriptors, _ in self.views.values()]
        some = np.concatenate(described)[::EVERY].astype(np.float64)
        self.centres, _ = kmeans2(some, WORDS, iter=ROUNDS, minit="points", seed=0)
        counts = np.array([self.word_counts(descriptors) for descriptors in described])
        self.rarity = np.log(len(counts) / np.maximum((counts > 0).sum(0), 1))
        self.bags = counts * self.rarity / np.linalg.norm(counts * self.rarity, axis=1, keepdims=True)

    def word_counts(self, descriptors: NDArray[np.float32]) -> NDArray[np.int64]:
        return np.bincount(vq(descriptors, self.centres)[0], minlength=WORDS)

    def retrieve(self, photo: str) -> list[str]:
        """Return the views whose words are most similar to those of the photo."""
        likeness = self.bags @ (self.rarity * self.word_counts(self.features[photo][1]))
        return [list(self.views)[i] for i in np.argsort(-likeness, kind="stable")[:RETRIEVED]]

    def localize(self, photo: str, camera: tuple[float, ...], views: Iterable[str] | None) -> Any:
        """Return rotation, translation and verdict of a photo of the database, against the points of these views or of
        all.
        """
        pixels, own = self.features[photo]
        theirs, ids = zip(*(self.views[name] for name in views or self.views), strict=True)
        keypoints, points = descriptor_matches(own, np.concatenate(theirs), np.concatenate(ids))
        lens = {"model": "PINHOLE", "width": 0, "height": 0, "params": list(camera)}
        accepted = {"max_reproj_error": THRESHOLD_PX, "seed": 0}
        pose, stats = poselib.estimate_absolute_pose(pixels[keypoints], self.points3d[points], lens, accepted, {})
        verdict = "confident" if stats["num_inliers"] >= LEAST_INLIERS else "ambiguous"
        return SimpleNamespace(
            rotation=np.asarray(pose.R), translation=np.asarray(pose.t), verdict=verdict, reason="",
            focal_length=np.nan, focal_length_std=np.nan,
            covariance=np.full((6, 6), np.nan), matches=np.column_stack([keypoints, points]),
        )  # fmt: skip


def features_of(database: Path) -> dict[str, tuple[Array, NDArray[np.float32]]]:
    """Return the keypoints (m, 2), pixels, and the descriptors (m, 128), unit vectors, of each photo."""
    found = {}
    with pycolmap.Database.open(database) as content:
        for image in content.read_all_images():
            descriptors = content.read_descriptors(image.image_id).data.astype(np.float32)
            pixels = content.read_keypoints(image.image_id)[:, :2].astype(np.float64)
            found[image.name] = pixels, descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True)
    return found


def descriptor_matches(
    own: NDArray[np.float32], theirs: NDArray[np.float32], ids: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return indices in `own` and ids of points whose nearest descriptor passes the ratio test.

    own: (m, d), theirs: (n, d), unit vectors. ids: (n,) of the points that they describe, several for each.
    """
    order = np.argsort(ids, kind="stable")
    points, starts = np.unique(ids[order], return_index=True)
    sorted_theirs = np.ascontiguousarray(theirs[order].T)
    nearest, ratios = [], []
    for first in range(0, len(own), AT_ONCE):
        likeness = np.maximum.reduceat(own[first : first + AT_ONCE] @ sorted_theirs, starts, axis=1)
        two = np.sort(np.partition(likeness, -2, axis=1)[:, -2:], axis=1)
        squares = np.maximum(2 - 2 * two, 1e-12)
        nearest.append(likeness.argmax(1))
        ratios.append(np.sqrt(squares[:, 1] / squares[:, 0]))
    kept = np.flatnonzero(np.concatenate(ratios) < RATIO)
    return kept, points[np.concatenate(nearest)[kept]]


def problems_of(scene: PhotoScene, photo: str, full: SceneMap, seed: int, time_limit: float) -> dict[str, Problem]:
    """Return the problems of one photo that is removed from its map, by method."""
    model = scene.model(left_out=photo)
    place, found = SceneMap.from_colmap(model), detected_keypoints(scene.photos / photo)
    _ = place.cones, place.pictures  # once a map, like the descriptors of the other methods
    (true,) = full.named([photo])
    shared = np.array([np.isin(view.points, true.points).sum() for view in full.views])
    likely = [full.views[i].name for i in np.argsort(-shared, kind="stable")]
    views = [name for name in likely if name != photo and name in place.view_numbers][:VIEWS]
    far = median_distance(full.points3d[true.points], (true.rotation, true.translation))
    alignment = align(full, place)
    described = DescribedMap(model, scene.database)
    arguments: dict[str, Any] = {"scores": found.scores, "seed": seed, "time_limit": time_limit}
    searches: dict[str, Callable[[], Solution]] = {}
    for method, named in (("views", views), ("map", None)):
        searches[method] = partial(place.localize, found.pixels, ("PINHOLE", CAMERA), views=named, **arguments)
        searches[f"{method}-sift"] = partial(described.localize, photo, CAMERA, named)
    searches["words-sift"] = lambda: described.localize(photo, CAMERA, described.retrieve(photo))
    name, pose = f"{scene.photos.name}/{photo}", alignment.pose(true.rotation, true.translation)
    return {
        method: Problem(name, search, [pose], distance=far * alignment.scale) for method, search in searches.items()
    }


def rows(options: argparse.Namespace) -> Iterator[Row]:
    for name in options.scenes:
        kept = options.maps / f"{name}-{FEATURES}"
        scene = PhotoScene(options.data / "photos" / name, kept, CAMERA, FEATURES)
        full = SceneMap.from_colmap(scene.model())
        chosen = spread([photo for photo in scene.names() if photo in full.view_numbers], options.limit)
        drawn = [problems_of(scene, photo, full, options.seed, options.time_limit) for photo in chosen]
        for method in drawn[0]:
            yield Row(f"{name}, {method}", partial(list, [one[method] for one in drawn]), RIGHT_DEG)


def main() -> None:
    options = parser(__doc__)
    options.add_argument("scenes", nargs="+", metavar="SCENE")
    options.add_argument("--maps", type=Path, default=Path("runs/left-out"), help="folder of the maps that are built")
    chosen = options.parse_args()
    run(rows(chosen), chosen)
