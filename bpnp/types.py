"""Data types of a solver: a `Batch` of problems is the input, a `Prediction` the output.

Axes: b batch, m 2D points, n 3D points (m and n are padded to the largest set of the batch).
Conventions: camera = R p + t (world to camera, COLMAP's `cam_from_world`); `points2d` are normalised image coordinates
x/z, y/z (intrinsics applied, distortion removed); 3D points and translations are in scene units.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any, TypeVar, cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from bpnp.argument_types import ManyArrays
from bpnp.cameras import check_normalised
from bpnp.checks import as_tensor_list, check_match3d, check_points, stack_values
from bpnp.geometry import is_finite

_T = TypeVar("_T")


def has_no_padding(mask: Bool[Tensor, "b k"]) -> bool:
    """Return True if every point is known to be real (True in the mask), so that the mask need not be applied.

    The result is False for a mask on a GPU, where reading the values would make the host wait, and while a graph is
    compiled, which has to serve any mask.
    """
    return mask.is_cpu and not torch.compiler.is_compiling() and bool(mask.all())


class Tensors:
    """Base of dataclasses whose fields are tensors, dicts of tensors, or such dataclasses."""

    def to(self: _T, *args: Any, **kwargs: Any) -> _T:
        """Move every tensor to a device or a dtype.

        Args:
            *args: As for `Tensor.to`. A dtype applies to floating-point tensors only.
            **kwargs: As for `Tensor.to`.

        Returns:
            A copy.
        """

        def move(x: Tensor) -> Tensor:
            moved = x.to(*args, **kwargs)
            # Integers keep their dtype: half precision cannot hold the index 2049.
            return moved if x.is_floating_point() or moved.dtype == x.dtype else x.to(moved.device)

        return map_tensors(self, move)


@dataclass(frozen=True)
class SolveStats(Tensors):
    """Convergence of an iterative solver, per sample.

    Attributes:
        iterations: Iterations used (b,).
        residual: Value that the solver compares with its tolerance (b,); its unit depends on the solver.
        converged: True where the tolerance was met (b,).
    """

    iterations: Int[Tensor, " b"]
    residual: Float[Tensor, " b"]
    converged: Bool[Tensor, " b"]

    @classmethod
    def of(cls, converged: Bool[Tensor, " b"], *, residual: Float[Tensor, " b"] | None = None) -> "SolveStats":
        """Return the stats of a solver without iterations: one iteration each.

        Args:
            converged: True where the solver succeeded (b,).
            residual: Residuals (b,). Default: 0 where it converged, infinity elsewhere.

        >>> import torch
        >>> from bpnp import SolveStats
        >>> SolveStats.of(torch.tensor([True, False])).residual.tolist()
        [0.0, inf]
        """
        if residual is None:
            residual = torch.where(converged, 0.0, torch.inf)
        return cls(torch.ones_like(converged, dtype=torch.long), residual, converged)


@dataclass(frozen=True)
class Pose(Tensors):
    """World-to-camera poses, camera = R p + t.

    A sample without a pose holds NaN, and its `stats.converged` is False.

    Attributes:
        rotation: R (b, 3, 3).
        translation: t (b, 3), scene units.
        stats: Convergence of the solver.
    """

    rotation: Float[Tensor, "b 3 3"]
    translation: Float[Tensor, "b 3"]
    stats: SolveStats

    @property
    def found(self) -> Bool[Tensor, " b"]:
        """True for samples with a finite pose (b,)."""
        return is_finite(self.rotation, self.translation)


@dataclass(frozen=True)
class Prediction(Tensors):
    """Output of a solver: the joint probability of every match, and poses by the name of the estimate.

    Attributes:
        assignment: P (b, m, n) of the solver's own transport; None for a solver without one.
        assignment_stats: Convergence of the transport.
        poses: Poses by name, such as "ransac" and "pnp".
        unmatched2d: Probability that a 2D point has no correspondence (b, m); None without dustbins.
        unmatched3d: Probability that a 3D point has no correspondence (b, n); None without dustbins.
        rematched: P (b, m, n) of the last round, if the solver matches the points again under its pose in evaluation.
        seconds: Time from the start of the batch until each pose was found, by its name; empty if not measured.
        ids: `Batch.ids`, set by `Trainer.predict`.
        index: `Batch.index`, set by `Trainer.predict`.
    """

    assignment: Float[Tensor, "b m n"] | None = None
    assignment_stats: SolveStats | None = None
    poses: dict[str, Pose] = field(default_factory=dict)
    unmatched2d: Float[Tensor, "b m"] | None = None
    unmatched3d: Float[Tensor, "b n"] | None = None
    rematched: Float[Tensor, "b m n"] | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    ids: tuple[str, ...] = ()
    index: Int[Tensor, " b"] | None = None


@dataclass  # not frozen: Lightning's precision plugins assign the cast inputs to the fields of a copy
class Batch(Tensors):
    """Problems, padded and masked: image points, scene points and their annotations.

    Attributes:
        points2d: Normalised image coordinates (b, m, 2).
        points3d: Scene points (b, n, 3), scene units.
        mask2d: True at real image points (b, m).
        mask3d: True at real scene points (b, n).
        focal: Pixels per unit of normalised coordinates (b,), to report errors in pixels.
        index: Position of each problem in its data set (b,). Metrics count an index once, although a padded distributed
            epoch repeats some problems.
        ids: Name of each problem.
        rotation: True rotation (b, 3, 3), None if unknown.
        translation: True translation (b, 3), scene units, None if unknown.
        match3d: Index of the 2D point that corresponds to 3D point j (b, n), -1 for none; None if unknown.
        origin: Vector that was subtracted from the scene's coordinates (b, 3). Written poses are in the coordinates
            before.
    """

    points2d: Float[Tensor, "b m 2"]
    points3d: Float[Tensor, "b n 3"]
    mask2d: Bool[Tensor, "b m"]
    mask3d: Bool[Tensor, "b n"]
    focal: Float[Tensor, " b"]
    index: Int[Tensor, " b"]
    ids: tuple[str, ...]
    rotation: Float[Tensor, "b 3 3"] | None = None
    translation: Float[Tensor, "b 3"] | None = None
    match3d: Int[Tensor, "b n"] | None = None
    origin: Float[Tensor, "b 3"] | None = None

    def __len__(self) -> int:
        return self.points2d.shape[0]

    @property
    def count2d(self) -> Int[Tensor, " b"]:
        """Number of real 2D points (b,)."""
        return self.mask2d.sum(-1)

    @property
    def count3d(self) -> Int[Tensor, " b"]:
        """Number of real 3D points (b,)."""
        return self.mask3d.sum(-1)

    def pin_memory(self) -> "Batch":
        """Return a copy in pinned memory; called by torch's data loader."""
        return map_tensors(self, lambda x: x.pin_memory())

    @classmethod
    def from_arrays(
        cls,
        points2d: ManyArrays,
        points3d: ManyArrays,
        rotation: ManyArrays | None = None,
        translation: ManyArrays | None = None,
        match3d: ManyArrays | None = None,
        *,
        focal: ManyArrays | float | None = None,
        index: Sequence[int] | None = None,
        ids: Sequence[str] | None = None,
    ) -> "Batch":
        """Pad and mask one problem, or lists of problems of different sizes.

        Every argument is one array (numpy or torch) for one problem, or a sequence of arrays for several. The batch is
        on the CPU, in float64 if a 2D array is, else in float32. Padding is zero.

        Args:
            points2d: Normalised image coordinates (m, 2).
            points3d: Scene points (n, 3).
            rotation: True rotation (3, 3). None if it is unknown.
            translation: True translation (3,), scene units. None if it is unknown.
            match3d: Index of the 2D point of each 3D point (n,), -1 for none. None if the matches are unknown.
            focal: Focal length in pixels, one for each problem or one for all. Default: None, 1.
            index: Position of each problem in its data set. Default: None, 0, 1, 2, ...
            ids: Name of each problem. Default: None, its index as text.

        Returns:
            The batch of b problems.

        Raises:
            ValueError: An array has a wrong shape, holds NaN or infinity, or has no points; the points are pixels; the
                lists differ in length; `match3d` holds no integers or no index of a 2D point.

        >>> import torch
        >>> from bpnp import Batch
        >>> batch = Batch.from_arrays([torch.rand(5, 2), torch.rand(7, 2)], [torch.rand(9, 3), torch.rand(6, 3)])
        >>> tuple(batch.points2d.shape), batch.count2d.tolist(), batch.count3d.tolist()
        ((2, 7, 2), [5, 7], [9, 6])
        """
        sets2d, sets3d = as_tensor_list("points2d", points2d, 2), as_tensor_list("points3d", points3d, 2)
        size = len(sets2d)
        dtype = torch.float64 if any(x.dtype == torch.float64 for x in sets2d) else torch.float32
        sets2d = [check_points("points2d", i, x, 2).to(dtype) for i, x in enumerate(sets2d)]
        for points in sets2d:
            check_normalised(points.detach(), "(points2d - principal point) / focal length")
        sets3d = [check_points("points3d", i, x, 3).to(dtype) for i, x in enumerate(sets3d)]
        rotations = None if rotation is None else as_tensor_list("rotation", rotation, 2)
        translations = None if translation is None else as_tensor_list("translation", translation, 1)
        matches = None if match3d is None else as_tensor_list("match3d", match3d, 1)
        focals = [torch.ones((), device="cpu")] if focal is None else as_tensor_list("focal", focal, 0)
        focals = focals * size if len(focals) == 1 else focals
        for name, values in (
            ("points3d", sets3d),
            ("rotation", rotations),
            ("translation", translations),
            ("match3d", matches),
            ("focal", focals),
            ("index", index),
            ("ids", ids),
        ):
            if values is not None and len(values) != size:
                raise ValueError(f"`{name}` has {len(values)} problems, but `points2d` has {size}")
        m, n = max(map(len, sets2d)), max(map(len, sets3d))
        if matches is not None:
            matches = [check_match3d(i, x, len(sets2d[i]), len(sets3d[i])) for i, x in enumerate(matches)]
        indices = torch.as_tensor(range(size) if index is None else index, dtype=torch.long, device="cpu")
        return cls(
            points2d=pad_sequence(sets2d, batch_first=True),
            points3d=pad_sequence(sets3d, batch_first=True),
            mask2d=torch.stack([torch.arange(m, device="cpu") < len(x) for x in sets2d]),
            mask3d=torch.stack([torch.arange(n, device="cpu") < len(x) for x in sets3d]),
            focal=stack_values("focal", focals, (), dtype),
            index=indices,
            ids=tuple(map(str, indices.tolist())) if ids is None else tuple(ids),
            rotation=None if rotations is None else stack_values("rotation", rotations, (3, 3), dtype),
            translation=None if translations is None else stack_values("translation", translations, (3,), dtype),
            match3d=None if matches is None else pad_sequence(matches, batch_first=True, padding_value=-1),
        )


def map_tensors(value: _T, function: Callable[[Tensor], Tensor]) -> _T:
    """Return a copy of a dataclass or dict with a function applied to every tensor, recursively.

    Any other value is returned unchanged.
    """
    if isinstance(value, Tensor):
        return cast(_T, function(value))
    if isinstance(value, dict):
        return cast(_T, {k: map_tensors(v, function) for k, v in value.items()})
    if is_dataclass(value) and not isinstance(value, type):
        changed = {f.name: map_tensors(getattr(value, f.name), function) for f in fields(value)}
        return cast(_T, type(value)(**changed))
    return value
