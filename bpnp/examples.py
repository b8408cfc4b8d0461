"""Example problems with their true pose.

Nothing is downloaded: the points come from the generators of the training data, and photos are drawn.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from PIL import Image, ImageDraw, ImageEnhance
from scipy.spatial.transform import Rotation

from bpnp.arrays import Array
from bpnp.cameras import import_pycolmap
from bpnp.datamodules.shapes import procedural_shape, sample_surface
from bpnp.datamodules.synthetic_maps.maps import LONG_SIDE, MapOptions, draw_map_problem

Kind = Literal["mesh", "photo", "leds"]
CAMERA = np.array([[800.0, 0.0, 640.0], [0.0, 800.0, 480.0], [0.0, 0.0, 1.0]])  # images of 1280 x 960 pixels
NOISE_PX = 0.5
LEDS, LIGHTS = 17, 3
PHOTO_CAMERA = ("PINHOLE", 640, 480, (560.0, 560.0, 320.0, 240.0))  # COLMAP's model, size and parameters in pixels
HOUSES_APART, WRONG_IMAGE = 40.0, "07.jpg"  # distance of the houses of `draw_map`, metres; image with a wrong pose
TEXELS = 80.0  # texels per metre of a texture, about the resolution of the photos
LIGHT = (0.95, 0.6, 0.8, 0.7, 1.0, 0.4)  # brightness of the faces of a box towards -y, y, -x, x, z, -z
COLOURS = {
    "brick": np.array([(150, 70, 60), (180, 90, 70), (190, 170, 150), (90, 50, 40), (190, 200, 200)]),
    "ground": np.array([(70, 110, 60), (110, 120, 80), (150, 150, 140), (100, 90, 90), (60, 80, 50)]),
    "wood": np.array([(170, 110, 60), (120, 70, 40), (200, 150, 90), (180, 190, 200)]),
    "slate": np.array([(60, 70, 90), (90, 100, 120), (50, 50, 60), (120, 130, 140)]),
}  # RGB
Face = tuple[Array, Array, Array, Image.Image]  # corner, edges a and b (metres, a x b outward), texture


@dataclass(frozen=True)
class Example:
    """Problem with its true pose."""

    points2d: Array  # image points (m, 2), pixels
    points3d: Array  # scene points (n, 3)
    camera: Array  # K (3, 3), pixels
    rotation: Array  # true R (3, 3), camera = R p + t
    translation: Array  # true t (3,), scene units
    normals3d: Array | None = None  # outward normals (n, 3), None for points without normals

    def __repr__(self) -> str:
        normals = "" if self.normals3d is None else " with normals"
        return f"Example({len(self.points2d)} image points, {len(self.points3d)} scene points{normals})"

    def rotation_error_deg(self, rotation: Any) -> float:
        """Return the angle in [0, 180] degrees between an estimated rotation (3, 3) and the true one.

        It is NaN for a rotation that is not finite, such as that of a failed solution.

        >>> import numpy as np
        >>> from bpnp.examples import load
        >>> load("mesh").rotation_error_deg(np.full((3, 3), np.nan))
        nan
        """
        if not np.isfinite(np.asarray(rotation)).all():
            return float("nan")
        return float(np.degrees(Rotation.from_matrix(np.asarray(rotation) @ self.rotation.T).magnitude()))


def load(kind: Kind | str, *, seed: int = 0) -> Example:
    """Return an example problem with its true pose.

    - "mesh": 200 points on a shape, all of them visible, seen from any side.
    - "photo": keypoints of a photo and points of a map; a third of them have no correspondence.
    - "leds": the LEDs that face the camera of 17 LEDs on a ring, with their normals, and 3 background lights.

    Args:
        kind: Kind of problem: "mesh", "photo" or "leds".
        seed: Random seed, default 0; the same seed gives the same problem.

    Returns:
        The problem.

    Raises:
        ValueError: The kind is unknown.

    >>> from bpnp.examples import load
    >>> load("mesh").points2d.shape
    (200, 2)
    """
    if kind not in get_args(Kind):
        raise ValueError(f"there is no example {kind!r}; the examples are {', '.join(get_args(Kind))}")
    rng = np.random.default_rng(seed)
    return {"mesh": _mesh, "photo": _photo, "leds": _leds}[kind](rng)


def _mesh(rng: np.random.Generator) -> Example:
    points = sample_surface(procedural_shape(rng), 200, rng)
    points = (points - points.mean(0)) / np.abs(points - points.mean(0)).max()
    rotation = Rotation.from_quat(rng.standard_normal(4)).as_matrix()
    translation = np.array([0.1, -0.2, 4.0])
    pixels = _pixels(points, rotation, translation) + rng.normal(0, NOISE_PX, (len(points), 2))
    return Example(rng.permutation(pixels), points, CAMERA, rotation, translation)


def _photo(rng: np.random.Generator) -> Example:
    options = MapOptions(
        num_points=300, min_points=150, outliers=0.33, views=(1, 1), kinds={"facades": 1.0}, noise_px=NOISE_PX
    )
    problem = draw_map_problem("photo", options, rng)
    middle = LONG_SIDE / 2  # of the photo, upright or not
    camera = np.array([[problem.focal, 0.0, middle], [0.0, problem.focal, middle], [0.0, 0.0, 1.0]])
    pixels = rng.permutation(problem.focal * problem.points2d.astype(np.float64) + middle)
    return Example(pixels, problem.points3d.astype(np.float64), camera, problem.rotation, problem.translation)


def _leds(rng: np.random.Generator) -> Example:
    angle = np.sort(rng.uniform(0, 2 * np.pi, LEDS))
    height = rng.uniform(-0.03, 0.03, LEDS)  # metres
    points = np.stack([0.1 * np.cos(angle), 0.1 * np.sin(angle), height], -1)
    normals = points * [1, 1, 0] / 0.1
    rotation = Rotation.from_euler("xyz", [75, 10, 40], degrees=True).as_matrix()
    translation = np.array([0.02, 0.01, 0.6])  # metres
    facing = ((points @ rotation.T + translation) * (normals @ rotation.T)).sum(-1) < 0
    pixels = _pixels(points[facing], rotation, translation) + rng.normal(0, NOISE_PX, (facing.sum(), 2))
    lights = rng.uniform(pixels.min(0) - 40, pixels.max(0) + 40, (LIGHTS, 2))
    return Example(rng.permutation(np.concatenate([pixels, lights])), points, CAMERA, rotation, translation, normals)


def _pixels(points: Any, rotation: Any, translation: Any) -> Any:
    camera = points @ rotation.T + translation
    return camera[:, :2] / camera[:, 2:] @ CAMERA[:2, :2].T + CAMERA[:2, 2]


def draw_photos(folder: Path | str, *, count: int = 14, seed: int = 0) -> dict[str, tuple[Array, Array]]:
    """Draw photos of a house and some boxes, taken on an arc around them, for COLMAP to build a map from.

    The photos 00.png, 01.png, ... have 640 x 480 pixels; their camera is `bpnp.examples.PHOTO_CAMERA`.

    Args:
        folder: Folder for the photos, created if needed; photos of these names are replaced.
        count: Number of photos, default 14.
        seed: Random seed, default 0.

    Returns:
        True pose of each photo by its file name: R (3, 3) and t (3,), camera = R p + t, metres.
    """
    rng = np.random.default_rng(seed)
    faces, poses = _build_scene(rng), {}
    Path(folder).mkdir(parents=True, exist_ok=True)
    for number, angle in enumerate(np.radians(np.linspace(-75, 15, count))):
        distance, height = rng.uniform(8, 10), rng.uniform(1.5, 3.4)
        centre = np.array([distance * np.sin(angle), -distance * np.cos(angle), height])
        forward = rng.uniform(-0.5, 0.5, 3) + [-0.5, -0.5, 1.1] - centre  # to the corner of the house
        right = np.cross(forward, [0, 0, 1])
        axes = np.stack([right, np.cross(forward, right), forward])
        upright = axes / np.linalg.norm(axes, axis=1, keepdims=True)
        rotation = Rotation.from_euler("z", rng.normal(0, 3), degrees=True).as_matrix() @ upright
        name = f"{number:02d}.png"
        poses[name] = rotation, -rotation @ centre
        _render(faces, *poses[name]).save(Path(folder) / name)
    return poses


def draw_map(folder: Path | str, *, seed: int = 0) -> dict[str, tuple[Array, Array]]:
    """Draw a COLMAP model of two equal houses in which one image has a wrong pose.

    Eleven images show a house and its copy 40 metres to the right. The image 07.jpg shows the second house but has the
    pose and the points of the first one, an error of structure from motion that equal buildings cause. The surroundings
    of the houses differ.

    Args:
        folder: New or empty folder for cameras, images and points3D, .bin.
        seed: Random seed, default 0.

    Returns:
        True pose of each image by its name: R (3, 3) and t (3,), camera = R p + t, metres.

    Raises:
        ValueError: The folder exists and is not empty.
    """
    path = Path(folder)
    if path.exists() and any(path.iterdir()):
        raise ValueError(f"{path} is not empty; name a new folder for the map")
    pycolmap = import_pycolmap()
    rng = np.random.default_rng(seed)
    house = rng.uniform((-5, -6, -1), (5, 1, 1), (90, 3))  # x to the right, y down, z away, metres
    surroundings = [rng.uniform((-9, -2, -3), (9, 1, 3), (60, 3)) for _ in range(2)]
    offset = np.array([HOUSES_APART, 0.0, 0.0])
    points = np.concatenate([house, house + offset, surroundings[0], surroundings[1] + offset])
    poses, parts = dict[str, tuple[Array, Array]](), np.split(np.arange(len(points)), (90, 180, 240))
    model, (kind, width, height, parameters) = pycolmap.Reconstruction(), PHOTO_CAMERA
    lens = pycolmap.Camera(camera_id=1, model=kind, width=width, height=height, params=parameters)
    model.add_camera_with_trivial_rig(lens)
    tracks = [pycolmap.Track() for _ in points]
    for number in range(11):
        second = number % 2
        name, rotation = f"{number:02d}.jpg", Rotation.from_euler("yx", rng.normal(0, 6, 2), degrees=True).as_matrix()
        centre = np.array([rng.uniform(-5, 5), rng.uniform(-1, 0.5), rng.uniform(-16, -12)]) + second * offset
        visible = np.concatenate([parts[second], parts[2 + second]])
        visible = np.sort(rng.choice(visible, round(0.8 * len(visible)), replace=False))
        pixels = np.asarray(lens.img_from_cam((points[visible] - centre) @ rotation.T)) + rng.normal(
            0, 0.4, (len(visible), 2)
        )
        poses[name] = rotation, -rotation @ centre
        if name == WRONG_IMAGE:  # its points are those of the first house, the others have none
            centre, visible = centre - offset, np.where(visible < 180, visible - 90, -1)
        others = rng.uniform((0, 0), (width, height), (80, 2))  # keypoints without a point
        model.add_image_with_trivial_frame(
            pycolmap.Image(name, np.concatenate([pixels, others]), 1, number + 1),
            pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ centre),
        )
        for element, point in enumerate(visible):
            if point >= 0:
                tracks[point].add_element(number + 1, element)
    for point, track in zip(points, tracks, strict=True):
        model.add_point3D(point, track)
    path.mkdir(parents=True, exist_ok=True)
    model.write_binary(path)
    return poses


def _build_scene(rng: np.random.Generator) -> list[Face]:
    """Return the faces of the ground, a house with a flat roof, and boxes around its corner."""
    edges = np.diag([15.0, 14.0, 0.0])
    faces = [(np.array([-7.0, -8.0, 0.0]), edges[0], edges[1], _texture(15, 14, "ground", rng))]
    for corner, size, colours in (
        ((-2.0, -1.0, 0.0), (5.0, 4.0, 3.2), "brick"),
        ((-2.3, -1.3, 3.2), (5.6, 4.6, 0.3), "slate"),
        ((-3.6, -2.6, 0.0), (1.2, 1.0, 1.0), "wood"),
        ((1.0, -3.0, 0.0), (1.5, 1.2, 0.8), "wood"),
        ((-4.5, 1.0, 0.0), (1.0, 1.6, 1.5), "slate"),
    ):
        low, (x, y, z) = np.array(corner), np.diag(size)
        sides = (low, x, z), (low + x + y, -x, z), (low + y, -y, z), (low + x, y, z), (low + z, x, y), (low, y, x)
        for (start, a, b), light in zip(sides, LIGHT, strict=True):
            texture = _texture(np.linalg.norm(a), np.linalg.norm(b), colours, rng)
            faces.append((start, a, b, ImageEnhance.Brightness(texture).enhance(light)))
    return faces


def _texture(width: Any, height: Any, colours: str, rng: np.random.Generator) -> Image.Image:
    """Draw overlapping rectangles of all sizes: detail at every scale, as in natural images. Sides are in metres.

    Source: Lee, Mumford, Huang, Occlusion models for natural images (dead leaves), IJCV 2001.
    """
    w, h = round(TEXELS * width), round(TEXELS * height)
    picture = Image.new("RGB", (w, h), tuple(COLOURS[colours].mean(0).astype(int)))
    pen = ImageDraw.Draw(picture)
    sides = np.sort(rng.uniform(90.0**-2, 3.0**-2, w * h // 60) ** -0.5)[::-1]  # texels, density side^-3
    for side in sides:
        colour = rng.choice(COLOURS[colours]) + rng.normal(0, 20)
        low = rng.uniform((-side, -side), (w, h))
        high = low + side * rng.uniform((1.0, 0.5), (1.8, 1.0))
        pen.rectangle([*low, *high], tuple(np.clip(colour, 0, 255).astype(int)))
    return picture


def _render(faces: Sequence[Face], rotation: Array, translation: Array) -> Image.Image:
    """Render faces as a photo by `PHOTO_CAMERA`; each pixel is the mean of four samples of the nearest face."""
    _, width, height, (fx, fy, cx, cy) = PHOTO_CAMERA
    camera = np.array([[2 * fx, 0, 2 * cx], [0, 2 * fy, 2 * cy], [0, 0, 1]])
    y, x = np.indices((2 * height, 2 * width), np.float32) + np.float32(0.5)
    pixels = np.stack([x, y, np.ones_like(x)]).reshape(3, -1)
    photo = Image.new("RGB", (2 * width, 2 * height), (160, 206, 235))  # the sky
    nearest = np.zeros(x.shape)  # 1 / depth
    for corner, a, b, texture in faces:
        to_pixels = camera @ np.column_stack([rotation @ a, rotation @ b, rotation @ corner + translation])
        if np.linalg.det(to_pixels) >= 0:
            continue  # a back face
        to_face = np.linalg.inv(to_pixels).astype(np.float32)
        u, v, inverse_depth = (to_face @ pixels).reshape(3, *x.shape)
        visible = (np.minimum(u, v) >= 0) & (np.maximum(u, v) <= inverse_depth) & (inverse_depth > nearest)
        nearest[visible] = inverse_depth[visible]
        to_texels = np.diag([*texture.size, 1]) @ to_face
        mapping = (to_texels / to_texels[2, 2]).ravel()[:8]
        warped = texture.transform(photo.size, Image.Transform.PERSPECTIVE, mapping, Image.Resampling.BILINEAR)
        photo.paste(warped, mask=Image.fromarray(visible))
    return photo.resize((width, height), Image.Resampling.BOX)
