"""Poses of a trained network for a problem, as results or as initial poses of a search."""

import copy
from functools import cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from bpnp.arrays import Array
from bpnp.runtime import Deadline
from bpnp.search.problem import Problem
from bpnp.search.propose.given import score_given
from bpnp.search.search_frame import SearchFrame
from bpnp.search.settings import DEFAULT
from bpnp.search.starts import PosePrior
from bpnp.search.verdict.contest import contest, rivals_of
from bpnp.search.verdict.decide import Case
from bpnp.search.verdict.reasons import objection
from bpnp.types import Batch

# Largest distance from the origin at which float32 is precise enough.
FARTHEST_ORIGIN = 100.0  # [sizes of the scene; numerics]
# With 2 % correct matches one in 10^5 is correct, and more nearly so.
DRAWN_TRIPLES = 80_000  # match triples per assignment [triples; derived]
NETWORK_SIGMA_DEG = 10.0  # standard deviation of the rotation of a network's pose [degrees; not tuned]
NETWORK_SIGMA_SHIFT = 0.1  # standard deviation of its translation, as a fraction of the distance [fraction; not tuned]

if TYPE_CHECKING:
    from bpnp.models.matcher import Matcher

ESTIMATES = ("refined", "ransac", "pnp")  # estimates of a prediction, the most reliable first


def evaluation_copy(module: nn.Module, device: torch.device | None) -> nn.Module:
    """Return the module in evaluation mode on a device, None for its own; a copy unless it is so already.

    The caller's module keeps its device and its training flags, and may be in use by other threads.
    """
    evaluates = not any(part.training for part in module.modules())
    if evaluates and device in (None, device_of(module)):
        return module
    return copy.deepcopy(module).to(device).eval()


def device_of(module: nn.Module) -> torch.device:
    """Return the device of a module's parameters; the CPU if it has none."""
    parameter = next(module.parameters(), None)
    return torch.device("cpu") if parameter is None else parameter.device


def pose_prior(net: nn.Module, problem: Problem, deadline: Deadline) -> PosePrior | None:
    """Return a prior at the network's pose; None if it has no pose."""
    (asked,) = predicted(net, [problem], deadline)
    if not len(asked.candidates):
        return None
    rotation, translation = asked.pose
    centre = rotation @ problem.points3d.mean(0) + translation
    sigma = NETWORK_SIGMA_SHIFT * float(np.linalg.norm(centre)) + 1e-12
    return PosePrior(rotation, translation, NETWORK_SIGMA_DEG, sigma)


def predicted(net: nn.Module, members: list[Problem], deadline: Deadline) -> list[Case]:
    """Return the scored poses of a module's prediction for each problem, and what their rivals found."""
    views, batch = _given(net, members)
    with torch.no_grad():
        poses = net(batch).poses
    if not poses:
        raise ValueError(f"the `solver` {type(net).__name__} returned a prediction without a pose")
    order = sorted(poses, key=lambda name: ESTIMATES.index(name) if name in ESTIMATES else len(ESTIMATES))
    rotation = _host(torch.stack([poses[name].rotation for name in order], 1))
    translation = _host(torch.stack([poses[name].translation for name in order], 1))
    given = zip(members, views, rotation, translation, strict=True)
    return [_case_of(problem, *view.before(r, t), deadline) for problem, view, r, t in given]


def _case_of(problem: Problem, rotation: Array, translation: Array, deadline: Deadline) -> Case:
    scene = SearchFrame(problem, 0, DEFAULT, deadline)
    poses = score_given(scene, rotation, translation)
    if not len(poses):
        return Case.without_pose(problem, objection("no_pose")._replace(clause="the module found no pose"))
    case = Case.of(poses, problem, iterations=len(rotation))
    return contest(case, rivals_of(lambda: scene, deadline))


def proposed(net: "Matcher", problem: Problem, seed: int) -> tuple[Array, Array]:
    """Return poses (s, 3, 3), (s, 3) of match triples sampled in proportion to the root of a matcher's assignment.

    Sampled in proportion to the assignment itself, they are too similar where it is wrong.
    """
    from bpnp.layers.ransac.proposals import drawn_poses  # imports torch modules only if needed

    (view,), batch = _given(net, [problem])
    with torch.no_grad():
        assignment = net.match(batch).assignment
    assert assignment is not None
    drawn = drawn_poses(
        assignment.sqrt(),
        batch.points2d,
        batch.points3d,
        triples=DRAWN_TRIPLES,
        seed=seed,
        aligned=net.frame == "view",
    )
    poses = _host(drawn[0])
    poses = poses[np.isfinite(poses).all((-2, -1))]
    return view.before(poses[:, :, :3], poses[:, :, 3])


@cache
def packaged_matcher(weights: str) -> "Matcher":
    """Return the matcher of packaged weights."""
    from bpnp.models.matcher import Matcher

    return Matcher.from_pretrained(weights)


class NetworkFrame(NamedTuple):
    """Coordinates R s p + t, in the user's unit, that a network expects for the points p of a problem of size s."""

    rotation: Array
    translation: Array
    size: float

    def enter(self, points3d: Array) -> Array:
        """Return points (n, 3) of the problem in these coordinates."""
        return self.size * points3d @ self.rotation.T + self.translation

    def before(self, rotation: Array, translation: Array) -> tuple[Array, Array]:
        """Return poses (s, 3, 3), (s, 3) of points in these coordinates as poses of the problem."""
        return rotation @ self.rotation, (rotation @ self.translation + translation) / self.size


def view_for(net: nn.Module, problem: Problem) -> NetworkFrame:
    """Return the coordinates in which a network expects the 3D points: the user's, or those of the view of the prior.

    A prior without a translation gets one at which the points appear as large as the image points. ValueError if the
    network has the frame "view" and there is no `PosePrior`.
    """
    if getattr(net, "frame", "any") == "any":
        return NetworkFrame(np.eye(3), _near_origin(problem), problem.size)
    if not isinstance(problem.prior, PosePrior):
        raise ValueError(
            "this network was trained in the coordinates of a view near the photo, and there is no `prior`; give "
            "prior=PosePrior(rotation, translation, ...) with the pose of such a view, or use SceneMap.localize"
        )
    rotation = np.asarray(problem.prior.rotation, np.float64)
    if problem.prior.translation is not None:
        return NetworkFrame(rotation, problem.size * np.asarray(problem.prior.translation), problem.size)
    turned, image = problem.size * problem.points3d @ rotation.T, _seen(problem)
    centre, image_centre = np.median(turned, 0), np.median(image, 0)
    across = np.median(np.linalg.norm((turned - centre)[:, :2], axis=1))
    depth = across / max(float(np.median(np.linalg.norm(image - image_centre, axis=1))), 1e-6)
    return NetworkFrame(rotation, depth * np.append(image_centre, 1.0) - centre, problem.size)


def _near_origin(problem: Problem) -> Array:
    """Return the origin of a problem in the user's coordinates; 0 if it is too far away for float32."""
    is_far = problem.origin is None or np.linalg.norm(problem.origin) > FARTHEST_ORIGIN * problem.size
    return np.zeros(3) if is_far else np.asarray(problem.origin)


def _seen(problem: Problem) -> Array:
    """Return the usable, finite 2D points (m, 2)."""
    points2d = problem.measured.plane[problem.measured.indices]
    return points2d[np.isfinite(points2d).all(-1)]


def _given(net: nn.Module, members: list[Problem]) -> tuple[list[NetworkFrame], Batch]:
    """Return the coordinates that the network expects for each problem, and the batch of problems in them."""
    views = [view_for(net, problem) for problem in members]
    batch = Batch.from_arrays(
        [_seen(problem).astype(np.float32) for problem in members],
        [view.enter(problem.points3d).astype(np.float32) for problem, view in zip(members, views, strict=True)],
    )
    return views, batch.to(device_of(net))


def _host(values: Tensor) -> Array:
    return values.detach().cpu().double().numpy()
