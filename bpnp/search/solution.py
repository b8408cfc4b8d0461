"""Result of `bpnp.solve`, and its JSON file."""

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from bpnp.argument_types import short_repr
from bpnp.arrays import Array
from bpnp.bounded_files import parse_json, read_json
from bpnp.cameras import Camera, CameraLike, camera_from, camera_to_json, check_single_camera, import_pycolmap
from bpnp.search.measured import Unit
from bpnp.search.verdict.decide import Verdict
from bpnp.search.verdict.uncertainty import centre_covariance

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ROTATION_PARAMETERS = ("rotation_x", "rotation_y", "rotation_z")  # rotation vector in the camera axes, radians
POSE_PARAMETERS = (*ROTATION_PARAMETERS, "translation_x", "translation_y", "translation_z")
FOCAL_LENGTH, SCALE = "focal_length", "scale"
FORMAT = 3  # version of the JSON file; raised when the meaning of a field changes [1; convention]


@dataclass(frozen=True, eq=False)
class Candidate:
    """A distinct pose that the search found, camera = R p + t."""

    rotation: Array  # (3, 3) rotation matrix
    translation: Array  # (3,) translation, in the unit of `Solution.translation`
    # Mean log-likelihood of the bearings, nats; larger is better. For a rig it is -log10 of the false alarms.
    score: float
    inlier_count: int  # number of one-to-one inliers (paper Eq. 1) within `Solution.inlier_threshold`, over all cameras
    log10_false_alarms: float  # expected number of equally good poses for unrelated points, log10; see `Solution`
    scale: float = 1.0  # scale of the scene, rig = scale R p + t; 1 unless it was estimated

    @property
    def centre(self) -> Array:
        """Camera centre in the scene, -R^T t / scale."""
        return -self.rotation.T @ self.translation / self.scale


@dataclass(frozen=True)
class SolutionStats:
    """Statistics of the search."""

    # Number of batches of initial poses; 0 if an enumeration or known matches decided. For a network as `solver` the
    # number of its poses.
    iterations: int = 0
    residual: float = math.nan  # scale of the residuals, radians
    converged: bool = False
    dropped2d: int = 0  # number of 2D points that could not be undistorted and were dropped
    taken2d: int = 0  # number of 2D points that other problems of the same image use (`solve_many`)
    # Stages that the time limit cut short: "search", "matcher" (it was not asked), "refinement", "focal lengths",
    # "competing poses", "views", "matches" (some points have none, or their nearest one).
    unfinished: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class Solution:
    """Pose of one problem, camera = R p + t. Without a pose it is NaN, with no matches and the verdict "failed".

    Attributes:
        rotation: (3, 3) rotation matrix.
        translation: (3,) translation, scene units; with `scale=True` units of the rig.
        matches: (k, 2) indices into `points2d` and `points3d`. No point is in two matches, except that with a `rig` a
            scene point may have one in each camera.
        inlier_count: Number of matches within `inlier_threshold` (paper Eq. 1).
        inlier_ratio: `inlier_count` as a fraction of min(m, n); with a `rig` of the sum of min(m, n) over its cameras;
            from `verify` with `matches` of the number of given matches.
        inlier_threshold: Largest reprojection error of a match, in `unit`. With a `rig` it is that of the first camera.
        reprojection_error: Mean reprojection error of the matches, in `unit`.
        reprojection_error_deg: Mean angle between the bearings of the matches, degrees.
        unit: Pixels with a camera, else normalised image units, or radians for bearings.
        covariance: (p, p) covariance of the errors of `parameters`, which for a pose are (w, v) with R' = exp([w]x) R
            and t' = t + v. Here w is in radians in the camera axes, and v in the unit of `translation`. It is the
            first-order estimate

                C = max(H^-1, sum_i D_i D_i^T),  H = -d2 log p(image points | pose) / d(w, v)^2 + prior,

            where max is the larger of the two matrices along each of their common axes, and D_i is the step to the
            optimum without image point i, with unknown correspondences (docs/verdict.md). NaN if the verdict is
            "failed" or the points do not fix the pose.
        parameters: Names of the p estimated parameters, in the order of the covariance: "rotation_x", "rotation_y",
            "rotation_z"; then "translation_x", "translation_y", "translation_z"; then "focal_length" (pixels) or
            "scale" if it was estimated.
        scale: Scale of the scene, rig = scale R p + t, with t in the unit of the rig; 1 unless `scale=True`.
        candidates: Distinct poses that the search found, best first; the first is this pose.
        verdict: "confident"; "ambiguous" if the pose is significant but another one may fit as well; "failed" if no
            pose is significant. A pose with the verdict "failed" is a guess.
        reason: Reason of the verdict, a sentence.
        reason_code: Kind of the reason: "confident", or one of docs/verdict.md, such as "competing_pose".
        log10_false_alarms: Expected number of poses that fit as well if image and scene were unrelated (NFA), log10;
            infinite without a pose. See docs/verdict.md.
        seconds: Run time of this problem. Problems that were solved together count equal parts of their time.
        view: Name of the view of a `SceneMap` near which the pose was found; None without a map.
        point_ids: (n,) ids of `points3d` in the map; None without a map. See `matched_point_ids`.
        points2d: (m, 2) normalised image coordinates; NaN for an input point that has none. Those of a rig are those of
            its cameras, one camera after the other.
        points_per_camera: Number of 2D points of each camera of a rig; None for a single camera.
        points3d: (n, 3) input points.
        normals3d: (n, 3) input normals; None without.
        camera: Input or estimated camera; None for normalised coordinates and bearings.
        stats: Statistics of the search.
    """

    rotation: Array = field(default_factory=lambda: np.full((3, 3), math.nan))
    translation: Array = field(default_factory=lambda: np.full(3, math.nan))
    matches: npt.NDArray[np.int64] = field(default_factory=lambda: np.empty((0, 2), np.int64))
    inlier_count: int = 0
    inlier_ratio: float = 0.0
    inlier_threshold: float = math.nan
    reprojection_error: float = math.nan
    reprojection_error_deg: float = math.nan
    unit: Unit
    covariance: Array = field(default_factory=lambda: np.full((6, 6), math.nan), repr=False)
    parameters: tuple[str, ...] = POSE_PARAMETERS
    scale: float = 1.0
    candidates: tuple[Candidate, ...] = ()
    verdict: Verdict
    reason: str
    reason_code: str = "no_pose"
    log10_false_alarms: float = math.inf
    stats: SolutionStats
    seconds: float = 0.0
    points2d: Array = field(repr=False)
    points3d: Array = field(repr=False)
    normals3d: Array | None = field(default=None, repr=False)
    camera: Camera | None = field(default=None, repr=False)
    view: str | None = None
    point_ids: npt.NDArray[np.int64] | None = field(default=None, repr=False)
    points_per_camera: tuple[int, ...] | None = field(default=None, repr=False)

    @property
    def matched_point_ids(self) -> npt.NDArray[np.int64] | None:
        """Ids (k,) in the map of the 3D points of the matches; None without a map."""
        return None if self.point_ids is None else self.point_ids[self.matches[:, 1]]

    @property
    def centre(self) -> Array:
        """Camera centre in the scene, -R^T t / scale."""
        return -self.rotation.T @ self.translation / self.scale

    @property
    def pose(self) -> Array:
        """(4, 4) matrix that maps scene points (x, y, z, 1) to the camera, [scale R | t]; NaN without a pose."""
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = self.scale * self.rotation, self.translation
        return pose

    @property
    def quaternion(self) -> Array:
        """(4,) unit quaternion x, y, z, w of `rotation`, w >= 0, as in SciPy and pycolmap; NaN without a pose."""
        if not self.found:
            return np.full(4, math.nan)
        return np.asarray(Rotation.from_matrix(self.rotation).as_quat(canonical=True))

    @property
    def cam_from_world(self) -> Any:
        """The pose as a pycolmap.Rigid3d; None without a pose. With a `rig`, whose pose is `pose`, it is an error."""
        check_single_camera(self.points_per_camera, "cam_from_world")
        return import_pycolmap().Rigid3d(self.pose[:3]) if self.found else None

    @property
    def rotation_std_deg(self) -> float:
        """Standard deviation of the rotation about its least certain axis, degrees."""
        return math.degrees(_largest(self.covariance[:3, :3]))

    @property
    def centre_std(self) -> float:
        """Standard deviation of `centre` along its least certain axis, scene units."""
        chosen, scale = list(range(len(POSE_PARAMETERS))), None
        if SCALE in self.parameters:
            chosen, scale = [*chosen, self.parameters.index(SCALE)], self.scale
        return _largest(centre_covariance(self.covariance[np.ix_(chosen, chosen)], self.translation, scale))

    @property
    def focal_length(self) -> float:
        """Focal length of `camera`, pixels: the mean of both axes; NaN without a camera."""
        return math.nan if self.camera is None else self.camera.focal

    @property
    def focal_length_std(self) -> float:
        """Standard deviation of an estimated focal length, pixels; 0 for a given one."""
        return self._std(FOCAL_LENGTH)

    @property
    def scale_std(self) -> float:
        """Standard deviation of an estimated scale; 0 if the scale was not estimated."""
        return self._std(SCALE)

    def _std(self, parameter: str) -> float:
        """Return the standard deviation of a parameter; 0 if it was not estimated."""
        if parameter not in self.parameters:
            return 0.0
        k = self.parameters.index(parameter)
        return math.sqrt(self.covariance[k, k])

    @property
    def found(self) -> bool:
        """True if there is a pose, which is a guess if the verdict is "failed"."""
        return bool(np.isfinite(self.rotation).all() and np.isfinite(self.translation).all())

    def __bool__(self) -> bool:
        """Return False if the verdict is "failed"; a pose that is returned is then a guess."""
        return self.verdict != "failed"

    def __repr__(self) -> str:
        from bpnp.report.terminal import format_fixed

        rows = "\n            ".join("  ".join(f"{value: .6f}" for value in row) for row in self.rotation)
        return (
            f"Solution({self.verdict}: {self.reason}\n  rotation: {rows}\n"
            f"  translation: {'  '.join(format_fixed(self.translation.tolist()))}\n"
            f"  centre: {'  '.join(format_fixed(self.centre.tolist()))}\n"
            f"  matches: {self.inlier_count} of {min(len(self.points2d), len(self.points3d))}, "
            f"mean error {self.reprojection_error:.3g} {self.unit}\n"
            f"  candidates: {len(self.candidates)}, seconds: {self.seconds:.2f})"
        )

    def plot(
        self, *, photo: Path | str | npt.NDArray[np.uint8] | None = None, camera: CameraLike | None = None
    ) -> "Figure":
        """Draw the image points and the projected scene points as a matplotlib figure.

        Args:
            photo: File or (h, w, 3) uint8 image to draw under the points; not undistorted. It needs a camera. None for
                a white background.
            camera: Camera whose pixels are the axes, as for `bpnp.solve`. Default: `self.camera`; without a camera the
                axes are normalised coordinates.

        Returns:
            The figure.

        Raises:
            ValueError: A photo was given without a camera, or no image point is in front of the camera.
        """
        from bpnp.report.images import read_photo
        from bpnp.report.solutions import draw_solution

        picture = read_photo(photo) if isinstance(photo, (Path, str)) else photo
        drawn = self if camera is None else replace(self, camera=camera_from(camera))
        return draw_solution(drawn, photo=picture)

    def _repr_html_(self) -> str:
        """Return `repr` as HTML, followed by the picture if a point is in front of the camera."""
        from bpnp.report.solutions import solution_html

        return solution_html(self)

    def to_colmap(
        self,
        folder: Path | str,
        *,
        camera: CameraLike | None = None,
        name: str = "image.jpg",
        size: tuple[int, int] | None = None,
    ) -> Path:
        """Write a COLMAP text model with this image, its matches as tracks, and all 3D points.

        Args:
            folder: New or empty folder to write to.
            camera: Camera to write, as for `bpnp.solve`. Default: `self.camera`, else a pinhole camera of 1000 pixels.
            name: Name of the image file without spaces, default "image.jpg".
            size: (width, height) of the image, pixels. Default: the size of the camera, else one that holds the points.

        Returns:
            The folder.

        Raises:
            ValueError: The solution has no pose or is that of a rig, the folder has files, the name has spaces, or the
                camera has skew.
        """
        from bpnp.datamodules.colmap.reconstruction import write_image

        if not self.found:
            raise ValueError(f"a solution without a pose cannot be exported: {self.reason}")
        check_single_camera(self.points_per_camera, "a model of one image")
        pose = self.rotation, self.translation / self.scale  # in the unit of the scene
        lens = self.camera if camera is None else camera
        points = self.points2d, self.points3d, self.matches
        return write_image(Path(folder), *points, pose, camera=lens, name=name, size=size)

    def to_json(self) -> str:
        """Return all fields as strict JSON, with null for NaN and all digits. `bpnp view` draws such a file."""
        pose = {name: getattr(self, name) if self.found else None for name in ("rotation", "translation", "centre")}
        derived = "rotation_std_deg", "centre_std", "focal_length", "focal_length_std", "scale_std"
        content = {"format": FORMAT} | vars(self) | pose | {name: getattr(self, name) for name in derived}
        content |= {"candidates": [vars(candidate) for candidate in self.candidates], "stats": vars(self.stats)}
        return json.dumps(_plain(content), allow_nan=False)

    @classmethod
    def from_json(cls, text: str | bytes | Path) -> "Solution":
        """Read a solution from the text of `to_json`, or from a file with it.

        Args:
            text: JSON text, or the path of a JSON file as a `Path`.

        Returns:
            The solution.

        Raises:
            ValueError: The text is not the JSON of a solution, or the file cannot be read.
        """
        name = f" in {text}" if isinstance(text, Path) else ""
        try:
            content = read_json(text) if isinstance(text, Path) else parse_json(text)
            if not isinstance(content, dict):
                raise ValueError(f"it holds {short_repr(content)}")
            if content["format"] != FORMAT:
                raise ValueError(f"format {content['format']} in place of {FORMAT}; solve the problem again")
            if content["verdict"] not in get_args(Verdict):
                raise ValueError(f"verdict {content['verdict']!r}")
            solution = _read(cls, content)
            counts = [len(solution.points2d), len(solution.points3d)]
            if ((solution.matches < 0) | (solution.matches >= counts)).any():
                most = solution.matches.max(0).tolist()
                raise ValueError(f"`matches` has indices up to {most}, but there are {counts} 2D and 3D points")
            return solution
        except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
            reason = f"its field {error} is missing" if isinstance(error, KeyError) else error
            raise ValueError(f"this is not the JSON of a solution{name}: {reason}") from error


def _largest(covariance: Array) -> float:
    """Return the root of the largest eigenvalue; NaN if the covariance is not finite."""
    is_finite = np.isfinite(covariance).all()
    return math.sqrt(float(np.linalg.eigvalsh(covariance)[-1])) if is_finite else math.nan


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, Camera):
        return camera_to_json(value)
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _read(kind: type, content: dict[str, Any]) -> Any:
    """Build a dataclass from its JSON."""
    values = {field.name: content[field.name] for field in fields(kind)}
    return kind(**{name: READERS[name](value) if name in READERS else value for name, value in values.items()})


def _array(values: Any, *, shape: tuple[int, ...]) -> Array:
    return np.full(shape, math.nan) if values is None else np.array(values, np.float64).reshape(shape)


def _float(value: float | None, *, missing: float = math.nan) -> float:
    return missing if value is None else value


READERS: dict[str, Callable[[Any], Any]] = {  # of the fields with another form in JSON
    "rotation": partial(_array, shape=(3, 3)),
    "translation": partial(_array, shape=(3,)),
    "covariance": lambda values: np.array([[_float(x) for x in row] for row in values], np.float64),
    "points2d": partial(_array, shape=(-1, 2)),
    "points3d": partial(_array, shape=(-1, 3)),
    "normals3d": lambda values: None if values is None else _array(values, shape=(-1, 3)),
    "parameters": tuple,
    "unfinished": tuple,
    "points_per_camera": lambda values: None if values is None else tuple(values),
    "matches": lambda values: np.array(values, np.int64).reshape(-1, 2),
    "camera": lambda value: None if value is None else camera_from(value),
    "point_ids": lambda values: None if values is None else np.array(values, np.int64),
    "log10_false_alarms": partial(_float, missing=math.inf),
    "score": partial(_float, missing=-math.inf),
    **dict.fromkeys(("inlier_threshold", "reprojection_error", "reprojection_error_deg", "residual", "scale"), _float),
    "candidates": lambda values: tuple(_read(Candidate, value) for value in values),
    "stats": lambda value: _read(SolutionStats, value),
}
