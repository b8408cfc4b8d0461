"""Pose of a rig, cameras that are fixed to each other: its evidence, covariance and refinement.

The logs of the likelihood ratios of all image points add up. Cameras with overlapping views see the same objects, and a
pose that fits those by chance in one camera also fits them in the others, if the baseline is short. A scene point that
has an image point near it in several cameras therefore counts as one match, and for its parallax: the depth of an
unrelated object is any of those in the scene. Image points that fit no scene point count fully. Three matches fix the
pose of the rig. The three largest terms are left out once, in the camera where they count most. The numbers of tests of
all cameras add up, since each camera proposes poses from its own triples.

Image points do not determine the unit of the scene, but cameras with a non-zero baseline determine it in units of the
rig. Translations of the rig are homogeneous: (t, u) in units of the scene, with u of them in a unit of the rig. Camera
k has the translation [C_k | c_k] (t, u). If u is unknown, one more match is left out and counted in the tests. It is in
another camera than the three.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import combinations, permutations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from bpnp.arrays import Array, PoseArrays
from bpnp.runtime import NEVER, Deadline
from bpnp.search.hypotheses import Hypotheses
from bpnp.search.pose_model import PoseModel, crossed
from bpnp.search.problem import Problem, UnknownFocal
from bpnp.search.refine.gauss_newton import refine, soft_equations, steps
from bpnp.search.search_frame import SearchFrame
from bpnp.search.solution import FOCAL_LENGTH, POSE_PARAMETERS, SCALE
from bpnp.search.starts import GravityPrior, PosePrior, Prior
from bpnp.search.verdict.covariance import covariance_of, join, student_factor
from bpnp.search.verdict.false_alarms import FARTHEST_PAIR, Terms, camera_terms, directions_of, log10_nfa, match_shares
from bpnp.search.verdict.uncertainty import linearise, matches_of

WIDE_SCALES = 60.0  # scale to compare proposals: a camera's pose is inaccurate in another [smallest scales; not tuned]
REFINEMENT_SCALES = 9  # number of decreasing scales of a refinement [scales; not tuned]
STEPS_A_SCALE = 2  # number of Gauss-Newton steps at each scale [steps; not tuned]
MOST_SCALE_STEP = 1.0  # largest step of the logarithm of the scale of the scene [nats; not tuned]
LENS_FIRST_SCALE = 8.0  # first scale of a fit of the lens [scales of the residuals; not tuned]
MOST_LENS_STEP = 0.1  # largest step of a lens, of its focal length or its distortion [nats; not tuned]
WEIGHED_SCALES = 7  # number of the last scales at which the false alarms of poses are computed [scales; cost]
SAME_CENTRE = 1e-6  # distance at which centres coincide, over their largest coordinate in the rig [fraction; numerics]


class Rig:
    """Rig cameras with their points of one scene. Translations of the rig are homogeneous.

    c_k and the translations are in sizes of the scene: a rig and a scene with the same unit are divided by one number.
    If the scene is metric, the last component of the translations is 1, else it is unknown, and the translation of a
    prior, in sizes of the scene, does not restrict a camera. A lens prior is that of the focal length of all cameras,
    which has one unknown factor: poses are refined with the given cameras; the number of tests and the covariance count
    the unknowns.
    """

    is_rig = True

    def __init__(
        self,
        problems: Sequence[Problem],
        mounts: Sequence[PoseArrays],
        *,
        is_metric: bool = True,
        prior: Prior | None = None,
        lens: UnknownFocal | None = None,
    ) -> None:
        if isinstance(prior, PosePrior) and not is_metric:
            prior = prior._replace(translation=None)
        centres = np.array([-turn.T @ shift for turn, shift in mounts])
        least = SAME_CENTRE * np.abs(centres).max()
        pairs = combinations(range(len(mounts)), 2)
        self.apart = [(k, other) for k, other in pairs if np.linalg.norm(centres[k] - centres[other]) > least]
        # Extrinsics (C_k, c_k) of each camera, camera_k = C_k rig + c_k.
        self.mounts = [(turn, shift / problem.size) for problem, (turn, shift) in zip(problems, mounts, strict=True)]
        baseline = is_metric and bool(self.apart)
        self.problems: Sequence[Problem] = [
            replace(each, prior=_prior_of(mount, prior), baseline=baseline)
            for each, mount in zip(problems, self.mounts, strict=True)
        ]
        self.floor = max(each.floor or float(each.image.scales[0]) for each in self.problems)
        self.model = PoseModel(problems[0].centre3d, lens, mounts=self.mounts, scale=not is_metric, prior=prior)
        self.unknowns = self.model.size

    @cached_property
    def _images(self) -> list[KDTree]:
        return [KDTree(problem.bearings) for problem in self.problems]

    def pose_of(self, k: int, rotation: Array, translation: Array) -> PoseArrays:
        """Return the poses of camera k for poses (..., 3, 3), (..., 4) of the rig."""
        turn, shift = self.mounts[k]
        return turn @ rotation, translation[..., :3] @ turn.T + translation[..., 3:] * shift

    def rig_of(self, k: int, rotation: Array, translation: Array, unit: Array | float = 1.0) -> PoseArrays:
        """Return the poses of the rig for poses of camera k.

        The poses of a camera become rotations (..., 3, 3) and homogeneous translations (..., 4); `unit` is the length
        of a rig unit in scene units.
        """
        turn, shift = self.mounts[k]
        units = np.broadcast_to(unit, (*translation.shape[:-1], 1))
        return turn.T @ rotation, np.concatenate([(translation - units * shift) @ turn, units], -1)

    def join(self, scenes: Mapping[int, SearchFrame]) -> None:
        """Register the scenes of the cameras with each other for common searches, if the unit is known."""
        for k, other in () if self.model.scale else permutations(scenes, 2):
            (turn, shift), (others, moved) = self.mounts[k], self.mounts[other]
            scenes[k].join(scenes[other], others @ turn.T, moved - others @ turn.T @ shift)

    def seen(self, k: int, poses: Hypotheses) -> Hypotheses:
        """Convert poses of the rig to poses of camera k, for tests of competing explanations in one camera."""
        rotations, shifts = self.pose_of(k, poses.rotation, poses.translation)
        return replace(poses, rotation=rotations, translation=shifts)

    def refined(self, rotation: Array, translation: Array) -> Iterator[tuple[Array, Array, float, float]]:
        """Refine a pose at decreasing scales.

        Yield rotation, translation, scale (radians) and expected number of matches after each step.
        """
        scales = (np.geomspace(WIDE_SCALES, 1.0, REFINEMENT_SCALES).repeat(STEPS_A_SCALE) * self.floor).tolist()
        model = replace(self.model, lens=None)
        linearise = soft_equations(model, self.problems, fewest=model.size - 3)
        largest = np.full(model.size, math.inf)
        largest[6:] = MOST_SCALE_STEP
        for last in steps(model, model.state(rotation, translation), linearise, scales, largest=largest):
            yield (*model.pose(last.state), last.scale, float(last.before.matched))

    def fit_lens(self, rotation: Array, translation: Array, scale: float) -> tuple[float, float]:
        """Fit the focal length of all cameras, and a radial coefficient if it is unknown, together with a pose.

        Return the factor of the focal length, and the radial coefficient. The pose of the rig is homogeneous, the scale
        of its residuals in radians.
        """
        linearise = soft_equations(self.model, self.problems, fewest=self.model.size - 3)
        scales = (
            max(scale, self.floor) * np.geomspace(LENS_FIRST_SCALE, 1.0, REFINEMENT_SCALES).repeat(STEPS_A_SCALE)
        ).tolist()
        largest = np.where(np.arange(self.model.size) < 6, math.inf, MOST_LENS_STEP)
        end = refine(self.model, self.model.state(rotation, translation), linearise, scales, largest=largest)
        return float(end.state.zoom), float(end.state.radial)

    def alarms(self, rotation: Array, translation: Array, scale: float) -> tuple[float, float]:
        """Return log10 of the number of false alarms at the scale of the residuals, and at rougher ones.

        Three matches of a camera fix the pose. An unknown scale needs one more, of a camera with a non-zero baseline. A
        prior multiplies their number by the largest fraction of the poses of a camera that are as near to it.
        """
        directions = self._directions(rotation, translation)
        cameras = self._counted_once(self._terms(directions, scale), directions, rotation, translation)
        ways = self.model.fixing_ways(len(self.problems), self.apart)
        poses = (self.pose_of(k, rotation, translation) for k in range(len(self.problems)))
        nearest = max(each.log10_prior_fraction(*pose) for each, pose in zip(self.problems, poses, strict=True))
        problems = [replace(each, focal=self.model.lens) for each in self.problems]
        return log10_nfa(cameras, max(self.model.log10_tests(problems) + nearest, 0.0), ways)

    def _directions(self, rotation: Array, translation: Array) -> list[Array]:
        """Return the directions (n, 3) of the scene points in each camera; NaN for those that it does not see."""
        return [
            directions_of(problem, *self.pose_of(k, rotation, translation)) for k, problem in enumerate(self.problems)
        ]

    def _terms(self, directions: Sequence[Array], scale: float | None) -> list[Terms | None]:
        return [camera_terms(*each, scale) for each in zip(self.problems, directions, strict=True)]

    def _counted_once(
        self, terms: Sequence[Terms | None], directions: Sequence[Array], rotation: Array, translation: Array
    ) -> list[Terms | None]:
        """Count the evidence of a scene point once that has an image point near it in several cameras.

        With logs L in g cameras, each counts (L + min(L, e)) / g; e is that of the parallax, a position on a line.
        """
        if len(self.problems) == 1:
            return list(terms)
        result: list[Terms | None] = []
        for k, (problem, own, of) in enumerate(zip(self.problems, directions, terms, strict=True)):
            if of is None:
                result.append(None)
                continue
            seen = np.flatnonzero(np.isfinite(own[:, 0]))
            scales = problem.image.scales[-of.logs.shape[1] :]
            _, nearest = KDTree(own[seen]).query(problem.bearings[problem.image.chosen])
            nearest = seen[nearest]
            distances = [_distances(*each) for each in zip(self._images, (d[nearest] for d in directions), strict=True)]
            near = np.array(distances)[:, :, None] <= FARTHEST_PAIR * scales
            near[k] = True
            cameras = near.sum(0)  # (points, scales), as `widest`
            parallax = self._parallax(k, seen, directions, rotation, translation)
            widest = (near * parallax[:, None, None]).max(0)
            ratio = (widest / (math.sqrt(2 * math.pi) * scales))[:, :, None]
            along = np.log1p(match_shares(problem) * np.maximum(ratio - 1, 0))
            logs = (of.logs + np.minimum(of.logs, along)) / cameras[:, :, None]
            logs = np.where((of.logs > 0) & (cameras > 1)[:, :, None], logs, of.logs)
            result.append(of._replace(logs=logs, together=of.together * cameras))
        return result

    def distinct_fraction(self, rotation: Array, translation: Array, scale: float) -> float:
        """Return the number of matched scene points over the number of matches of all cameras, 1 without a match."""
        directions = self._directions(rotation, translation)
        terms = self._terms(directions, scale)
        matches, points = 0, 0.0
        for each, once in zip(terms, self._counted_once(terms, directions, rotation, translation), strict=True):
            if each is None or once is None:
                continue
            matched = each.of_points() > 0
            cameras = (once.together / each.together)[:, each.own].mean(1)
            matches, points = matches + int(matched.sum()), points + float((1 / cameras[matched]).sum())
        return points / matches if matches else 1.0

    def _parallax(
        self, k: int, seen: NDArray[np.int64], directions: Sequence[Array], rotation: Array, translation: Array
    ) -> Array:
        """Return the width (cameras,), radians, over which the depths of the scene spread a bearing of camera k.

        It is that of uniform numbers with the same standard deviation; 0 for cameras with the same centre. `seen` are
        the scene points that it sees, `directions` (n, 3) those of all scene points in each camera.
        """
        turn, shift = self.pose_of(k, rotation, translation)
        depths = np.linalg.norm(self.problems[k].points3d[seen] @ turn.T + shift, axis=1)
        even = (np.median(depths) * directions[k][seen] - shift) @ turn  # the same bearings at one distance
        result = np.zeros(len(self.problems))
        for other, each in enumerate(directions):
            turn, shift = self.pose_of(other, rotation, translation)
            there = even @ turn.T + shift
            moved = each[seen] - there / np.maximum(np.linalg.norm(there, axis=1, keepdims=True), 1e-300)
            moved = moved[np.isfinite(moved[:, 0])]
            if len(moved) > 1:
                result[other] = math.sqrt(12 * moved.var(0).sum())
        return result

    def evidence(self, rotation: Array, translation: Array, scale: float | None = None) -> Array:
        """Return the log likelihood ratio (cameras,) of the bearings of each camera under a pose and by chance.

        A scene point that several cameras see counts in each of them. The scale of the residuals is in radians; None
        takes the mean over all scales.
        """
        terms = self._terms(self._directions(rotation, translation), scale)
        return np.array([0.0 if one is None else one.evidence(0)[0] for one in terms])

    def covariance(self, rotation: Array, translation: Array, scale: float) -> Array | None:
        """Return the covariance of the pose in the axes of the rig, or None if the points do not fix it.

        It is (6, 6) of the rotation and the shift of the scene centroid; then the logarithms of an unknown focal length
        and of an unknown scale follow. `scale` is the standard deviation of the residuals, radians.
        """
        state = self.model.state(rotation, translation)
        for sharper in (1.0, 1 / math.sqrt(2)):  # as `local_covariance`
            seen = [linearise(self.model, each, state, sharper * scale, k) for k, each in enumerate(self.problems)]
            parts = [matches_of(linear) for linear in seen if linear is not None]
            if not parts:
                return None
            matches = join(parts)._replace(known=self.model.information(state))
            covariance = covariance_of(matches, fitted=self.unknowns)
            if covariance is not None:
                names = [name for name in self.model.columns if name != "radial"]
                kept = np.concatenate([np.arange(self.model.size)[self.model.columns[name]] for name in names])
                return np.asarray(covariance[np.ix_(kept, kept)] / sharper**2)
        return None

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the estimated parameters."""
        names = POSE_PARAMETERS if self.model.lens is None else (*POSE_PARAMETERS, FOCAL_LENGTH)
        return (*names, SCALE) if self.model.scale else names

    def to_user(self, poses: Hypotheses) -> Hypotheses:
        """Return poses in the user's frame, with homogeneous translations."""
        _, moved = self.problems[0].to_user(poses.rotation, poses.translation[:, :3])
        return replace(poses, translation=np.column_stack([moved, poses.translation[:, 3]]))

    def covariance_of(self, poses: Hypotheses, residual: float, inliers: int) -> Array | None:
        """Return the covariance of the user's parameters of the first pose.

        They are the rotation, the translation in units of the rig, the focal length in pixels and the scale.
        """
        (rotation, translation), first = poses.pose(), self.problems[0]
        covariance = self.covariance(rotation, translation, residual)
        if covariance is None:
            return None
        scale, (_, shift) = 1 / translation[3], first.to_user(rotation, translation[:3])
        has_focal, camera = self.model.lens is not None, first.measured.camera
        moved = np.eye(6 + has_focal + self.model.scale)  # from an error about the centroid, in unit size
        moved[3:6, 3:6] *= scale * first.size
        moved[3:6, :3] = scale * crossed(rotation @ first.centre3d_of_user)
        if has_focal and camera is not None:
            moved[6, 6] = camera.focal
        if self.model.scale:
            moved[-1, -1] = scale
            moved[3:6, -1] = scale * shift
        free = max(2 * inliers - self.unknowns, 1)
        return np.asarray(student_factor(free) * moved @ covariance @ moved.T)

    def candidates(
        self, rotations: Array, translations: Array, deadline: Deadline = NEVER, stage: str | None = None
    ) -> Hypotheses:
        """Return poses refined on all cameras, each at the scale with the fewest false alarms.

        After the deadline, which notes the stage, the others are left out.
        """
        ends = []
        for k, (rotation, translation) in enumerate(zip(rotations, translations, strict=True)):
            if k and deadline.passed(stage):
                break
            last = list(self.refined(rotation, translation))[STEPS_A_SCALE - 1 :: STEPS_A_SCALE][-WEIGHED_SCALES:]
            if last:
                ends.append(min(((*self.alarms(*end[:3]), *end) for end in last), key=lambda scored: scored[0]))
        if not ends:
            return Hypotheses.from_poses(rotations[:0], translations[:0])
        own, rough, rotations, translations, scales, counts = map(np.array, zip(*ends, strict=True))
        return Hypotheses.from_poses(
            rotations,
            translations,
            match_count=counts,
            scale=scales,
            log_likelihood=-own,
            log10_false_alarms=own,
            log10_rough=rough,
        )


def _distances(image: KDTree, directions: Array) -> Array:
    """Return the distance (k,) of each direction (k, 3) from the nearest bearing; infinite for NaN."""
    seen, result = np.isfinite(directions[:, 0]), np.full(len(directions), math.inf)
    result[seen] = image.query(directions[seen])[0]
    return result


def _prior_of(mount: PoseArrays, prior: Prior | None) -> Prior | None:
    """Return the prior of the pose of a rig as one of the pose of a camera with these extrinsics."""
    turn, shift = mount
    if isinstance(prior, GravityPrior):
        return prior._replace(up_camera=turn @ np.asarray(prior.up_camera, np.float64))
    if prior is None or prior.translation is None:
        return prior if prior is None else prior._replace(rotation=turn @ np.asarray(prior.rotation, np.float64))
    rotation, translation = (np.asarray(each, np.float64) for each in prior[:2])
    return prior._replace(rotation=turn @ rotation, translation=turn @ translation + shift)
