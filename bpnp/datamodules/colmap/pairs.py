"""The pairs of point sets that the images of COLMAP models give."""

import logging
from collections.abc import Sequence

import numpy as np
from jaxtyping import Int
from numpy.typing import NDArray
from torch import Tensor

from bpnp.datamodules.augment import check_clutter
from bpnp.datamodules.colmap.reconstruction import ImagePoints, Reconstruction
from bpnp.datamodules.pair import Counts, Pair, stacked
from bpnp.datamodules.stored_pairs import enough_pairs
from bpnp.types import Batch

FAR = 100.0  # median distances of the points from their median; further off float32 steps by 1e-5 of that distance
logger = logging.getLogger(__name__)


class ColmapSource:
    """A `PairSource`: the keypoints of each image with a 3D point, those points, and points without a partner.

    reconstructions: the models, see `read_reconstruction`.
    min_points: an image with fewer true pairs is skipped, with a warning.
    clutter: points without a partner, as a ratio to the true pairs, or as many as there are: keypoints without a 3D
        point, and points of the scene that the image does not see; drawn uniformly, by (seed, epoch, index).

    Units are the scene's. An image whose points lie more than 100 times their extent from the origin (in a geo-
    referenced scene, say) gets their median as its origin, for float32 has 7 digits; how many did is logged as a
    warning.
    """

    def __init__(
        self,
        reconstructions: Sequence[Reconstruction],
        *,
        min_points: int = 4,
        clutter: float = 0.0,
        seed: Sequence[int] = (0,),
    ) -> None:
        check_clutter(clutter)
        images = [(scene, image) for scene in reconstructions for image in scene.images]
        names = ", ".join(scene.name for scene in reconstructions)
        kept = enough_pairs(np.array([len(image.seen) for _, image in images]), min_points, names)
        self.images = [images[i] for i in kept]
        self.clutter, self.seed = clutter, tuple(seed)
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
    def counts(self) -> Counts:
        matched = np.array([len(image.seen) for _, image in self.images])
        free = np.array([self._free(scene, image) for scene, image in self.images])
        return Counts(matched, matched + free[:, 0], matched + free[:, 1])

    def names(self, index: Sequence[int]) -> tuple[str, ...]:
        return tuple(f"{scene.name}/{image.name}" for scene, image in (self.images[i] for i in index))

    def batch(self, index: Int[Tensor, " b"], epoch: int) -> Batch:
        return stacked([self.pair(i, epoch) for i in index.tolist()], index)

    def pair(self, index: int, epoch: int = 0) -> Pair:
        """The points of image `index`."""
        scene, image = self.images[index]
        rng = np.random.default_rng([*self.seed, epoch, index])
        free2d, free3d = self._free(scene, image)
        clutter2d = image.clutter2d[rng.choice(len(image.clutter2d), free2d, replace=False)]
        unseen = np.delete(np.arange(len(scene.points3d)), image.observed) if free3d else image.seen[:0]
        chosen = np.concatenate([image.seen, rng.choice(unseen, free3d, replace=False)])
        origin = self.origins[index]
        return Pair(
            name=f"{scene.name}/{image.name}",
            points2d=np.concatenate([image.points2d, clutter2d]),
            points3d=(scene.points3d[chosen] - origin).astype(np.float32),
            matched=len(image.seen),
            rotation=image.rotation,
            translation=image.translation + image.rotation @ origin,
            focal=image.camera.focal,
            origin=origin,
        )

    def _free(self, scene: Reconstruction, image: ImagePoints) -> tuple[int, int]:
        """Points without a partner on the 2D side, and on the 3D side."""
        wanted = self.clutter * len(image.seen)
        free3d = len(scene.points3d) - len(image.observed)
        return round(min(wanted, len(image.clutter2d))), round(min(wanted, free3d))


def _origin(points3d: NDArray[np.float64]) -> NDArray[np.float64]:
    """The median of the points if they are far from the origin, else the origin."""
    median = np.median(points3d, axis=0)
    extent = np.median(np.linalg.norm(points3d - median, axis=-1))
    return median if np.linalg.norm(median) > FAR * extent else np.zeros(3)
