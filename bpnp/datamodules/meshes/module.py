"""Meshes seen by virtual cameras: ModelNet40, any folder in its layout, or procedural shapes."""

from pathlib import Path
from typing import Any, Literal

import numpy as np
from lightning import LightningDataModule
from numpy.typing import NDArray
from torch.utils.data import DataLoader

from bpnp.datamodules.loader import STAGES, PairDataset, PairSource, pair_loader
from bpnp.datamodules.manifest import StoreError, is_store
from bpnp.datamodules.meshes.device_views import DeviceViews, KeyDataset, ViewKeys
from bpnp.datamodules.meshes.folder import folder_pools
from bpnp.datamodules.meshes.pools import SurfacePools
from bpnp.datamodules.meshes.procedural import SPLITS, procedural_pools
from bpnp.datamodules.meshes.source import MeshSource, hold_out
from bpnp.datamodules.meshes.surface_store import open_surfaces
from bpnp.datamodules.meshes.surfaces import Normalisation
from bpnp.datamodules.meshes.views import Views
from bpnp.datamodules.outliers import Outliers, harder
from bpnp.geometry import MIN_POINTS
from bpnp.types import Batch


class MeshDataModule(LightningDataModule):
    """Virtual cameras around meshes, by default as in Campbell et al. (ECCV 2020), or around procedural shapes.

    Every pair is a subset of a mesh's cached surface samples, seen by a random camera. Validation meshes are held out
    of the training split; test meshes serve testing and prediction only. Works without a Trainer: `setup()`, then the
    loaders.

    Args:
        root: folder that `bpnp prepare modelnet40` made, or folder of meshes in ModelNet40's layout,
            <class>/{train,test}/*.{glb,obj,off,ply,stl}; none for procedural shapes.
        train_pairs: training pairs; pair i shows training mesh i modulo their number.
        fresh_views: draw new cameras, points and noise every epoch; false for the fixed pairs of the paper.
        views_on_device: let a Trainer make the fresh training views in batches on its device; none for wherever that is
            not a CPU and every pair gets as many outliers. They have the distribution of the views that the loader
            draws, but are others.
        val_fraction: share of the training meshes that is held out for validation.
        val_pairs: validation pairs, fixed; none for one per held-out mesh.
        test_pairs: test pairs, fixed; none for one per test mesh. Fewer are a random choice of meshes, more are
            further views.
        num_points: 3D points of a pair.
        pool_size: surface samples kept of each mesh, at least num_points; every pair draws its own num_points of them
            (pool_size equal to num_points: all pairs of a mesh have the same points, as in the paper).
        normalisation: of each mesh. unit_sphere: mean of its surface samples at the origin, farthest at distance 1;
            unit_cube: bounding box centred, longest side 1; none: units of the file.
        rotation: euler for R = Rz Ry Rx with angles from euler_range, so3 for uniform rotations.
        euler_range: lowest and highest Euler angle, degrees.
        translation_range: each coordinate of the translation is uniform within plus and minus this, scene units.
        distance: added to the translation along the optical axis, scene units.
        focal: focal length, pixels.
        noise_px: standard deviation of the noise on 2D points, pixels.
        train_outliers: outliers and occlusion in training and validation; none for none.
        test_outliers: the same in testing and prediction.
        train_shapes: procedural training shapes; like val_shapes and test_shapes only used without root.
        val_shapes: procedural validation shapes; with root val_fraction counts.
        test_shapes: procedural test shapes.
        batch_size: training pairs per step, over all processes.
        eval_batch_size: pairs per step in validation, testing and prediction; none for batch_size.
        num_workers: loader processes.
        seed: of shapes, held-out meshes, cameras and order.
        cache_dir: where the surface samples are kept.
    """

    def __init__(
        self,
        root: str | None = None,
        *,
        train_pairs: int = 40_000,
        fresh_views: bool = False,
        views_on_device: bool | None = None,
        val_fraction: float = 0.05,
        val_pairs: int | None = None,
        test_pairs: int | None = None,
        num_points: int = 1000,
        pool_size: int = 2048,
        normalisation: Normalisation = "unit_sphere",
        rotation: Literal["euler", "so3"] = "euler",
        euler_range: tuple[float, float] = (0.0, 45.0),
        translation_range: float = 0.5,
        distance: float = 4.5,
        focal: float = 800.0,
        noise_px: float = 2.0,
        train_outliers: Outliers | None = None,
        test_outliers: Outliers | None = None,
        train_shapes: int = 1000,
        val_shapes: int = 100,
        test_shapes: int = 200,
        batch_size: int = 16,
        eval_batch_size: int | None = None,
        num_workers: int = 0,
        seed: int = 0,
        cache_dir: str = ".cache/bpnp",
    ) -> None:
        super().__init__()
        if not MIN_POINTS <= num_points <= pool_size:
            raise ValueError(
                f"expected `num_points` from {MIN_POINTS} to `pool_size`, got {num_points} and {pool_size}; "
                "try a larger `pool_size`"
            )
        self.root, self.cache_dir = None if root is None else Path(root), Path(cache_dir)
        self.num_pairs = {"train": train_pairs, "val": val_pairs, "test": test_pairs}
        self.num_shapes = {"train": train_shapes, "val": val_shapes, "test": test_shapes}
        self.views = Views(rotation, euler_range, translation_range, distance, focal, noise_px)
        self.num_points, self.pool_size, self.normalisation = num_points, pool_size, normalisation
        self.outliers = {"train": train_outliers, "val": train_outliers, "test": test_outliers}
        self.fresh_views, self.val_fraction, self.seed = fresh_views, val_fraction, seed
        self.views_on_device = views_on_device
        self.batch_size = batch_size
        self.eval_batch_size = batch_size if eval_batch_size is None else eval_batch_size
        self.num_workers = num_workers
        self.sources: dict[str, PairSource] = {}
        self._viewed: MeshSource | None = None
        self._device_views: DeviceViews | None = None

    def prepare_data(self) -> None:
        """Build the caches in one process, for `setup` to open in all."""
        self._open(None if self.trainer is None or self.trainer.state.fn is None else self.trainer.state.fn.value)

    def setup(self, stage: str | None = None) -> None:
        """Open the meshes of a stage (fit, validate, test, predict; none for all). Raises ValueError for bad data."""
        self.sources |= self._open(stage)

    def train_dataloader(self) -> DataLoader[Batch]:
        dataset = KeyDataset(self._viewed) if self._viewed and self._makes_views() else None
        return self._loader("train", batch_size=self.batch_size, dataset=dataset)

    def val_dataloader(self) -> DataLoader[Batch]:
        return self._loader("val", batch_size=self.eval_batch_size)

    def test_dataloader(self) -> DataLoader[Batch]:
        return self._loader("test", batch_size=self.eval_batch_size)

    def predict_dataloader(self) -> DataLoader[Batch]:
        return self.test_dataloader()

    def on_after_batch_transfer(self, batch: Any, dataloader_idx: int) -> Any:
        """The views of a batch of keys; other batches as they are."""
        if not isinstance(batch, ViewKeys) or self._viewed is None:
            return batch
        if self._device_views is None or self._device_views.samples.device != batch.row.device:
            self._device_views = DeviceViews(self._viewed, self.outliers["train"], device=batch.row.device)
        return self._device_views.batch(batch)

    def teardown(self, stage: str) -> None:
        """Free the samples on the device."""
        self._device_views = None

    def _makes_views(self) -> bool:
        """Whether the Trainer, which hands each batch to `on_after_batch_transfer`, is to make the fresh views."""
        if self.trainer is None or self._viewed is None:
            return False
        if self.views_on_device is not None:
            return self.views_on_device
        # A batch made at once has no room for points that a camera misses, or for pairs of different sizes.
        whole = self._viewed.views.sees_all(self._viewed.pools.radius)
        whole &= self.outliers["train"] is None or self.outliers["train"].fixed is not None
        return whole and self.trainer.strategy.root_device.type != "cpu"

    def _loader(
        self, split: str, *, batch_size: int, dataset: PairDataset | None = None
    ) -> DataLoader[Batch]:  # fmt: skip
        if split not in self.sources:
            raise ValueError(f"expected `setup` before the {split} loader, got no call; try `setup()`")
        return pair_loader(
            self.sources[split] if dataset is None else dataset,
            batch_size=batch_size,
            shuffle=split == "train",
            seed=self.seed,
            num_workers=self.num_workers,
        )

    def _open(self, stage: str | None) -> dict[str, PairSource]:
        return {split: self._source(split) for split in (SPLITS if stage is None else STAGES[stage])}

    def _source(self, split: str) -> PairSource:
        pools, rows = self._meshes(split)
        fresh = self.fresh_views and split == "train"
        source = MeshSource(
            pools,
            rows,
            num_pairs=len(rows) if (pairs := self.num_pairs[split]) is None else pairs,
            num_points=self.num_points,
            views=self.views,
            seed=self.seed,
            split=split,
            fresh_views=fresh,
        )
        self._viewed = source if fresh else self._viewed
        return harder(source, self.outliers[split], seed=self.seed, fresh=fresh)

    def _meshes(self, split: str) -> tuple[SurfacePools, NDArray[np.int64]]:
        """Surface samples, and which of their rows belong to a split."""
        if self.root is None:
            pools = procedural_pools(
                split,
                self.num_shapes[split],
                seed=self.seed,
                pool_size=self.pool_size,
                normalisation=self.normalisation,
                cache_dir=self.cache_dir,
            )
            return pools, np.arange(len(pools))
        pools = self._pools(self.root, "test" if split == "test" else "train")
        if split == "test":
            return pools, np.arange(len(pools))
        training, held_out = hold_out(len(pools), self.val_fraction, seed=self.seed)
        return pools, training if split == "train" else held_out

    def _pools(self, root: Path, split: str) -> SurfacePools:
        if not is_store(root):
            return folder_pools(
                root, split, pool_size=self.pool_size, normalisation=self.normalisation, cache_dir=self.cache_dir
            )
        store = open_surfaces(root)
        if (kept := store.parameters["normalisation"]) != self.normalisation:
            raise StoreError(
                f"expected meshes of `normalisation` {self.normalisation}, got {kept} in {root}; try {kept}, or "
                f"preparing again with --normalisation {self.normalisation}"
            )
        return store.pools(split, pool_size=self.pool_size)
