"""PLY headers: lines, elements and properties that are not understood are refused, or left out where they change nothing."""

from pathlib import Path

import numpy as np
import pytest

from epipole.errors import FileFormatError
from epipole.io import read_points_ply
from epipole.io.gaussians.ply import read_gaussian_ply, write_gaussian_ply
from epipole.io.meshes.mesh_ply import read_mesh_ply
from epipole.scene.gaussian_cloud import GaussianCloud

VERTEX = "element vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
FACE = "element face 1\nproperty list uchar int vertex_indices\n"
ROWS = "0 0 0\n1 0 0\n0 1 0\n"


def written(tmp_path: Path, header: str, rows: str = ROWS, form: str = "format ascii 1.0\n") -> Path:
    path = tmp_path / "a.ply"
    path.write_text(f"ply\n{form}{header}end_header\n{rows}")
    return path


def test_known_headers(tmp_path) -> None:
    for header, rows in (
        (VERTEX, ROWS),
        (f"comment by hand\nobj_info 3 points\n\n{VERTEX}", ROWS),
        (f"element camera 0\nproperty float view_px\n{VERTEX}element range_grid 1\nproperty list uchar int i\n", f"{ROWS}1 0\n"),
        (VERTEX + "property float quality\nproperty int label\n", "0 0 0 1 1\n1 0 0 1 1\n0 1 0 1 1\n"),
    ):  # fmt: skip
        assert read_points_ply(written(tmp_path, header, rows)).xyz.tolist()[1] == [1.0, 0.0, 0.0]


@pytest.mark.parametrize(
    "header",
    [
        f"{VERTEX}propertie float q\n",
        f"{VERTEX}transform 2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1\n",
        f"property float q\n{VERTEX}",
        f"{VERTEX}property half q\n",
        f"{VERTEX}property list uchar int q\n",
        f"{VERTEX}property float q 3\n",
        f"{VERTEX}element vertex 3\n",
        f"{VERTEX}element face\n",
        f"{VERTEX}element face x\n",
        f"{VERTEX}element face -1\n",
        f"format ascii 1.0\n{VERTEX}",
        f"element camera 1\nproperty float q\n{VERTEX}",
    ],
)
def test_lines_that_are_not_understood_are_refused(tmp_path, header) -> None:
    with pytest.raises(FileFormatError, match=r"line .*invalid header line|invalid header: a property"):
        read_points_ply(written(tmp_path, header))


@pytest.mark.parametrize("form", ["format ascii 2.0\n", "format ascii\n", "format text 1.0\n", ""])
def test_other_versions_are_refused(tmp_path, form) -> None:
    with pytest.raises(FileFormatError):
        read_points_ply(written(tmp_path, VERTEX, form=form))


@pytest.mark.parametrize(
    ("header", "rows", "message"),
    [
        (f"{VERTEX}element tristrips 1\nproperty list int int vertex_indices\n", "3 0 1 2\n", "element tristrips is not supported"),
        (f"{VERTEX}element edge 1\nproperty int vertex1\nproperty int vertex2\n{FACE}", "0 1\n3 0 1 2\n", "faces must come directly after"),
        (f"{VERTEX}element polygon 1\nproperty list uchar int i\n", "3 0 1 2\n", "element polygon is not supported"),
    ],
)  # fmt: skip
def test_surfaces_that_would_be_left_out_are_refused(tmp_path, header, rows, message) -> None:
    path = written(tmp_path, header, ROWS + rows)
    with pytest.raises(FileFormatError, match=message):
        read_mesh_ply(path)
    assert len(read_points_ply(path)) == 3


def test_elements_without_a_surface_may_stand_beside_a_mesh(tmp_path) -> None:
    edges = "element edge 1\nproperty int vertex1\nproperty int vertex2\n"
    empty = "element tristrips 0\nproperty list int int vertex_indices\n"
    assert read_mesh_ply(
        written(tmp_path, VERTEX + FACE + edges, f"{ROWS}3 0 1 2\n0 1\n")
    ).faces.tolist() == [[0, 1, 2]]
    assert read_mesh_ply(written(tmp_path, VERTEX + empty + FACE, f"{ROWS}3 0 1 2\n")).faces.tolist() == [
        [0, 1, 2]
    ]
    assert len(read_mesh_ply(written(tmp_path, VERTEX + edges, f"{ROWS}0 1\n")).faces) == 0


def with_property(path: Path, name: str) -> None:
    """Another number behind every vertex."""
    head, body = path.read_bytes().split(b"end_header\n")
    count = int(head.split(b"element vertex ")[1].split()[0])
    rows = np.frombuffer(body, "<f4").reshape(count, -1)
    longer = np.column_stack([rows, np.full(count, 0.5, "<f4")])
    path.write_bytes(head + f"property float {name}\nend_header\n".encode() + longer.tobytes())


@pytest.mark.parametrize("name", ["filter_3D", "rot_4", "scale_3", "motion_0", "omega", "semantic_0"])
def test_properties_of_gaussians_that_are_not_understood_are_refused(tmp_path, name) -> None:
    rng = np.random.default_rng(0)
    cloud = GaussianCloud(
        *(rng.normal(size=(4, k)).astype(np.float32) for k in (3, 3, 4)),
        rng.normal(size=4).astype(np.float32),
        rng.normal(size=(4, 1, 3)).astype(np.float32),
    )
    path = tmp_path / "splat.ply"
    write_gaussian_ply(path, cloud)
    assert len(read_gaussian_ply(path)) == 4
    with_property(path, "label")
    np.testing.assert_array_equal(read_gaussian_ply(path).means_in_world, cloud.means_in_world)
    with_property(path, name)
    with pytest.raises(FileFormatError, match=f"unsupported properties of Gaussians \\({name}\\)"):
        read_gaussian_ply(path)
