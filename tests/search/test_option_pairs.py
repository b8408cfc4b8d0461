"""Pairs of options of `bpnp.solve`: a pair recovers a planted pose with both options, or is refused with its reason.

A pair that works is solved three times: with both options right, and with each of them wrong. The right ones recover
the planted pose. A wrong one changes the verdict, the number of false alarms, the pose, the matches or the camera, so
that no option is ignored.
"""

from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from planted import degrees_between
from scipy.spatial.transform import Rotation

from bpnp import GravityPrior, PosePrior, Solution, solve, solve_many
from bpnp.arrays import Array

Options = frozenset[str]
FOCAL, SIZE, NOISE = 400.0, (640, 480), 0.15
COLOURS = 4
SCALE = 2.5  # units of the rig in one unit of a scene with `scale`
RADIAL = -0.08  # radial coefficient of the images with `distortion`


class Device(NamedTuple):
    """One problem: pixels of each camera, index of the scene point of each pixel (-1 for a false one), and the pose."""

    pixels: list[Array]
    truth: list[NDArray[np.int64]]
    scene: Array
    rotation: Array
    translation: Array


class Planted(NamedTuple):
    """The problems of a pair: one, or two with `many`; and the extrinsics of the cameras of their rig."""

    devices: list[Device]
    mounts: list[tuple[Array, Array]]


def turn(degrees: float, axis: int) -> Array:
    return Rotation.from_rotvec(np.radians(degrees) * np.eye(3)[axis]).as_matrix()


def plant(options: Options) -> Planted:
    rng = np.random.default_rng(sum(map(ord, "".join(sorted(options)))))
    mounts = [(turn(4, 1), np.array([0.3, 0.1, 0.0])), (turn(-9.0, 1), np.array([-0.6, 0.0, 0.1]))]
    mounts = mounts if options & {"rig", "scale"} else [(np.eye(3), np.zeros(3))]
    # An unknown focal length alone allows a significant distortion.
    radial = RADIAL if "distortion" in options and "focal" not in options else 0.0
    devices = []
    for _ in range(2 if "many" in options else 1):
        rotation, translation = Rotation.random(rng=rng).as_matrix(), np.array([0.1, -0.1, 4.0])
        # A radial coefficient is fitted to 24 matches or more.
        count, most = (36, 28) if "distortion" in options else (20, 15)
        scene = rng.uniform(-1.2, 1.2, (count, 3))
        pixels, truth = [], []
        for apart, shift in mounts:
            camera = (scene @ rotation.T + translation) @ apart.T + shift
            plane = camera[:, :2] / camera[:, 2:]
            image = FOCAL * plane * (1 + radial * (plane**2).sum(1, keepdims=True)) + np.array(SIZE) / 2
            ahead = (camera[:, 2] > 0) & ((plane**2).sum(1) < 1.5)
            inside = np.flatnonzero(ahead & (image > 0).all(1) & (image < SIZE).all(1))
            seen = rng.permutation(inside)[:most]
            false = rng.uniform((20, 20), (620, 460), (5, 2))
            pixels.append(np.concatenate([image[seen] + NOISE * rng.standard_normal((len(seen), 2)), false]))
            truth.append(np.r_[seen, np.full(len(false), -1)])
        unit = SCALE if "scale" in options else 1.0
        devices.append(Device(pixels, truth, scene / unit, rotation, translation))
    return Planted(devices, mounts)


def swapped(count: int, shift: int) -> NDArray[np.int64]:
    """A shift of every third label: most of them stay, and the pose is found."""
    return np.where(np.arange(count) % 3 == 0, shift, 0)


def colours(device: Device, shift: int = 0) -> tuple[list[NDArray[np.int64]], NDArray[np.int64]]:
    scene = np.arange(len(device.scene)) % COLOURS
    return [
        np.where(i < 0, np.arange(len(i)) % COLOURS, (scene[i] + swapped(len(i), shift)) % COLOURS)
        for i in device.truth
    ], scene


def colour_shares(device: Device, shift: int = 0) -> tuple[list[Array], Array]:
    image, scene = colours(device, shift)
    shares = 0.08 + (1 - 0.08 * COLOURS) * np.eye(COLOURS)
    return [shares[each] for each in image], shares[scene]


def identities(device: Device, shift: int = 0) -> tuple[list[NDArray[np.int64]], NDArray[np.int64]]:
    n = len(device.scene)
    own = [np.where(i < 0, n + np.arange(len(i)), i) for i in device.truth]
    for labels in own if shift else ():
        labels[:24:3] = labels[:24:3][::-1]  # four pairs of exchanged labels
    return own, np.arange(n)


def normals(device: Device, sign: float = 1.0) -> Array:
    """Normals of the points that are seen face the camera, the others do not."""
    towards = -device.rotation.T @ device.translation - device.scene
    seen = np.isin(np.arange(len(device.scene)), np.concatenate(device.truth))
    return np.asarray(sign * np.where(seen, 1, -1)[:, None] * towards / np.linalg.norm(towards, axis=1, keepdims=True))


def is_true(device: Device, right: bool) -> list[Array]:
    return [np.where((i >= 0) == right, 0.9, 0.3) for i in device.truth]


def is_seen(device: Device, right: bool) -> Array:
    """Scores of the scene points; wrong ones also prefer some of those that are seen to others."""
    index = np.arange(len(device.scene))
    seen = np.isin(index, np.concatenate(device.truth))
    return np.where(seen, 0.9, 0.3) if right else np.where(seen & (index % 2 > 0), 0.2, 0.8)


def arguments(name: str, device: Device, options: Options, right: bool) -> dict[str, Any]:
    """The arguments by which an option is set for one problem, rightly or wrongly."""
    up = np.array([0.0, 1.0, 0.0])
    off = np.eye(3) if right else turn(50, 2)
    known = {"labels": colours, "classes": colour_shares, "known": identities}
    if name in known:
        image, scene = known[name](device, 0 if right else 1)
        return {"labels2d": image, "labels3d": scene}
    match name:
        case "prior":
            shift = None if options & {"scale"} else device.translation
            return {"prior": PosePrior(off @ device.rotation, shift, 3.0, 0.3)}
        case "gravity":
            return {"prior": GravityPrior(off @ device.rotation @ up, up, 2.0)}
        case "normals":
            return {"normals3d": normals(device, 1.0 if right else -1.0)}
        case "scores2d":
            return {"scores2d": is_true(device, right)}
        case "scores3d":
            return {"scores3d": is_seen(device, right)}
    raise KeyError(name)


# Arguments of all problems together, rightly and wrongly set.
COMMON: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "clutter": ({"clutter": 0.2}, {"clutter": 0.85}),
    "threshold": ({"inlier_threshold": 1.5}, {"inlier_threshold": 0.12}),
    "focal": ({"focal_error": 0.03}, {"focal_error": 0.0005}),
    "distortion": ({"distortion": True}, {}),
    "scale": ({"scale": True}, {}),
    "rig": ({}, {}),
    "many": ({}, {}),
}
EACH = "prior", "gravity", "normals", "labels", "classes", "known", "scores2d", "scores3d"
MANY = "many"  # a way to pose the problem: there is no wrong one


def answers(options: Options, planted: Planted, wrong: str | None) -> list[Solution]:
    """Solve the planted problems with these options, one of them wrong."""
    camera = ("SIMPLE_PINHOLE", [FOCAL, SIZE[0] / 2, SIZE[1] / 2])
    if options & {"focal", "distortion"}:
        camera = ("SIMPLE_PINHOLE", [1.05 * FOCAL, SIZE[0] / 2, SIZE[1] / 2])
    rigged, many, call = bool(options & {"rig", "scale"}), "many" in options, dict[str, Any]()
    for name in sorted(options & set(COMMON)):
        call |= COMMON[name][name == wrong]
    if "distortion" in options - {wrong}:
        call.setdefault("focal_error", 0.03)
    each: list[dict[str, Any]] = [{"points2d": device.pixels, "points3d": device.scene} for device in planted.devices]
    for k, device in enumerate(planted.devices):
        for name in sorted(options & set(EACH)):
            each[k] |= arguments(name, device, options, name != wrong)
        if not rigged:
            each[k] |= {name: value[0] for name, value in each[k].items() if isinstance(value, list)}
    if rigged:
        mounts = planted.mounts
        if wrong == "rig":
            mounts = [mounts[0], (turn(25, 0) @ mounts[1][0], mounts[1][1])]
        call["rig"] = mounts
    arrays = {name: [one[name] for one in each] for name in each[0]} if many else each[0]
    call |= arrays | {"camera": camera, "solver": "search", "time_limit": 300.0}
    if many:
        return solve_many(**call)
    return [solve(**call)]


def summary(solutions: list[Solution]) -> list[Any]:
    return [
        (
            one.verdict,
            round(one.log10_false_alarms, 6),
            np.round(one.rotation, 9).tolist(),
            len(one.matches),
            one.stats.iterations,
            None if one.camera is None else (np.round(one.camera.focal, 6), type(one.camera).__name__),
        )
        for one in solutions
    ]


# Pairs that are one argument.
SAME = {
    frozenset(pair) for pair in (("prior", "gravity"), ("labels", "classes"), ("labels", "known"), ("classes", "known"))
}
PAIRS = [pair for pair in map(frozenset, combinations([*EACH, *COMMON], 2)) if pair not in SAME]


def name_of(pair: Options) -> str:
    return "+".join(sorted(pair))


@pytest.mark.nightly
@pytest.mark.parametrize("pair", PAIRS, ids=name_of)
def test_a_pair_recovers_the_pose_and_uses_both_options(pair: Options) -> None:
    planted = plant(pair)
    right = answers(pair, planted, None)
    for solution, device in zip(right, planted.devices, strict=True):
        assert solution.verdict == "confident", solution.reason
        assert degrees_between(solution.rotation, device.rotation) < 1
        if "scale" in pair:
            assert solution.scale == pytest.approx(SCALE, rel=0.05)
        np.testing.assert_allclose(solution.translation, device.translation, atol=0.15)
        centre = -device.rotation.T @ device.translation / (SCALE if "scale" in pair else 1.0)
        assert np.linalg.norm(solution.centre - centre) < 5 * solution.centre_std < 0.3
        if pair & {"focal", "distortion"}:
            assert abs(solution.focal_length - FOCAL) < 4 * solution.focal_length_std < 0.04 * FOCAL
    for name in sorted(pair - {MANY}):
        assert summary(answers(pair, planted, name)) != summary(right), f"`{name}` has no effect"


@pytest.mark.parametrize("setting", [{"solver": "matcher-sfm"}, {"prior": "learned"}, {"device": "cpu"}])
def test_a_network_solves_points_of_one_camera_only(setting: dict[str, Any]) -> None:
    (device,), mounts = plant(frozenset(("rig", "labels")))
    with pytest.raises(ValueError, match="networks are trained for the points of one camera"):
        solve(device.pixels, device.scene, np.diag([400.0, 400, 1]), rig=mounts, **setting)
