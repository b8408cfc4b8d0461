"""Errors of `solve`, `solve_many` and `verify`: each names the wrong argument."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from planted import plant

from bpnp import GravityPrior, PosePrior, solve, solve_many, verify
from bpnp.cameras import camera_from
from bpnp.solving.arguments import check_inside, checked_prior, checked_seed, positive

K = np.array([[520.0, 1.5, 405.0], [0.0, 500.0, 290.0], [0.0, 0.0, 1.0]])
CAMERA = ("SIMPLE_PINHOLE", [500.0, 320.0, 240.0])
PLANTED = plant(1, 20)
X, P = PLANTED.points2d[0].numpy(), PLANTED.points3d[0].numpy()
PIXELS = np.r_[500 * X[:19] + [320, 240], [[600.0, 240.0]]]
SIZE = (640, 480)
WITH_NAN = np.where(np.arange(20)[:, None] == 7, np.nan, P)
EVEN = np.full((20, 4), 0.25)  # class probabilities
SEEN: dict[str, Any] = {"points2d": X, "points3d": P}
SKY: dict[str, Any] = {"points2d": PIXELS, "points3d": P / np.linalg.norm(P, axis=1, keepdims=True), "camera": CAMERA}
RIG: dict[str, Any] = {"points2d": [PIXELS[:6], PIXELS[6:12]], "points3d": P}
RIG |= {"camera": [CAMERA] * 2, "rig": [np.eye(4)] * 2}
CALLS: dict[str, Any] = {
    "points": partial(solve, **SEEN),
    "sky": partial(solve, at_infinity=True, **SKY),
    "rig": partial(solve, **RIG),
    "many": partial(solve_many, points2d=[X, X], points3d=P),
    "verify": partial(verify, **SEEN, rotation=np.eye(3), translation=[0, 0, 5.0]),
}
NO_PRIOR = PosePrior(np.eye(3), np.zeros(3), 5.0, 1.0)


@pytest.mark.parametrize(
    ("call", "change", "message"),
    [
        ("points", {"points2d": X[:3]}, "4 or more points in `points2d`, got 3"),
        ("points", {"points3d": P[:3]}, "4 or more points in `points3d`, got 3"),
        ("points", {"points2d": X[:0]}, "4 or more points in `points2d`, got 0"),
        ("points", {"points3d": WITH_NAN}, "finite `points3d`, got .* at point 7"),
        ("points", {"points2d": X + np.inf}, "finite `points2d`"),
        ("points", {"points2d": P, "points3d": X}, "swapped"),
        ("points", {"points2d": P}, "unit bearings .* swapped"),
        ("points", {"points2d": P, "points3d": X, "camera": K}, "swapped"),
        ("points", {"points3d": X}, r"`points3d` of shape \(k, 3\).* swapped"),
        ("points", {"points2d": X.T}, r"`points2d` of shape \(k, 2\) or \(k, 3\), got \(2, 20\)"),
        ("points", {"points2d": X[:, 0]}, r"got \(20,\)"),
        ("points", {"points3d": "points.npy"}, "`points3d` as an array of numbers"),
        ("points", {"points2d": X.astype(complex)}, "`points2d` as an array of numbers"),
        ("points", {"points2d": None}, "`points2d` as an array of numbers"),
        ("points", {"points2d": PIXELS}, "look like pixels; try camera=K"),
        ("points", {"camera": K}, "look normalised"),
        ("points", {"points2d": PIXELS, "camera": np.diag([500.0, 0, 1])}, "`camera` matrix is singular"),
        ("points", {"inlier_threshold": 0.0}, "positive `inlier_threshold`"),
        ("points", {"time_limit": -1.0}, "positive `time_limit`"),
        ("points", {"clutter": 1.5}, "`clutter`"),
        ("points", {"solver": "serch"}, '`solver` "auto", "search"'),
        ("points", {"device": "gpu0"}, "`device` of this machine"),
        ("points", {"prior": PosePrior(2 * np.eye(3), None, 5.0)}, "a rotation in `prior.rotation`"),
        ("points", {"prior": PosePrior(np.eye(3), np.zeros(2), 5.0)}, r"`prior.translation` of shape \(3,\)"),
        ("points", {"prior": PosePrior(np.eye(3), None, 0.0)}, "positive `prior.rotation_sigma_deg`"),
        ("points", {"prior": GravityPrior(np.zeros(3), np.ones(3), 1.0)}, "expected directions"),
        ("points", {"prior": "nothing.ckpt"}, "nothing.ckpt"),
        ("points", {"solver": "nothing.ckpt"}, "nothing.ckpt"),
        # What is known of the points.
        ("points", {"normals3d": 2 * P}, "expected unit vectors in `normals3d`, got .* at point 0; try to divide"),
        ("points", {"normals3d": np.ones((5, 3))}, r"`normals3d` of shape \(20, 3\) as `points3d`, got \(5, 3\)"),
        ("points", {"normals3d": np.full((20, 3), np.nan)}, "expected unit vectors in `normals3d`"),
        ("points", {"normals3d": [["a", "b", "c"]] * 20}, "expected `normals3d` as an array of numbers"),
        ("points", {"labels2d": np.zeros(20, int)}, "expected both `labels2d` and `labels3d`, or neither, got no"),
        ("labels", [np.zeros(5, int), np.zeros(20, int)], r"expected `labels2d` of shape \(20,\) as `points2d`, got"),
        ("labels", [np.zeros(20), np.zeros(20, int)], "expected integers in `labels2d`, got float64; try"),
        ("labels", [np.zeros(20, int), np.full(20, -2)], "labels of 0 or more, or -1 for any, in `labels3d`, got -2"),
        ("labels", [np.full((20, 4), 0.3), EVEN], "add up to 1 in `labels2d`"),
        ("labels", [EVEN, np.tile([1.5, -0.5, 0, 0], (20, 1))], "probabilities from 0 .* in `labels3d`"),
        ("labels", [EVEN, np.full((20, 5), 0.2)], "as many classes in `labels2d` as .*, got 4 and 5"),
        ("labels", [EVEN[1:], EVEN], r"in `labels2d` of shape \(20, c\)"),
        ("labels", [EVEN, np.zeros(20, int)], r"in `labels3d` of shape \(20, c\)"),
        ("labels", [np.full((20, 4), np.nan), EVEN], "in `labels2d`"),
        ("labels", [EVEN, None], "both `labels2d` and `labels3d`"),
        ("points", {"scores2d": np.ones(5)}, r"expected `scores2d` of shape \(20,\) as `points2d`, got \(5,\)"),
        ("points", {"scores3d": np.zeros(20)}, "probabilities above 0 and up to 1 in `scores3d`, got 0.0 at point 0"),
        ("points", {"scores3d": ["a"] * 20}, "expected `scores3d` as an array of numbers"),
        # A focal length that is not known.
        ("pixels", {"image_size": SIZE, "camera": K}, "a `camera` or the `image_size` .*, got both"),
        ("pixels", {"image_size": (480, 640)}, "inside the 480 x 640 pixels .* are width and height swapped"),
        ("pixels", {"image_size": (320, 200)}, "inside the 320 x 200 pixels .* try the size of the image"),
        ("pixels", {"camera": K * [[-1], [1], [1]]}, "focal lengths -.* and .*, which mirror the image; give positive"),
        ("pixels", {"camera": K * [[-1], [-1], [1]]}, "focal lengths -.* and -.*, which mirror the image"),
        ("pixels", {"image_size": (640.5, 480)}, "`image_size` as .width, height. in whole pixels"),
        ("pixels", {"image_size": 640}, "`image_size` as .width, height. in whole pixels"),
        ("pixels", {"image_size": SIZE, "focal_error": 0.1}, "`focal_error` beside a `camera`"),
        ("pixels", {"focal_error": 0.1}, "expected a `camera` whose focal length"),
        ("pixels", {"camera": K, "focal_error": 1.5}, "`focal_error` above 0 and below 1"),
        ("pixels", {"camera": K, "distortion": True}, "`distortion=True` needs an `image_size`"),
        # Directions.
        ("sky", {"points3d": 2 * P}, "expected unit vectors in `points3d`, got .* or points of a scene without"),
        ("sky", {"points3d": X}, r"expected `points3d` of shape \(k, 3\)"),
        ("sky", {"points2d": PIXELS[:2]}, "expected 3 or more points in `points2d`"),
        ("sky", {"points2d": X}, "expected pixels with a `camera`"),
        ("sky", {"camera": None}, "`points2d` has values .*, not normalised image coordinates"),
        ("sky", {"prior": NO_PRIOR}, "expected no `prior` with `at_infinity`, got Pose"),
        ("sky", {"normals3d": P}, "expected no `normals3d` with `at_infinity`"),
        ("sky", {"labels2d": [1], "labels3d": [1]}, "expected no `labels2d` with `at_infinity`"),
        ("sky", {"clutter": 0.2}, "expected no `clutter` with `at_infinity`"),
        ("sky", {"solver": "matcher-maps"}, "expected no `solver` with `at_infinity`"),
        ("sky", {"scores2d": np.zeros(20)}, "expected probabilities above 0"),
        ("sky", {"inlier_threshold": -1}, "expected a positive `inlier_threshold`"),
        # Several cameras.
        ("rig", {"camera": [CAMERA]}, "expected 2 of `camera`, one a camera of the `rig`, got 1"),
        ("rig", {"rig": [np.eye(4)]}, "expected 1 of `points2d`, one a camera of the `rig`, got 2"),
        ("rig", {"rig": [np.eye(4), np.eye(3)]}, r"`rig\[1\]` as cam_from_rig, \(3, 4\), \(4, 4\) or \(R, t\)"),
        ("rig", {"rig": [np.eye(4), 2 * np.eye(4)]}, r"expected a rotation in `rig\[1\].rotation`"),
        ("rig", {"prior": GravityPrior([0, 1, 0], [0, 1, 0])}, "expected no `prior` with `rig`"),
        ("rig", {"scores3d": np.ones(20)}, "expected no `scores3d` with `rig`"),
        ("rig", {"image_size": SIZE}, "expected no `image_size` with `rig`"),
        ("rig", {"solver": "matcher-sfm"}, "expected no `solver` with `rig`"),
        ("rig", {"points2d": [np.zeros((3, 2)), np.zeros((5, 2))]}, "camera 0: .* points in `points2d`, got 3"),
        ("rig", {"labels2d": [np.zeros(6, int)]}, "expected 2 of `labels2d`"),
        ("rig", {"scale": True}, "expected cameras that are apart in `rig` with `scale=True`, got one centre for all"),
        ("rig", {"scale": True, "rig": None}, "expected a `rig` with `scale=True`, got none"),
        # Several problems.
        ("many", {"points2d": [X, X[:3]], "points3d": [P, P]}, "problem 1: .* points in `points2d`, got 3"),
        ("many", {"points2d": [X], "points3d": [P, P]}, "1 of `points3d`, one a problem, got 2"),
        ("many", {"points2d": X}, r"`points2d` as a sequence of arrays, one a problem, got shape \(20, 2\)"),
        ("many", {"points2d": [], "points3d": []}, "one array a problem in `points2d`, got 0"),
        ("many", {"points2d": 5}, "`points2d` as a sequence"),
        ("many", {"camera": [K]}, "2 of `camera`, one a problem, got 1"),
        ("many", {"prior": 3}, "`prior` as PosePrior, GravityPrior, a pose, BPnPNet"),
        ("many", {"prior": [None]}, "2 of `prior`, one a problem, got 1"),
        # A pose to verify.
        ("verify", {"rotation": 2 * np.eye(3)}, r"expected a rotation in `rotation`, R R\^T = I and det R = 1"),
        ("verify", {"rotation": np.diag([1, 1, -1.0])}, "expected a rotation in `rotation`"),
        ("verify", {"rotation": np.eye(4)}, r"expected finite `rotation` of shape \(3, 3\)"),
        ("verify", {"translation": [0, 0, np.nan]}, "expected finite `translation`"),
        ("verify", {"matches": [[0, 0], [0, 1]]}, "each point in one of the `matches`, got 2D point 0 in 2"),
        ("verify", {"matches": [[0, 900]]}, "expected `matches` below"),
        ("verify", {"matches": [0, 1]}, "expected `matches` as integers of shape"),
        ("verify", {"time_limit": -1}, "expected a positive `time_limit`"),
        ("verify", {"inlier_threshold": 0}, "expected a positive `inlier_threshold`"),
    ],
)
def test_a_mistake_is_one_clear_error(call: str, change: Any, message: str) -> None:
    if call == "labels":
        call, change = "points", {"labels2d": change[0], "labels3d": change[1]}
    elif call == "pixels":
        call, change = "points", {"points2d": PIXELS} | change
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        CALLS[call](**change)


@pytest.mark.parametrize(
    ("outside", "count", "refused"), [(1.8, 1, False), (1.8, 20, False), (30.0, 1, False), (30.0, 5, True)]
)
def test_the_fraction_of_points_outside_tells_a_wrong_image_size(outside: float, count: int, refused: bool) -> None:
    """Detectors put keypoints slightly outside; of a hundred, one may be far outside."""
    pixels = np.random.default_rng(0).uniform(0, 100, (100, 2)) * (6.4, 4.8)
    pixels[:count, 0] = 640 + outside
    if refused:
        with pytest.raises(ValueError, match="5 of 100 outside, such as \\[670.0"):
            check_inside(pixels, (640, 480))
    else:
        check_inside(pixels, (640, 480))


@pytest.mark.parametrize("value", ["1", [1.0], True, 0, -1.0, np.nan])
def test_what_is_no_positive_number_is_named(value: Any) -> None:
    with pytest.raises(ValueError, match="expected a positive `time_limit`, got"):
        positive("time_limit", value)


@pytest.mark.parametrize("value", [1.5, "1", None, -1, True])
def test_a_seed_is_a_whole_number(value: Any) -> None:
    with pytest.raises(ValueError, match="`seed` is .*; it is a whole number, 0 or more"):
        checked_seed(value)
    assert checked_seed(np.int64(3)) == 3


@pytest.mark.parametrize("params", [(-800, 800, 320, 240), (800, -800, 320, 240), (800, 0, 320, 240)])
def test_each_focal_length_is_positive(params: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="focal length of a camera has to be positive"):
        camera_from(("PINHOLE", params))


def test_a_pose_matrix_has_the_last_row_of_one() -> None:
    with pytest.raises(ValueError, match=r"`prior` has the last row \[0.0, 0.0, 1.0, 1.0\]"):
        checked_prior(np.eye(4) + np.eye(4, k=-1))
    with pytest.raises(ValueError, match="a rotation in `prior.rotation`"):
        checked_prior((2 * np.eye(3), np.zeros(3)))
