"""Errors of `solve`, `solve_many` and `verify`: each names the wrong argument."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from planted import plant

from bpnp import GravityPrior, PosePrior, solve, solve_many, verify
from bpnp.search.arguments import check_inside, checked_prior, checked_seed, each_prior, positive

K = np.array([[520.0, 1.5, 405.0], [0.0, 500.0, 290.0], [0.0, 0.0, 1.0]])
CAMERA = ("SIMPLE_PINHOLE", [500.0, 320.0, 240.0])
PLANTED = plant(1, 20)
X, P = PLANTED.points2d[0].numpy(), PLANTED.points3d[0].numpy()
PIXELS = np.r_[500 * X[:19] + [320, 240], [[600.0, 240.0]]]
SIZE = (640, 480)
WITH_NAN = np.where(np.arange(20)[:, None] == 7, np.nan, P)
EVEN = np.full((20, 4), 0.25)  # class probabilities
SEEN: dict[str, Any] = {"points2d": X, "points3d": P}
RIG: dict[str, Any] = {"points2d": [PIXELS[:6], PIXELS[6:12]], "points3d": P}
RIG |= {"camera": [CAMERA] * 2, "rig": [np.eye(4)] * 2}
CALLS: dict[str, Any] = {
    "points": partial(solve, **SEEN),
    "rig": partial(solve, **RIG),
    "many": partial(solve_many, points2d=[X, X], points3d=P),
    "verify": partial(verify, **SEEN, rotation=np.eye(3), translation=[0, 0, 5.0]),
}


@pytest.mark.parametrize(
    ("call", "change", "message"),
    [
        ("points", {"points2d": X[:3]}, "`points2d` has 3 points; at least 4 are needed"),
        ("points", {"points3d": P[:3]}, "`points3d` has 3 points; at least 4 are needed"),
        ("points", {"points2d": X[:0]}, "`points2d` has 0 points; at least 4 are needed"),
        ("points", {"points3d": WITH_NAN}, "`points3d` is .* at point 7; all numbers must be finite"),
        ("points", {"points2d": X + np.inf}, "`points2d` is .*; all numbers must be finite"),
        ("points", {"points2d": P, "points3d": X}, "swapped"),
        ("points", {"points2d": P}, "unit bearings, but one has the length .* swapped"),
        ("points", {"points2d": P, "points3d": X, "camera": K}, "swapped"),
        ("points", {"points3d": X}, r"`points3d` has the shape \(20, 2\), not .*3\).* swapped"),
        (
            "points",
            {"points2d": X.T},
            r"`points2d` has the shape \(2, 20\), not \(k, 2\) or \(k, 3\); give one row per point",
        ),
        ("points", {"points2d": X[:, 0]}, r"`points2d` has the shape \(20,\)"),
        ("points", {"points3d": "points.npy"}, "`points3d` is 'points.npy'; an array of numbers is needed"),
        ("points", {"points2d": X.astype(complex)}, "`points2d` is .*; an array of numbers is needed"),
        ("points", {"points2d": None}, "`points2d` is .*; an array of numbers is needed"),
        ("points", {"points2d": PIXELS}, "look like pixels; try camera=K"),
        ("points", {"camera": K}, "look normalised"),
        ("points", {"points2d": PIXELS, "camera": np.eye(3)}, "lie 90 degrees from the axis .* length is 1 pixels"),
        ("points", {"points2d": PIXELS, "camera": np.diag([500.0, 0, 1])}, "`camera` matrix is singular"),
        ("points", {"inlier_threshold": 0.0}, "`inlier_threshold` is .*; it must be a positive number"),
        ("points", {"time_limit": -1.0}, "`time_limit` is -1.0; it must be a positive number"),
        ("points", {"clutter": 1.5}, "`clutter` is 1.5; it is a fraction of the points"),
        ("points", {"clutter": 1.5, "points3d": np.zeros((20, 3))}, "`clutter` is 1.5"),  # although nothing is searched
        ("points", {"solver": "serch"}, '`solver` is .serch.; it is "auto", "search"'),
        ("points", {"device": "gpu0"}, "this machine has no `device` gpu0"),
        ("points", {"prior": PosePrior(2 * np.eye(3), None, 5.0)}, "`prior.rotation` is no rotation matrix"),
        (
            "points",
            {"prior": PosePrior(np.eye(3), np.zeros(2), 5.0)},
            r"`prior.translation` is .*; finite numbers of shape \(3,\)",
        ),
        (
            "points",
            {"prior": PosePrior(np.eye(3), None, 0.0)},
            "`prior.rotation_sigma_deg` is 0.0; it must be a positive number",
        ),
        (
            "points",
            {"prior": GravityPrior(np.zeros(3), np.ones(3), 1.0)},
            "`prior` is GravityPrior.*; its directions must not be zero",
        ),
        (
            "points",
            {"prior": PosePrior(np.eye(3), None, None)},  # type: ignore[arg-type]
            "`prior.rotation_sigma_deg` is None; it must be a positive number",
        ),
        (
            "points",
            {"prior": PosePrior(np.eye(3), np.ones(3), 5.0, None)},  # type: ignore[arg-type]
            "`prior.translation_sigma` is None; it must be a positive number",
        ),
        (
            "points",
            {"prior": GravityPrior(np.ones(3), np.ones(3), "2")},  # type: ignore[arg-type]
            "`prior.sigma_deg` is '2'; it must be a positive number",
        ),
        ("points", {"prior": "nothing.ckpt"}, "nothing.ckpt"),
        ("points", {"solver": "nothing.ckpt"}, "nothing.ckpt"),
        # What is known of the points.
        ("points", {"normals3d": 2 * P}, "`normals3d` is .* at point 0; unit vectors are needed: divide"),
        (
            "points",
            {"normals3d": np.ones((5, 3))},
            r"`normals3d` has the shape \(5, 3\), not \(20, 3\) for these `points3d`",
        ),
        ("points", {"normals3d": np.full((20, 3), np.nan)}, "`normals3d` is .*nan.*; unit vectors are needed"),
        ("points", {"normals3d": [["a", "b", "c"]] * 20}, "`normals3d` is .*; an array of numbers is needed"),
        ("points", {"labels2d": np.zeros(20, int)}, "`labels3d` is missing; give both `labels2d` and `labels3d`"),
        (
            "labels",
            [np.zeros(5, int), np.zeros(20, int)],
            r"`labels2d` has the shape \(5,\), not \(20,\) for these `points2d`",
        ),
        ("labels", [np.zeros(20), np.zeros(20, int)], "`labels2d` has the type float64; labels are integers: use"),
        (
            "labels",
            [np.zeros(20, int), np.full(20, -2)],
            "`labels3d` has the label -2; labels are 0 or more, or -1 for any",
        ),
        (
            "labels",
            [np.arange(20, dtype=np.uint64) + np.uint64(2**63), np.arange(20)],
            "`labels2d` has the label 9223372036854775827; labels are below 2.63: number them from 0",
        ),
        ("labels", [np.full((20, 4), 0.3), EVEN], "`labels2d` is .*; probabilities are 0 or more and add up to 1"),
        (
            "labels",
            [EVEN, np.tile([1.5, -0.5, 0, 0], (20, 1))],
            "`labels3d` is .*; probabilities are 0 or more and add up to 1",
        ),
        ("labels", [EVEN, np.full((20, 5), 0.2)], "`labels2d` has 4 classes and `labels3d` 5"),
        ("labels", [EVEN[1:], EVEN], r"`labels2d` has the shape \(19, 4\); .* of shape \(20, c\)"),
        ("labels", [EVEN, np.zeros(20, int)], r"`labels3d` has the shape \(20,\); .* of shape \(20, c\)"),
        ("labels", [np.full((20, 4), np.nan), EVEN], "`labels2d` is .*nan"),
        ("labels", [EVEN, None], "`labels3d` is missing; give both `labels2d` and `labels3d`"),
        ("points", {"scores2d": np.ones(5)}, r"`scores2d` has the shape \(5,\), not \(20,\) for these `points2d`"),
        ("points", {"scores3d": np.zeros(20)}, "`scores3d` is 0.0 at point 0; scores are above 0 and at most 1"),
        ("points", {"scores3d": ["a"] * 20}, "`scores3d` is .*; an array of numbers is needed"),
        # A focal length that is not known.
        ("pixels", {"image_size": SIZE, "camera": K}, "`camera` and `image_size` exclude each other"),
        ("pixels", {"image_size": (480, 640)}, "outside the 480 x 640 pixels .* are width and height swapped"),
        ("pixels", {"image_size": (320, 200)}, "outside the 320 x 200 pixels .* give the size of the image"),
        ("pixels", {"camera": K * [[-1], [1], [1]]}, "focal lengths -.* and .*, which mirror the image; give positive"),
        ("pixels", {"camera": K * [[-1], [-1], [1]]}, "focal lengths -.* and -.*, which mirror the image"),
        ("pixels", {"image_size": np.array([480, 640])}, "outside the 480 x 640 pixels"),
        ("pixels", {"image_size": (640.5, 480)}, "`image_size` is .640.5, 480.; it is .width, height. in whole pixels"),
        ("pixels", {"image_size": 640}, "`image_size` is 640; it is .width, height. in whole pixels"),
        (
            "pixels",
            {"image_size": SIZE, "focal_error": 0.1},
            "`focal_error` needs a `camera` and has no meaning with `image_size`",
        ),
        ("pixels", {"focal_error": 0.1}, "`focal_error` needs the `camera`"),
        (
            "pixels",
            {"camera": K, "focal_error": 1.5},
            "`focal_error` is 1.5; it is a fraction of the focal length, above 0 and below 1",
        ),
        ("pixels", {"camera": K, "distortion": True}, "`distortion=True` needs an `image_size`"),
        # Directions.
        # Several cameras.
        ("rig", {"camera": [CAMERA, None]}, "`camera` is None for camera 1 of the `rig`, but not for all"),
        ("rig", {"camera": [CAMERA]}, "`camera` has the length 1, but the `rig` has 2 cameras"),
        ("rig", {"rig": [np.eye(4)]}, "`points2d` has the length 2, but the `rig` has 1 cameras"),
        (
            "rig",
            {"rig": [np.eye(4), np.eye(3)]},
            r"`rig\[1\]` has the shape \(3, 3\); give cam_from_rig as \(R, t\), a matrix",
        ),
        ("rig", {"rig": [np.eye(4), np.diag([2, 2, 2, 1])]}, r"`rig\[1\].rotation` is no rotation matrix"),
        ("rig", {"rig": [np.eye(4), 2 * np.eye(4)]}, r"`rig\[1\]` has the last row .*; that of a pose is 0, 0, 0, 1"),
        ("rig", {"prior": "learned"}, "`prior` is the network 'learned', but networks are trained for .* one camera"),
        ("rig", {"scores3d": np.ones(19)}, r"camera 0: `scores3d` has the shape \(19,\), not \(20,\)"),
        ("rig", {"scores2d": [np.ones(6)]}, "`scores2d` has the length 1, but the `rig` has 2 cameras"),
        ("rig", {"clutter": 1.0}, "`clutter`"),
        ("rig", {"image_size": SIZE}, "`camera` and `image_size` exclude each other"),
        ("rig", {"solver": "matcher-sfm"}, "`solver` is 'matcher-sfm', but networks are trained for .* one camera"),
        ("rig", {"points2d": [np.zeros((3, 2)), np.zeros((5, 2))]}, "camera 0: `points2d` has 3 points"),
        ("rig", {"labels2d": [np.zeros(6, int)]}, "`labels2d` has the length 1, but the `rig` has 2 cameras"),
        ("rig", {"scale": True}, "all cameras of the `rig` have one centre"),
        ("rig", {"scale": True, "rig": None}, "`scale=True` needs a `rig`"),
        # Several problems.
        ("many", {"points2d": [X, X[:3]], "points3d": [P, P]}, "problem 1: `points2d` has 3 points"),
        ("many", {"points2d": [X], "points3d": [P, P]}, "`points3d` has the length 2, but the number of problems is 1"),
        (
            "many",
            {"points2d": X},
            r"`points2d` has the shape \(20, 2\); a sequence of arrays is needed, one per problem",
        ),
        ("many", {"points2d": [], "points3d": []}, "`points2d` is empty; it holds one array per problem"),
        ("many", {"points2d": 5}, "`points2d` is 5; a sequence of arrays"),
        ("many", {"camera": [K]}, "`camera` has the length 1, but the number of problems is 2"),
        ("many", {"prior": 3}, "`prior` is 3; give a PosePrior, a GravityPrior, a pose"),
        ("many", {"prior": [None]}, "`prior` has the length 1, but the number of problems is 2"),
        # A pose to verify.
        ("verify", {"rotation": 2 * np.eye(3)}, r"`rotation` is no rotation matrix, R R\^T = I and det R = 1"),
        ("verify", {"rotation": np.diag([1, 1, -1.0])}, "`rotation` is no rotation matrix"),
        ("verify", {"rotation": np.eye(2)}, r"`rotation` is .*; finite numbers of shape \(3, 3\)"),
        ("verify", {"translation": [0, 0, np.nan]}, "`translation` is .*nan.*; finite numbers"),
        ("verify", {"matches": [[0, 0], [0, 1]]}, "2D point 0 is in 2 of the `matches`; a point has one at most"),
        (
            "verify",
            {"matches": [[0, 900]]},
            "`matches` has indices from .0, 900. to .0, 900.; there are 20 2D and 20 3D points",
        ),
        ("verify", {"matches": [0, 1]}, "`matches` has the shape .2,.; pairs of indices are needed"),
        ("verify", {"time_limit": -1}, "`time_limit` is -1; it must be a positive number"),
        ("verify", {"inlier_threshold": 0}, "`inlier_threshold` is .*; it must be a positive number"),
    ],
)
def test_a_mistake_is_one_clear_error(call: str, change: Any, message: str) -> None:
    if call == "labels":
        call, change = "points", {"labels2d": change[0], "labels3d": change[1]}
    elif call == "pixels":
        call, change = "points", {"points2d": PIXELS} | change
    with pytest.raises((ValueError, FileNotFoundError), match=message) as error:
        CALLS[call](**change)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("outside", "count", "refused"), [(1.8, 1, False), (1.8, 20, False), (30.0, 1, False), (30.0, 5, True)]
)
def test_many_points_outside_the_image_are_a_wrong_image_size(outside: float, count: int, refused: bool) -> None:
    """Detectors put keypoints slightly outside; of a hundred, one may be far outside."""
    pixels = np.random.default_rng(0).uniform(0, 100, (100, 2)) * (6.4, 4.8)
    pixels[:count, 0] = 640 + outside
    if refused:
        with pytest.raises(ValueError, match="5 of 100 `points2d` are outside .* such as \\[670.0"):
            check_inside(pixels, (640, 480))
    else:
        check_inside(pixels, (640, 480))


@pytest.mark.parametrize("value", ["1", [1.0], True, 0, -1.0, np.nan])
def test_a_value_that_is_no_positive_number_is_named(value: Any) -> None:
    with pytest.raises(ValueError, match="`time_limit` is .*; it must be a positive number"):
        positive("time_limit", value)


@pytest.mark.parametrize("value", [1.5, "1", None, -1, True])
def test_a_seed_is_a_whole_number(value: Any) -> None:
    with pytest.raises(ValueError, match="`seed` is .*; it is a whole number, 0 or more"):
        checked_seed(value)
    assert checked_seed(np.int64(3)) == 3


def test_priors_of_many_problems_are_one_or_a_list_of_them() -> None:
    """A matrix of lists is one prior, and four poses are four priors."""
    matrix, pose = np.eye(4)[:3].tolist(), PosePrior(np.eye(3), None, 5.0)
    assert each_prior(matrix, 3) == [matrix] * 3
    parts = [np.eye(3), np.ones(3)]
    assert each_prior(parts, 2) == [parts] * 2
    assert each_prior([parts] * 2, 2) == [parts] * 2
    assert each_prior([np.eye(4)] * 4, 4)[3].shape == (4, 4)
    assert each_prior([pose] * 4, 4) == [pose] * 4
    assert each_prior([matrix, None, matrix], 3) == [matrix, None, matrix]


def test_a_pose_matrix_has_the_last_row_of_one() -> None:
    with pytest.raises(ValueError, match=r"`prior` has the last row \[0.0, 0.0, 1.0, 1.0\]"):
        checked_prior(np.eye(4) + np.eye(4, k=-1))
    with pytest.raises(ValueError, match="`prior.rotation` is no rotation matrix"):
        checked_prior((2 * np.eye(3), np.zeros(3)))
