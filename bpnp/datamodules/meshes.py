"""Shapes seen by virtual cameras: ModelNet40, any meshes or point clouds in its layout, or procedural shapes."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import roma
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from bpnp.checks import check_positive, check_within
from bpnp.datamodules.augment import gather_points
from bpnp.datamodules.clouds import open_shapes
from bpnp.datamodules.keyed_random import (
    Generators,
    Purpose,
    generators,
    normal,
    permutations,
    rotations,
    row_keys,
    uniform,
)
from bpnp.datamodules.loader import STAGES, ProblemDataModule, hold_out
from bpnp.datamodules.problem import Counts
from bpnp.datamodules.shapes import (
    NAMES,
    MeshError,
    Normalisation,
    ProceduralKind,
    Sampler,
    Shapes,
    normalise,
    procedural_shapes,
)
from bpnp.datamodules.store import JobResult, Recipe, Store, StoreError, StoreRow, is_store, open_or_prepare, open_store
from bpnp.geometry import project, transform
from bpnp.poses import MIN_POINTS
from bpnp.types import Batch

POINTS = "points"  # bulk column of a store of surface samples
SURFACES = "surfaces"  # kind of such a store
MESHES_A_PART = 64  # meshes sampled in one job
MIN_DEPTH = 0.1  # least depth of a visible point, scene units


@dataclass(frozen=True)
class RandomCameras:
    """Distribution of the cameras of `MeshDataModule`; an option out of range is a ValueError.

    The translation is t = (x, y, distance + z), each of x, y, z uniform in +-translation_range. The defaults are those
    of Campbell et al. (ECCV 2020) for ModelNet40. As in the paper, points beyond the border of the 640 x 480 image are
    kept.
    """

    # "euler" for R = Rz Ry Rx with angles uniform in euler_range, "so3" for uniform rotations.
    rotation: Literal["euler", "so3"] = "euler"
    euler_range: tuple[float, float] = (0.0, 45.0)  # smallest and largest Euler angle, degrees
    translation_range: float = 0.5  # half width of the uniform distribution of each coordinate, scene units
    distance: float = 4.5  # added to the translation along the optical axis, scene units
    focal: float = 800.0  # focal length, pixels
    noise_px: float = 2.0  # standard deviation of the noise of 2D points, pixels

    def __post_init__(self) -> None:
        if self.rotation not in ("euler", "so3"):
            raise ValueError(f"`rotation` is {self.rotation!r}; it is euler or so3")
        check_within(-math.inf, math.inf, euler_range=self.euler_range)
        lengths = {name: getattr(self, name) for name in ("translation_range", "distance", "noise_px", "focal")}
        check_within(0, math.inf, **lengths)
        check_positive(focal=self.focal)

    def poses(self, random: Generators) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3"]]:
        """Draw a pose camera = R p + t, float64, from each generator."""
        numbers = uniform(random, 6)
        if self.rotation == "so3":
            rotation = rotations(random)
        else:
            low, high = (math.radians(angle) for angle in self.euler_range)
            rotation = roma.euler_to_rotmat("xyz", low + (high - low) * numbers[:, :3])
        offset = self.translation_range * (2 * numbers[:, 3:] - 1)
        offset[:, 2] += self.distance
        return rotation, offset


class MeshSource:
    """Source of problems: problem i is view i // k of mesh rows[i % k] of a store of surface samples, with k meshes.

    Fewer problems than meshes use a random choice of the meshes; `count` is None for one per mesh. A problem draws its
    points from the first `pool_size` samples of its mesh. It is a function of (seed, epoch, index). A warning is issued
    if some points may lie behind a camera. `label` is the name of the split, for messages.
    """

    def __init__(
        self,
        store: Store,
        rows: NDArray[np.int64],
        *,
        count: int | None,
        num_points: int,
        pool_size: int,
        cameras: RandomCameras,
        seed: Sequence[int],
        label: str,
    ) -> None:
        check_within(1, math.inf, **{f"{label}_problems": 1 if count is None else count})
        radius = float(store.columns["radius"][rows].max())
        self.sees_all = cameras.distance - cameras.translation_range - radius > MIN_DEPTH
        if not self.sees_all:
            warnings.warn(
                f"the {label} meshes extend {radius:.3g} from their origin; points behind a camera at `distance` "
                f"{cameras.distance} get no 2D point. Use normalisation unit_sphere or a larger distance",
                stacklevel=2,
            )
        self.count = len(rows) if count is None else count
        if self.count < len(rows):  # a random choice, because the first meshes are all of one class
            rows = np.sort(np.random.default_rng(seed[0]).choice(rows, self.count, replace=False))
        self.store, self.rows, self.num_points, self.pool_size = store, rows, num_points, pool_size
        self.cameras, self.seed = cameras, tuple(seed)

    @property
    def counts(self) -> Counts:
        """Numbers of points of each problem."""
        points = np.full(self.count, self.num_points)
        return Counts(points, points, points)

    def batch(self, index: Int[Tensor, " b"], epoch: int) -> Batch:
        """Return random camera views of `num_points` samples of each mesh, drawn without replacement.

        2D points are x/z and y/z plus noise, computed in float64. A point with a depth below 0.1 has no 2D point and -1
        in match3d. All other points have one, on the far side of the mesh too. Raise ValueError if a problem has fewer
        than 4 points in front of its camera.
        """
        count, size = self.num_points, len(index)
        keys = row_keys(index, *self.seed, epoch)
        views = [divmod(i, len(self.rows)) for i in index.tolist()]
        rows = [int(self.rows[mesh]) for _, mesh in views]
        ids = tuple(f"{self.store.name(row)}#{view}" for row, (view, _) in zip(rows, views, strict=True))
        points3d = self._draw_points(rows, generators(keys, Purpose.SUBSET))
        rotation, translation = self.cameras.poses(generators(keys, Purpose.POSE))
        camera = transform(rotation, translation, points3d.double())
        visible = camera[..., 2] > MIN_DEPTH
        if not self.sees_all and bool((few := visible.sum(-1) < MIN_POINTS).any()):
            first = int(few.nonzero()[0, 0])
            raise ValueError(
                f"{ids[first]} has {int(visible[first].sum())} points in front of the camera; at least {MIN_POINTS} "
                "are needed: use normalisation unit_sphere, or a larger `distance`"
            )
        noise = normal(generators(keys, Purpose.NOISE), 2 * count).view(size, count, 2)
        points2d = project(camera) + noise * (self.cameras.noise_px / self.cameras.focal)
        return Batch(
            points2d=(points2d.where(visible[..., None], 0.0)).float(),
            points3d=points3d,
            mask2d=visible,
            mask3d=torch.ones_like(visible),
            focal=torch.full((size,), self.cameras.focal),
            index=index,
            ids=ids,
            rotation=rotation,
            translation=translation,
            match3d=torch.arange(count).where(visible, -1),
            origin=torch.zeros(size, 3, dtype=torch.float64),
        )

    def _draw_points(self, rows: Sequence[int], random: Generators) -> Float[Tensor, "b n 3"]:
        """Draw `num_points` of the first `pool_size` points of each shape, whose numbers of points may differ."""
        pools = [self.store.row(row)[POINTS][: self.pool_size] for row in rows]
        points = torch.empty((len(rows), self.num_points, 3), dtype=torch.float32)
        sizes = np.array([len(pool) for pool in pools])
        for size in np.unique(sizes).tolist():
            same = np.flatnonzero(sizes == size).tolist()
            order = permutations([random[i] for i in same], size)[:, : self.num_points]
            points[same] = gather_points(torch.from_numpy(np.stack([pools[i] for i in same])), order)
        return points


class MeshDataModule(ProblemDataModule):
    """Virtual cameras around meshes, by default as in Campbell et al. (ECCV 2020), or around procedural shapes.

    Every problem is a subset of a mesh's surface samples, seen by a random camera. Self-occlusion is not simulated: the
    camera sees points on the far side of the mesh too. Validation meshes are held out of the training split; test
    meshes serve testing and prediction only. Works without a Trainer: `setup()`, then the loaders.

    Args:
        root: Folder that `bpnp prepare modelnet40` made, or folder of meshes or point clouds in ModelNet40's layout,
            <class>/{train,test}/*.{glb,obj,off,ply,stl,npy,txt,xyz}, or ModelNet40's HDF5 or `normal_resampled`
            archive, unpacked; None for procedural shapes.
        train_problems: Number of training problems; problem i shows training mesh i modulo the number of meshes.
        fresh_views: Draw new cameras, points and noise every epoch. Default False, the fixed problems of the paper.
        val_fraction: Fraction of the training meshes held out for validation.
        val_problems: Number of validation problems, fixed; None for one per held-out mesh.
        test_problems: Number of test problems, fixed; None for one per test mesh. Fewer use a random choice of meshes,
            more are further views.
        num_points: Number of 3D points of a problem.
        pool_size: Number of surface samples kept of each mesh, at least num_points. Every problem draws its own
            num_points of them. With pool_size equal to num_points all problems of a mesh have the same points, as in
            the paper. A point cloud with fewer points is used whole.
        normalisation: Frame of each mesh. "unit_sphere", the default: the mean of its surface samples is the origin,
            the farthest one at distance 1. "unit_cube": the bounding box is centred, its longest side is 1. "none": the
            units of the file.
        rotation: "euler" for R = Rz Ry Rx with angles uniform in euler_range, "so3" for uniform rotations.
        euler_range: Smallest and largest Euler angle, degrees.
        translation_range: Half width of the uniform distribution of each coordinate of the translation, scene units.
        distance: Added to the translation along the optical axis, scene units.
        focal: Focal length, pixels.
        noise_px: Standard deviation of the noise of 2D points, pixels.
        train_shapes: Number of procedural training shapes; used without root only, as are val_shapes and test_shapes.
        val_shapes: Number of procedural validation shapes; with root, val_fraction is used.
        test_shapes: Number of procedural test shapes.
        procedural_kind: "turned" for shapes of turned parts, which have no axes; "aligned" for shapes of parts
            parallel to the axes, most of them with a plane of symmetry, as furniture.
        cache_dir: Folder for the surface samples; None for BPNP_CACHE, else the user's cache folder.
        **loading: Options of `ProblemDataModule`: train_outliers, test_outliers, batch_size, eval_batch_size,
            max_cells, num_workers and seed.

    Raises:
        ValueError: An option is out of range. A folder without usable meshes raises in `setup`.
    """

    def __init__(
        self,
        root: str | None = None,
        *,
        train_problems: int = 40_000,
        fresh_views: bool = False,
        val_fraction: float = 0.05,
        val_problems: int | None = None,
        test_problems: int | None = None,
        num_points: int = 1000,
        pool_size: int = 2048,
        normalisation: Normalisation = "unit_sphere",
        rotation: Literal["euler", "so3"] = "euler",
        euler_range: tuple[float, float] = (0.0, 45.0),
        translation_range: float = 0.5,
        distance: float = 4.5,
        focal: float = 800.0,
        noise_px: float = 2.0,
        train_shapes: int = 1000,
        val_shapes: int = 100,
        test_shapes: int = 200,
        procedural_kind: ProceduralKind = "turned",
        cache_dir: str | None = None,
        **loading: Any,
    ) -> None:
        super().__init__(**loading)
        if not MIN_POINTS <= num_points <= pool_size:
            raise ValueError(
                f"`num_points` is {num_points} and `pool_size` is {pool_size}; `num_points` goes from {MIN_POINTS} to "
                "`pool_size`"
            )
        self.root, self.cache_dir = None if root is None else Path(root), cache_dir
        self.problems = {"train": train_problems, "val": val_problems, "test": test_problems}
        self.num_shapes = {"train": train_shapes, "val": val_shapes, "test": test_shapes}
        self.procedural_kind = procedural_kind
        self.cameras = RandomCameras(rotation, euler_range, translation_range, distance, focal, noise_px)
        self.num_points, self.pool_size, self.normalisation = num_points, pool_size, normalisation
        self._stores: dict[str, Store] = {}
        self.fresh, self.val_fraction = fresh_views, val_fraction

    def prepare_data(self) -> None:
        """Build the caches in one process, before `setup` opens them in all."""
        state = None if self.trainer is None else self.trainer.state.fn
        for part in STAGES[state]:
            self._store(part)

    def _source(self, split: str, seed: tuple[int, int]) -> MeshSource:
        store = self._store(split)
        return MeshSource(
            store,
            np.arange(len(store)) if self.root is None else self._rows(store, split, self.root),
            count=self.problems[split],
            num_points=self.num_points,
            pool_size=self.pool_size,
            cameras=self.cameras,
            seed=seed,
            label=split,
        )

    def _rows(self, store: Store, split: str, root: Path) -> NDArray[np.int64]:
        """Return the rows of the shapes of a split; raise StoreError if there are none, or one has too few points."""
        folder = "test" if split == "test" else "train"
        rows = np.array([row for row in range(len(store)) if store.name(row).split("/")[-2] == folder])
        if not len(rows):
            raise StoreError(f"{root} has no meshes <class>/{folder}/*; give another `root`")
        if self.pool_size > (most := int(store.parameters["points"])):
            raise StoreError(
                f"`pool_size` is {self.pool_size}, but {store.folder} has {most} samples of each mesh; use that, or "
                f"prepare it again with --points {self.pool_size}"
            )
        fewest = int(rows[store.counts(POINTS)[rows].argmin()])
        if self.num_points > (count := int(store.counts(POINTS)[fewest])):
            raise StoreError(
                f"{store.name(fewest)} in {root} has {count} points, fewer than `num_points` {self.num_points}; set "
                f"data.num_points to {count} or less, or leave the shape out"
            )
        if split == "test":
            return rows
        training, held_out = hold_out(len(rows), self.val_fraction, seed=self.seed)
        return rows[training if split == "train" else held_out]

    def _store(self, part: str) -> Store:
        """Return the surface samples of a part, opened once, and made if they do not exist."""
        split = "all" if self.root is not None else "test" if part == "predict" else part
        if split not in self._stores:
            self._stores[split] = self._open_store(split)
        return self._stores[split]

    def _open_store(self, split: str) -> Store:
        if self.root is None:
            kind = self.procedural_kind
            shapes = procedural_shapes(split, self.num_shapes[split], seed=self.seed, kind=kind)
            label = f"{NAMES[kind]}-{split}"
        elif not is_store(self.root):
            shapes, label = open_shapes(self.root), self.root.resolve().name
        else:
            store = open_store(self.root, SURFACES)
            if (stored := store.parameters["normalisation"]) != self.normalisation:
                raise StoreError(
                    f"`normalisation` is {self.normalisation}, but {self.root} was made with {stored}; use that, or "
                    f"prepare it again with --normalisation {self.normalisation}"
                )
            return store
        recipe = surfaces_recipe(shapes, points=self.pool_size, normalisation=self.normalisation, label=label)
        return open_or_prepare(recipe, label, self.cache_dir)


def surfaces_recipe(shapes: Shapes, *, points: int, normalisation: Normalisation, label: str) -> Recipe:
    """Return the recipe of a store of surface samples in a normalised frame."""
    samplers = list(shapes.samplers.items())
    starts = range(0, len(samplers), MESHES_A_PART)
    return Recipe(
        kind=SURFACES,
        widths={POINTS: 3},
        parameters={"points": points, "normalisation": normalisation, "source": shapes.identity},
        jobs=[(samplers[start : start + MESHES_A_PART], points, normalisation) for start in starts],
        work=_sample_rows,
        what="mesh",
        source=label,
    )


def _sample_rows(samplers: Sequence[tuple[str, Sampler]], count: int, mode: Normalisation) -> JobResult:
    rows: list[StoreRow] = []
    skipped = {}
    for name, sampler in samplers:
        try:
            samples = normalise(sampler(count), mode)
        except (MeshError, OSError) as error:
            skipped[name] = str(error)
        else:
            rows.append((name, {POINTS: samples}, {"radius": float(np.linalg.norm(samples, axis=-1).max())}))
    return rows, skipped
