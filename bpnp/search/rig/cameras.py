"""Pose of a rig, cameras that are fixed to each other: its evidence, covariance and refinement.

The image points of the cameras are independent, so the logs of their likelihood ratios add up. Three matches fix the
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
from itertools import combinations, permutations

import numpy as np
from numpy.typing import NDArray

from bpnp.search.config import RIG
from bpnp.search.hypotheses import Hypotheses
from bpnp.search.pose_model import PoseModel
from bpnp.search.problem import Problem, UnknownFocal
from bpnp.search.refine.gauss_newton import refine, soft_equations, steps
from bpnp.search.search_frame import Scene
from bpnp.search.starts import GravityPrior, PosePrior, Prior
from bpnp.search.verdict.covariance import covariance_of, join
from bpnp.search.verdict.false_alarms import Terms, camera_terms, directions_of, log10_nfa
from bpnp.search.verdict.uncertainty import linearise, matches_of

Array = NDArray[np.float64]
Pose = tuple[Array, Array]


class Rig:
    """Rig cameras with their points of one scene. Translations of the rig are homogeneous.

    c_k and the translations are in sizes of the scene: a rig and a scene with the same unit are divided by one number.

    Args:
        problems: Points of each camera.
        mounts: Extrinsics (C_k, c_k) of each camera, camera_k = C_k rig + c_k.
        is_metric: True if the last component of the translations is 1; else it is unknown. Default True.
        prior: Prior of the pose of the rig, in sizes of the scene; None for none. Without a metric scene its
            translation does not restrict a camera.
        lens: Prior of the focal length of all cameras, which has one unknown factor; None if it is known. Poses are
            refined with the given cameras; the number of tests and the covariance count the unknowns.
    """

    def __init__(
        self,
        problems: Sequence[Problem],
        mounts: Sequence[Pose],
        *,
        is_metric: bool = True,
        prior: Prior | None = None,
        lens: UnknownFocal | None = None,
    ) -> None:
        if isinstance(prior, PosePrior) and not is_metric:
            prior = prior._replace(translation=None)
        self.mounts = [(turn, shift / problem.size) for problem, (turn, shift) in zip(problems, mounts, strict=True)]
        self.problems = [
            replace(each, prior=_prior_of(mount, prior)) for each, mount in zip(problems, self.mounts, strict=True)
        ]
        self.floor = max(each.floor or float(each.image.scales[0]) for each in self.problems)
        self.model = PoseModel(problems[0].centre3d, lens, mounts=self.mounts, scale=not is_metric, prior=prior)
        self.unknowns = self.model.size
        centres = np.array([-turn.T @ shift for turn, shift in mounts])
        least = RIG.same_centre * np.abs(centres).max()
        pairs = combinations(range(len(mounts)), 2)
        self.apart = [(k, other) for k, other in pairs if np.linalg.norm(centres[k] - centres[other]) > least]

    def pose_of(self, k: int, rotation: Array, translation: Array) -> Pose:
        """Return the poses of camera k for poses (..., 3, 3), (..., 4) of the rig."""
        turn, shift = self.mounts[k]
        return turn @ rotation, translation[..., :3] @ turn.T + translation[..., 3:] * shift

    def rig_of(self, k: int, rotation: Array, translation: Array, unit: Array | float = 1.0) -> Pose:
        """Return the poses of the rig for poses of camera k.

        Args:
            k: Index of the camera.
            rotation: (..., 3, 3) of the camera.
            translation: (..., 3) of the camera.
            unit: Length of a rig unit in scene units, default 1.

        Returns:
            Rotations (..., 3, 3) and homogeneous translations (..., 4).
        """
        turn, shift = self.mounts[k]
        units = np.broadcast_to(unit, (*translation.shape[:-1], 1))
        return turn.T @ rotation, np.concatenate([(translation - units * shift) @ turn, units], -1)

    def join(self, scenes: Mapping[int, Scene]) -> None:
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

        Yields:
            Rotation, translation, scale (radians) and expected number of matches after each step.
        """
        scales = (np.geomspace(RIG.wide, 1.0, RIG.steps).repeat(RIG.again) * self.floor).tolist()
        model = replace(self.model, lens=None)
        linearise = soft_equations(model, self.problems, fewest=model.size - 3)
        largest = np.full(model.size, math.inf)
        largest[6:] = RIG.most_scale
        for last in steps(model, model.state(rotation, translation), linearise, scales, largest=largest):
            yield (*model.pose(last.state), last.scale, float(last.before.matched))

    def fit_lens(self, rotation: Array, translation: Array, scale: float) -> tuple[float, float]:
        """Fit the focal length of all cameras, and a radial coefficient if it is unknown, together with a pose.

        Args:
            rotation: (3, 3) of the rig.
            translation: (4,) of the rig, homogeneous.
            scale: Scale of the residuals, radians.

        Returns:
            Factor of the focal length, and the radial coefficient.
        """
        linearise = soft_equations(self.model, self.problems, fewest=self.model.size - 3)
        scales = (max(scale, self.floor) * np.geomspace(RIG.lens_wide, 1.0, RIG.steps).repeat(RIG.again)).tolist()
        largest = np.where(np.arange(self.model.size) < 6, math.inf, RIG.most_lens)
        end = refine(self.model, self.model.state(rotation, translation), linearise, scales, largest=largest)
        return float(end.state.zoom), float(end.state.radial)

    def alarms(self, rotation: Array, translation: Array, scale: float) -> tuple[float, float]:
        """Return log10 of the number of false alarms at the scale of the residuals, and at rougher ones.

        Three matches of a camera fix the pose. An unknown scale needs one more, of a camera with a non-zero baseline. A
        prior multiplies their number by the largest fraction of the poses of a camera that are as near to it.
        """
        cameras = self._terms(rotation, translation, scale)
        ways = self.model.fixing_ways(len(self.problems), self.apart)
        poses = (self.pose_of(k, rotation, translation) for k in range(len(self.problems)))
        nearest = max(each.log10_prior_fraction(*pose) for each, pose in zip(self.problems, poses, strict=True))
        problems = [replace(each, focal=self.model.lens) for each in self.problems]
        return log10_nfa(cameras, max(self.model.log10_tests(problems) + nearest, 0.0), ways)

    def _terms(self, rotation: Array, translation: Array, scale: float | None) -> list[Terms | None]:
        seen = (
            directions_of(problem, *self.pose_of(k, rotation, translation)) for k, problem in enumerate(self.problems)
        )
        return [camera_terms(*each, scale) for each in zip(self.problems, seen, strict=True)]

    def evidence(self, rotation: Array, translation: Array, scale: float | None = None) -> Array:
        """Return the log likelihood ratio (cameras,) of the bearings under a pose and by chance.

        Args:
            rotation: (3, 3) of the rig.
            translation: (4,) of the rig, homogeneous.
            scale: Scale of the residuals, radians; None takes the mean over all scales.
        """
        terms = self._terms(rotation, translation, scale)
        return np.array([0.0 if one is None else one.evidence(0)[0] for one in terms])

    def covariance(self, rotation: Array, translation: Array, scale: float) -> Array | None:
        """Return the covariance of the pose in the axes of the rig, or None if the points do not fix it.

        Args:
            rotation: (3, 3) of the rig.
            translation: (4,) of the rig, homogeneous.
            scale: Standard deviation of the residuals, radians.

        Returns:
            (6, 6) of the rotation and the shift of the scene centroid; then the logarithms of an unknown focal length
            and of an unknown scale.
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

    def candidates(self, rotations: Array, translations: Array) -> Hypotheses:
        """Return poses refined on all cameras, each at the scale with the fewest false alarms."""
        ends = []
        for rotation, translation in zip(rotations, translations, strict=True):
            last = list(self.refined(rotation, translation))[RIG.again - 1 :: RIG.again][-RIG.weighed :]
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


def _prior_of(mount: Pose, prior: Prior | None) -> Prior | None:
    """Return the prior of the pose of a rig as one of the pose of a camera with these extrinsics."""
    turn, shift = mount
    if isinstance(prior, GravityPrior):
        return prior._replace(up_camera=turn @ np.asarray(prior.up_camera, np.float64))
    if prior is None or prior.translation is None:
        return prior if prior is None else prior._replace(rotation=turn @ np.asarray(prior.rotation, np.float64))
    rotation, translation = (np.asarray(each, np.float64) for each in prior[:2])
    return prior._replace(rotation=turn @ rotation, translation=turn @ translation + shift)
