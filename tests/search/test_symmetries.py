"""Motions of a scene onto itself, against planted symmetries; and what a search concludes from them."""

import numpy as np
import pytest
from planted import degrees_between
from scipy.spatial.transform import Rotation

import bpnp
from bpnp.arrays import Array
from bpnp.search.propose import symmetries
from bpnp.search.propose.symmetries import Motions, matching_tolerance, mirror_pose, self_motions


def parts(fold: int, each: int, unique: int, seed: int, axis: tuple[float, float, float] = (0, 0, 1)) -> Array:
    """`fold` copies of random points, turned about an axis, and unique points, in that order."""
    rng = np.random.default_rng(seed)
    base = rng.uniform(-1, 1, (each, 3))
    unit = np.array(axis) / np.linalg.norm(axis)
    turns = Rotation.from_rotvec([2 * np.pi * k / fold * unit for k in range(fold)]).as_matrix()
    return np.concatenate([*(base @ turn.T for turn in turns), rng.uniform(-1, 1, (unique, 3))])


def angles(motions: Motions) -> list[int]:
    return sorted(np.degrees(Rotation.from_matrix(motions.rotation).magnitude()).round().astype(int).tolist())


@pytest.mark.parametrize(
    ("fold", "expected"), [(2, [180]), (3, [120] * 2), (5, [72, 72, 144, 144]), (6, [60, 60, 120, 120, 180])]
)
@pytest.mark.parametrize("axis", [(0, 0, 1), (0.3, -0.5, 0.8)])
def test_all_rotations_of_a_symmetric_object_are_found(
    fold: int, expected: list[int], axis: tuple[float, float, float]
) -> None:
    points = parts(fold, 90 // fold, 8, 1, axis)
    motions = self_motions(points, 0.02)
    assert angles(motions) == expected
    np.testing.assert_allclose(motions.fraction, 90 / 98, atol=0.05)
    moved = points[:90] @ motions.rotation[0].T + motions.shift[0]
    nearest = np.linalg.norm(moved[:, None] - points, axis=-1).min(1)
    assert nearest.max() < 1e-9
    assert motions.left_out == 0


def test_a_motion_has_an_inverse_and_a_shift_too() -> None:
    base = np.random.default_rng(3).uniform(0, 1, (30, 3))
    motions = self_motions(np.concatenate([base, base + [5, 0, 0]]), 0.02)
    assert len(motions.shift) == 2
    np.testing.assert_allclose(np.sort(motions.shift[:, 0]), [-5, 5], atol=1e-6)
    np.testing.assert_allclose(motions.fraction, 0.5)


@pytest.mark.parametrize("seed", range(5))
def test_a_part_of_half_of_the_points_is_found(seed: int) -> None:
    assert 180 in angles(self_motions(parts(2, 25, 50, seed), 0.02))


def test_points_off_by_less_than_the_tolerance_are_mapped() -> None:
    rng = np.random.default_rng(5)
    points = parts(2, 20, 3, 5) + 0.006 * rng.normal(size=(43, 3))
    assert angles(self_motions(points, 0.04))[-1] == 180
    assert 180 not in angles(self_motions(points, 0.002))


@pytest.mark.parametrize("count", [10, 40, 300, 2000])
def test_random_points_have_no_motion(count: int) -> None:
    points = np.random.default_rng(count).uniform(-1, 1, (count, 3))
    spacing = count ** (-1 / 3)
    assert not len(self_motions(points, 0.1 * spacing).fraction)


@pytest.mark.parametrize("unit", [1e-6, 1e7])
def test_motions_do_not_depend_on_the_unit(unit: float) -> None:
    points = parts(3, 20, 5, 2)
    one, other = self_motions(points, 0.02), self_motions(unit * points, 0.02 * unit)
    np.testing.assert_allclose(other.rotation, one.rotation, atol=1e-6)
    np.testing.assert_allclose(other.shift / unit, one.shift, atol=1e-6)


def test_labels_and_normals_break_a_symmetry() -> None:
    points = parts(2, 25, 0, 4)
    labels = np.repeat([0, 1], 25)
    assert not len(self_motions(points, 0.02, labels3d=labels).fraction)
    assert len(self_motions(points, 0.02, labels3d=np.tile(np.arange(25), 2)).fraction) == 1
    outward = np.random.default_rng(1).normal(size=(25, 3))
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    turned = outward * (-1, -1, 1)
    assert len(self_motions(points, 0.02, normals3d=np.concatenate([outward, turned])).fraction) == 1
    assert not len(self_motions(points, 0.02, normals3d=np.concatenate([outward, -turned])).fraction)


def test_sources_are_the_points_that_are_moved() -> None:
    points = parts(2, 20, 60, 6)
    whole, part = self_motions(points, 0.02), self_motions(points, 0.02, sources=np.arange(20))
    assert max(whole.fraction) < 0.5
    assert part.fraction[0] == 1


def test_a_lattice_has_more_motions_than_are_ranked() -> None:
    lattice = np.stack(np.meshgrid(*[np.arange(8.0)] * 3), -1).reshape(-1, 3)
    assert self_motions(lattice, 0.05).left_out > 0


def part_and_copy(scale: float, each: int, unique: int, seed: int) -> tuple[Array, Array, Array]:
    """Return random points, their copy of another size and unique points, in that order; the rotation and the shift."""
    rng = np.random.default_rng(seed)
    base, turn, shift = rng.uniform(-1, 1, (each, 3)), Rotation.random(rng=rng).as_matrix(), np.array([3.0, -2, 1])
    copy = scale * base @ turn.T + shift
    return np.concatenate([base, copy, rng.uniform(-1, 4, (unique, 3))]), turn, shift


@pytest.mark.parametrize("scale", [0.3, 0.5, 0.7, 1.5, 3.0])
@pytest.mark.parametrize("unique", [0, 12])
def test_a_copy_of_another_size_is_found(scale: float, unique: int) -> None:
    points, turn, shift = part_and_copy(scale, 20, unique, 1)
    motions = self_motions(points, 0.02, least=0.2, bases=128, factor=4)
    there, back = (int(np.argmin(abs(motions.scale - size))) for size in (scale, 1 / scale))
    np.testing.assert_allclose(motions.scale[[there, back]], [scale, 1 / scale])
    np.testing.assert_allclose(motions.rotation[[there, back]], [turn, turn.T], atol=1e-9)
    np.testing.assert_allclose(motions.shift[[there, back]], [shift, -turn.T @ shift / scale], atol=1e-9)
    np.testing.assert_allclose(motions.fraction[[there, back]], 20 / len(points), atol=0.06)
    assert (self_motions(points, 0.02, least=0.2, bases=128).scale == 1).all()


def test_the_competitor_of_a_copy_of_another_size_projects_the_same_image() -> None:
    points, turn, shift = part_and_copy(0.4, 20, 0, 2)
    planted = Motions(turn[None], shift[None], np.array([0.4]), np.ones(1), 0.0)
    rotation, translation = Rotation.from_euler("xyz", [0.5, 0.2, 0.1]).as_matrix(), np.array([0.3, 0.1, 9.0])
    (other,), (moved,) = planted.competitors(rotation, translation)
    one, copy = points[:20] @ rotation.T + translation, points[20:] @ other.T + moved
    np.testing.assert_allclose(copy[:, :2] / copy[:, 2:], one[:, :2] / one[:, 2:])
    np.testing.assert_allclose(copy[:, 2], 0.4 * one[:, 2])
    np.testing.assert_allclose(planted.apply(points[:20])[0], points[20:])
    np.testing.assert_allclose(planted.inverse().apply(points[20:])[0], points[:20])


@pytest.mark.parametrize("unit", [1e-6, 1e7])
def test_a_copy_of_another_size_is_found_in_any_unit(unit: float) -> None:
    points, _, _ = part_and_copy(0.5, 25, 5, 3)
    one, other = (self_motions(size * points, 0.02 * size, factor=4) for size in (1.0, unit))
    np.testing.assert_allclose(np.sort(one.scale), [0.5, 2])
    np.testing.assert_allclose(other.scale, one.scale)
    np.testing.assert_allclose(other.shift / unit, one.shift, atol=1e-6)


def test_labels_and_normals_distinguish_a_copy_of_another_size() -> None:
    points, turn, _ = part_and_copy(0.5, 25, 0, 4)
    normals = np.random.default_rng(1).normal(size=(25, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    for labels, normals3d, count in [
        (np.tile(np.arange(25), 2), np.concatenate([normals, normals @ turn.T]), 2),
        (np.repeat([0, 1], 25), None, 0),
        (None, np.concatenate([normals, -normals @ turn.T]), 0),
    ]:
        assert len(self_motions(points, 0.02, labels3d=labels, normals3d=normals3d, factor=4).scale) == count


def test_the_tolerance_of_a_smaller_copy_is_smaller() -> None:
    points, turn, shift = part_and_copy(0.25, 30, 0, 5)
    points[30:] += 0.012 * np.random.default_rng(5).choice([-1, 1], (30, 3))  # 0.02 in all
    planted = Motions(turn[None], shift[None], np.array([0.25]), np.ones(1), 0.0)
    assert len(planted.of(points, np.arange(30), 0.1, 0.9).scale) == 1  # 0.025 at the size of the copy
    assert not len(planted.of(points, np.arange(30), 0.05, 0.9).scale)


@pytest.mark.parametrize("count", [10, 20, 40, 120, 400])
def test_random_points_have_no_copy_of_another_size(count: int) -> None:
    points = np.random.default_rng(count).uniform(-1, 1, (count, 3))
    assert (self_motions(points, 0.1 * count ** (-1 / 3), factor=4).scale == 1).all()


def test_the_mirror_image_of_a_plane_projects_to_the_same_points_from_afar() -> None:
    rng = np.random.default_rng(0)
    board = np.c_[rng.uniform(-1, 1, (20, 2)), np.zeros(20)]
    rotation, translation = Rotation.from_euler("xyz", [0.5, 0.2, 0.1]).as_matrix(), np.array([0.0, 0.0, 200.0])
    mirrored = mirror_pose(board, rotation, translation)
    assert mirrored is not None
    one, other = (board @ turn.T + shift for turn, shift in ((rotation, translation), mirrored))
    np.testing.assert_allclose(one[:, :2] / one[:, 2:], other[:, :2] / other[:, 2:], atol=5e-5)
    assert np.degrees(Rotation.from_matrix(rotation.T @ mirrored[0]).magnitude()) > 20
    assert mirror_pose(rng.uniform(-1, 1, (20, 3)), rotation, translation) is None


def mirrored_object(count: int, unique: int, seed: int) -> tuple[Array, Array, Array]:
    """Return an object of two mirrored halves and unique points, and the reflection p -> S p + d of the halves."""
    rng = np.random.default_rng([seed, 6])
    base, normal = rng.uniform(-1, 1, (count, 3)), rng.normal(size=3)
    reflection = np.eye(3) - 2 * np.outer(normal, normal) / (normal @ normal)
    shift = 0.4 * normal / np.linalg.norm(normal)
    halves = np.concatenate([base, base @ reflection.T + shift])
    return np.concatenate([halves, rng.uniform(-1, 1, (unique, 3))]), reflection, shift


@pytest.mark.parametrize("count", [8, 25, 60])
def test_the_reflection_of_a_mirror_symmetric_object_is_found(count: int) -> None:
    points, reflection, shift = mirrored_object(count, 5, count)
    found = self_motions(points, 0.01, reflected=True)
    np.testing.assert_allclose(found.rotation[0], reflection, atol=1e-6)
    np.testing.assert_allclose(found.shift[0], shift, atol=1e-6)
    np.testing.assert_allclose(found.fraction[0], 2 * count / (2 * count + 5))
    assert self_motions(points, 0.01).fraction.max(initial=0) < 0.6
    labels = np.r_[np.zeros(count), np.ones(count + 5)].astype(int)
    assert self_motions(points, 0.01, labels3d=labels, reflected=True).fraction.max(initial=0) < 0.6


def test_a_mirror_image_sees_the_reflected_object_at_the_same_place_from_afar() -> None:
    points, reflection, shift = mirrored_object(10, 0, 0)
    motions = Motions(reflection[None], shift[None], np.ones(1), np.ones(1), 0.0)
    rotation, translation = Rotation.from_euler("xyz", [0.5, 0.2, 0.1]).as_matrix(), np.array([1.0, 2.0, 400.0])
    (other,), (moved,) = motions.mirror_images(rotation, translation, points.mean(0))
    np.testing.assert_allclose(np.linalg.det(other), 1)
    one, two = points @ rotation.T + translation, (points @ reflection.T + shift) @ other.T + moved
    np.testing.assert_allclose(one[:, :2] / one[:, 2:], two[:, :2] / two[:, 2:], atol=3e-5)
    assert degrees_between(rotation, other) > 20


def seen_from_afar(count: int, seed: int) -> tuple[Array, Array, Array, Array]:
    """Return an image of a mirror-symmetric object with hidden points and other lights, its points, and the pose.

    The distance is 50 times the size, and the noise a hundredth of the size in the image.
    """
    rng = np.random.default_rng([seed, 9])
    points, _, _ = mirrored_object(count, 0, seed)
    rotation, translation = Rotation.random(rng=rng).as_matrix(), np.array([0.0, 0.0, 100.0])
    camera = points[rng.random(len(points)) < 0.8] @ rotation.T + translation
    image = camera[:, :2] / camera[:, 2:] + 1e-4 * rng.normal(size=(len(camera), 2))
    others = rng.uniform(image.min(0), image.max(0), (len(image) // 6, 2))
    return rng.permutation(np.concatenate([image, others])), rng.permutation(points), rotation, translation


def solved(points: Array, seed: int) -> tuple[bpnp.Solution, float]:
    rng = np.random.default_rng([seed, 7])
    rotation = Rotation.random(random_state=rng).as_matrix()
    camera = points @ rotation.T + [0.1, 0, 5]
    image = camera[:, :2] / camera[:, 2:] + 1e-3 * rng.normal(size=(len(points), 2))
    found = bpnp.solve(rng.permutation(image), rng.permutation(points), seed=seed, time_limit=30)
    return found, float(np.degrees(Rotation.from_matrix(rotation @ found.rotation.T).magnitude()))


@pytest.mark.slow
@pytest.mark.parametrize(("fold", "each", "unique"), [(3, 30, 8), (5, 18, 8), (2, 45, 8), (3, 7, 4), (5, 6, 4)])
@pytest.mark.parametrize("seed", range(2))
def test_unique_points_decide_between_the_rotations_of_an_object(fold: int, each: int, unique: int, seed: int) -> None:
    found, error = solved(parts(fold, each, unique, seed), seed)
    assert found.verdict == "confident"
    assert error < 2


@pytest.mark.slow
@pytest.mark.parametrize(("fold", "each"), [(3, 30), (2, 45), (3, 7), (5, 6)])
def test_an_exactly_symmetric_object_is_ambiguous(fold: int, each: int) -> None:
    found, error = solved(parts(fold, each, 0, 11), 0)
    assert found.verdict == "ambiguous"
    assert abs(error - 360 / fold * round(error * fold / 360)) < 3
    assert f"{360 // fold} deg" in found.reason or f"{720 // fold} deg" in found.reason


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 3, 6])
def test_a_mirror_symmetric_object_is_ambiguous_from_afar(seed: int) -> None:
    image, points, rotation, translation = seen_from_afar(8, seed)
    _, reflection, shift = mirrored_object(8, 0, seed)
    motions = Motions(reflection[None], shift[None], np.ones(1), np.ones(1), 0.0)
    (other,), _ = motions.mirror_images(rotation, translation, points.mean(0))
    found = bpnp.solve(image, points, seed=seed, time_limit=30)
    verified = bpnp.verify(image, points, rotation, translation, time_limit=30)
    for one in (found, verified):
        assert one.verdict == "ambiguous"
        assert one.reason_code == "competing_pose"
        assert min(degrees_between(pose.rotation, rotation) for pose in one.candidates) < 5
        assert min(degrees_between(pose.rotation, other) for pose in one.candidates) < 5


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 3, 7])
def test_many_points_decide_between_the_two_poses_of_a_distant_mirror_symmetric_object(seed: int) -> None:
    image, points, rotation, _ = seen_from_afar(45, seed)
    found = bpnp.solve(image, points, seed=seed, time_limit=30)
    assert found.verdict == "confident"
    assert degrees_between(found.rotation, rotation) < 2


def test_of_a_small_lattice_some_motions_may_be_missing() -> None:
    """24 rotations, each with dozens of shifts that map over a fifth of the 64 points."""
    points = np.stack(np.meshgrid(*[np.arange(4.0)] * 3), -1).reshape(-1, 3)
    tolerance = matching_tolerance(points, np.arange(64), 0.0)
    assert self_motions(points, tolerance, least=0.2, bases=128).left_out >= 0.5


@pytest.mark.parametrize(("fold", "each", "unique"), [(3, 7, 4), (5, 6, 4)])
@pytest.mark.parametrize("tolerance", [0.02, 0.04, 0.06])
def test_chance_motions_of_few_points_leave_out_no_symmetry(
    fold: int, each: int, unique: int, tolerance: float
) -> None:
    """By chance, dozens of motions map five of 25 points within a coarse tolerance."""
    points = parts(fold, each, unique, 0)
    motions = self_motions(points, tolerance, least=0.2, bases=128)
    assert (motions.fraction > 0.8).sum() == fold - 1
    assert motions.left_out < 0.5


@pytest.mark.parametrize("repeats", [(16, 1), (4, 4)])
def test_no_shift_of_a_repetition_maps_more_than_what_was_left_out_unless_it_is_found(repeats: tuple[int, int]) -> None:
    motif = np.random.default_rng(0).uniform(0, 0.8, (4, 3))
    cells = np.stack([*np.meshgrid(*[np.arange(float(n)) for n in repeats], indexing="ij"), np.zeros(repeats)], -1)
    cells = cells.reshape(-1, 3)
    points = (cells[:, None] + motif).reshape(-1, 3)
    tolerance = matching_tolerance(points, np.arange(len(points)), 0.0)
    motions = self_motions(points, tolerance, least=0.2, bases=128)
    shifts = np.concatenate([cells, -cells, cells * [1, -1, 1], cells * [-1, 1, 1]])
    fraction = np.prod([np.maximum(n - np.abs(shifts[:, k]), 0) / n for k, n in enumerate(repeats)], 0)
    upright = motions.rotation.trace(axis1=1, axis2=2) > 1 + 2 * np.cos(0.05)
    found = motions.shift[upright]
    lacking = (np.linalg.norm(shifts[:, None] - found, axis=-1) > 4 * tolerance).all(1) & shifts.any(1)
    assert fraction[lacking].max() <= max(motions.left_out, 0.2) + 0.03
    sources = np.arange(48)
    moved = points[sources] + shifts[lacking][:, None]
    mapped = (np.linalg.norm(moved[:, :, None] - points, axis=-1) < tolerance).any(-1).mean(-1)
    part = motions.of(points, sources, tolerance, 0.2)
    assert mapped.max() <= part.left_out + 0.03
    assert motions.left_out <= part.left_out <= 1


def test_motions_may_be_missing_if_the_registration_is_cut_off(monkeypatch: pytest.MonkeyPatch) -> None:
    points = parts(2, 25, 0, 4)
    assert self_motions(points, 0.02).left_out == 0
    monkeypatch.setattr(symmetries, "MOST_WORK", 32)
    assert self_motions(points, 0.02).left_out == 1


def test_a_shift_that_was_left_out_makes_a_row_of_equal_things_ambiguous() -> None:
    """A row of 15 motifs and four unique points; the image shows the left half. A shift by nine motifs maps
    over half of the points in view, but is not among the motions that are compared. The bound on what it maps is
    higher: as if it mapped nothing but points in view."""
    rng = np.random.default_rng(0)
    motif = rng.uniform(0, 0.8, (4, 3))
    row = np.concatenate([motif + [k, 0, 0] for k in range(15)])
    points = np.concatenate([row, rng.uniform(row.min(0), row.max(0), (4, 3))])
    in_view = points[points[:, 0] < 7.9]
    tolerance, shift = matching_tolerance(points, np.arange(64), 0.0), np.array([9.0, 0, 0])
    nearest = np.linalg.norm((in_view + shift)[:, None] - points, axis=-1).min(1)
    assert (nearest < tolerance).mean() > 0.6
    motions = self_motions(points, tolerance, least=0.2, bases=128)
    moved = in_view @ motions.rotation.transpose(0, 2, 1) + motions.shift[:, None]
    assert np.linalg.norm(moved - in_view - shift, axis=-1).max(1).min() > 0.5

    rotation = Rotation.random(rng=np.random.default_rng(5)).as_matrix()
    camera = (in_view - in_view.mean(0)) @ rotation.T + [0, 0, 16]
    image = camera[:, :2] / camera[:, 2:] + 1e-3 * rng.normal(size=(len(in_view), 2))
    solution = bpnp.solve(rng.permutation(image), points, seed=0)
    assert degrees_between(solution.rotation, rotation) < 3
    assert solution.verdict == "ambiguous"
    assert solution.reason_code == "competing_pose"


def image_of(points: Array, seed: int) -> tuple[Array, Array, Array]:
    """Return the noisy image (k, 2) of points seen from a random side, 1 pixel at 1,000 pixels, and the pose."""
    rng = np.random.default_rng([seed, 8])
    rotation = Rotation.random(rng=rng).as_matrix()
    size = np.abs(points - points.mean(0)).max()
    translation = size * np.array([0.1, 0, 5]) - rotation @ points.mean(0)
    camera = points @ rotation.T + translation
    image = camera[:, :2] / camera[:, 2:] + 1e-3 * rng.normal(size=(len(points), 2))
    return rng.permutation(image), rotation, translation


@pytest.mark.slow
@pytest.mark.parametrize(("scale", "unique"), [(0.5, 0), (0.5, 15), (1.5, 15), (0.33, 15)])
@pytest.mark.parametrize("seed", range(3))
def test_a_copy_of_another_size_makes_a_pose_ambiguous(scale: float, unique: int, seed: int) -> None:
    points, _, _ = part_and_copy(scale, 30, unique, seed)
    image, rotation, translation = image_of(points[30 * (seed % 2) :][:30], seed)
    found = bpnp.solve(image, np.random.default_rng(seed).permutation(points), seed=seed, time_limit=30)
    assert found.verdict == "ambiguous"
    given = bpnp.verify(image, points, rotation, translation)
    assert given.verdict == "ambiguous"


@pytest.mark.parametrize(("scale", "unique"), [(0.5, 4), (0.7, 15)])
def test_a_copy_of_another_size_that_the_image_shows_too_decides(scale: float, unique: int) -> None:
    points, _, _ = part_and_copy(scale, 25, unique, 6)
    image, rotation, _ = image_of(points, 6)
    found = bpnp.solve(image, np.random.default_rng(6).permutation(points), time_limit=30)
    assert found.verdict == "confident"
    assert np.degrees(Rotation.from_matrix(rotation @ found.rotation.T).magnitude()) < 1


@pytest.mark.parametrize("fold", [2, 3])
def test_a_prior_of_a_wrong_copy_does_not_leave_the_better_pose_without_matches(fold: int) -> None:
    """The prior is rotated by the symmetry and excludes the planted pose, which two unique points decide."""
    points, (rotation, translation) = parts(fold, 24 // fold, 2, 6), (np.eye(3), np.array([0.1, 0.0, 5.0]))
    turn = Rotation.from_rotvec([0, 0, 2 * np.pi / fold]).as_matrix()
    seen = points @ rotation.T + translation
    image = seen[:, :2] / seen[:, 2:] + 6e-4 * np.random.default_rng(0).standard_normal((len(points), 2))
    prior = bpnp.PosePrior(rotation @ turn.T, translation, 15.0)
    solution = bpnp.solve(image, points, prior=prior, time_limit=np.inf)
    assert degrees_between(solution.rotation, rotation) < 1
    assert solution.reason_code == "contradicts_prior", solution.reason  # and nothing else speaks against it
