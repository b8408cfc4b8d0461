"""Map for localising photos: the points and views of a COLMAP reconstruction."""

import warnings
from collections import deque
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bpnp.argument_types import ArrayLike, HasReconstruction, ImageSize, PointsLike
from bpnp.cameras import CENTRE, Camera, CameraLike, camera_from, is_opencv, resize_camera, same_aspect_ratio
from bpnp.cameras import image_size as image_size_of
from bpnp.datamodules.colmap.model_files import ColmapError
from bpnp.datamodules.colmap.reconstruction import read_reconstruction
from bpnp.loops.parallel import Clock, Deadline
from bpnp.maps import index
from bpnp.maps.localize import (
    BRIEF,
    LIKELY,
    LONGER,
    ONCE,
    PROMISING,
    Photo,
    Region,
    among_all,
    near_view,
    on_all_points,
    rank,
    strongest_of,
)
from bpnp.maps.photos import focal_from_exif, photo_keypoints, photo_size, up_from_exif
from bpnp.maps.twins import without_twins
from bpnp.maps.upright import quarter_turns, turned_view
from bpnp.maps.verify_view import verify_pose
from bpnp.maps.views import (
    RUNG,
    STEP,
    Array,
    Cones,
    Pictures,
    View,
    pictures_of_views,
    places_first,
    scores_of_views,
    viewing_cones,
)
from bpnp.poses import MIN_POINTS
from bpnp.search.config import SearchSettings
from bpnp.solving.arguments import (
    PriorLike,
    check_inside,
    checked_prior,
    checked_seed,
    numbers,
    pixels_from,
    positive,
    seconds_from,
    source_from,
)
from bpnp.solving.focal_length import UnknownCamera, unknown_camera
from bpnp.solving.solution import Solution
from bpnp.solving.sources import Options
from bpnp.solving.verify import SECONDS as SECONDS_OF_VERIFICATION

if TYPE_CHECKING:
    import torch

LEAST_TRACK = 2  # least number of views of a point after a view is removed
UNKNOWN = "unknown"  # focal length
SAME_FOCAL = 1.05  # largest ratio of the focal lengths of views whose camera a photo can get


class Place(NamedTuple):
    """A view to search near, the indices (k,) of the points to use, and the camera model or its prior."""

    view: View
    points: NDArray[np.integer]
    lens: Camera | UnknownCamera


@dataclass(frozen=True, eq=False, repr=False)
class SceneMap:
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

    points3d: Array
    point_ids: NDArray[np.int64]
    track_lengths: NDArray[np.int32]
    views: tuple[View, ...]

    @classmethod
    def from_colmap(cls, path: str | Path | HasReconstruction) -> "SceneMap":
        """Read a map from a COLMAP model.

        Images with an invalid pose and points that are not finite are skipped with a warning. A view without points
        stays in the map. Keypoints are not kept: 10^6 points and 10^4 views of 1,000 points take 80 MB. When a large
        map is opened for the first time, an index is written to the cache folder (`bpnp.maps.index`).

        Args:
            path: Folder with cameras, images and points3D, all .bin or all .txt; or a pycolmap.Reconstruction.

        Raises:
            ColmapError: The model cannot be read, or no view sees a point. It is a ValueError.
        """
        if not isinstance(path, (str, Path)):
            with TemporaryDirectory() as folder:
                path.write_binary(folder)
                return cls.from_colmap(folder)
        known = index.read_index(Path(path))
        if known is not None:
            return cls._from_index(known)
        model = read_reconstruction(path, keypoints=False)
        views = tuple(
            View(image.name, image.camera, image.rotation, image.translation, image.observed.astype(np.int32))
            for image in model.images
        )
        if not any(len(view.points) for view in views):
            raise ColmapError(
                f"expected a map with views that see points in {path}, got {len(views)} views and "
                f"{len(model.point_ids)} points; try a model with registered images"
            )
        scene = cls(model.points3d, model.point_ids, np.zeros(len(model.point_ids), np.int32), views).seen_by(1)
        if len(scene.points3d) < index.LARGE:
            return scene
        parts = scene.points3d, scene.point_ids, scene.track_lengths, scene.views
        return cls._from_index(
            index.make_index(Path(path), lambda: index.Index(*parts, scene.pictures, scene.cones)),
        )

    @classmethod
    def _from_index(cls, known: index.Index) -> "SceneMap":
        scene = cls(*known[:4])
        vars(scene).update(pictures=known.pictures, cones=known.cones)
        return scene

    def __repr__(self) -> str:
        return f"SceneMap({len(self.views):,} views, {len(self.points3d):,} points)"

    @cached_property
    def pictures(self) -> Pictures:
        """Density images of the views, from which their ranks are computed."""
        return pictures_of_views(self.points3d, self.views)

    @cached_property
    def cones(self) -> Cones:
        """Cone of directions from which each point is visible."""
        return viewing_cones(self.points3d, ((view.centre, view.points) for view in self.views))

    @cached_property
    def view_numbers(self) -> dict[str, int]:
        """Indices in `views` by name."""
        return {view.name: i for i, view in enumerate(self.views)}

    def named(self, names: Iterable[str]) -> list[View]:
        """Return the views with these names; raise ValueError for a name that is not in the map."""
        wanted = list(names)
        if unknown := [name for name in wanted if name not in self.view_numbers]:
            some = ", ".join(view.name for view in self.views[:5])
            raise ValueError(f"expected names of views of the map, got {', '.join(unknown[:5])}; try {some}, ...")
        return [self.views[self.view_numbers[name]] for name in wanted]

    def without(self, names: Collection[str]) -> "SceneMap":
        """Return the map without some views, and without points that fewer than two of the other views see.

        Args:
            names: Names of the views to remove.

        Raises:
            ValueError: A name is not in the map, or no view that sees a point is left.
        """
        left_out = {view.name for view in self.named(names)}
        views = tuple(view for view in self.views if view.name not in left_out)
        return replace(self, views=views).seen_by(LEAST_TRACK)

    def seen_by(self, least: int) -> "SceneMap":
        """Return the map with only the points that `least` or more views see; raise ValueError if none is left."""
        tracks = np.zeros(len(self.points3d), np.int32)
        for view in self.views:
            tracks[view.points] += 1
        enough = tracks >= least
        if not enough.any():
            raise ValueError(f"expected points that {least} or more views see, got none in {len(self.views)} views")
        place = np.cumsum(enough, dtype=np.int32) - 1
        views = tuple(replace(view, points=place[view.points[enough[view.points]]]) for view in self.views)
        return SceneMap(self.points3d[enough], self.point_ids[enough], tracks[enough], views)

    def places(self, views: Iterable[str] | None, keypoints: ArrayLike, lens: Camera | UnknownCamera) -> "list[Place]":
        """Return the views to search near for a photo's keypoints, in this order.

        With `views` these are the given views in their order. Each gets the points that any of them sees, since they
        show one place. Otherwise they are all views of the map by rank (`bpnp.maps.views`), each with its own points.
        With an unknown focal length several are tried, the likeliest first: the next one follows `RUNG` views behind.
        Views with too few points to fix a pose are skipped.

        Args:
            views: Names of views, best first; None for all views of the map.
            keypoints: (m, 2) pixels.
            lens: Camera model, or its prior if the focal length is unknown.

        Raises:
            ValueError: A name is unknown, or `views` is empty.
        """
        if views is not None:
            named = self.named(views)
            if not named:
                raise ValueError("expected names of views to try, got none; try views=None for all of the map")
            points = np.unique(np.concatenate([view.points for view in named]))
            return [Place(view, points, lens) for view in named if len(view.points) and len(points) >= MIN_POINTS]
        cameras: list[Camera] = lens.ladder(STEP) if isinstance(lens, UnknownCamera) else [lens]
        scores = self._scores(cameras[0], keypoints, known_focal=isinstance(lens, Camera))
        order = list(places_first(self.views, scores, len(self.points3d)))
        turns = [(place + RUNG * rung, rung, k) for rung in range(len(cameras)) for place, k in enumerate(order)]
        tried = [lens.near(one) if isinstance(lens, UnknownCamera) else lens for one in cameras]
        return [
            Place(view, view.points, tried[rung])
            for _, rung, k in sorted(turns)
            if len((view := self.views[k]).points) >= MIN_POINTS
        ]

    def _scores(self, camera: Camera, keypoints: Any, *, known_focal: bool = True) -> NDArray[np.float32]:
        points2d = camera.normalise(np.asarray(keypoints, np.float64))
        return scores_of_views(points2d, self.pictures, known_focal=known_focal)

    def _region(self, view: View, points: NDArray[np.integer]) -> Region:
        in_camera = self.points3d[view.points] @ view.rotation.T + view.translation
        distance = float(np.median(np.linalg.norm(in_camera, axis=-1)))
        cones = Cones(self.cones.axes[points], self.cones.cosines[points])
        return Region(view, self.points3d[points], self.point_ids[points], cones, distance)

    def _regions(self, views: Sequence[str] | None, camera: Any, keypoints: Array) -> Iterator[Region]:
        """Yield the points seen by the given views, or by all views ranked for the keypoints of a known camera.

        Several views may show the same place.
        """
        if views is not None:
            order = self.named(views)
        else:
            scores = self._scores(camera_from(camera), keypoints)
            order = [self.views[k] for k in np.argsort(-scores, kind="stable")]
        yield from (self._region(view, view.points) for view in order if len(view.points) >= MIN_POINTS)

    def localize(
        self,
        keypoints: PointsLike,
        camera: CameraLike | None = None,
        *,
        image_size: ImageSize | None = None,
        focal_error: float | int | None = None,
        distortion: bool = False,
        views: Iterable[str] | None = None,
        scores: ArrayLike | None = None,
        prior: PriorLike | None = None,
        up_camera: ArrayLike | None = None,
        solver: "str | Path | torch.nn.Module" = "auto",
        seed: int = 0,
        time_limit: float | int | None = None,
    ) -> Solution:
        """Estimate the pose of a photo in the map from its keypoints, without descriptors.

        Short searches run near each view until a pose is confident. If the NFA of a pose is very small, a longer search
        follows at once. Then each view is tried once more, and the most promising ones with longer searches. If no pose
        is confident, the pose with the fewest false alarms is returned.

        A confident pose is compared with poses elsewhere in the map that explain the same image points
        (`bpnp.maps.twins`), unless a prior is given. It is "ambiguous" if one of them is about as likely. Both are then
        the first `candidates`.

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
                each uses the points that any of them sees. None to try all views of the map, each with its own points,
                in the order in which their point density resembles that of the keypoints.
            scores: (m,) strengths of the keypoints; the strongest 2,048 are used. None to use all keypoints.
            prior: Prior of the photo's pose, as for `bpnp.solve`; None to use the pose of the view that is tried.
            up_camera: (3,) direction up in the camera frame of the photo, accurate to a quarter turn, such as from the
                EXIF orientation. Views are first rotated about their optical axes by quarter turns to match it. If no
                pose is confident, they are tried unrotated. None for an unknown direction. It has no effect with a
                prior.
            solver: As for `bpnp.solve`. A network that needs the points in a camera frame gets them in that of the view
                that is tried, or of the prior.
            seed: Seed of the search, default 0.
            time_limit: Seconds for all views together; None for no limit. After it no search starts, but competing
                poses of a confident pose are still tested, which takes about a second.

        Returns:
            Solution of the photo. `view` is the view near which the pose was found. `points3d` are the points of
                the map that were tried, and `point_ids` their ids in the COLMAP model. `matches` (k, 2) are indices
                into `points2d` and `points3d`; `matched_point_ids` are the ids of the matched points.

        Raises:
            ValueError: A view is unknown, or `bpnp.solve` rejects the input.
        """
        views = None if views is None else list(views)
        if up_camera is not None and prior is None and (turned := self._turned(up_camera)) is not self:
            known: dict[str, Any] = {"image_size": image_size, "focal_error": focal_error, "distortion": distortion}
            known |= {"views": views, "scores": scores, "solver": solver, "seed": seed}
            return self._localize_turned(turned, keypoints, camera, positive("time_limit", time_limit), known)
        start, best = Clock.now(), list[tuple[Place, Solution]]()
        pixels = pixels_from(keypoints, image_size or camera)
        lens = self._lens(camera, image_size, focal_error, distortion)
        if image_size is not None:
            check_inside(pixels, image_size)
        views, prior = None if views is None else list(views), checked_prior(prior)
        deadline = Deadline.after(positive("time_limit", time_limit))
        strongest = None if scores is None else strongest_of(scores, np.shape(pixels)[:1])
        used = pixels if strongest is None else np.asarray(pixels)[strongest]
        module, places = source_from(solver), self.places(views, used, lens)
        met, tries = list[Solution](), len(places)
        whole = cache(lambda: self._region(places[0].view, np.arange(len(self.points3d))))

        def options_for(settings: SearchSettings) -> Options:
            limit = max(deadline.at - Clock.now(), 1e-3)
            asks = solver == "auto" and settings is LONGER  # not for every view of the map
            return Options(module, asks, seed=checked_seed(seed), time_limit=limit, settings=settings, until=deadline)

        def near(camera: Any, options: Options, region: Region, expected: Any) -> Solution:
            return near_view(region, used, camera, expected, options, views=tries)

        def in_map(place: Place, solution: Solution, options: Options) -> Solution:
            """Judge a pose on all map points in view and, if confident, against competing poses elsewhere."""
            regions, own = partial(self._regions, views, solution.camera), solution
            photo = Photo(used, solution.camera, replace(whole(), view=place.view), regions, seed)
            solution = on_all_points(solution, photo, lens, tries)
            if prior is None and solution.verdict == "confident":  # a prior would exclude competing poses elsewhere
                photo = Photo(used, solution.camera, photo.place, regions, seed)
                search = partial(near, solution.camera, options)
                photo = photo if views is None else replace(photo, place=self._region(place.view, place.points))
                solution = without_twins(photo, solution, [*met, own], search)
            return solution

        waiting, longer = deque((place, rule) for rule in (BRIEF, ONCE) for place in places), set[str]()
        while waiting:
            place, settings = waiting.popleft()
            if best and deadline.passed():
                best = [(one, in_map(one, found, options_for(settings))) for one, found in best[:1]]
                break
            options = options_for(settings)
            solution = near(place.lens, options, self._region(place.view, place.points), prior)
            decided = solution.verdict == "confident"
            if decided or solution.log10_false_alarms < 0:
                solution = in_map(place, solution, options)
                decided = decided or solution.verdict == "confident"
            if not decided:
                met.append(solution)
                best = sorted([*best, (place, solution)], key=lambda item: rank(item[1]), reverse=True)[:PROMISING]
                if not waiting:  # not significant so far, but perhaps with all points of the map
                    best = [(one, in_map(one, found, options)) for one, found in best]
                    best.sort(key=lambda item: rank(item[1]), reverse=True)
                    place, solution = best[0]
                    decided = solution.verdict == "confident"
            if decided:
                best = [(place, solution)]
                break
            likely = solution.log10_false_alarms < LIKELY and len(longer) < PROMISING
            again = best if not waiting else [(place, solution)] if likely else []
            for one, found in reversed(again):
                if one.view.name not in longer:
                    longer.add(one.view.name)
                    waiting.appendleft((one._replace(lens=_near(lens, found)), LONGER))
        if not best:
            raise ValueError("expected a map with views that see 4 or more points, got none")
        solution = best[0][1] if strongest is None else among_all(best[0][1], strongest, pixels)
        return replace(solution, seconds=Clock.now() - start)

    def _turned(self, up_camera: Any) -> "SceneMap":
        """Return the map with each view rotated by quarter turns until its up direction is that of a photo (3,).

        Return the map itself if no view needs a rotation.
        """
        up = numbers("up_camera", up_camera)
        if up.shape != (3,) or not np.isfinite(up).all() or not up.any():
            raise ValueError(f"`up_camera` is {up.tolist()}; three numbers that are not all zero are needed")
        turns = quarter_turns(self.views, up)
        if not turns.any():
            return self
        key = turns.tobytes()
        if key not in self._turned_maps:
            views = tuple(map(turned_view, self.views, turns.tolist()))
            self._turned_maps[key] = turned = replace(self, views=views)
            vars(turned).update(cones=self.cones)  # cones depend on the view centres only, which are unchanged
        return self._turned_maps[key]

    @cached_property
    def _turned_maps(self) -> dict[bytes, "SceneMap"]:
        return {}

    def _localize_turned(
        self, turned: "SceneMap", keypoints: Any, camera: Any, time_limit: float | None, options: dict[str, Any]
    ) -> Solution:
        """Localize a photo in a map with rotated views; if the result is not confident, also in this map.

        Return the better solution. Half of the time limit is for the first attempt.
        """
        start = Clock.now()
        half = None if time_limit is None else time_limit / 2
        upright = turned.localize(keypoints, camera, time_limit=half, **options)
        if upright.verdict == "confident":
            return upright
        left = None if time_limit is None else max(time_limit - (Clock.now() - start), 1e-3)
        best = max(upright, self.localize(keypoints, camera, time_limit=left, **options), key=rank)
        return replace(best, seconds=Clock.now() - start)

    def verify_view(
        self,
        name: str,
        keypoints: PointsLike,
        *,
        seed: int = 0,
        time_limit: float | int | None = SECONDS_OF_VERIFICATION,
    ) -> Solution:
        """Verify the pose of a view without its own observations.

        The view is removed from the map, with the points that fewer than two other views see: these have no position
        without it. Its pose is judged on the other points that it can see, whatever points the reconstruction matched
        its keypoints to. It is then compared with poses elsewhere in the map. It is "ambiguous" if another pose is
        about as likely. It is "failed" if it is not significant, or another pose is more likely by three decades.

        Args:
            name: Name of the view.
            keypoints: (m, 2) pixels, all that were detected in its image, in COLMAP's convention: (0.5, 0.5) is the
                centre of the first pixel.
            seed: Seed of the perturbed copies of the pose from which it is refined, default 0.
            time_limit: Seconds until competing poses in view are no longer tested, 10 by default; math.inf for no
                limit.

        Returns:
            Solution as of `bpnp.verify`. `points3d` and `point_ids` are the points in view.

        Raises:
            ValueError: The name is not in the map, or the view can see fewer than 4 of the remaining points.
        """
        if time_limit is None:
            message = "`time_limit=None` of `verify_view` is its default limit now, 10 s; math.inf is no limit"
            warnings.warn(message, DeprecationWarning, stacklevel=2)
        limit = seconds_from(time_limit, SECONDS_OF_VERIFICATION)
        view, rest = self.named([name])[0], self.without([name])
        pixels = np.asarray(pixels_from(keypoints, view.camera), np.float64)
        place = replace(rest._region(rest.views[0], np.arange(len(rest.points3d))), view=view)
        photo = Photo(pixels, view.camera, place, partial(rest._regions, None, view.camera), seed)
        return verify_pose(photo, view, time_limit=limit)

    def _lens(
        self, camera: Any, image_size: Any, focal_error: float | int | None, distortion: bool
    ) -> Camera | UnknownCamera:
        """Return the camera model of a photo, or its prior if the focal length is unknown."""
        if camera is None and image_size is None:
            raise ValueError("expected a `camera`, or `image_size` where the focal length is unknown, got neither")
        if image_size is None and focal_error is None and not distortion:
            return camera_from(camera)
        unknown = unknown_camera(camera, image_size, focal_error, distortion)
        if camera is not None:
            return unknown
        known = [view.camera.focal / max(size) for view in self.views if (size := image_size_of(view.camera))]
        smallest, largest = min([unknown.smallest, *known]), max([unknown.largest, *known])
        return unknown._replace(smallest=smallest, largest=largest, usual=float(np.median(known or [unknown.usual])))

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
            focal_error: Relative standard deviation of the focal length of the camera, as for `localize`. It has no
                effect on a photo with an unknown camera.
            distortion: Always fit a radial distortion coefficient, as for `localize`. Default False.
            views: Names of views that may show the same place, best first, as for `localize`; None for all views.
            prior: Prior of the photo's pose, as for `localize`.
            solver: As for `localize`.
            seed: Seed of the search, default 0.
            time_limit: Seconds for all views together; None for no limit.

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
        if lens is not None and (known := image_size_of(lens)) not in (None, size):
            raise ValueError(
                f"expected photos of {known[0]} x {known[1]} pixels as the camera has, got {path.name} of {size[0]} x "
                f"{size[1]}; try a camera with the focal length and the centre of this size, or that of the map"
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
        """Return the camera of a photo, and its source in words.

        Args:
            photo: Image file.
            exif: Use the focal length of the EXIF data, with the principal point at the image centre. Without EXIF data
                use the camera of views with images of the photo's size. If False, use only the camera of views with
                images of its aspect ratio, scaled to its size.

        Returns:
            Camera and source. The camera is None if there is none, or if the focal lengths of the views differ by more
                than 5 %.

        Raises:
            ValueError: `exif` is False and there is no such camera.
        """
        size = width, height = photo_size(photo)
        if exif and (focal := focal_from_exif(photo)) is not None:
            return camera_from(("SIMPLE_PINHOLE", width, height, (focal, width / 2, height / 2))), "EXIF"
        owners = {id(view.camera): view for view in reversed(self.views)}  # the first view of each camera
        sizes = {key: image_size_of(view.camera) for key, view in owners.items()}
        fitting = [
            (resize_camera(owners[key].camera, size), f"view {owners[key].name} of the map")
            for key, known in sizes.items()
            if known == size or (not exif and known is not None and same_aspect_ratio(known, size))
        ]
        fitting.sort(key=lambda item: item[0].focal)
        if fitting and fitting[-1][0].focal <= SAME_FOCAL * fitting[0][0].focal:
            return fitting[len(fitting) // 2]
        if exif:
            return None, "unknown focal length"
        wanted = f"views of the shape of {photo} of {width} x {height} pixels with one focal length"
        if fitting:
            got = f"{len(fitting)} of {fitting[0][0].focal:.0f} to {fitting[-1][0].focal:.0f} pixels"
        else:
            others = ", ".join(sorted({"{} x {}".format(*known) for known in sizes.values() if known})[:4])
            got = f"none: the map's are of {others}"
        raise ValueError(f"expected {wanted}, got {got}; try --camera with the camera of the photo, or unknown")


def _near(lens: Camera | UnknownCamera, solution: Solution) -> Camera | UnknownCamera:
    """Return the camera for a longer search near a solution.

    An unknown camera gets the focal length of a significant solution; otherwise all focal lengths are tried.
    """
    if isinstance(lens, UnknownCamera) and solution.log10_false_alarms < 0:
        return lens.near(camera_from(solution.camera))
    return lens
