"""Gaussians as PLY in the layout of Kerbl et al. (2023), supported by most splat viewers and trainers."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from epipole._checks import checked
from epipole.errors import FileFormatError
from epipole.io.atomic import atomic_write
from epipole.io.files import open_file
from epipole.io.gaussians._finite import finite_gaussians
from epipole.io.meshes.ply import ply_columns
from epipole.scene.gaussian_cloud import NUM_SH, GaussianCloud
from epipole.scene.local_origin import ORIGIN

_FIRST = ("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2")
_WITHOUT_EFFECT = (
    "red",
    "green",
    "blue",
    "alpha",
    "label",
    "id",
    "class",
    "segment",
    "segment_id",
    "object_id",
    "instance_id",
)
"""Previews and labels, which do not affect rendering."""
_LAST = ("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")

_ORIGIN_WORDS = [b"comment", ORIGIN.encode()]
_MOST_HEADER = 1 << 16


@checked
def write_gaussian_ply(path: str | Path, cloud: GaussianCloud) -> None:
    """Write Gaussians in single precision: coefficients above degree 0 channel by channel, rotations as w, x, y, z.

    Means are relative to the cloud's origin; if that is not zero, a header comment has it: `origin_in_world X Y Z`.

    Raises:
        WorkspaceError: the file cannot be written.
    """
    n, higher = len(cloud), cloud.sh.shape[1] - 1
    names = [*_FIRST, *(f"f_rest_{k}" for k in range(3 * higher)), *_LAST]
    # A single table without copies: there may be millions of rows.
    table = np.zeros((n, len(names)), "<f4")
    table[:, :3], table[:, 6:9] = cloud.means_in_world, cloud.sh[:, 0]
    table[:, 9 : 9 + 3 * higher].reshape(n, 3, higher)[:] = cloud.sh[:, 1:].transpose(0, 2, 1)
    table[:, -8], table[:, -7:-4], table[:, -4:] = cloud.opacity_logits, cloud.log_scales, cloud.quats_wxyz
    header = ["ply", "format binary_little_endian 1.0", *origin_comment(cloud), f"element vertex {n}"]
    header += [f"property float {name}" for name in names]
    with atomic_write(Path(path)) as part, part.open("wb") as stream:
        stream.write("".join(f"{line}\n" for line in [*header, "end_header"]).encode("ascii"))
        stream.write(table.data)


@checked
def read_gaussian_ply(path: str | Path) -> GaussianCloud:
    """Read Gaussians; non-finite ones are dropped.

    Normals, labels and color previews are ignored, as are elements after the vertices.

    Raises:
        FileFormatError: not a PLY file of Gaussians, truncated, without finite Gaussians, or with unsupported
            properties (such as filter_3D).
    """
    path = Path(path)
    columns = ply_columns(path)
    origin = origin_in_header(path)
    wanted = [name for name in (*_FIRST, *_LAST) if not name.startswith("n")]
    missing = [name for name in wanted if name not in columns]
    if missing:
        raise FileFormatError(path, f"not a file of Gaussians: the vertices have no {', '.join(missing[:4])}")
    higher = sum(name.startswith("f_rest_") for name in columns)
    rest = [f"f_rest_{k}" for k in range(higher)]
    if higher % 3 or higher // 3 + 1 not in NUM_SH or any(name not in columns for name in rest):
        raise FileFormatError(path, f"{higher} coefficients f_rest do not match any degree (0, 9, 24 or 45)")
    unknown = [
        name for name in columns if name not in {*_FIRST, *_LAST, *_WITHOUT_EFFECT} and name[:7] != "f_rest_"
    ]
    if unknown:
        raise FileFormatError(
            path,
            f"unsupported properties of Gaussians ({', '.join(unknown[:4])}) may change the render: export plain 3D Gaussians",
        )

    def table(*names: str, kind: type = np.float32) -> np.ndarray:
        rows: list[np.ndarray] = [columns[name].astype(kind) for name in names]
        return np.stack(rows, axis=1) if rows else np.zeros((len(columns["x"]), 0), kind)

    n = len(columns["x"])
    dc, above = (
        table("f_dc_0", "f_dc_1", "f_dc_2"),
        table(*rest).reshape(n, 3, higher // 3).transpose(0, 2, 1),
    )
    parts = (
        table("x", "y", "z", kind=np.float64),
        table("scale_0", "scale_1", "scale_2"),
        table(*(f"rot_{k}" for k in range(4))),
        table("opacity")[:, 0],
        np.concatenate([dc[:, None], above], axis=1),
    )
    return finite_gaussians(path, parts, origin)


@checked
def origin_comment(cloud: GaussianCloud) -> list[str]:
    """The header comment with the cloud's origin; empty if the origin is zero."""
    if not cloud.origin_in_world.any():
        return []
    return [f"comment {ORIGIN} {' '.join(map(repr, cloud.origin_in_world.tolist()))}"]


@checked
def origin_in_header(path: Path) -> np.ndarray:
    """(3,) origin in the header, to be added to the means; zero if absent.

    Raises:
        FileFormatError: the comment does not have three numbers.
    """
    with open_file(path) as stream:
        head = stream.read(_MOST_HEADER).split(b"end_header", 1)[0]
    lines = [line.split()[2:] for line in head.splitlines() if line.split()[:2] == _ORIGIN_WORDS]
    try:
        origin = np.array(lines[0] if lines else [0.0] * 3, np.float64)
    except ValueError:
        origin = np.empty(0)
    if origin.shape != (3,) or not np.isfinite(origin).all():
        raise FileFormatError(path, f"the header comment {ORIGIN} does not have three numbers")
    return origin
