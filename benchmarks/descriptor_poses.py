"""The yardstick of localisation with descriptors: nearest SIFT descriptors, ratio test, RANSAC of PoseLib; and the
views by a bag of visual words (Sivic and Zisserman, ICCV 2003)."""

from collections.abc import Iterable
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import poselib
import pycolmap
from numpy.typing import NDArray
from record import Array
from scipy.cluster.vq import kmeans2, vq

from bpnp.datamodules.colmap.model_files import read_records

RATIO = 0.8  # largest ratio of the distances to the nearest descriptor and to that of another point (Lowe 2004)
THRESHOLD_PX = 8.0  # of an inlier
LEAST_INLIERS = 12  # of a pose that counts as confident, the limit of hloc
WORDS, ROUNDS, EVERY = 512, 5, 4  # of the vocabulary; rounds of k-means; one descriptor of so many makes it
RETRIEVED = 10  # views
AT_ONCE = 256  # descriptors of the photo in one product


class DescribedMap:
    """The descriptors of a model's observations, from the database that the model was built from."""

    def __init__(self, model: Path, database: Path) -> None:
        records = read_records(model)
        self._points3d = dict(zip(records.point_ids.tolist(), records.points3d, strict=True))
        self._database = database
        self._views = {}
        for image in records.images:
            _, descriptors = self._features(image.name)
            seen = image.point_ids >= 0
            self._views[image.name] = descriptors[seen], image.point_ids[seen]

    @cached_property
    def words(self) -> tuple[Array, Array, Array]:
        """Centres of the words (w, 128), the rarity of each, and of each view its words by rarity, a unit vector."""
        rows = np.concatenate([descriptors for descriptors, _ in self._views.values()])[::EVERY].astype(np.float64)
        centres, _ = kmeans2(rows, min(WORDS, len(rows)), iter=ROUNDS, minit="points", seed=0)
        counts = np.array([word_counts(descriptors, centres) for descriptors, _ in self._views.values()])
        rarity = np.log(len(counts) / np.maximum((counts > 0).sum(0), 1))
        return centres, rarity, counts * rarity / np.linalg.norm(counts * rarity, axis=1, keepdims=True)

    def retrieved(self, photo: str) -> list[str]:
        """The views whose words are most like those of the photo."""
        centres, rarity, bags = self.words
        likeness = bags @ (rarity * word_counts(self._features(photo)[1], centres))
        return [list(self._views)[i] for i in np.argsort(-likeness, kind="stable")[:RETRIEVED]]

    def localize(self, photo: str, camera: tuple[float, ...], views: Iterable[str] | None) -> Any:
        """Rotation, translation and verdict of a photo of the database, against the points of these views or of all."""
        pixels, own = self._features(photo)
        theirs, ids = zip(*(self._views[name] for name in views or self._views), strict=True)
        keypoints, points = descriptor_matches(own, np.concatenate(theirs), np.concatenate(ids))
        lens = {"model": "PINHOLE", "width": 0, "height": 0, "params": list(camera)}
        pose, stats = poselib.estimate_absolute_pose(
            pixels[keypoints], np.array([self._points3d[point] for point in points.tolist()]), lens,
            {"max_reproj_error": THRESHOLD_PX, "seed": 0}, {},
        )  # fmt: skip
        verdict = "confident" if stats["num_inliers"] >= LEAST_INLIERS else "ambiguous"
        return SimpleNamespace(
            rotation=np.asarray(pose.R), translation=np.asarray(pose.t), verdict=verdict,
            covariance=np.full((6, 6), np.nan), focal_length=np.nan,
        )  # fmt: skip

    def _features(self, photo: str) -> tuple[Array, NDArray[np.float32]]:
        """Keypoints (m, 2), pixels, and descriptors (m, 128) of unit length."""
        with pycolmap.Database.open(self._database) as content:
            (number,) = (image.image_id for image in content.read_all_images() if image.name == photo)
            descriptors = content.read_descriptors(number).data.astype(np.float32)
            pixels = content.read_keypoints(number)[:, :2].astype(np.float64)
        return pixels, descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True)


def word_counts(descriptors: NDArray[np.float32], centres: Array) -> NDArray[np.int64]:
    return np.bincount(vq(descriptors, centres)[0], minlength=len(centres))


def descriptor_matches(
    own: NDArray[np.float32], theirs: NDArray[np.float32], ids: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Places in `own` and ids of points, where the nearest descriptor passes the ratio test.

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
