"""Poses of a rig that its cameras propose, and how well all of them agree."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from bpnp.search.candidates import Candidates
from bpnp.search.rig.cameras import WIDE, Pose, Rig

Array = NDArray[np.float64]
AGREE_DEG, AGREE, PAIRS = 6.0, 0.2, 50_000  # of poses of two cameras that tell a scale: turn, shift in distances, most
LEAST_APART = 0.01  # of two cameras, in distances of the scene: a scale with which they are nearer cannot be told


def proposals_of(rig: Rig, new: Mapping[int, Candidates], met: Sequence[Candidates]) -> Pose:
    """Poses of the rig: those of each camera; or, of an unknown scale, those in which two cameras that are apart agree,
    one of them with what it had `met` before, the middle of the scene where it is with least squares."""
    if rig.unknowns == 6:
        parts = [rig.rig_of(k, poses.rotation, poses.translation) for k, poses in new.items()]
    else:
        pairs = [(k, other, poses) for k, poses in new.items() for other in range(len(met))]
        parts = []
        for k, other, poses in pairs:
            others = [met[other], *([new[other]] if other in new and other > k else [])]
            if (min(k, other), max(k, other)) in rig.apart:
                parts.append(_told_by(rig, (k, other), poses, Candidates.concatenated(others)))
    if not parts:
        return np.empty((0, 3, 3)), np.empty((0, 4))
    rotation, translation = map(np.concatenate, zip(*parts, strict=True))
    return rotation, translation


def _told_by(rig: Rig, pair: tuple[int, int], first: Candidates, second: Candidates) -> Pose:
    """Poses of the rig in which two cameras agree."""
    (turn, shift), (other, moved) = (rig.mounts[k] for k in pair)
    middle = rig.sets[0].middle
    turns, others = (turn.T @ first.rotation).reshape(-1, 9), (other.T @ second.rotation).reshape(-1, 9)
    traces = turns.astype(np.float32) @ others.T.astype(np.float32)
    near = np.flatnonzero(traces.ravel() > 1 + 2 * math.cos(math.radians(AGREE_DEG)))
    i, j = np.divmod(near[np.argsort(-traces.ravel()[near], kind="stable")[:PAIRS]], max(len(others), 1))
    rotation = turn.T @ first.rotation[i]
    seen = (first.rotation[i] @ middle + first.translation[i]) @ turn  # from the first camera, in the axes of the rig
    way = seen - (second.rotation[j] @ middle + second.translation[j]) @ other
    apart = shift @ turn - moved @ other
    distance, length = np.linalg.norm(seen, axis=-1), float(np.linalg.norm(apart))
    unit = np.maximum(way @ apart / length, LEAST_APART * distance)[:, None] / length
    translation = np.concatenate(
        [seen - unit * (shift @ turn) - (way - unit * apart) / 2 - rotation @ middle, unit], -1
    )
    agree = np.linalg.norm(way - unit * apart, axis=-1) < AGREE * distance
    return rotation[agree], translation[agree]


def agreement(rig: Rig, rotations: Array, translations: Array) -> Array:
    """How well poses (p, 3, 3), (p, 4) explain the bearings of all cameras at a wide scale, nats (p,)."""
    total, scale = np.zeros(len(rotations)), WIDE * rig.floor
    for k, sets in enumerate(rig.sets):
        turns, shifts = rig.pose_of(k, rotations, translations)
        seen = sets.points3d @ turns.transpose(0, 2, 1) + shifts[:, None]
        seen /= np.maximum(np.linalg.norm(seen, axis=-1, keepdims=True), 1e-300)
        nearest = (sets.bearings @ seen.transpose(0, 2, 1)).max(-1)
        total += np.logaddexp((nearest - 1) / scale**2, -4.0).sum(-1)
    return total
