"""The camera of a photo: from EXIF for the size that the photo has now, else from the views of the map."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image
from planted_model import HEIGHT, PINHOLE, WIDTH, plant_model

from bpnp import SceneMap
from bpnp.cameras import camera_from
from bpnp.maps.photos import focal_from_exif

TAGS = {
    "FocalLength": 0x920A,
    "FocalLengthIn35mmFilm": 0xA405,
    "FocalPlaneXResolution": 0xA20E,
    "PixelXDimension": 0xA002,
    "PixelYDimension": 0xA003,
}
# 5 mm on a sensor of 4 mm x 3 mm with 1000 pixels a mm: 5,000 pixels of 4,000; the same as 43.27 mm on film.
TAKEN = {"FocalLength": 5.0, "FocalPlaneXResolution": 25400.0, "PixelXDimension": 4000, "PixelYDimension": 3000}


def photo_with(path: Path, size: tuple[int, int] = (400, 300), **tags: object) -> Path:
    image = Image.new("RGB", size)
    exif = image.getexif()
    exif.get_ifd(0x8769).update({TAGS[name]: value for name, value in tags.items()})
    image.save(path, exif=exif)
    return path


@pytest.mark.parametrize(
    ("size", "tags", "focal"),
    [
        ((4000, 3000), TAKEN, 5000),
        ((1000, 750), TAKEN, 1250),  # scaled with its EXIF
        ((750, 1000), TAKEN, 1250),  # and turned
        ((1000, 750), TAKEN | {"FocalLengthIn35mmFilm": 43}, 1250),
        ((1000, 750), {"FocalLengthIn35mmFilm": 43}, 1250),
        ((1000, 750), TAKEN | {"FocalLengthIn35mmFilm": 43, "PixelXDimension": 1000, "PixelYDimension": 750}, 1250),
        ((1000, 750), TAKEN | {"FocalLengthIn35mmFilm": 0}, 1250),
        ((1000, 1000), TAKEN | {"FocalLengthIn35mmFilm": 43}, None),  # cropped, no one knows from what
        ((1000, 750), {"FocalLength": 5.0, "FocalPlaneXResolution": 25400.0}, None),  # at which size is not known
        ((1000, 750), {"FocalLength": 5.0}, None),
        ((1000, 750), TAKEN | {"FocalLengthIn35mmFilm": "?"}, 1250),  # tags of a wrong type are ignored
        ((1000, 750), {"FocalLengthIn35mmFilm": 43, "PixelXDimension": (1000, 1000)}, 1250),
        ((1000, 750), TAKEN | {"PixelXDimension": (4000, 4000)}, None),
        ((1000, 750), {}, None),
    ],
)
def test_the_focal_length_is_that_of_the_photo_as_it_is(
    size: tuple[int, int], tags: dict[str, object], focal: float | None, tmp_path: Path
) -> None:
    photo = photo_with(tmp_path / "a.jpg", size, **tags)
    assert focal_from_exif(photo) == (None if focal is None else pytest.approx(focal, rel=0.01))
    theirs = pycolmap.infer_camera_from_image(photo)
    if set(tags) == {"FocalLengthIn35mmFilm"}:
        assert theirs.has_prior_focal_length
        assert focal_from_exif(photo) == pytest.approx(theirs.focal_length, rel=1e-3)


def test_exif_comes_before_the_views_of_the_map(tmp_path: Path) -> None:
    plant_model(tmp_path / "map", camera=PINHOLE)
    scene = SceneMap.from_colmap(tmp_path / "map")
    photo = photo_with(tmp_path / "a.jpg", (WIDTH, HEIGHT), FocalLengthIn35mmFilm=43)
    camera, source = scene.camera_for(photo)
    assert source == "EXIF"
    np.testing.assert_allclose(camera.matrix, [[994, 0, 400], [0, 994, 300], [0, 0, 1]], atol=1)
    camera, source = scene.camera_for(photo_with(tmp_path / "b.jpg", (WIDTH, HEIGHT)))
    assert source == "view photo 0.jpg of the map"
    np.testing.assert_allclose(camera.matrix, [[520, 0, 400], [0, 520, 300], [0, 0, 1]])


def test_views_with_different_focal_lengths_give_no_camera(tmp_path: Path) -> None:
    """A zoom lens: no view says at which length the photo was taken."""
    plant_model(tmp_path / "map", camera=PINHOLE)
    scene = SceneMap.from_colmap(tmp_path / "map")
    enlarged = replace(scene.views[1], camera=camera_from(("PINHOLE", WIDTH, HEIGHT, [900, 900, 400, 300])))
    scene = replace(scene, views=(scene.views[0], enlarged))
    assert scene.camera_for(photo_with(tmp_path / "b.jpg", (WIDTH, HEIGHT))) == (None, "unknown focal length")
    with pytest.raises(
        ValueError, match=r"the 2 cameras of this shape have focal lengths of 520 to 900 pixels; give --camera"
    ):
        scene.camera_for(tmp_path / "b.jpg", exif=False)


@pytest.mark.slow
def test_a_photo_is_localised_with_any_of_its_cameras(shared_data: Path) -> None:
    """Camera of the map at twice the size, scaled; the same as OpenCV has it. The model has the photo's pose."""
    scene = SceneMap.from_colmap(shared_data / "colmap/fountain-P11/sparse/0")
    photo = shared_data / "photos/fountain-P11/0004.jpg"
    (view,) = scene.named(["0004.jpg"])
    scaled, _ = scene.camera_for(photo, exif=False)
    assert scaled.focal == pytest.approx(view.camera.focal / 2)
    matrix = scaled.matrix - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    for camera in (scene, (matrix, None)):
        solution = scene.localize_photo(photo, camera, views=["0003.jpg", "0005.jpg"])
        assert solution.verdict == "confident"
        np.testing.assert_allclose(solution.rotation, view.rotation, atol=2e-3)
        assert solution.reprojection_error < 1
    with pytest.raises(ValueError, match="0004.jpg has 1536 x .* pixels, but its camera 3072 x 2048"):
        scene.localize_photo(photo, view.camera)
