"""Colors of PLY files by their type and values."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from epipole.errors import FileFormatError
from epipole.io.meshes.mesh_ply import read_mesh_ply
from epipole.io.meshes.ply import read_points_ply

EXPECTED = [[255, 128, 0], [10, 20, 30]]


def written(
    path: Path, kind: str, rows: list[list[float]], names: tuple[str, ...] = ("red", "green", "blue")
) -> Path:
    """A text PLY with colors of one type."""
    lines = ["ply", "format ascii 1.0", f"element vertex {len(rows)}"]
    lines += [f"property float {axis}" for axis in "xyz"] + [f"property {kind} {name}" for name in names]
    lines += ["end_header", *("0 0 1 " + " ".join(map(str, row)) for row in rows)]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize(
    ("kind", "factor"),
    [
        ("uchar", 1),
        ("ushort", 1),
        ("ushort", 257),
        ("int", 1),
        ("uint", 257),
        ("float", 1.0),
        ("float", 1 / 255),
        ("double", 257.0),
    ],
)
def test_types_and_ranges(tmp_path: Path, kind: str, factor: float) -> None:
    rows = [[value * factor for value in row] for row in EXPECTED]
    path = written(tmp_path / "x.ply", kind, rows)
    assert read_points_ply(path).rgb.tolist() == EXPECTED
    assert read_mesh_ply(path).rgb.tolist() == EXPECTED


@pytest.mark.parametrize(
    "names",
    [
        ("r", "g", "b"),
        ("diffuse_red", "diffuse_green", "diffuse_blue"),
        ("Red", "Green", "Blue"),
        ("ambient_red", "ambient_green", "ambient_blue"),
    ],
)
def test_names(tmp_path: Path, names: tuple[str, ...]) -> None:
    assert read_points_ply(written(tmp_path / "x.ply", "uchar", EXPECTED, names)).rgb.tolist() == EXPECTED


@pytest.mark.parametrize("kind", ["float", "uint"])
def test_packed_colors(tmp_path: Path, kind: str) -> None:
    bits = np.array([0xFF000000 | r << 16 | g << 8 | b for r, g, b in EXPECTED], np.uint32)
    values = bits if kind == "uint" else (bits & 0xFFFFFF).view(np.float32)
    rows = np.zeros(2, [("xyz", "<f4", 3), ("rgb", values.dtype)])
    rows["rgb"] = values
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 2\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz") + f"property {kind} rgb\nend_header\n"
    path = tmp_path / "x.ply"
    path.write_bytes(header.encode() + rows.tobytes())
    assert read_points_ply(path).rgb.tolist() == EXPECTED


def test_signed_bytes_are_the_same_bytes(tmp_path: Path) -> None:
    rows = np.zeros(2, [("xyz", "<f4", 3), ("rgb", "i1", 3)])
    rows["rgb"] = np.array(EXPECTED, np.uint8).view(np.int8)
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 2\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz")
    header += "".join(f"property char {name}\n" for name in ("red", "green", "blue")) + "end_header\n"
    path = tmp_path / "x.ply"
    path.write_bytes(header.encode() + rows.tobytes())
    assert read_points_ply(path).rgb.tolist() == EXPECTED


def test_fractions_with_an_overshoot_and_without_a_value(tmp_path: Path) -> None:
    path = written(tmp_path / "x.ply", "float", [[1.02, 0.5, -0.01], ["nan", 0.0, 1.0]])
    assert read_points_ply(path).rgb.tolist() == [[255, 128, 0], [0, 0, 255]]


@pytest.mark.parametrize(("kind", "value"), [("uint", 1_000_000), ("int", -3), ("float", 1e9)])
def test_unknown_ranges_are_refused(tmp_path: Path, kind: str, value: float) -> None:
    with pytest.raises(FileFormatError, match="not a known range"):
        read_points_ply(written(tmp_path / "x.ply", kind, [[value, 0, 0]]))


def test_a_missing_channel_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path / "x.ply", "uchar", [[1, 2]], ("red", "green"))
    with pytest.raises(FileFormatError, match="no blue"):
        read_points_ply(path)
