"""Pose and focal length together, on planted points and cameras."""

import json
import math
import re
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from planted import degrees_between
from scipy.spatial.transform import Rotation

from bpnp import Solution, solve
from bpnp.arrays import Array
from bpnp.cameras import Camera, camera_from, camera_to_json
from bpnp.search.assemble import Solved
from bpnp.search.focal_length import FocalSweep, fit_camera, is_within_bound, unknown_camera
from bpnp.search.inputs import problem_from
from bpnp.search.problem import Problem, UnknownFocal
from bpnp.search.solution import FOCAL_LENGTH, POSE_PARAMETERS, SCALE, Candidate, SolutionStats
from bpnp.search.solvers import Options
from bpnp.search.verdict.decide import Case

SIZE = (640, 480)
LIMIT = 300.0  # seconds, more than any of them takes


def planted(
    focal: float, *, points: int = 60, depth: float = 1.0, distance: float = 4.0, radial: float = 0.0, seed: int = 0
) -> tuple[Array, Array, Array]:
    """Pixels of points in random order, with half a pixel of noise, the points, and the rotation."""
    rng = np.random.default_rng(seed)
    scene = rng.uniform(-1, 1, (points, 3)) * [1, 1, depth]
    rotation = Rotation.from_rotvec([0.2, -0.3, 0.4]).as_matrix() if depth else np.eye(3)
    translation = np.array([0.1, -0.1, distance * focal / 600])
    camera = camera_from(("SIMPLE_RADIAL", (focal, 320.0, 240.0, radial)))
    pixels = camera.project(scene @ rotation.T + translation) + 0.5 * rng.standard_normal((points, 2))
    order = rng.permutation(np.flatnonzero(((pixels >= 0) & (pixels <= SIZE)).all(1)))
    return pixels[order], scene, rotation


@pytest.fixture(scope="module")
def found() -> tuple[Solution, Array]:
    pixels, scene, rotation = planted(900.0)
    return solve(pixels, scene, image_size=SIZE, solver="search", time_limit=LIMIT), rotation


@pytest.mark.slow
def test_pose_and_focal_length_are_found_together(found: tuple[Solution, Array]) -> None:
    solution, rotation = found
    assert degrees_between(solution.rotation, rotation) < 0.5
    assert abs(solution.focal_length - 900) < 4 * solution.focal_length_std < 120
    assert solution.verdict == "confident"
    assert solution.covariance.shape == (7, 7)
    pose = [f"{part}_{axis}" for part in ("rotation", "translation") for axis in "xyz"]
    assert solution.parameters == (*pose, "focal_length")
    again = Solution.from_json(solution.to_json())
    np.testing.assert_array_equal(again.covariance, solution.covariance)
    assert again.parameters == solution.parameters
    assert again.focal_length == solution.focal_length


def test_the_uncertainty_of_the_focal_length_holds_those_within_its_bound(found: tuple[Solution, Array]) -> None:
    """The bound of 99.9 % is about 3.3 standard deviations at a fixed rotation, which the information matrix has."""
    solution, _ = found
    names = [solution.parameters.index(name) for name in ("rotation_x", "rotation_y", "rotation_z", "focal_length")]
    information = np.linalg.inv(solution.covariance[np.ix_(names, names)])
    sigma = information[3, 3] ** -0.5 / solution.focal_length
    claimed = [is_within_bound(solution, solution.rotation, math.exp(k * sigma)) for k in (-10, -1, 1, 10)]
    assert claimed == [False, True, True, False]


def test_the_nfa_and_the_covariance_count_the_focal_length(found: tuple[Solution, Array]) -> None:
    pixels, scene, _ = planted(900.0)
    known = solve(pixels, scene, found[0].camera, solver="search", time_limit=LIMIT)
    assert known.log10_false_alarms < found[0].log10_false_alarms - 1
    assert known.covariance.shape == (6, 6)
    assert known.parameters == found[0].parameters[:6]
    assert known.focal_length_std == 0
    assert known.centre_std < found[0].centre_std


@pytest.mark.slow
def test_the_verdict_names_a_wrong_focal_length() -> None:
    pixels, scene, _ = planted(800.0, points=150)
    right, wrong = (solve(pixels, scene, ("SIMPLE_PINHOLE", (focal, 320.0, 240.0))) for focal in (800.0, 1000.0))
    assert (right.verdict, wrong.verdict) == ("confident", "ambiguous")
    named = re.search(r"With ([\d.]+) times the focal length", wrong.reason)
    assert named is not None
    assert float(named[1]) == pytest.approx(0.8, rel=0.03)


@pytest.mark.nightly
def test_a_plane_seen_from_the_front_leaves_the_focal_length_open() -> None:
    pixels, scene, rotation = planted(700.0, depth=0.0)
    solution = solve(pixels, scene, image_size=SIZE, solver="search", time_limit=LIMIT)
    assert degrees_between(solution.rotation, rotation) < 10
    assert solution.verdict == "ambiguous"
    assert not solution.focal_length_std < 0.05 * solution.focal_length


@pytest.mark.nightly
def test_a_rough_focal_length_is_a_prior() -> None:
    """A distant scene shows little perspective, so that the given focal length counts."""
    pixels, scene, rotation = planted(700.0, distance=12.0)
    camera = ("SIMPLE_PINHOLE", (735.0, 320.0, 240.0))
    stds = []
    for error in (0.02, 0.2):
        solution = solve(pixels, scene, camera, focal_error=error, solver="search", time_limit=LIMIT)
        assert degrees_between(solution.rotation, rotation) < 3
        stds.append(solution.focal_length_std / solution.focal_length)
    assert stds[0] < 0.021
    assert stds[1] > stds[0]


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("radial", [-0.3, 0.25, 0.0])
def test_distortion_is_found_where_it_is_significantly_better(radial: float) -> None:
    """The distortion is not given. Without its coefficient the focal length would be wrong by many sigma."""
    pixels, scene, rotation = planted(600.0, points=150, radial=radial, distance=3.0)
    solution = solve(pixels, scene, image_size=SIZE, solver="search", time_limit=LIMIT)
    camera = json.loads(solution.to_json())["camera"]
    assert camera["model"] == ("SIMPLE_PINHOLE" if radial == 0 else "SIMPLE_RADIAL")
    assert radial == 0 or camera["params"][3] == pytest.approx(radial, abs=0.05)
    assert degrees_between(solution.rotation, rotation) < 0.5
    assert abs(solution.focal_length - 600) < 3 * solution.focal_length_std < 30
    assert solution.verdict == "confident"


@pytest.mark.slow
@pytest.mark.parametrize("radial", [-0.4, 0.4])
def test_a_strong_distortion_is_found_among_dense_points(radial: float) -> None:
    """The fit starts from the true pose and focal length. Without distortion few of 1,200 points match correctly."""
    rng = np.random.default_rng(0)
    scene = rng.uniform(-1, 1, (1200, 3)) * [2.2, 1.8, 1]
    pose = Rotation.from_rotvec([0.2, -0.3, 0.4]).as_matrix(), np.array([0.1, -0.1, 4.0])
    camera = camera_from(("SIMPLE_RADIAL", (600.0, 320.0, 240.0, radial)))
    pixels = camera.project(scene @ pose[0].T + pose[1]) + 0.5 * rng.standard_normal((1200, 2))
    pixels = pixels[((pixels >= 0) & (pixels <= SIZE)).all(1)]
    pixels = np.concatenate([pixels[: len(pixels) // 2], SIZE * rng.random((600, 2))])

    def problem_at(lens: Camera, focal: UnknownFocal | None = None) -> Problem:
        return problem_from(pixels, scene, lens, focal=focal)

    unknown = unknown_camera(None, SIZE, None)
    unknown = unknown.seen_by(problem_at(unknown.reference))
    fitted = camera_to_json(fit_camera(problem_at, unknown, unknown.at(600 / 640), pose, 1e-3, seed=0).camera)
    assert isinstance(fitted, dict)
    assert fitted["params"] == pytest.approx([600, 320, 240, radial], rel=0.01)


@pytest.mark.nightly
def test_distortion_true_always_fits_a_coefficient() -> None:
    pixels, scene, _ = planted(600.0, points=150, distance=3.0)
    solution = solve(pixels, scene, image_size=SIZE, distortion=True, solver="search", time_limit=LIMIT)
    camera = json.loads(solution.to_json())["camera"]
    assert camera["model"] == "SIMPLE_RADIAL"
    assert camera["params"][3] == pytest.approx(0, abs=0.05)
    without = solve(pixels, scene, image_size=SIZE, solver="search", time_limit=LIMIT)
    assert without.log10_false_alarms < solution.log10_false_alarms  # which counts one unknown less


@pytest.mark.slow
def test_a_rough_pinhole_camera_may_be_distorted_and_one_with_distortion_keeps_it() -> None:
    pixels, scene, rotation = planted(600.0, points=150, radial=-0.3, distance=3.0)
    known: dict[str, Any] = {"focal_error": 0.1, "solver": "search", "time_limit": LIMIT}
    solution = solve(pixels, scene, ("PINHOLE", (630.0, 630.0, 320.0, 240.0)), **known)
    assert degrees_between(solution.rotation, rotation) < 0.5
    assert json.loads(solution.to_json())["camera"]["params"][-1] == pytest.approx(-0.3, abs=0.05)
    assert abs(solution.focal_length - 600) < 3 * solution.focal_length_std
    kept = solve(pixels, scene, ("SIMPLE_RADIAL", (630.0, 320.0, 240.0, -0.3)), **known)
    assert json.loads(kept.to_json())["camera"]["params"][3] == -0.3
    assert degrees_between(kept.rotation, rotation) < 0.5
    with pytest.raises(ValueError, match="`distortion=True` needs a pinhole `camera`"):
        solve(pixels, scene, ("SIMPLE_RADIAL", (630.0, 320.0, 240.0, -0.3)), distortion=True, **known)
    with pytest.raises(ValueError, match="`distortion=True` needs an `image_size`, or a `focal_error`"):
        solve(pixels, scene, ("SIMPLE_PINHOLE", (630.0, 320.0, 240.0)), distortion=True)


@pytest.mark.parametrize("radial", [-0.3, 0.3])
def test_a_given_camera_is_kept_and_a_better_camera_model_makes_the_pose_ambiguous(radial: float) -> None:
    camera = ("SIMPLE_PINHOLE", (600.0, 320.0, 240.0))
    pixels, scene, _ = planted(600.0, points=150, radial=radial, distance=3.0)
    solution = solve(pixels, scene, camera, solver="search", time_limit=LIMIT)
    assert solution.verdict == "ambiguous"
    named = re.search(r"a radial distortion of (\S+)", solution.reason)
    assert named is not None
    assert float(named[1]) == pytest.approx(radial, abs=0.05)
    assert json.loads(solution.to_json())["camera"] == camera_to_json(camera_from(camera))
    known = solve(pixels, scene, ("SIMPLE_RADIAL", (600.0, 320.0, 240.0, radial)), solver="search", time_limit=LIMIT)
    assert known.verdict == "confident"


class PlantedSweep(FocalSweep):
    """A sweep whose solutions are given."""

    def solve_with(self, camera: Camera, options: Options) -> Solved:
        raise NotImplementedError

    def refine(self, solution: Solution, camera: Camera, zooms: Sequence[float] = (1.0,)) -> Camera:
        raise NotImplementedError


@pytest.mark.parametrize("unit", [1.0, 1e-3])
def test_the_unit_of_a_scene_hides_no_pose_at_another_focal_length(unit: float) -> None:
    """A rig in metres, 5 and 10 m from a scene in metres or millimetres: two poses that fit equally well."""
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3)) + [0, 0, 5]

    def end(distance: float, focal: float, log10_nfa: float) -> Solved:
        pose = Candidate(np.eye(3), np.array([0, 0, distance - 5]), 0.0, 20, log10_nfa, scale=unit)
        solution = Solution(
            rotation=pose.rotation,
            translation=pose.translation,
            scale=unit,
            log10_false_alarms=log10_nfa,
            candidates=(pose,),
            matches=np.repeat(np.arange(20)[:, None], 2, 1),
            covariance=1e-8 * np.eye(8),
            parameters=(*POSE_PARAMETERS, FOCAL_LENGTH, SCALE),
            camera=camera_from(("SIMPLE_PINHOLE", (focal, 320.0, 240.0))),
            unit="px",
            verdict="confident",
            reason="",
            stats=SolutionStats(),
            points2d=np.zeros((20, 2)),
            points3d=points / unit,
        )
        return Solved(Case.without_pose(Problem(np.eye(3), np.eye(3))), solution)

    ends = [end(5.0, 800.0, -20.0), end(10.0, 1000.0, -19.0)]
    other = PlantedSweep(unknown_camera(None, SIZE, None), Options(), ends=ends).other_focal_length()
    assert other is not None
    assert (other.code, other.margin) == ("other_focal_length", pytest.approx(1.0))
