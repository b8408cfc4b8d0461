"""`solve` with a rig: options that mean nothing there, and the arrays of each camera."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from bpnp.search.arguments import cameras_from, check_inside, checked_prior, each_of, each_set, is_network, pixels_from
from bpnp.search.assemble import Solved
from bpnp.search.focal_length import unknown_camera
from bpnp.search.rig.points import mount_from, prepare_rig
from bpnp.search.solvers import Options
from bpnp.search.starts import GravityPrior, PosePrior

PER_CAMERA = "labels2d", "scores2d"


class RigOptions(NamedTuple):
    """Arguments that are common to all problems; as for `bpnp.solve`."""

    rig: Sequence[Any]
    scale: bool
    image_size: Any
    focal_error: float | int | None
    distortion: bool
    solver: Any
    device: Any


def prepare(
    points2d: Any,
    points3d: Any,
    camera: Any,
    point_options: Mapping[str, Any],
    options: Options,
    chosen: RigOptions,
    prior: Any,
) -> Callable[[], Solved]:
    """Check the arguments of one problem with a rig, and return the function that solves it.

    The image points and their options are lists with one array per camera; `chosen` are the arguments that are common
    to all problems. ValueError for an argument that is invalid, or has no meaning with a rig.
    """
    mounts = [mount_from(f"rig[{k}]", mount) for k, mount in enumerate(chosen.rig)]
    _refuse(chosen, prior)
    count, images = len(mounts), each_set("points2d", points2d, None)
    cameras = cameras_from(camera, count)
    for name, values in (
        ("points2d", images),
        ("camera", cameras),
        *((name, point_options[name]) for name in PER_CAMERA),
    ):
        if isinstance(values, list) and len(values) != count:
            raise ValueError(
                f"`{name}` has the length {len(values)}, but the `rig` has {count} cameras; give one per camera"
            )
    arrays = dict(point_options) | {name: each_set(name, point_options[name], count, 1) for name in PER_CAMERA}
    cameras = each_of("camera", cameras, count)
    lacking = [k for k, one in enumerate(cameras) if one is None]
    if 0 < len(lacking) < count:
        raise ValueError(
            f"`camera` is None for camera {lacking[0]} of the `rig`, but not for all, and all errors have one unit; "
            "give each its camera, or normalised image coordinates or bearings for all"
        )
    unknown, size = None, chosen.image_size
    if chosen.distortion or size is not None or chosen.focal_error is not None:
        unknown = [unknown_camera(one, size, chosen.focal_error, chosen.distortion) for one in cameras]
    images = [pixels_from(points, one, size) for points, one in zip(images, cameras, strict=True)]
    for image in images if size is not None else ():
        check_inside(image, size)
    rough = checked_prior(prior)
    assert rough is None or isinstance(rough, (PosePrior, GravityPrior))
    return prepare_rig(images, points3d, cameras, unknown, mounts, arrays, options, prior=rough, scale=chosen.scale)


def _refuse(chosen: RigOptions, prior: Any) -> None:
    """Raise ValueError for an option that cannot be used with a rig."""
    networks = "networks are trained for the points of one camera, not for a `rig`"
    if chosen.solver not in ("auto", "search"):
        raise ValueError(f'`solver` is {chosen.solver!r:.60}, but {networks}; use solver="search"')
    if isinstance(prior, (str, Path)) or is_network(prior):
        raise ValueError(f"`prior` is the network {prior!r:.60}, but {networks}; give a pose or a GravityPrior")
    if chosen.device is not None:
        raise ValueError(f"`device` is {chosen.device!r:.60}, but no network runs: {networks}; leave `device` out")
