"""Map for localising photos: the points and views of a COLMAP reconstruction."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from bpnp.argument_types import ArrayLike, HasReconstruction, ImageSize, PointsLike
from bpnp.arrays import Array
from bpnp.cameras import CENTRE, Camera, CameraLike, camera_from, is_opencv, resize_camera, same_aspect_ratio
from bpnp.cameras import image_size as image_size_of
from bpnp.datamodules.colmap.model_files import ColmapError
from bpnp.datamodules.colmap.reconstruction import read_reconstruction
from bpnp.maps import index
from bpnp.maps.localize import among_all, localize, strongest_of
from bpnp.maps.photo_problem import Photo
from bpnp.maps.photos import focal_from_exif, photo_keypoints, photo_size, up_from_exif
from bpnp.maps.verify_view import verify_pose
from bpnp.maps.viewed_points import RankViews, ViewedPoints
from bpnp.maps.views import View
from bpnp.runtime import default_float_errors
from bpnp.search.arguments import (
    PriorLike,
    check_inside,
    checked_prior,
    checked_seed,
    numbers,
    pixels_from,
    seconds_from,
    source_from,
)
from bpnp.search.focal_length import UnknownCamera, unknown_camera
from bpnp.search.solution import Solution
from bpnp.search.solvers import TIME_LIMIT, Options

# Smaller maps open in two seconds without one.
INDEXED_POINTS = 200_000  # least number of points of a map that gets an index [points; cost]
SAME_FOCAL = 1.05  # largest ratio of the focal lengths of views whose camera a photo can get [ratio; not tuned]
# The photos of cities are measured with it (docs/maps.md).
PHOTO_TIME_LIMIT = 60.0  # default time limit of a photo [seconds; convention]

if TYPE_CHECKING:
    import torch

UNKNOWN = "unknown"  # focal length


@dataclass(frozen=True, eq=False, repr=False)
class SceneMap(ViewedPoints):
    """A COLMAP reconstruction as a map: n points, and the views that see them.

    Attributes:
        points3d: (n, 3) scene points, in the order of their ids.
        point_ids: (n,) ids in the COLMAP model.
        track_lengths: (n,) number of views that see each point.
        views: Views in the order of their names.

    >>> from bpnp import SceneMap
    >>> scene = SceneMap.from_colmap("sparse/0")  # doctest: +SKIP
    >>> solution = scene.localize_photo("photo.jpg")  # doctest: +SKIP
    >>> solution.verdict, solution.view, solution.matched_point_ids  # doctest: +SKIP
    """

    @classmethod
    def from_colmap(cls, path: str | Path | HasReconstruction) -> "SceneMap":
        """Read a map from a COLMAP model.

        Images with an invalid pose and points that are not finite are skipped with a warning. A view without points
        stays in the map. Keypoints are not kept: 10^6 points and 10^4 views of 1,000 points take 80 MB. When a large
        map is opened for the first time, an index is written to the cache folder (`bpnp.maps.index`).

        Args:
            path: Folder with cameras, images and points3D, all .bin or all .txt; or a pycolmap.Reconstruction.

        Returns:
            The map.

        Raises:
            ColmapError: The model cannot be read, or no view sees a point. It is a ValueError.
        """
        if not isinstance(path, (str, Path)):
            with TemporaryDirectory() as temporary:
                path.write_binary(temporary)
                return cls._read_colmap(Path(temporary))
        folder = Path(path)
        stored = index.read_index(folder)
        if stored is not None:
            return cls._from_index(stored)
        stamp = index.model_stamp(folder)
        scene = cls._read_colmap(folder)
        if len(scene.points3d) < INDEXED_POINTS:
            return scene
        parts = scene.points3d, scene.point_ids, scene.track_lengths, scene.views
        return cls._from_index(
            index.make_index(folder, stamp, lambda: index.Index(*parts, scene.pictures, scene.cones)),
        )

    @classmethod
    def _read_colmap(cls, folder: Path) -> "SceneMap":
        """Read a map from the files of a COLMAP model, without an index."""
        model = read_reconstruction(folder, keypoints=False)
        views = tuple(
            View(image.name, image.camera, image.rotation, image.translation, image.observed.astype(np.int32))
            for image in model.images
        )
        if not any(len(view.points) for view in views):
            raise ColmapError(
                f"no view of {folder} sees a point; it has {len(views)} views and {len(model.point_ids)} points. Give "
                "a model with registered images"
            )
        return cls(model.points3d, model.point_ids, np.zeros(len(model.point_ids), np.int32), views).seen_by(1)

    @classmethod
    def _from_index(cls, stored: index.Index) -> "SceneMap":
        scene = cls(*stored[:4])
        vars(scene).update(pictures=stored.pictures, cones=stored.cones)
        return scene

    @default_float_errors
    def localize(
        self,
        keypoints: PointsLike,
        camera: CameraLike | None = None,
        *,
        image_size: ImageSize | None = None,
        focal_error: float | int | None = None,
        distortion: bool = False,
        views: Iterable[str] | None = None,
        rank_views: RankViews | None = None,
        scores: ArrayLike | None = None,
        prior: PriorLike | None = None,
        up_camera: ArrayLike | None = None,
        solver: "str | Path | torch.nn.Module" = "auto",
        seed: int = 0,
        time_limit: float | int | None = None,
    ) -> Solution:
        """Estimate the pose of a photo in the map from its keypoints, without descriptors.

        Short searches run near each view until a pose is confident. A significant pose is refined and judged on all map
        points in view; if its NFA is very small but it is not confident, a longer search near its view follows at once.
        If no view gives a confident pose, each is tried once more, and the most promising ones get longer searches. If
        the pose is still not confident, the one with the fewest false alarms is returned.

        A confident pose is compared with poses elsewhere in the map that explain the same image points
        (`bpnp.maps.aliasing`). It is "ambiguous" if one of them is about as likely. Both are then the first
        `candidates`.

        Args:
            keypoints: (m, 2) pixels in COLMAP's convention: (0.5, 0.5) is the centre of the first pixel. Or a list of
                cv2.KeyPoint, which OpenCV counts from (0, 0).
            camera: Camera of the photo, as for `bpnp.solve`. With OpenCV's (K, distortion) the keypoints, also in an
                array, follow OpenCV's convention. None with `image_size`.
            image_size: (width, height) of the photo, pixels, if its focal length is unknown, as for `bpnp.solve`. The
                range of the search includes the focal lengths of the views.
            focal_error: Relative standard deviation of the focal length of `camera`, as for `bpnp.solve`.
            distortion: Always fit a radial distortion coefficient, as for `bpnp.solve`. Default False.
            views: Names of views that may show the same place, best first, from any image retrieval. The search near
                each uses the points that any of them sees; competing poses may be anywhere in the map. None to try all
                views of the map, each with its own points, in the order in which their point density resembles that of
                the keypoints.
            rank_views: Function `(points2d, views) -> scores` that ranks the views instead, such as an image retrieval:
                `points2d` (m, 2) are the keypoints in normalised image coordinates, `views` the views of the map, and
                `scores` one number per view, the largest for the view to try first. It is called again with the
                keypoints that a confident pose explains, for the competing poses. With `views` only for these.
            scores: (m,) strengths of the keypoints; the strongest 2,048 are used. None to use all keypoints.
            prior: Prior of the photo's pose, as for `bpnp.solve`; None to use the pose of the view that is tried.
            up_camera: (3,) direction up in the camera frame of the photo, of any length, such as from the EXIF
                orientation; only the nearest quarter turn of it is used. Views are first rotated about their optical
                axes by quarter turns to match it, for at most half of the time. If no pose is confident, they are tried
                unrotated. None for an unknown direction. It has no effect with a prior.
            solver: As for `bpnp.solve`. A network that was trained in the frame of a view gets the points in the frame
                of the view that is tried, or of the prior.
            seed: Seed of the search, default 0.
            time_limit: Seconds in total; math.inf for no limit. Default: None, 60 seconds. The last 1.5 seconds are
                kept to refine the best pose on all map points in view and to test its competing poses; a pose for which
                that was cut short is "ambiguous" at best. A pose that is not confident then has a reason with the
                number of views that were tried.

        Returns:
            Solution of the photo. `view` is the view near which the pose was found. `points3d` are the points of
                the map that were tried, and `point_ids` their ids in the COLMAP model. `matches` (k, 2) are indices
                into `points2d` and `points3d`; `matched_point_ids` are the ids of the matched points.

        Raises:
            ValueError: A view is unknown, or `bpnp.solve` rejects the input.
        """
        limit = seconds_from(time_limit, PHOTO_TIME_LIMIT)
        pixels = pixels_from(keypoints, camera, image_size)
        lens = self._lens(camera, image_size, focal_error, distortion)
        if image_size is not None:
            check_inside(pixels, image_size)
        strongest = None if scores is None else strongest_of(scores, np.shape(pixels)[:1])
        used = np.asarray(pixels if strongest is None else np.asarray(pixels)[strongest], np.float64)
        photo = Photo(used, lens, checked_prior(prior), seed=checked_seed(seed), rank_views=rank_views)
        options = Options(source_from(solver), solver == "auto", seed=photo.seed)
        maps = [self]
        if up_camera is not None and prior is None:
            upright = self.match_orientation(_direction(up_camera))
            maps = [upright, self] if upright is not self else maps
        result = localize(maps, photo, None if views is None else list(views), options, limit)
        solution = result.solution
        return solution if strongest is None else among_all(solution, strongest, pixels)

    @default_float_errors
    def verify_view(
        self,
        name: str,
        keypoints: PointsLike,
        *,
        seed: int = 0,
        time_limit: float | int | None = None,
    ) -> Solution:
        """Verify the pose of a view without its own observations.

        The view is removed from the map, with the points that fewer than two other views see: these have no position
        without it. Its pose is judged on the other points that it can see, whatever points the reconstruction matched
        its keypoints to. It is then compared with poses elsewhere in the map. It is "ambiguous" if another pose is
        about as likely. It is "failed" if it is not significant, or another pose is more likely by a factor of 1,000.

        Args:
            name: Name of the view.
            keypoints: (m, 2) pixels, all that were detected in its image, in COLMAP's convention: (0.5, 0.5) is the
                centre of the first pixel.
            seed: Seed of the perturbed copies of the pose from which it is refined, default 0.
            time_limit: Seconds; math.inf for no limit. Default: None, 10 seconds. A pose whose competing poses were not
                all tested by then is "ambiguous" at best.

        Returns:
            Solution as of `bpnp.verify`. `points3d` and `point_ids` are the points in view.

        Raises:
            ValueError: The name is not in the map, there are fewer than 4 keypoints, or the view can see fewer than 4
                of the remaining points.
        """
        limit = seconds_from(time_limit, TIME_LIMIT)
        view, rest = self.named([name])[0], self.without([name])
        pixels = np.asarray(pixels_from(keypoints, view.camera), np.float64)
        regions = partial(rest.ranked_regions, view.camera)
        photo = Photo(pixels, view.camera, seed=checked_seed(seed))
        return verify_pose(photo, view, replace(rest.region(rest.views[0]), view=view), regions, time_limit=limit)

    def _lens(
        self, camera: Any, image_size: Any, focal_error: float | int | None, distortion: bool
    ) -> Camera | UnknownCamera:
        """Return the camera model of a photo, or its prior if the focal length is unknown."""
        if camera is None and image_size is None:
            raise ValueError("`camera` is missing; give it, or `image_size` if the focal length is unknown")
        if not isinstance(distortion, (bool, np.bool_, type(None))):
            raise ValueError("`distortion` is not True or False; give a camera of OpenCV as camera=(K, distortion)")
        if image_size is None and focal_error is None and not distortion:
            return camera_from(camera)
        unknown = unknown_camera(camera, image_size, focal_error, distortion)
        if camera is not None:
            return unknown
        ratios = [view.camera.focal / max(size) for view in self.views if (size := image_size_of(view.camera))]
        smallest, largest = min([unknown.smallest, *ratios]), max([unknown.largest, *ratios])
        return unknown._replace(smallest=smallest, largest=largest, usual=float(np.median(ratios or [unknown.usual])))

    @default_float_errors
    def localize_photo(
        self,
        photo: str | Path,
        camera: "CameraLike | SceneMap | Literal['unknown'] | None" = None,
        *,
        keypoints: str | Path | None = None,
        name: str | None = None,
        ignore_orientation: bool = False,
        focal_error: float | int | None = None,
        distortion: bool = False,
        views: Iterable[str] | None = None,
        prior: PriorLike | None = None,
        solver: "str | Path | torch.nn.Module" = "auto",
        seed: int = 0,
        time_limit: float | int | None = None,
    ) -> Solution:
        """Estimate the pose of a photo from its file, as `bpnp localize` does.

        Args:
            photo: Image file.
            camera: Camera, as for `localize`. None for that of `camera_for`: from EXIF data, else from views of the
                photo's size, else with an unknown focal length. A `SceneMap` for the camera of its views, scaled to the
                photo's size. "unknown" for an unknown focal length even with EXIF data.
            keypoints: HDF5 file of hloc, or database of COLMAP, with the keypoints of the photo; None to detect SIFT
                keypoints.
            name: Name of the photo in that file; None for the name of the image file.
            ignore_orientation: Ignore the EXIF orientation. By default it is the `up_camera` of `localize`. The photo
                is never rotated, as in COLMAP.
            focal_error: Relative standard deviation of the focal length of the camera, as for `localize`; None if it is
                exact. It has no effect on a photo with an unknown camera.
            distortion: Always fit a radial distortion coefficient, as for `localize`. Default False.
            views: Names of views that may show the same place, best first, as for `localize`; None for all views.
            prior: Prior of the photo's pose, as for `localize`; None for the pose of the view that is tried.
            solver: As for `localize`.
            seed: Seed of the search, default 0.
            time_limit: Seconds for all views together; math.inf for no limit. Default: None, 60 seconds.

        Returns:
            Solution as of `localize`.

        Raises:
            ValueError: The photo cannot be read, its size differs from that of its camera or keypoints, or `localize`
                rejects the input.
        """
        path = Path(photo)
        if camera is None or isinstance(camera, SceneMap):
            camera = (camera or self).camera_for(path, exif=camera is None)[0]
        size, lens = photo_size(path), None if camera is None or isinstance(camera, str) else camera_from(camera)
        if lens is not None and (camera_size := image_size_of(lens)) not in (None, size):
            raise ValueError(
                f"{path.name} has {size[0]} x {size[1]} pixels, but its camera {camera_size[0]} x "
                f"{camera_size[1]}; give a camera with the focal length and the centre of this size, or that of the map"
            )
        points = photo_keypoints(path, keypoints, path.name if name is None else name)
        known_lens = lens is not None
        return self.localize(
            points.pixels - (CENTRE if known_lens and is_opencv(camera) else 0.0),
            lens,
            image_size=None if known_lens else size,
            focal_error=focal_error if known_lens else None,
            distortion=distortion,
            views=views,
            scores=points.scores,
            prior=prior,
            up_camera=None if ignore_orientation else up_from_exif(path),
            solver=solver,
            seed=seed,
            time_limit=time_limit,
        )

    def camera_for(self, photo: Path, *, exif: bool = True) -> tuple[Camera | None, str]:
        """Return the camera of a photo, and its source as text.

        Args:
            photo: Image file.
            exif: True, the default, to use the focal length of the EXIF data, with the principal point at the image
                centre, and without EXIF data the camera of views with images of the photo's size. False to use only the
                camera of views with images of its aspect ratio, scaled to its size.

        Returns:
            Camera and source, such as "EXIF". With `exif` the camera is None if there is neither EXIF data nor such a
                view, or if the focal lengths of these views differ by more than 5 %.

        Raises:
            ValueError: The photo cannot be read. Or `exif` is False and there is no such view, or the focal lengths of
                these views differ by more than 5 %.
        """
        size = width, height = photo_size(photo)
        if exif and (focal := focal_from_exif(photo)) is not None:
            return camera_from(("SIMPLE_PINHOLE", width, height, (focal, width / 2, height / 2))), "EXIF"
        owners = {id(view.camera): view for view in reversed(self.views)}  # the first view of each camera
        sizes = {key: image_size_of(view.camera) for key, view in owners.items()}
        fitting = [
            (resize_camera(owners[key].camera, size), f"view {owners[key].name} of the map")
            for key, camera_size in sizes.items()
            if camera_size == size or (not exif and camera_size is not None and same_aspect_ratio(camera_size, size))
        ]
        fitting.sort(key=lambda item: item[0].focal)
        if fitting and fitting[-1][0].focal <= SAME_FOCAL * fitting[0][0].focal:
            return fitting[len(fitting) // 2]
        if exif:
            return None, "unknown focal length"
        if fitting:
            focals = f"{fitting[0][0].focal:.0f} to {fitting[-1][0].focal:.0f} pixels"
            found = f"the {len(fitting)} cameras of this shape have focal lengths of {focals}"
        else:
            others = ", ".join(
                sorted({"{} x {}".format(*camera_size) for camera_size in sizes.values() if camera_size})[:4]
            )
            found = f"its images have {others} pixels"
        raise ValueError(
            f"no camera of the map fits {photo} of {width} x {height} pixels: {found}; give --camera of the photo, or "
            "unknown"
        )


def _direction(up_camera: Any) -> Array:
    """Return the direction up (3,) in the camera; raise ValueError unless it is three numbers that are not all zero."""
    up = numbers("up_camera", up_camera)
    if up.shape != (3,) or not np.isfinite(up).all() or not up.any():
        raise ValueError(f"`up_camera` is {up.tolist()}; three numbers that are not all zero are needed")
    return up
