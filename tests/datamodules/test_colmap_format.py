import struct
from pathlib import Path

import numpy as np
import pytest
from planted_model import plant_model

from bpnp.datamodules.colmap.model_files import ColmapError
from bpnp.datamodules.colmap.reconstruction import read_reconstruction


@pytest.mark.parametrize("suffix", ["bin", "txt"])
@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_a_truncated_file_is_one_error_that_names_it(name: str, suffix: str, tmp_path: Path) -> None:
    plant_model(tmp_path, text=suffix == "txt")
    path = tmp_path / f"{name}.{suffix}"
    content = path.read_bytes()
    cuts = {0, 1, 4, 8, 9, 20, len(content) - 1, *np.linspace(0, len(content) - 1, 60).astype(int).tolist()}
    if suffix == "txt":  # also between lines, where every line that is left is whole
        cuts |= {i + 1 for i, byte in enumerate(content[:-1]) if byte == ord("\n")}
        cuts |= {len(content) - 2, len(content) - 3}
        # Fewer digits of the last parameter of a camera, and fewer keypoints without a point, are whole records too.
        whole = content.rstrip().rfind(b" ") if name == "cameras" else content.rfind(b"\n", 0, -1)
        cuts = {cut for cut in cuts if cut < (len(content) - 1 if name == "points3D" else whole)}
        inside = content.rfind(b" 57 ")  # a keypoint of the last image with a point: others with points follow
        cuts |= {inside + 4, inside + 2, inside - 3} if name == "images" else set()
    for cut in sorted(cuts):
        path.write_bytes(content[:cut])
        with pytest.raises(ColmapError, match=f"{name}.{suffix}"):
            read_reconstruction(tmp_path)


@pytest.mark.parametrize("header", [True, False])
def test_a_text_model_whose_last_line_has_no_break_is_read_if_its_header_has_the_count(
    header: bool, tmp_path: Path
) -> None:
    plant_model(tmp_path, text=True)
    expected = read_reconstruction(tmp_path)
    for path in tmp_path.glob("*.txt"):
        lines = [line for line in path.read_bytes().splitlines(keepends=True) if header or not line.startswith(b"#")]
        path.write_bytes(b"".join(lines)[:-1])
    if not header:
        with pytest.raises(ColmapError, match="cameras.txt ends without a line break, .* looks truncated"):
            read_reconstruction(tmp_path)
        return
    read = read_reconstruction(tmp_path)
    np.testing.assert_array_equal(read.points3d, expected.points3d)
    assert [image.name for image in read.images] == [image.name for image in expected.images]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("cameras.bin", b"\x89PNG\r\n\x1a\n" + bytes(range(256)), "cameras.bin"),
        ("images.bin", np.random.default_rng(0).bytes(5000), "images.bin is truncated or not a COLMAP file"),
        ("points3D.bin", b"# text\n" * 99, "points3D.bin is truncated or not a COLMAP file"),
        ("cameras.bin", struct.pack("<QIiQQ4d", 1, 1, 77, 9, 9, 1, 1, 1, 1), "a camera of the unknown model 77"),
        (
            "cameras.bin",
            struct.pack("<QIiQQ4d", 1, 1, 1, 9, 9, np.nan, 1, 1, 1),
            "camera 1 of image .*: the parameters of a PINHOLE camera hold NaN or infinity",
        ),
        (
            "cameras.bin",
            struct.pack("<QIiQQ4d", 1, 1, 1, 9, 9, -2, -2, 1, 1),
            "focal length of a camera has to be positive; .* give -2",
        ),
        ("cameras.bin", struct.pack("<QIiQQ4d", 1, 7, 1, 9, 9, 1, 1, 1, 1), "camera 1 of image .* is missing"),
        (
            "cameras.bin",
            struct.pack("<QIiQQ5d", 1, 1, 1, 9, 9, 1, 1, 1, 1, 1),
            "should end at byte 64, but has 72 bytes",
        ),
        ("images.bin", bytes(8), "images.bin has no records"),
        ("points3D.bin", bytes(8), "points3D.bin has no records"),
        (
            "points3D.txt",
            b"1 nan 0 0 0 0 0 0\n",
            "pycolmap cannot read the model in .*cameras.txt, images.txt and points3D.txt: ",
        ),
        ("points3D.txt", b"# Number of points: 0\n", "points3D.txt has no records"),
        ("cameras.txt", b"1 PINHOLE 9 9 1 1 1\n", "pycolmap cannot read .*cameras.txt, .*: .*VerifyParams"),
        (
            "cameras.txt",
            b"1 PINHALL 9 9 1 1 1 1\n",
            "pycolmap cannot read .*cameras.txt, .*: Camera model does not exist",
        ),
        (
            "images.txt",
            b"1 1 0 0 0 zero 0 0 1 a.jpg\n1 1 1\n",
            "pycolmap cannot read .*images.txt and .*: .*cam_from_world",
        ),
        ("images.txt", b"1 1 0 0 0 0 0 0 1 a.jpg\n1 1 1 2\n", "pycolmap cannot read .*images.txt and "),
        ("points3D.txt", b"\x00\xff\xfe garbage\n", "pycolmap cannot read .*points3D.txt: "),
        ("points3D.txt", b"99999999999999999999 0 0 0 0 0 0 0\n", "pycolmap cannot read .*points3D.txt: "),
    ],
)
def test_a_foreign_file_is_one_error_that_names_it(name: str, content: bytes, message: str, tmp_path: Path) -> None:
    plant_model(tmp_path, text=name.endswith("txt"))
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ColmapError, match=message):
        read_reconstruction(tmp_path)


def test_a_missing_file_or_folder_is_one_error(tmp_path: Path) -> None:
    plant_model(tmp_path / "scene")
    (tmp_path / "scene" / "points3D.bin").unlink()
    for folder in ("scene", "nowhere"):
        with pytest.raises(ColmapError, match=f"{folder} is no COLMAP model .* Give a folder such as sparse/0"):
            read_reconstruction(tmp_path / folder)
