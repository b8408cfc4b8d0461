"""`solve` with a rig or with directions: options that mean nothing there, and the arrays of each camera."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from bpnp.search.arguments import check_inside, checked_prior, each_camera, each_set, is_network, pixels_from
from bpnp.search.focal_length import unknown_camera
from bpnp.search.infinity.solve import prepare_directions
from bpnp.search.rig.solve import mount_from, prepare_rig
from bpnp.search.solution import Solution
from bpnp.search.solvers import Options
from bpnp.search.starts import GravityPrior, PosePrior

PER_CAMERA = "labels2d", "scores2d"


class Mode(NamedTuple):
    """Arguments that are common to all problems; as for `bpnp.solve`."""

    at_infinity: bool
    rig: Sequence[Any] | None
    scale: bool
    image_size: Any
    focal_error: float | int | None
    distortion: bool
    solver: Any
    device: Any


def prepare_mode(
    points2d: Any,
    points3d: Any,
    camera: Any,
    point_options: Mapping[str, Any],
    options: Options,
    mode: Mode,
    prior: Any,
) -> Callable[[], Solution]:
    """Check the arguments of one problem with a rig or with directions, and return the function that solves it.

    Args:
        points2d: Points of the image, or with a `rig` a list with those of each camera.
        points3d: (n, 3) scene points or directions.
        camera: Camera, or with a `rig` one for all or a list.
        point_options: `normals3d`, `labels2d`, `labels3d`, `scores2d`, `scores3d`; with a `rig` those of the image
            points are lists with one array per camera.
        options: Options of the search.
        mode: Arguments that are common to all problems.
        prior: As for `bpnp.solve`.

    Raises:
        ValueError: An argument is invalid, or has no meaning in this mode.
    """
    at_infinity, rig, scale, image_size, focal_error, distortion, solver, device = mode
    _refuse(point_options, at_infinity=at_infinity, scale=scale, prior=prior, solver=solver, device=device)
    mounts = None if rig is None else [mount_from(f"rig[{k}]", mount) for k, mount in enumerate(rig)]
    count = 1 if mounts is None else len(mounts)
    images, each = [points2d], {name: [point_options[name]] for name in PER_CAMERA}
    if mounts is not None:
        images = each_set("points2d", points2d, None)
        for name, values in (
            ("points2d", images),
            ("camera", camera),
            *((name, point_options[name]) for name in PER_CAMERA),
        ):
            if isinstance(values, list) and len(values) != count:
                raise ValueError(
                    f"`{name}` has the length {len(values)}, but the `rig` has {count} cameras; give one per camera"
                )
        each = {name: each_set(name, point_options[name], count, 1) for name in PER_CAMERA}
    cameras = each_camera(camera, count) if mounts is not None else [camera]
    lacking = [k for k, one in enumerate(cameras) if one is None]
    if 0 < len(lacking) < count:
        raise ValueError(
            f"`camera` is None for camera {lacking[0]} of the `rig`, but not for all, and all errors have one unit; "
            "give each its camera, or normalised image coordinates or bearings for all"
        )
    unknown = None
    if distortion or image_size is not None or focal_error is not None:
        unknown = [unknown_camera(one, image_size, focal_error, distortion) for one in cameras]
    images = [pixels_from(points, one, image_size) for points, one in zip(images, cameras, strict=True)]
    if image_size is not None:
        for image in images:
            check_inside(image, image_size)
    arrays, rough = dict(point_options) | each, checked_prior(prior)
    assert rough is None or isinstance(rough, (PosePrior, GravityPrior))
    if at_infinity:
        return prepare_directions(
            images,
            points3d,
            cameras,
            unknown,
            arrays,
            options,
            camera_rotations=None if mounts is None else [turn for turn, _ in mounts],
            prior=rough,
            distortion=distortion,
        )
    return prepare_rig(images, points3d, cameras, unknown, mounts or [], arrays, options, prior=rough, scale=scale)


def _refuse(
    point_options: Mapping[str, Any], *, at_infinity: bool, scale: bool, prior: Any, solver: Any, device: Any
) -> None:
    """Raise ValueError for an option that cannot be used with a rig or with directions."""
    networks = "networks are trained for the points of one camera, not for a `rig` or directions `at_infinity`"
    if solver not in ("auto", "search"):
        raise ValueError(f'`solver` is {solver!r:.60}, but {networks}; use solver="search"')
    if isinstance(prior, (str, Path)) or is_network(prior):
        raise ValueError(f"`prior` is the network {prior!r:.60}, but {networks}; give a pose or a GravityPrior")
    if device is not None:
        raise ValueError(f"`device` is {device!r:.60}, but no network runs: {networks}; leave `device` out")
    if at_infinity and point_options["normals3d"] is not None:
        raise ValueError(
            "`normals3d` has no meaning with `at_infinity=True`: a direction has no surface that could face away; "
            "leave the normals out"
        )
    if at_infinity and scale:
        raise ValueError(
            "`scale=True` has no meaning with `at_infinity=True`: directions have no unit of length; leave `scale` out"
        )
