"""The pairs of point sets that the images of COLMAP models give."""

import logging
import warnings
from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bpnp.datamodules.colmap.model_files import ColmapError
from bpnp.datamodules.colmap.reconstruction import ImagePoints, Reconstruction
from bpnp.datamodules.loader import Pair

Side = Literal["both", "2d", "3d"]
FAR = 100.0  # median distances of the points from their median; further off float32 steps by 1e-5 of that distance
logger = logging.getLogger(__name__)


class ColmapSource:
    """One pair for each image: its keypoints with a 3D point, those points, and clutter, each side in random order.

    reconstructions: the models, see `read_reconstruction`.
    min_points: an image with fewer true pairs is skipped; how many were is warned about and kept in `skipped`.
    max_points: at most this many true pairs of an image, drawn without replacement; None for all.
    clutter: natural clutter to add, as a ratio to the true pairs: keypoints without a 3D point (2D side) and points of
        the scene that the image does not see, uniformly drawn (3D side), as many as there are.
    clutter_side: which sides get it, "both", "2d" or "3d".
    rotate: turn the scene by a uniformly random rotation, so that its upright axis tells nothing.
    fresh: draw anew in every epoch, else the same each time.
    seed: a pair is a function of (seed, epoch, index).

    Units are the scene's. An image whose points lie more than 100 times their extent from the origin (in a geo-
    referenced scene, say) gets their median as its origin, for float32 has 7 digits; how many did is logged as a
    warning, and `frame` gives the origin.

    Raises ValueError for an option out of range, ColmapError if no image is left.
    """

    def __init__(
        self,
        reconstructions: Sequence[Reconstruction],
        *,
        min_points: int = 4,
        max_points: int | None = None,
        clutter: float = 0.0,
        clutter_side: Side = "both",
        rotate: bool = False,
        fresh: bool = False,
        seed: int = 0,
    ) -> None:
        if min_points < 4:
            raise ValueError(f"expected `min_points` of 4 or more, got {min_points}: fewer do not fix a pose")
        if max_points is not None and max_points < min_points:
            raise ValueError(f"expected `max_points` of at least `min_points` = {min_points}, got {max_points}")
        if not 0 <= clutter < np.inf:
            raise ValueError(f"expected `clutter` of 0 or more, got {clutter}; 0.5 adds half as many points")
        if clutter_side not in ("both", "2d", "3d"):
            raise ValueError(f'expected `clutter_side` "both", "2d" or "3d", got {clutter_side!r}')
        images = [(scene, image) for scene in reconstructions for image in scene.images]
        self.images = [(scene, image) for scene, image in images if len(image.seen) >= min_points]
        self.skipped = len(images) - len(self.images)
        names = ", ".join(scene.name for scene in reconstructions)
        if not self.images:
            raise ColmapError(
                f"expected images with {min_points} points or more in {names or 'the scenes'}, got none of "
                f"{len(images)}; try a smaller `min_points` or other scenes"
            )
        if self.skipped:
            warnings.warn(
                f"skipped {self.skipped} of {len(images)} images of {names}: fewer than {min_points} points",
                stacklevel=2,
            )
        self.max_points = max_points
        self.clutter2d = clutter * (clutter_side != "3d")
        self.clutter3d = clutter * (clutter_side != "2d")
        self.rotate, self.fresh, self.seed = rotate, fresh, seed
        self.origins = [_origin(scene.points3d[image.seen]) for scene, image in self.images]
        if moved := sum(bool(origin.any()) for origin in self.origins):
            logger.warning(
                "%d of %d images of %s see points that are far from the origin for float32: points and poses of these "
                "pairs are relative to the median of the points",
                moved,
                len(self.images),
                names,
            )

    @property
    def sizes(self) -> NDArray[np.int64]:
        """Points of the larger side of each pair."""
        return np.array([max(sum(side) for side in self._counts(*item)) for item in self.images])

    def frame(self, index: int, epoch: int = 0) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(turn (3, 3), origin (3,)): a point p of the scene is turn (p - origin) in the pair.

        So a pose (R, t) found for the pair is (R turn, t - R turn origin) in the scene.
        """
        turn = Rotation.from_quat(self._rng(index, epoch, 0).normal(size=4)).as_matrix() if self.rotate else np.eye(3)
        return turn, self.origins[index]

    def pair(self, index: int, epoch: int) -> Pair:
        """The points of image `index`, each side in its own random order."""
        scene, image = self.images[index]
        rng = self._rng(index, epoch, 1)
        (kept, extra2d), (_, extra3d) = self._counts(scene, image)
        true = rng.choice(len(image.seen), kept, replace=False)
        extra = rng.choice(len(image.clutter2d), extra2d, replace=False)
        points2d = np.concatenate([image.points2d[true], image.clutter2d[extra]])
        order2d = rng.permutation(len(points2d))

        unseen = rng.choice(_unseen(scene, image), extra3d, replace=False) if extra3d else np.empty(0, np.int64)
        points3d = scene.points3d[np.concatenate([image.seen[true], unseen])]
        order3d = rng.permutation(len(points3d))
        match3d = np.full(len(points3d), -1)
        match3d[:kept] = np.argsort(order2d)[:kept]

        turn, origin = self.frame(index, epoch)
        return Pair(
            name=f"{scene.name}/{image.name}",
            points2d=points2d[order2d],
            points3d=((points3d[order3d] - origin) @ turn.T).astype(np.float32),
            rotation=image.rotation @ turn.T,
            translation=image.translation + image.rotation @ origin,
            match3d=match3d[order3d],
            focal=image.focal,
            origin=turn @ origin,
        )

    def _rng(self, index: int, epoch: int, stream: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, epoch if self.fresh else 0, index, stream])

    def _counts(self, scene: Reconstruction, image: ImagePoints) -> tuple[tuple[int, int], tuple[int, int]]:
        """True pairs and clutter of the 2D side, and of the 3D side."""
        kept = len(image.seen) if self.max_points is None else min(len(image.seen), self.max_points)
        extra2d = min(round(self.clutter2d * kept), len(image.clutter2d))
        extra3d = min(round(self.clutter3d * kept), len(scene.points3d) - len(image.observed))
        return (kept, extra2d), (kept, extra3d)


def _unseen(scene: Reconstruction, image: ImagePoints) -> NDArray[np.int64]:
    mask = np.ones(len(scene.points3d), dtype=bool)
    mask[image.observed] = False
    return np.flatnonzero(mask)


def _origin(points3d: NDArray[np.float64]) -> NDArray[np.float64]:
    """The median of the points if they are far from the origin, else the origin."""
    median = np.median(points3d, axis=0)
    extent = np.median(np.linalg.norm(points3d - median, axis=-1))
    return median if np.linalg.norm(median) > FAR * extent else np.zeros(3)
