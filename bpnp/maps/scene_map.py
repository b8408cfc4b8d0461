"""A map to localise photos in: the points and views of a COLMAP reconstruction."""

from collections import deque
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bpnp.cameras import CENTRE, Camera, camera_from, is_opencv, resize_camera, same_aspect_ratio
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
from bpnp.search.settings import SearchSettings
from bpnp.solving.arguments import (
    check_inside,
    checked_prior,
    checked_seed,
    numbers,
    pixels_from,
    positive,
    source_from,
)
from bpnp.solving.focal_length import UnknownCamera, unknown_camera
from bpnp.solving.solution import Solution
from bpnp.solving.sources import Options

if TYPE_CHECKING:
    import torch

LEAST_TRACK = 2  # views that fix a point; with one left it would not be in the map
UNKNOWN = "unknown"  # focal length
SAME_FOCAL = 1.05  # largest ratio of the focal lengths of views whose camera is taken for that of a photo


class Place(NamedTuple):
    """A view to look near, the points (k,) to look among, and what is known of the photo's camera there."""

    view: View
    points: NDArray[np.integer]
    lens: Camera | UnknownCamera


@dataclass(frozen=True, eq=False, repr=False)
class SceneMap:
    """A COLMAP reconstruction as a map: n points, and the views that see them.

    points3d: (n, 3) scene units, in the order of their ids. point_ids: (n,) ids in the COLMAP model.
    track_lengths: (n,) views that see each point. views: in the order of their names.

    >>> from bpnp import SceneMap
    >>> scene = SceneMap.from_colmap("sparse/0")  # doctest: +SKIP
    >>> solution = scene.localize_photo("photo.jpg")  # doctest: +SKIP
    >>> solution.verdict, solution.view, solution.matches  # doctest: +SKIP
    """

    points3d: Array
    point_ids: NDArray[np.int64]
    track_lengths: NDArray[np.int32]
    views: tuple[View, ...]

    @classmethod
    def from_colmap(cls, path: Any) -> "SceneMap":
        """The map in a folder of cameras, images and points3D, all .bin or all .txt, or in a pycolmap.Reconstruction.

        Not used, and logged as a warning: images with a broken pose, and points that are not finite. A view without
        points stays in the map. Keypoints are not kept: 10^6 points and 10^4 views of 1,000 points take 80 MB. The
        first time that a large map is opened, an index is written to the cache folder (`bpnp.maps.index`).
        Raises ColmapError, a ValueError, for a model that cannot be read or has no view that sees a point.
        """
        if callable(getattr(path, "write_binary", None)):
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
        """What the views' ranks are told from."""
        return pictures_of_views(self.points3d, self.views)

    @cached_property
    def cones(self) -> Cones:
        """From where each point is seen."""
        return viewing_cones(self.points3d, ((view.centre, view.points) for view in self.views))

    @cached_property
    def view_numbers(self) -> dict[str, int]:
        """Places in `views` by name."""
        return {view.name: i for i, view in enumerate(self.views)}

    def named(self, names: Iterable[str]) -> list[View]:
        """The views of these names. Raises ValueError for one that the map does not have."""
        wanted = list(names)
        if unknown := [name for name in wanted if name not in self.view_numbers]:
            some = ", ".join(view.name for view in self.views[:5])
            raise ValueError(f"expected names of views of the map, got {', '.join(unknown[:5])}; try {some}, ...")
        return [self.views[self.view_numbers[name]] for name in wanted]

    def without(self, names: Collection[str]) -> "SceneMap":
        """The map as it would be without these views: also points that then fewer than two views see are left out.

        Raises ValueError for a name that the map does not have, or if no view that sees a point is left.
        """
        left_out = {view.name for view in self.named(names)}
        views = tuple(view for view in self.views if view.name not in left_out)
        return replace(self, views=views).seen_by(LEAST_TRACK)

    def seen_by(self, least: int) -> "SceneMap":
        """Only such points as `least` or more of the views see. Raises ValueError if none is left."""
        tracks = np.zeros(len(self.points3d), np.int32)
        for view in self.views:
            tracks[view.points] += 1
        enough = tracks >= least
        if not enough.any():
            raise ValueError(f"expected points that {least} or more views see, got none in {len(self.views)} views")
        place = np.cumsum(enough, dtype=np.int32) - 1
        views = tuple(replace(view, points=place[view.points[enough[view.points]]]) for view in self.views)
        return SceneMap(self.points3d[enough], self.point_ids[enough], tracks[enough], views)

    def places(self, views: Iterable[str] | None, keypoints: Any, lens: Camera | UnknownCamera) -> "list[Place]":
        """What to look near a photo's keypoints, in this order.

        Each of the given views, in their order, with the points that any of them sees, since they show one place; or
        all views of the map, each with its own points, by their rank (`bpnp.maps.views`). Of an unknown focal length
        several in turns, from the likeliest, the next one after `RUNG` views with that before. None with fewer points
        than fix a pose.

        Raises ValueError for unknown names, or if there is none.
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
        """The surroundings of the given views, or of all views by their rank for keypoints of a known camera; also of
        views that show the same place."""
        if views is not None:
            order = self.named(views)
        else:
            scores = self._scores(camera_from(camera), keypoints)
            order = [self.views[k] for k in np.argsort(-scores, kind="stable")]
        yield from (self._region(view, view.points) for view in order if len(view.points) >= MIN_POINTS)

    def localize(
        self,
        keypoints: Any,
        camera: Any = None,
        *,
        image_size: Any = None,
        focal_error: float | int | None = None,
        distortion: bool = False,
        views: Iterable[str] | None = None,
        scores: Any = None,
        prior: Any = None,
        up_camera: Any = None,
        solver: "str | Path | torch.nn.Module" = "auto",
        seed: int = 0,
        time_limit: float | int | None = None,
    ) -> Solution:
        """The pose of a photo in the map, from its keypoints alone.

        keypoints: (m, 2) pixels, COLMAP's: (0.5, 0.5) is the centre of the first one; or a list of cv2.KeyPoint, which
            OpenCV counts from (0, 0).
        camera: as for `bpnp.solve`. With OpenCV's (K, distortion) pixels count as OpenCV's do, those in an array too.
        image_size: (width, height) in pixels of a photo whose focal length is unknown, as for `bpnp.solve`. The focal
            length is looked for where those of the views are too.
        focal_error: relative standard deviation of the focal length of `camera`, as for `bpnp.solve`.
        distortion: whether a radial coefficient is always fitted, as for `bpnp.solve`.
        views: names of views of the map that may show the same place, best first, from any image retrieval: the points
            that any of them sees are used near each; None to try the points of one view of the whole map after the
            other, those first where the density of its points is most like that of the keypoints.
        scores: (m,) strength of the keypoints; the strongest are used first.
        prior: what is known of the photo's pose, as for `bpnp.solve`; None to expect it near that of the view that is
            tried.
        up_camera: direction up (3,) in the camera of the photo, known to a quarter turn, such as from the orientation
            of EXIF data. Views that are turned against it by a quarter turn or more are tried as if they were not. If
            no pose is confident then, they are tried as they are. No effect with a prior.
        solver: as for `bpnp.solve`; a network that expects the points in the camera of a view gets them in that of the
            view that is tried, or of the prior.
        seed: of the search.
        time_limit: seconds for all views together, after which no search begins, but what speaks against a confident
            pose is still looked for, about a second; None for no limit.

        Poses near each view are tried briefly until one is confident, longer at once where hardly any unrelated points
        would fit as well; then near each view once more, and near the most promising ones longer; else the pose with
        the fewest false alarms is returned. A confident pose is compared with those that explain the same image points
        elsewhere in the map (`bpnp.maps.twins`): "ambiguous" if one does so about as well, and both are the first
        `candidates`; not if a prior is given. `solution.view` is the view near which it was found.
        `solution.matches` (k, 2): place of a keypoint, and id of a point in the map's COLMAP model; `solution.points3d`
        with the ids `solution.point_ids` are the points that were tried.
        Raises ValueError for unknown views and for input that `bpnp.solve` refuses.
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
            asks = solver == "auto" and settings is LONGER  # not of every view of the map
            return Options(module, asks, seed=checked_seed(seed), time_limit=limit, settings=settings, until=deadline)

        def near(camera: Any, options: Options, region: Region, expected: Any) -> Solution:
            return near_view(region, used, camera, expected, options, views=tries)

        def in_map(place: Place, solution: Solution, options: Options) -> Solution:
            """Judge a pose on all points of the map in view and, if it is significant, beside its twins."""
            regions, own = partial(self._regions, views, solution.camera), solution
            photo = Photo(used, solution.camera, replace(whole(), view=place.view), regions, seed)
            solution = on_all_points(solution, photo, lens, tries)
            if prior is None and solution.verdict == "confident":  # a prior would tell twins apart
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
                if not waiting:  # chance explains the others, but perhaps not with all points of the map
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
        """The map with the camera of each view turned by quarter turns until its up is that of a photo (3,); the map
        itself if none has to be turned."""
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
            vars(turned).update(cones=self.cones)  # of the centres of the views, which stay
        return self._turned_maps[key]

    @cached_property
    def _turned_maps(self) -> dict[bytes, "SceneMap"]:
        return {}

    def _localize_turned(
        self, turned: "SceneMap", keypoints: Any, camera: Any, time_limit: float | None, options: dict[str, Any]
    ) -> Solution:
        """The pose of a photo in a map with turned views or, if that is not confident, the better one of it and that in
        this map. Half of the time limit is for the first."""
        start = Clock.now()
        half = None if time_limit is None else time_limit / 2
        upright = turned.localize(keypoints, camera, time_limit=half, **options)
        if upright.verdict == "confident":
            return upright
        left = None if time_limit is None else max(time_limit - (Clock.now() - start), 1e-3)
        best = max(upright, self.localize(keypoints, camera, time_limit=left, **options), key=rank)
        return replace(best, seconds=Clock.now() - start)

    def verify_view(
        self, name: str, keypoints: Any, *, seed: int = 0, time_limit: float | int | None = 10.0
    ) -> Solution:
        """Verify the pose of a view without its own observations.

        The view is taken out of the map, with the points that fewer than two other views see: these have no position
        without it. Its pose is judged on the other points that it can see, whatever points the reconstruction matched
        its keypoints to, and compared with poses elsewhere in the map. The pose is "ambiguous" if another one is about
        as likely, and "failed" if it fits no better than chance or another one is likelier by three decades.

        Args:
            name: Of the view.
            keypoints: (m, 2) pixels, all that were detected in its image, COLMAP's: (0.5, 0.5) is the centre of the
                first one.
            seed: Of the copies of the pose from which its optimum is refined.
            time_limit: Seconds until its competitors in view are no longer tested; None for no limit.

        Returns:
            The solution, as of `bpnp.verify`; `matches` have the ids of points.

        Raises:
            ValueError: For a name that the map does not have, and if fewer than 4 points are left that it can see.
        """
        view, rest = self.named([name])[0], self.without([name])
        pixels = np.asarray(pixels_from(keypoints, view.camera), np.float64)
        place = replace(rest._region(rest.views[0], np.arange(len(rest.points3d))), view=view)
        photo = Photo(pixels, view.camera, place, partial(rest._regions, None, view.camera), seed)
        return verify_pose(photo, view, time_limit=positive("time_limit", time_limit))

    def _lens(
        self, camera: Any, image_size: Any, focal_error: float | int | None, distortion: bool
    ) -> Camera | UnknownCamera:
        """The camera of a photo, or what is known of it."""
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
        camera: Any = None,
        *,
        keypoints: str | Path | None = None,
        name: str | None = None,
        ignore_orientation: bool = False,
        **options: Any,
    ) -> Solution:
        """The pose of a photo from its file, as `bpnp localize` finds it.

        camera: as for `localize`; None for the one that `camera_for` finds, that of the EXIF data, else of views of the
            photo's size, else with an unknown focal length; a SceneMap for that of its views, scaled to the photo's
            size; "unknown" for an unknown focal length whatever EXIF says.
        keypoints: HDF5 file of hloc or COLMAP's database, which has those of the photo under its `name`, by default
            that of the file; None to detect SIFT keypoints.
        ignore_orientation: whether the orientation in the EXIF data is not used. It is a hint: the side that is up is
            tried first (`up_camera` of `localize`). The photo is not turned, as in COLMAP.
        options: focal_error, distortion, views, prior, solver, seed and time_limit, as for `localize`; the first one
            has no effect on a photo whose camera is unknown.
        Raises ValueError for a photo that cannot be read, or of another size than its camera or keypoints, and as
        `localize`.
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
        options = {option: value for option, value in options.items() if value is not None}
        if not ignore_orientation:
            options.setdefault("up_camera", up_from_exif(path))
        if lens is None:
            options.pop("focal_error", None)
            return self.localize(points.pixels, image_size=size, scores=points.scores, **options)
        pixels = points.pixels - (CENTRE if is_opencv(camera) else 0.0)
        return self.localize(pixels, lens, scores=points.scores, **options)

    def camera_for(self, photo: Path, *, exif: bool = True) -> tuple[Camera | None, str]:
        """The camera of a photo, and in words where it is from.

        With the focal length of its EXIF data, the principal point in the middle; else that of views with images of its
        size; None if there is none, or the focal lengths of such views differ by more than a twentieth. Without `exif`
        that of views with images of its shape, scaled to its size: raises ValueError where that would be None.
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
    """The camera for a longer search about a solution: an unknown one has the focal length found, if that is more than
    chance, else all of them are tried."""
    if isinstance(lens, UnknownCamera) and solution.log10_false_alarms < 0:
        return lens.near(camera_from(solution.camera))
    return lens
