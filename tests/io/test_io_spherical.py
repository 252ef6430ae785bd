"""Spherical images and cameras are refused wherever they come from."""

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, PngImagePlugin

from epipole.cameras import CameraModel
from epipole.errors import FileFormatError, NoModelError
from epipole.io import read_colmap_model, write_colmap_model
from epipole.io.images.photographs import read_gray, read_header, read_rgb
from epipole.io.images.rgba import read_rgba
from epipole.io.images.video import frame_size
from epipole.io.images.video_files import write_video
from epipole.pipelines.sfm.config import ReconstructConfig
from epipole.pipelines.sfm.photographs import read_image_set
from epipole.pipelines.slam.config import CameraOptions, JobOptions
from epipole.pipelines.slam.sources.intrinsics import find_camera
from io_models import small_model

FAULTS = Path(__file__).parents[2].parent / "shared" / "data" / "faults"
ATTRIBUTE = '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description GPano:ProjectionType="{}"/></x:xmpmeta>'
ELEMENT = "<x:xmpmeta><GPano:ProjectionType>{}</GPano:ProjectionType></x:xmpmeta>"


def write_image(path: Path, xmp: str | None, mode: str = "RGB") -> Path:
    pixels = np.random.default_rng(0).integers(0, 255, (32, 64, len(mode)), np.uint8)
    image = Image.fromarray(pixels, mode)
    if xmp is None:
        image.save(path)
    elif path.suffix == ".png":
        info = PngImagePlugin.PngInfo()
        info.add_itxt("XML:com.adobe.xmp", xmp)
        image.save(path, pnginfo=info)
    elif path.suffix == ".tif":
        image.save(path, tiffinfo={700: xmp.encode()})
    else:
        image.save(path, xmp=xmp.encode())
    return path


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".webp"])
@pytest.mark.parametrize("xmp", [ATTRIBUTE, ELEMENT], ids=["attribute", "element"])
def test_images_with_the_metadata_of_a_panorama_are_refused(tmp_path, suffix, xmp) -> None:
    path = write_image(tmp_path / f"a{suffix}", xmp.format("equirectangular"))
    for read in (read_header, read_rgb, read_gray):
        with pytest.raises(FileFormatError, match=r"equirectangular: spherical .* not supported"):
            read(path)
    for plain in (xmp.format("perspective"), "<x:xmpmeta/>", None):
        assert read_header(write_image(tmp_path / f"b{suffix}", plain)).width == 64
    assert read_rgb(tmp_path / f"b{suffix}").shape == (32, 64, 3)


def test_images_with_transparency_too(tmp_path) -> None:
    with pytest.raises(FileFormatError, match="ProjectionType cylindrical"):
        read_rgba(write_image(tmp_path / "a.png", ATTRIBUTE.format("cylindrical"), "RGBA"))


def test_a_reconstruction_of_spherical_images_says_so(tmp_path) -> None:
    (tmp_path / "photos").mkdir()
    for k in range(3):
        write_image(tmp_path / "photos" / f"{k}.jpg", ATTRIBUTE.format("equirectangular"))
    with pytest.raises(NoModelError, match="spherical"):
        read_image_set(
            tmp_path / "photos", ReconstructConfig(), tmp_path / "memory", progress=lambda progress: None
        )


def test_a_sequence_of_spherical_images_says_so(tmp_path) -> None:
    for k in range(3):
        write_image(tmp_path / f"{k}.jpg", ATTRIBUTE.format("equirectangular"))
    with pytest.raises(FileFormatError, match="spherical"):
        find_camera(tmp_path, JobOptions(fps=10.0), CameraOptions(), lambda progress: None)


@pytest.mark.parametrize("name", ["SPHERICAL", "EQUIRECTANGULAR"])
def test_spherical_cameras_of_colmap_are_refused(tmp_path, name) -> None:
    write_colmap_model(small_model(), tmp_path, text=True)
    lines = (tmp_path / "cameras.txt").read_text().splitlines()
    last = lines[-1].split()
    (tmp_path / "cameras.txt").write_text("\n".join([*lines[:-1], f"{last[0]} {name} 64 32 64 32"]) + "\n")
    with pytest.raises(FileFormatError, match=f"line {len(lines)}: unknown camera model {name}; spherical"):
        read_colmap_model(tmp_path)


@pytest.mark.parametrize(("number", "name"), [(7, "FOV"), (11, "RAD_TAN_THIN_PRISM_FISHEYE"), (99, "99")])
def test_unknown_cameras_of_binary_models_are_named(tmp_path, number, name) -> None:
    write_colmap_model(small_model(), tmp_path)
    data = bytearray((tmp_path / "cameras.bin").read_bytes())
    data[12:16] = number.to_bytes(4, "little")
    (tmp_path / "cameras.bin").write_bytes(data)
    with pytest.raises(FileFormatError, match=f"unknown camera model {name}; supported are SIMPLE_PINHOLE"):
        read_colmap_model(tmp_path)


def test_a_rig_with_more_words_than_sensors_is_refused(tmp_path) -> None:
    write_colmap_model(small_model(), tmp_path, text=True)
    text = (tmp_path / "rigs.txt").read_text().rstrip("\n")
    (tmp_path / "rigs.txt").write_text(f"{text} CAMERA 9 0\n")
    with pytest.raises(FileFormatError, match="not a rig"):
        read_colmap_model(tmp_path)


def box(kind: bytes, content: bytes, *, is_long: bool = False) -> bytes:
    size = len(content) + (16 if is_long else 8)
    return (
        (1).to_bytes(4, "big") + kind + size.to_bytes(8, "big") + content
        if is_long
        else size.to_bytes(4, "big") + kind + content
    )


@pytest.mark.parametrize(
    "metadata",
    [
        box(
            b"uuid",
            b"<rdf:SphericalVideo><GSpherical:Spherical>true</GSpherical:Spherical></rdf:SphericalVideo>",
        ),
        box(b"sv3d", box(b"svhd", b"maker") + box(b"proj", box(b"equi", bytes(20)))),
    ],
    ids=["version 1", "version 2"],
)
@pytest.mark.parametrize("is_long", [True, False])
def test_spherical_videos_are_refused(tmp_path, metadata, is_long) -> None:
    write_video(tmp_path / "plain.mp4", [np.zeros((48, 96, 3), np.uint8)] * 3, 10.0)
    assert frame_size(tmp_path / "plain.mp4") == (96, 48)
    file = box(b"ftyp", b"isom") + box(b"mdat", bytes(100), is_long=is_long)
    (tmp_path / "a.mp4").write_bytes(file + box(b"moov", box(b"trak", metadata), is_long=is_long))
    with pytest.raises(FileFormatError, match="the video is spherical"):
        frame_size(tmp_path / "a.mp4")
    for other in (file + metadata, file + bytes(50), b"\x1a\x45\xdf\xa3" + metadata):
        (tmp_path / "b.mp4").write_bytes(other)  # no index: OpenCV says what is wrong
        with pytest.raises(FileFormatError, match="not a readable video"):
            frame_size(tmp_path / "b.mp4")


def write_fisheye_model(folder: Path) -> None:
    (folder / "cameras.txt").write_text("1 RADIAL_FISHEYE 512 512 150 256 256 0 0\n")
    (folder / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n\n2 1 0 0 0 -1 0 0 1 b.png\n\n")
    (folder / "points3D.txt").write_text("")


def test_the_fisheye_of_a_half_circle_is_read_as_a_fisheye(tmp_path) -> None:
    write_fisheye_model(tmp_path)
    for folder in (tmp_path, *([FAULTS / "model_fisheye180"] if FAULTS.is_dir() else [])):
        camera = read_colmap_model(folder).cameras[0]
        assert camera.model == CameraModel.OPENCV_FISHEYE
        assert camera.params.tolist() == [150, 150, 255.5, 255.5, 0, 0, 0, 0]


def test_the_suffix_of_the_file_does_not_matter(tmp_path) -> None:
    data = io.BytesIO()
    Image.new("RGB", (64, 32)).save(data, "JPEG", xmp=ATTRIBUTE.format("Equirectangular").encode())
    (tmp_path / "a.png").write_bytes(data.getvalue())  # a JPEG by another name
    with pytest.raises(FileFormatError, match="Equirectangular"):
        read_header(tmp_path / "a.png")
