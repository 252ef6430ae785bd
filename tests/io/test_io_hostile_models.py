"""Models, graphs, clouds and known cameras out of damaged files: a clear error or a sound object, in little memory."""

import bz2
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from test_io_colmap_database import PAIRS, make_contents

from epipole.errors import FileFormatError
from epipole.geometry import Rigid2, Rigid3, Similarity3
from epipole.io import (
    read_bal,
    read_colmap_model,
    read_database,
    read_g2o,
    read_points_ply,
    read_transforms,
    read_truth,
    write_colmap_model,
    write_database,
    write_g2o,
    write_points_ply,
)
from epipole.io.images.depth_maps import read_pfm
from epipole.optim import PoseGraph
from hostile_bytes import assert_model, assert_motions, read_or_refuse, spoil_one, spoilt
from io_models import small_model

pytestmark = pytest.mark.usefixtures("unchecked")  # a thousand files, of types that other tests check


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("hostile")


@pytest.fixture(scope="module", params=[False, True], ids=["binary", "text"])
def colmap(request: pytest.FixtureRequest, folder: Path) -> dict[str, bytes]:
    """The files of a valid model."""
    write_colmap_model(small_model(), folder / "valid", text=request.param)
    return {p.name: p.read_bytes() for p in sorted((folder / "valid").iterdir()) if p.is_file()}


@pytest.mark.parametrize("stem", ["cameras", "rigs", "frames", "images", "points3D"])
@settings(max_examples=25)  # of each of ten files
@given(data=st.data())
def test_colmap_models(folder: Path, colmap: dict[str, bytes], stem: str, data: st.DataObject) -> None:
    name = next(n for n in colmap if n.startswith(stem))
    where = folder / f"colmap_{Path(name).suffix[1:]}"
    spoil_one(where, colmap, name, data.draw(spoilt(colmap[name], is_text=name.endswith("txt"))))
    found = read_or_refuse(read_colmap_model, where, names=where.name)
    if found is not None:
        assert_model(found)


@pytest.fixture(scope="module")
def database(folder: Path) -> bytes:
    write_database(folder / "valid.db", make_contents(small_model(), PAIRS))
    return (folder / "valid.db").read_bytes()


@given(data=st.data())
def test_colmap_databases(folder: Path, database: bytes, data: st.DataObject) -> None:
    path = folder / "spoilt.db"
    path.write_bytes(data.draw(spoilt(database, is_text=False)))
    found = read_or_refuse(read_database, path, names=path.name)
    if found is not None:
        counts = np.diff(found.images.keypoint_offsets)
        for (i, j), rows in found.matches.items():
            assert (rows >= 0).all() and (rows < counts[[i, j]]).all()


def transforms_text(known: str) -> bytes:
    frame = {"file_path": "images/a.png", "transform_matrix": np.eye(4).tolist()}
    content = {
        "camera_angle_x": 2 * np.arctan(320 / 500),
        "ply_file_path": "points.ply",
        "k1": 0.01,
        "frames": [frame, frame],
    }
    size = {"w": 640, "h": 480, "cx": 320.0, "cy": 240.0}
    own = {"all": {**size, "fl_x": 500.0, "fl_y": 501.5}, "size": size, "nothing": {}}[known]
    return json.dumps(content | own, indent=1).encode()


@given(data=st.data())
def test_transforms(folder: Path, data: st.DataObject) -> None:
    path = folder / "transforms.json"
    write_points_ply(folder / "points.ply", np.ones((3, 3)), np.zeros((3, 3), np.uint8))
    path.write_bytes(
        data.draw(
            spoilt(transforms_text(data.draw(st.sampled_from(["all", "size", "nothing"]))), is_text=True)
        )
    )
    found = read_or_refuse(read_transforms, path, names=path.name)
    if found is not None:
        assert_model(found)


TEXT_MESH = (
    b"ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    b"element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    b"0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3\n3 0 1 2\n"
)
TEXT_PLY = b"""ply
format ascii 1.0
comment made by hand
element vertex 2
property float x
property double y
property float z
property uchar red
property uchar green
property uchar blue
element face 0
property list uchar int vertex_indices
end_header
0.5 1.5 -2 10 20 30
1e3 2 3 255 0 1
"""


@pytest.mark.parametrize("is_text", [False, True], ids=["binary", "text"])
@given(data=st.data())
def test_ply(folder: Path, is_text: bool, data: st.DataObject) -> None:
    path = folder / "cloud.ply"
    write_points_ply(path, np.ones((6, 3)), np.zeros((6, 3), np.uint8))
    valid = TEXT_PLY if is_text else path.read_bytes()
    # A header is text in both.
    path.write_bytes(data.draw(spoilt(valid, is_text=is_text or data.draw(st.booleans()))))
    found = read_or_refuse(read_points_ply, path, names=path.name)
    assert found is None or found.rgb is None or found.rgb.shape == found.xyz.shape


BAL = b"""2 2 3
0 0 -3.5 10.25
1 0 4 1e1
1 1 0.5 -7
""" + b"\n".join(b"%r" % v for v in [0.01, -0.02, 0.03, 0.1, 0.2, -5.0, 500.0, -1e-2, 1e-3] * 2 + [0.5] * 6)


@pytest.mark.parametrize("packed", [False, True], ids=["text", "bzip2"])
@given(data=st.data())
def test_bundle_problems(folder: Path, packed: bool, data: st.DataObject) -> None:
    path = folder / ("problem.txt.bz2" if packed else "problem.txt")
    valid = bz2.compress(BAL) if packed and data.draw(st.booleans()) else BAL
    content = data.draw(spoilt(valid, is_text=valid is BAL))
    path.write_bytes(bz2.compress(content) if packed and valid is BAL else content)
    found = read_or_refuse(read_bal, path, names=path.name)
    if found is not None:
        assert_motions(found.rig_from_world)
        assert found.offsets[-1] == len(found.frame) == len(found.pixels)


def graph_of(kind: Any, dimension: int) -> PoseGraph:
    steps = 0.1 * np.arange(3 * dimension).reshape(3, dimension)
    index = np.array([0, 1, 2])
    return PoseGraph(
        kind.exp(steps), index, (index + 1) % 3, kind.exp(steps), np.tile(np.eye(dimension), (3, 1, 1))
    )


GRAPHS = [(Rigid2, 3), (Rigid3, 6), (Similarity3, 7)]


@pytest.mark.parametrize(("kind", "dimension"), GRAPHS, ids=[k.__name__ for k, _ in GRAPHS])
@given(data=st.data())
def test_pose_graphs(folder: Path, kind: Any, dimension: int, data: st.DataObject) -> None:
    path = folder / f"{kind.__name__}.g2o"
    write_g2o(path, graph_of(kind, dimension))
    path.write_bytes(data.draw(spoilt(path.read_bytes(), is_text=True)))
    found = read_or_refuse(read_g2o, path, names=path.name)
    if found is not None and not isinstance(found.graph.world_from_body, Rigid2):
        for motions in (found.graph.world_from_body, found.graph.first_from_second):
            assert np.isfinite(motions.rotation).all()
            assert_motions(motions)


STRECHA = b"""2759.48 0 1520.69
0 2764.16 1006.81
0 0 1
0 0 0
0.450927 -0.0945642 -0.887537
-0.892535 -0.0401974 -0.449183
0.00679989 0.994707 -0.102528
-7.28137 -7.57667 0.204446
3072 2048
"""
MIDDLEBURY = b"""2
a.png 1520.4 0 302.32 0 1525.9 246.87 0 0 1 0.0254 0.0084 0.9996 1 0 0 0 1 0 0 0.1 0.2 0.3
b.png 1520.4 0 302.32 0 1525.9 246.87 0 0 1 1 0 0 0 1 0 0 0 1 -0.028 0.1 0.57
"""


@pytest.mark.parametrize(
    ("name", "valid"),
    [
        ("a.png.camera", STRECHA),
        ("temple_par.txt", MIDDLEBURY.replace(b"0.0254 0.0084 0.9996 1 0 0 0 1 0 0", b"1 0 0 0 1 0 0 0 1")),
    ],
    ids=["strecha", "middlebury"],
)
@given(data=st.data())
def test_known_cameras(folder: Path, name: str, valid: bytes, data: st.DataObject) -> None:
    where = folder / name.partition(".")[2]
    spoil_one(where, {name: valid}, name, data.draw(spoilt(valid, is_text=True)))
    found = read_or_refuse(read_truth, where, names=where.name)
    if found is not None:
        assert np.isfinite(found.cams_from_world.rotation).all()
        assert_motions(found.cams_from_world)


def test_valid_files_are_read(folder: Path) -> None:
    """The files that the tests above spoil are sound: what they refuse, they refuse for the damage."""
    for name, valid, read in (
        ("valid.txt", BAL, read_bal),
        ("valid.txt.bz2", bz2.compress(BAL), read_bal),
        ("valid.ply", TEXT_PLY, read_points_ply),
        ("valid.json", transforms_text("size"), read_transforms),
    ):
        (folder / name).write_bytes(valid)
        assert read(folder / name) is not None


DIGITS = "9" * 4300
"""The longest number that Python reads; twice as much it does not print."""


def refused(folder: Path, name: str, content: bytes, read: Any) -> None:
    (folder / name).write_bytes(content)
    assert read_or_refuse(read, folder / name, names=name) is None


@pytest.mark.parametrize(
    "text",
    [
        f"{DIGITS} {DIGITS} {DIGITS}",
        "-1 1 1 0",
        "1099511627776 0 0",
        "1 1 1 0.5 0 1 2" + 12 * " 1",
        "1 1 1 0 0 1 2 1e160" + 11 * " 1",
    ],
    ids=["endless counts", "a negative count", "a count of 2^40", "half an index", "an endless turn"],
)
def test_impossible_bundle_problems(folder: Path, text: str) -> None:
    refused(folder, "impossible.txt", text.encode(), read_bal)


def test_a_small_archive_of_a_gigabyte_is_not_unpacked(folder: Path) -> None:
    one = bz2.compress(bytes(100 << 20))
    refused(folder, "bomb.txt.bz2", one, read_bal)


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


@pytest.mark.parametrize(
    "text", [f"Pf\n{DIGITS} {DIGITS}\n-1\n", "Pf\n-1 -1\n-1\n0000", "Pf\n1 1\nnan\n0000"]
)
def test_impossible_maps(folder: Path, text: str) -> None:
    refused(folder, "impossible.pfm", text.encode(), read_pfm)


@pytest.mark.parametrize(
    "change",
    [
        {"ply_file_path": "a" * 5000},
        {"frames": [{"file_path": "a" * 5000, "transform_matrix": np.eye(4).tolist()}]},
        {"camera_angle_x": 0},
        {"w": float("inf")},
        {"w": 10**400},
    ],
    ids=[
        "a long name of points",
        "a long name of an image",
        "no angle",
        "endless width",
        "width of 400 digits",
    ],
)
def test_impossible_transforms(folder: Path, change: dict[str, Any]) -> None:
    content = json.loads(transforms_text("size")) | change
    refused(folder, "impossible.json", json.dumps(content).encode(), read_transforms)


def test_a_picture_of_900_megapixels_gives_no_size(folder: Path) -> None:
    """Pillow refuses to look at its header, with an error of its own."""
    image = io.BytesIO()
    Image.new("1", (1, 1)).save(image, "PPM")
    (folder / "huge.pbm").write_bytes(image.getvalue().replace(b"1 1", b"30000 30000", 1))
    content = json.loads(transforms_text("nothing"))
    content["frames"][0]["file_path"] = "huge.pbm"
    refused(folder, "huge.json", json.dumps(content).encode(), read_transforms)


def test_whole_numbers_of_a_cloud_that_are_none(folder: Path) -> None:
    text = TEXT_PLY.replace(b"property float x", b"property int x")
    for value in (b"inf", b"nan", b"1e300"):
        refused(
            folder, "impossible.ply", text.replace(b"\n0.5 1.5", b"\n" + value + b" 1.5"), read_points_ply
        )
