"""Image points as the user measured them: their unit, their camera, and those of them that a problem uses."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from bpnp.arrays import Array, Labels
from bpnp.cameras import Camera, in_front

Unit = Literal["px", "normalised", "rad"]


@dataclass(frozen=True, eq=False)
class Measured:
    """Image points in the user's unit, pixels for example, in which residuals are measured: all of them, or some."""

    points: Array  # (m, 2) pixels with a camera, else normalised; (m, 3) bearings
    indices: Labels  # (m,) of each point among the user's
    plane: Array  # (k, 2) all of the user's points, normalised; NaN for one without such coordinates
    camera: Camera | None = None  # of the pixels
    taken: int = 0  # number of the user's points that were left to another problem

    @classmethod
    def of(cls, points: Array, camera: Camera | None = None, plane: Array | None = None) -> "Measured":
        """Return the record of all of the user's points; without `plane` they are bearings or normalised."""
        normalised = points if points.shape[1] == 2 else in_front(points)[:, :2]
        return cls(points, np.arange(len(points)), normalised if plane is None else plane, camera)

    def choose(self, chosen: Labels | slice) -> "Measured":
        """Return some of the points."""
        return replace(self, points=self.points[chosen], indices=self.indices[chosen])

    @property
    def dropped(self) -> int:
        """Number of the user's points that could not be undistorted."""
        return len(self.plane) - len(self.indices) - self.taken

    @property
    def unit(self) -> Unit:
        """Unit in which residuals are measured."""
        return "rad" if self.points.shape[1] == 3 else "normalised" if self.camera is None else "px"

    @cached_property
    def per_radian(self) -> float:
        """Units per radian at the median point: a plane stretches by (1 + r^2)^(3/4) at the distance r."""
        if self.unit == "rad":
            return 1.0
        stretch = (1 + (self.plane[self.indices] ** 2).sum(-1)) ** 0.75
        return float(np.median(stretch) * (1.0 if self.camera is None else self.camera.focal))

    def project(self, in_camera: Array) -> Array:
        """Project points (p, 3) in the camera's frame; NaN for points without an image."""
        if self.camera is not None:
            return self.camera.project(in_camera)
        if self.unit == "normalised":
            return in_front(in_camera)[:, :2]
        length = np.linalg.norm(in_camera, axis=-1, keepdims=True)
        return np.divide(in_camera, length, out=np.full_like(in_camera, np.nan), where=length > 0)


UNMEASURED = Measured.of(np.array([[]] * 3).T)  # stands for the bearings of a problem
