"""Types of the arguments of public functions, and how an error message shows a value.

For type checkers these are unions of what a function accepts. At run time they are `Any`: the functions check the
values themselves, and raise a ValueError that names the argument.
"""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Protocol, SupportsFloat, TypeAlias, runtime_checkable

import numpy as np
import numpy.typing as npt


class HasArray(Protocol):
    """A NumPy array, a torch tensor, a data frame, or another object that NumPy converts."""

    def __array__(self) -> npt.NDArray[Any]: ...


class HasVertices(Protocol):
    """A mesh or cloud of trimesh, or a mesh of Open3D."""

    @property
    def vertices(self) -> Any: ...


class HasPoints(Protocol):
    """A point cloud of Open3D."""

    @property
    def points(self) -> Any: ...


class KeyPoint(Protocol):
    """A cv2.KeyPoint."""

    @property
    def pt(self) -> Sequence[float]: ...


class HasPose(Protocol):
    """An object with a rotation and a translation, such as a `Solution`."""

    @property
    def rotation(self) -> Any: ...

    @property
    def translation(self) -> Any: ...


class HasMatrix(Protocol):
    """A pycolmap.Rigid3d."""

    @property
    def matrix(self) -> Callable[..., Any]: ...


class HasCameraModel(Protocol):
    """A pycolmap.Camera."""

    @property
    def cam_from_img(self) -> Callable[..., Any]: ...

    @property
    def img_from_cam(self) -> Callable[..., Any]: ...


@runtime_checkable
class HasReconstruction(Protocol):
    """A pycolmap.Reconstruction."""

    @property
    def write_binary(self) -> Callable[..., Any]: ...


# A union has one `Sequence` at most: mypy then infers the type of a list of different things.
if TYPE_CHECKING:
    Numbers: TypeAlias = HasArray | Sequence[SupportsFloat]
    ArrayLike: TypeAlias = HasArray | Sequence[SupportsFloat | Sequence[SupportsFloat]]
    ManyArrays: TypeAlias = HasArray | Sequence[ArrayLike | SupportsFloat | None]
    Points: TypeAlias = HasArray | HasVertices | HasPoints
    PointsLike: TypeAlias = Points | Sequence[KeyPoint | Sequence[SupportsFloat]]
    ManyPoints: TypeAlias = Points | Sequence[PointsLike | KeyPoint | Sequence[SupportsFloat]]
    PoseObject: TypeAlias = HasArray | tuple[ArrayLike, ArrayLike] | HasPose | HasMatrix
    PoseLike: TypeAlias = PoseObject | Sequence[Sequence[SupportsFloat]]
    ImageSize: TypeAlias = HasArray | Sequence[int]
else:
    Numbers = ArrayLike = ManyArrays = PointsLike = ManyPoints = PoseObject = PoseLike = ImageSize = Any


def check_unmasked(name: str, values: object) -> None:
    """Raise ValueError for a masked array with masked values, whose mask NumPy drops in a conversion."""
    if isinstance(values, np.ma.MaskedArray) and (count := int(np.ma.count_masked(values))):
        raise ValueError(
            f"`{name}` is a masked array with {count} masked values; give only the rows to use, such as "
            f"`{name}[~{name}.mask.any(1)].data`"
        )


def array_shape(values: Any) -> tuple[int, ...]:
    """Return the shape of an array, or of a list or tuple that NumPy can convert; () for anything else.

    >>> from bpnp.argument_types import array_shape
    >>> array_shape([[1, 2, 3]]), array_shape([[1, 2], 3]), array_shape("abc")
    ((1, 3), (), ())
    """
    if not isinstance(values, (list, tuple)):
        return tuple(getattr(values, "shape", ()))
    try:
        return np.shape(values)
    except (TypeError, ValueError, RuntimeError):  # rows of different lengths, or tensors that NumPy cannot read
        return ()


def short_repr(value: object) -> str:
    """Return the representation of a value in one line of at most 80 characters, for an error message.

    >>> from bpnp.argument_types import short_repr
    >>> short_repr([[1.0], [2.0]])
    '[[1.0], [2.0]]'
    """
    return " ".join(repr(value).split())[:80]
