"""What the file of a photo says about its camera."""

from pathlib import Path
from typing import Any

IFD_EXIF = 0x8769
FOCAL_LENGTH, FOCAL_LENGTH_35MM = 0x920A, 0xA405
RESOLUTION_X, RESOLUTION_UNIT = 0xA20E, 0xA210
DIAGONAL_35MM = 43.2666  # of a frame of 36 x 24 mm; equivalent focal lengths are by the diagonal (CIPA DCG-001)
MILLIMETRES = {2: 25.4, 3: 10.0}  # of the resolution's unit, by its EXIF number: inch, centimetre

ColmapCamera = tuple[str, int, int, tuple[float, float, float]]


def photo_size(photo: Path) -> tuple[int, int]:
    """Width and height of a photo in pixels. Raises ValueError if it cannot be read."""
    from PIL import Image

    try:
        with Image.open(photo) as image:
            return image.size
    except OSError as error:
        raise ValueError(f"expected a photo that can be read, got {photo}: {error}; try a JPEG or PNG file") from error


def camera_from_exif(photo: Path) -> ColmapCamera:
    """("SIMPLE_PINHOLE", width, height, (f, cx, cy)), f in pixels from EXIF, the principal point in the centre.

    From the focal length in millimetres and the resolution of the sensor, or from the equivalent at 35 mm film.
    Raises ValueError for a photo that cannot be read or does not have either.
    """
    from PIL import Image

    try:
        with Image.open(photo) as image:
            (width, height), tags = image.size, image.getexif().get_ifd(IFD_EXIF)
    except OSError as error:
        raise ValueError(f"expected a photo that can be read, got {photo}: {error}") from error
    focal = _focal(tags, width, height)
    if focal is None:
        raise ValueError(
            f"expected a focal length in the EXIF data of {photo}, got none; try --camera, such as "
            f"SIMPLE_PINHOLE,{1.2 * max(width, height):.0f},{width / 2:g},{height / 2:g}"
        )
    return "SIMPLE_PINHOLE", width, height, (focal, width / 2, height / 2)


def _focal(tags: dict[int, Any], width: int, height: int) -> float | None:
    """Pixels."""
    own, resolution = float(tags.get(FOCAL_LENGTH, 0)), float(tags.get(RESOLUTION_X, 0))
    unit = MILLIMETRES.get(int(tags.get(RESOLUTION_UNIT, 2)))
    if own > 0 and resolution > 0 and unit is not None:
        return own * resolution / unit
    equivalent = float(tags.get(FOCAL_LENGTH_35MM, 0))
    return equivalent * (width**2 + height**2) ** 0.5 / DIAGONAL_35MM if equivalent > 0 else None
