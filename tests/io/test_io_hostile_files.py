"""Damaged files that were once read wrongly: models, calibrations, images and videos (see also tests/fuzz)."""

import io
import json
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from example_files import GPS, KALIBR, MOTION, PAIR, RGB, XML
from PIL import Image

from epipole.errors import FileFormatError
from epipole.io import read_g2o, read_transforms
from epipole.io.calibration.files import (
    read_calibration,
    read_stereo_rig,
    write_calibration,
    write_opencv_yaml,
)
from epipole.io.images.depth_maps import read_png16, write_png16
from epipole.io.images.exif import new_exif
from epipole.io.images.photographs import copy_or_rotate, read_gray, read_header, read_mask, read_rgb
from epipole.io.images.video import extract_frames
from hostile_bytes import read_or_refuse


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("damaged")


@pytest.mark.parametrize(
    "line",
    [
        f"VERTEX_SE2 {1 << 63} 0 0 0",
        "VERTEX_SE3:QUAT 0 1 2 3 0 0 0 0",
        "VERTEX_SE3:QUAT 0 1 2 3 1e200 0 0 1e200",
        "VERTEX_SIM3:QUAT 0 1 2 3 0 0 0 1 -2",
        "EDGE_SE3:QUAT 0 0 1 2 3 0 0 0 0" + 21 * " 0",
    ],
)
def test_impossible_pose_graphs(folder: Path, line: str) -> None:
    """A name beyond 64 bits, quaternions without direction, a scale that turns the world inside out."""
    first = line.split()[0].replace("EDGE", "VERTEX")
    rest = {"VERTEX_SE2": "0 0 0", "VERTEX_SE3:QUAT": "0 0 0 0 0 0 1", "VERTEX_SIM3:QUAT": "0 0 0 0 0 0 1 1"}[
        first
    ]
    sound = f"{first} {0 if 'EDGE' in line else 7} {rest}\n"
    (folder / "sound.g2o").write_text(sound)
    assert len(read_g2o(folder / "sound.g2o").graph) == 1
    (folder / "impossible.g2o").write_text(sound + line + "\n")
    with pytest.raises(FileFormatError, match=r"impossible\.g2o: line 2: "):
        read_g2o(folder / "impossible.g2o")


def test_the_size_of_a_picture_of_900_megapixels_is_read(folder: Path) -> None:
    """Pillow refuses to look at its header, with an error of its own."""
    (folder / "huge.pbm").write_bytes(b"P4\n30000 30000\n\x80")
    frame = {"file_path": "huge.pbm", "transform_matrix": np.eye(4).tolist()}
    (folder / "huge.json").write_text(json.dumps({"camera_angle_x": 1.1, "frames": [frame]}))
    camera = read_transforms(folder / "huge.json").cameras[0]
    assert (camera.width, camera.height) == (30000, 30000)


def encoded(**options: object) -> bytes:
    """A JPEG."""
    stream = io.BytesIO()
    Image.fromarray(RGB).save(stream, "JPEG", **options)
    return stream.getvalue()


EXIF = new_exif("Canon", "Canon EOS 5D", 35.0, GPS)


def spoilt_exif(valid: bytes, exif: bytes) -> bytes:
    """A JPEG with this EXIF block (in its APP1 segment) in the place of its own."""
    start = valid.index(b"Exif\0\0")
    length = int.from_bytes(valid[start - 2 : start], "big")
    segment = (len(exif) + 8).to_bytes(2, "big") + b"Exif\0\0" + exif
    return valid[: start - 2] + segment + valid[start - 2 + length :]


def test_an_exif_block_that_is_put_back_is_read(folder: Path) -> None:
    block = EXIF.tobytes().removeprefix(b"Exif\0\0")
    (folder / "again.jpg").write_bytes(spoilt_exif(encoded(exif=EXIF), block))
    header = read_header(folder / "again.jpg")
    assert header.make == "Canon" and header.gps.alt_m == 512.0


def test_a_picture_is_turned_where_its_exif_cannot_be_written_again(folder: Path) -> None:
    """Its north or south is two numbers: Pillow reads them, and fails to write them."""
    entries = struct.pack(">HHIHHHHII", 0x0112, 3, 1, 6, 0, 0x8825, 4, 1, 38)
    position = struct.pack(">HHHIHHI", 1, 1, 3, 2, 1, 2, 0)
    block = b"MM\0*" + struct.pack(">IH", 8, 2) + entries + bytes(4) + position
    (folder / "two.jpg").write_bytes(spoilt_exif(encoded(exif=EXIF), block))
    assert read_header(folder / "two.jpg").orientation == 6
    copy_or_rotate(folder / "two.jpg", folder / "turned.jpg")
    assert read_header(folder / "turned.jpg").orientation == 1
    assert read_rgb(folder / "turned.jpg").shape == read_rgb(folder / "two.jpg").shape


@pytest.fixture(scope="module")
def video(folder: Path) -> Path:
    path = folder / "valid.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (64, 48))
    for n in range(6):
        writer.write(np.roll(np.kron(RGB[:12, :16], np.ones((4, 4, 1), np.uint8)), n, axis=1))
    writer.release()
    return path


@pytest.mark.parametrize("name", ["own.jpg", "frames.json", ".", "../own.jpg", "frame_" + "9" * 300 + ".jpg"])
def test_a_list_of_frames_that_names_other_files_removes_none(folder: Path, video: Path, name: str) -> None:
    out = folder / "kept"
    extract_frames(video, out, max_frames=2)
    (out / "own.jpg").write_bytes(b"mine")
    (folder / "own.jpg").write_bytes(b"mine")
    content = json.loads((out / "frames.json").read_text())
    content["frames"][0]["name"] = name
    (out / "frames.json").write_text(json.dumps(content))
    assert len(extract_frames(video, out, max_frames=3)) == 3
    assert (out / "own.jpg").read_bytes() == (folder / "own.jpg").read_bytes() == b"mine"


@pytest.mark.parametrize("change", [lambda rows: [], lambda rows: rows * 2, lambda rows: 3 * rows[:1]])
def test_a_list_of_no_frames_or_of_one_twice_is_made_anew(folder: Path, video: Path, change: object) -> None:
    out = folder / "again"
    names = extract_frames(video, out, max_frames=2).name
    content = json.loads((out / "frames.json").read_text())
    (out / "frames.json").write_text(json.dumps(content | {"frames": change(content["frames"])}))
    assert extract_frames(video, out, max_frames=2).name == names


@pytest.mark.parametrize(
    "text", ["#EXTM3U\n#EXTINF:1,\nhttp://127.0.0.1/a.ts\n", "ffconcat version 1.0\nfile a.avi\n"]
)
def test_a_list_of_videos_is_no_video(folder: Path, text: str) -> None:
    """FFmpeg would follow the addresses and names in it."""
    (folder / "list.mp4").write_text(text)
    with pytest.raises(FileFormatError, match="not a video: the file is text"):
        extract_frames(folder / "list.mp4", folder / "none", max_frames=2)


def test_a_mask_that_is_a_lying_jpeg_is_refused(folder: Path) -> None:
    data = encoded()
    start = data.index(b"\xff\xc0") + 5
    (folder / "masked.jpg.png").write_bytes(
        data[:start] + struct.pack(">HH", 30000, 30000) + data[start + 4 :]
    )
    with pytest.raises(FileFormatError, match="cannot hold 30000 x 30000 pixels"):
        read_mask(folder, "masked.jpg")


def test_a_blank_picture_is_not_taken_for_a_lie(folder: Path) -> None:
    """Nothing is packed more tightly: one color, optimized tables, a progressive JPEG without detail."""
    for options in ({"optimize": True}, {"progressive": True, "optimize": True}):
        Image.new("L", (4000, 3000), 255).save(folder / "blank.jpg", "JPEG", quality=10, **options)
        assert read_gray(folder / "blank.jpg", 100).shape == (75, 100)
    write_png16(folder / "flat.png", np.full((2000, 3000), 7.0))
    assert np.nanmax(read_png16(folder / "flat.png")) == 7.0


def changed(folder: Path, change) -> Path:
    write_calibration(folder / "changed.json", PAIR)
    content = json.loads((folder / "changed.json").read_text())
    change(content["cameras"][1], content)
    (folder / "changed.json").write_text(json.dumps(content))
    return folder / "changed.json"


OWN = {
    "endless width": lambda camera, _: camera.update(width=float("inf")),
    "a width of 2^40": lambda camera, _: camera.update(width=1 << 40),
    "a parameter of 400 digits": lambda camera, _: camera["params"].update(fx=10**400),
    "a place that is nowhere": lambda camera, _: camera["cam_from_rig"].update(translation=[np.nan] * 3),
    "a quaternion of infinite length": lambda camera, _: camera["cam_from_rig"].update(quat_wxyz=[1e200] * 4),
    "a small covariance": lambda _, content: content.update(covariance=[[1.0]]),
    "no list of cameras": lambda _, content: content.update(cameras=3),
}


@pytest.mark.parametrize("what", list(OWN))
def test_what_own_files_cannot_hold(folder: Path, what: str) -> None:
    path = changed(folder, OWN[what])
    with pytest.raises(FileFormatError, match=r"changed\.json: .+"):
        read_calibration(path)


PLAIN = """image_width: 640
image_height: 480
camera_matrix: {data: [500, 0, 320, 0, 500, 240, 0, 0, 1]}
distortion_coefficients: {data: [0, 0, 0, 0]}
"""


@pytest.mark.parametrize(
    "line",
    [
        "x: !!int ''",
        "x: !!float _",
        "x: !!bool q",
        "x: !!timestamp q",
        "x: !!binary q",
        "x: *none",
        "? {a: 1}\n: 2",
    ],
)
def test_yaml_that_trips_its_own_reader(folder: Path, line: str) -> None:
    """PyYAML raises IndexError, KeyError and AttributeError for some of these."""
    (folder / "plain.yaml").write_text(PLAIN)
    assert read_calibration(folder / "plain.yaml").cameras[0].params[0] == 500.0
    (folder / "tripping.yaml").write_text(PLAIN + line + "\n")
    with pytest.raises(FileFormatError, match=r"tripping.yaml: it is neither JSON nor YAML"):
        read_calibration(folder / "tripping.yaml")


def test_a_name_that_is_no_text(folder: Path) -> None:
    write_opencv_yaml(folder / "bytes.yaml", PAIR)
    (folder / "bytes.yaml").write_bytes(
        (folder / "bytes.yaml").read_bytes().replace(b"image_width", b"\xe9mage_width")
    )
    with pytest.raises(FileFormatError, match=r"bytes\.yaml: it is neither JSON nor YAML"):
        read_calibration(folder / "bytes.yaml")


def test_a_few_lines_of_aliases_are_not_a_billion_numbers(folder: Path) -> None:
    lines = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]" for k in range(1, 10)]
    path = folder / "billion.yaml"
    path.write_text("\n".join([*lines, PLAIN.replace("{data: [0, 0, 0, 0]}", "*a9")]))
    assert read_or_refuse(read_calibration, path, names="alias") is None
    # One list named twice, as PyYAML writes it, is read.
    twice = KALIBR | {"cam1": KALIBR["cam1"] | {"resolution": KALIBR["cam0"]["resolution"]}}
    (folder / "twice.yaml").write_text(yaml.safe_dump(twice))
    assert "*id001" in (folder / "twice.yaml").read_text()
    assert read_stereo_rig(folder / "twice.yaml").right.width == 752


def test_a_place_that_is_no_rotation_is_refused(folder: Path) -> None:
    matrix = MOTION.as_matrix()
    matrix[0, 0] += 0.01
    (folder / "bent.yaml").write_text(
        yaml.safe_dump(KALIBR | {"cam1": KALIBR["cam1"] | {"T_cn_cnm1": matrix.tolist()}})
    )
    with pytest.raises(FileFormatError, match=r"bent\.yaml: T_cn_cnm1 is not a motion"):
        read_calibration(folder / "bent.yaml")


def test_opencv_reads_the_same_from_its_own_files(folder: Path) -> None:
    """What we read without OpenCV's reader is what it reads."""
    write_opencv_yaml(folder / "opencv.yaml", PAIR)
    (folder / "opencv.xml").write_bytes(XML)
    for name, matrix, lens in (
        ("opencv.yaml", "M1", "D1"),
        ("opencv.xml", "camera_matrix", "distortion_coefficients"),
    ):
        storage = cv2.FileStorage(str(folder / name), cv2.FILE_STORAGE_READ)
        camera = read_calibration(folder / name).cameras[0]
        np.testing.assert_allclose(camera.K, storage.getNode(matrix).mat(), rtol=1e-15)
        np.testing.assert_allclose(camera.params[4:8], storage.getNode(lens).mat().ravel()[:4], rtol=1e-15)
