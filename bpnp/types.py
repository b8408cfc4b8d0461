"""What flows through bpnp: a `Batch` goes into a solver, a `Prediction` comes out.

Axes: b batch, m 2D points, n 3D points (m and n padded to the largest set of the batch).
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

from bpnp.cameras import check_normalised
from bpnp.checks import Arrays, as_tensor_list, check_match3d, check_points, stack_values
from bpnp.geometry import is_finite

_T = TypeVar("_T")


def has_no_padding(mask: Bool[Tensor, "b k"]) -> bool:
    """Whether every point is known to be real, so that masks need not be applied.

    False for a mask on a GPU, whose values the host would have to wait for, and in a graph that is to serve any mask.
    """
    return mask.is_cpu and not torch.compiler.is_compiling() and bool(mask.all())


class Tensors:
    """A dataclass of tensors, of dicts of them, and of such dataclasses."""

    def to(self: _T, *args: Any, **kwargs: Any) -> _T:
        """Move every tensor; a dtype applies to the floating-point ones. Same arguments as `Tensor.to`."""

        def move(x: Tensor) -> Tensor:
            moved = x.to(*args, **kwargs)
            # A dtype is for numbers: half precision has no index 257.
            return moved if x.is_floating_point() or moved.dtype == x.dtype else x.to(moved.device)

        return map_tensors(self, move)


@dataclass(frozen=True)
class SolveStats(Tensors):
    """How an iterative solver ended, per sample."""

    iterations: Int[Tensor, " b"]
    residual: Float[Tensor, " b"]
    converged: Bool[Tensor, " b"]

    @classmethod
    def of(cls, converged: Bool[Tensor, " b"], *, residual: Float[Tensor, " b"] | None = None) -> "SolveStats":
        """Of a solver without iterations: one each. Its residual, if it has none, is 0 where it converged, else inf.

        >>> SolveStats.of(torch.tensor([True, False])).residual.tolist()
        [0.0, inf]
        """
        known = torch.where(converged, 0.0, torch.inf) if residual is None else residual
        return cls(torch.ones_like(converged, dtype=torch.long), known, converged)


@dataclass(frozen=True)
class Pose(Tensors):
    """World-to-camera poses. A sample without a pose holds NaN and `stats.converged` False."""

    rotation: Float[Tensor, "b 3 3"]
    translation: Float[Tensor, "b 3"]
    stats: SolveStats

    @property
    def found(self) -> Bool[Tensor, " b"]:
        """Samples that have a finite pose."""
        return is_finite(self.rotation, self.translation)


@dataclass(frozen=True)
class Prediction(Tensors):
    """A solver's answer: the joint probability of every match, and each pose estimate by name.

    assignment: what the solver's own transport gave. rematched: that of the last round, of a solver that matches again
        under its pose in evaluation.
    unmatched2d, unmatched3d: the probability that a point has no partner, of an assignment with bins for them.
    seconds: by the name of a pose, the time from the start of the batch until it was found; empty if not measured.
    ids, index: those of the batch, of a prediction by `Trainer.predict`.
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


@dataclass  # not frozen: Lightning's precision plugins cast inputs by assigning to the fields of a copy
class Batch(Tensors):
    """Problems, padded and masked: sets of image points and of scene points, and what is known of them.

    points2d: (b, m, 2) normalised image coordinates.
    points3d: (b, n, 3) scene units.
    mask2d, mask3d: True at real points.
    rotation, translation: true pose, if known.
    match3d: (b, n) index of the 2D point that 3D point j was seen as, -1 for none; if known.
    focal: (b,) pixels per unit of normalised coordinates, to report errors in pixels.
    index: (b,) position of each problem in its data set; a problem that appears twice (a padded distributed epoch) is
        counted once.
    ids: a name for each problem.
    origin: (b, 3) what was subtracted from the scene's coordinates; written poses have it undone.
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
        return self.mask2d.sum(-1)

    @property
    def count3d(self) -> Int[Tensor, " b"]:
        return self.mask3d.sum(-1)

    def pin_memory(self) -> "Batch":
        return map_tensors(self, lambda x: x.pin_memory())

    @classmethod
    def from_arrays(
        cls,
        points2d: Arrays,
        points3d: Arrays,
        rotation: Arrays | None = None,
        translation: Arrays | None = None,
        match3d: Arrays | None = None,
        *,
        focal: Arrays | None = None,
        index: Sequence[int] | None = None,
        ids: Sequence[str] | None = None,
    ) -> "Batch":
        """Pad and mask one problem, or lists of problems of different sizes.

        points2d (m, 2) and points3d (n, 3) for one problem, or sequences of such arrays; rotation (3, 3), translation
        (3,), match3d (n,) and focal () likewise, or one focal for all. Padding is zero. The dtype is float64 if a 2D
        array is, else float32; the batch is on the CPU.

        Raises ValueError that names the argument: wrong shape, NaN or infinity, pixels, no points, lists of different
        length, or a match3d that holds no integers or an index that is no 2D point.

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
        focals = [torch.ones(())] if focal is None else as_tensor_list("focal", focal, 0)
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
                raise ValueError(f"expected `{name}` for {size} problems as in `points2d`, got {len(values)}")
        m, n = max(map(len, sets2d)), max(map(len, sets3d))
        if matches is not None:
            matches = [check_match3d(i, x, len(sets2d[i]), len(sets3d[i])) for i, x in enumerate(matches)]
        return cls(
            points2d=pad_sequence(sets2d, batch_first=True),
            points3d=pad_sequence(sets3d, batch_first=True),
            mask2d=torch.stack([torch.arange(m) < len(x) for x in sets2d]),
            mask3d=torch.stack([torch.arange(n) < len(x) for x in sets3d]),
            focal=stack_values("focal", focals, (), dtype),
            index=torch.arange(size) if index is None else torch.as_tensor(index, dtype=torch.long),
            ids=tuple(map(str, range(size))) if ids is None else tuple(ids),
            rotation=None if rotations is None else stack_values("rotation", rotations, (3, 3), dtype),
            translation=None if translations is None else stack_values("translation", translations, (3,), dtype),
            match3d=None if matches is None else pad_sequence(matches, batch_first=True, padding_value=-1),
        )


def map_tensors(value: _T, function: Callable[[Tensor], Tensor]) -> _T:
    """The value with a function applied to every tensor in dataclasses and dicts of them; the rest stays."""
    if isinstance(value, Tensor):
        return cast(_T, function(value))
    if isinstance(value, dict):
        return cast(_T, {k: map_tensors(v, function) for k, v in value.items()})
    if is_dataclass(value) and not isinstance(value, type):
        changed = {f.name: map_tensors(getattr(value, f.name), function) for f in fields(value)}
        return cast(_T, type(value)(**changed))
    return value
