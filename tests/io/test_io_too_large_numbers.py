"""Whole numbers beyond what a computer's own hold, where files have numbers: a clear error, no overflow."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from epipole.errors import FileFormatError
from epipole.io import read_sequence
from epipole.io.meshes.mesh_ply import read_mesh_ply
from epipole.io.sequences.imu_logs import read_camera_from_imu

HUGE = "9" * 400
VERTICES = "".join(f"property float {axis}\n" for axis in "xyz")


def text_mesh(folder: Path) -> Path:
    path = folder / "mesh.ply"
    head = f"ply\nformat ascii 1.0\nelement vertex 3\n{VERTICES}element face 1\nproperty list uchar int vertex_indices\n"
    path.write_text(f"{head}end_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 {HUGE}\n")
    return path


def mounting(folder: Path) -> Path:
    path = folder / "mounting.yaml"
    path.write_text(f"T_cam_imu: [[1, 0, 0, {HUGE}], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n")
    return path


def drone(folder: Path) -> Path:
    camera = folder / "cam0"
    (camera / "data").mkdir(parents=True)
    cv2.imwrite(str(camera / "data" / "0.png"), np.zeros((8, 8), np.uint8))
    (camera / "data.csv").write_text(f"#timestamp [ns],filename\n{HUGE},0.png\n")
    (camera / "sensor.yaml").write_text("sensor_type: camera\n")
    return folder


@pytest.mark.parametrize(
    ("make", "read", "named"),
    [
        (text_mesh, read_mesh_ply, "mesh.ply"),
        (mounting, read_camera_from_imu, "mounting.yaml"),
        (drone, read_sequence, "data.csv"),
    ],
    ids=["mesh", "mounting", "drone"],
)
def test_numbers_that_are_too_large(
    make: Callable[[Path], Path], read: Callable[[Path], object], named: str, tmp_path: Path
) -> None:
    with pytest.raises(FileFormatError, match=named):
        read(make(tmp_path))
