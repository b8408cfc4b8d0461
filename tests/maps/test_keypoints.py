"""Keypoints are found where the picture has them, and features of another photo or size are refused."""

from pathlib import Path

import h5py
import numpy as np
import pycolmap
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

from bpnp.maps.photos import detected_keypoints, focal_from_exif, photo_size, read_features
from bpnp.report.images import read_photo


@pytest.fixture
def blobs(tmp_path: Path) -> tuple[Path, np.ndarray, np.ndarray]:
    """A picture of dark discs with known centres, in COLMAP's coordinates, and radii."""
    centres = np.array([[60.5, 50.5], [160.5, 60.5], [70.5, 150.5], [170.0, 160.0]])
    radii = np.array([5.0, 8.0, 11.0, 15.0])
    x, y = np.meshgrid(np.arange(240) + 0.5, np.arange(200) + 0.5)
    picture = np.full((200, 240), 220.0)
    for (cx, cy), radius in zip(centres, radii, strict=True):
        picture -= 170 / (1 + np.exp(2 * (np.hypot(x - cx, y - cy) - radius)))
    path = tmp_path / "discs.png"
    Image.fromarray(picture.astype(np.uint8)).save(path)
    return path, centres, radii


def test_discs_are_found_at_their_centres_and_large_ones_are_stronger(blobs) -> None:
    path, centres, radii = blobs
    found = detected_keypoints(path)
    assert found.size == photo_size(path) == (240, 200)
    distance = np.linalg.norm(found.pixels[:, None] - centres, axis=-1)
    assert (distance.min(0) < 0.3).all()
    sizes = found.scores[distance.argmin(0)]
    np.testing.assert_allclose(sizes / radii, np.median(sizes / radii), rtol=0.25)


def test_keypoints_of_a_photo_with_exif_orientation_are_in_stored_pixels(blobs, tmp_path: Path) -> None:
    """COLMAP, the camera of EXIF, the check of sizes and the picture over the photo use these axes too."""
    path, *_ = blobs
    tags = Image.Exif()
    tags[0x0112] = 6  # to be shown turned by 90 degrees, as phones have it
    Image.open(path).save(tmp_path / "turned.png", exif=tags)
    found = detected_keypoints(tmp_path / "turned.png")
    assert found.size == photo_size(tmp_path / "turned.png")
    np.testing.assert_array_equal(found.pixels, detected_keypoints(path).pixels)


def test_keypoints_are_as_faint_as_those_of_colmap_and_the_largest(tmp_path: Path) -> None:
    """A map's points come from faint keypoints too; without them most of the map would have no correspondence."""
    noise = np.random.default_rng(0).normal(size=(200, 240))
    picture = sum(gaussian_filter(noise, width) * width for width in (1.5, 3.0, 6.0)) * 0.04 + 0.5
    Image.fromarray((255 * picture).round().clip(0, 255).astype(np.uint8)).save(tmp_path / "noise.png")
    found = detected_keypoints(tmp_path / "noise.png")
    pycolmap.extract_features(tmp_path / "database.db", tmp_path, image_names=["noise.png"])
    with pycolmap.Database.open(tmp_path / "database.db") as content:
        theirs = content.read_keypoints(content.read_image_with_name("noise.png").image_id)[:, :2]
    distance = np.linalg.norm(theirs[:, None] - found.pixels, axis=-1).min(1)
    assert (distance < 1).mean() > 0.8
    largest = detected_keypoints(tmp_path / "noise.png", most=20)
    np.testing.assert_array_equal(np.sort(largest.scores), np.sort(found.scores)[-len(largest.scores) :])


def test_a_file_that_is_no_photo_is_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_text("no photo")
    for read in (detected_keypoints, focal_from_exif, photo_size):
        with pytest.raises(ValueError, match=r"cannot read the photo .*a\.jpg"):
            read(tmp_path / "a.jpg")
    with pytest.raises(ValueError, match=r"cannot read the photo .*a\.jpg"):
        read_photo(tmp_path / "a.jpg")
    Image.new("L", (64, 64)).save(tmp_path / "black.png")
    with pytest.raises(ValueError, match=r"no keypoints were found in .*black\.png"):
        detected_keypoints(tmp_path / "black.png")


def test_a_photo_with_more_pixels_than_pillow_reads_is_one_clear_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Image.new("L", (64, 64)).save(tmp_path / "large.png")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 64 * 64 // 2 - 1)  # an error from twice as many, 200 megapixels
    for read in (focal_from_exif, photo_size, read_photo):
        with pytest.raises(ValueError, match=r"the photo .*large\.png is too large: .*; reduce its size"):
            read(tmp_path / "large.png")


def test_keypoints_of_hloc_are_read_and_wrong_files_named(tmp_path: Path) -> None:
    path = tmp_path / "features.h5"
    with h5py.File(path, "w") as file:
        group = file.create_group("query/a.jpg")
        group["keypoints"] = np.array([[0.0, 0.0], [99.0, 49.0]], np.float32)
        group["scores"] = np.array([0.25, 0.5])
        group["image_size"] = [100, 50]
    found = read_features(path, "query/a.jpg")
    np.testing.assert_array_equal(found.pixels, [[0.5, 0.5], [99.5, 49.5]])
    np.testing.assert_array_equal(found.scores, [0.25, 0.5])
    with pytest.raises(ValueError, match=r"features\.h5 has no keypoints of b\.jpg, but of query"):
        read_features(path, "b.jpg")
    with h5py.File(path, "a") as file:
        file["none.jpg/keypoints"] = np.zeros((0, 2))
    assert read_features(path, "none.jpg", (200, 100)).pixels.shape == (0, 2)
    with h5py.File(path, "a") as file:
        file["c.jpg"] = np.zeros((5, 2))  # an array without a group
    with pytest.raises(ValueError, match=r"features\.h5 has no keypoints of c\.jpg, but of"):
        read_features(path, "c.jpg")
    with pytest.raises(ValueError, match=r"those of a photo of size \(100, 50\), but the photo has \(200, 100\)"):
        read_features(path, "query/a.jpg", (200, 100))
    with h5py.File(path, "a") as file:
        del file["query/a.jpg/image_size"]
    with pytest.raises(
        ValueError, match=r"1 keypoints are outside the 80 x 50 pixels of query/a\.jpg .*, such as \[99\.5"
    ):
        read_features(path, "query/a.jpg", (80, 50))
    path.write_bytes(b"something else")
    with pytest.raises(ValueError, match="is neither an HDF5 file of keypoints nor a database of COLMAP"):
        read_features(path, "query/a.jpg")


def test_features_that_claim_terabytes_are_refused(tmp_path: Path) -> None:
    """A chunked data set has a size without a value stored."""
    with h5py.File(tmp_path / "features.h5", "w") as file:
        file.create_dataset("a.jpg/keypoints", (10**12, 2), "f4", chunks=(1024, 2))
    with pytest.raises(
        ValueError, match=r"a.jpg/keypoints in .*features.h5 states float32 of shape \(1000000000000, 2\)"
    ):
        read_features(tmp_path / "features.h5", "a.jpg")
