"""Reading and writing Gaussians in common exchange formats: PLY, compressed PLY, SPZ, SOG and .splat.

The content determines the format, except for .splat, which has no header: 32 bytes per Gaussian with position, scale,
color with opacity, and rotation as bytes, without harmonics above degree 0.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from epipole._checks import checked
from epipole.errors import ConfigError, FileFormatError
from epipole.io.atomic import atomic_write
from epipole.io.contents_in_words import with_what_it_is
from epipole.io.files import file_bytes, open_file
from epipole.io.gaussians._finite import finite_gaussians
from epipole.io.gaussians._sog_files import META as META
from epipole.io.gaussians._sog_files import is_sog as is_sog
from epipole.io.gaussians._sog_files import is_unpacked_sog as is_unpacked_sog
from epipole.io.gaussians.compressed_ply import read_compressed_ply, write_compressed_ply
from epipole.io.gaussians.ply import read_gaussian_ply, write_gaussian_ply
from epipole.io.gaussians.sog import read_sog, write_sog
from epipole.io.gaussians.spz import read_spz, write_spz
from epipole.scene.gaussian_cloud import DC, GaussianCloud

SUFFIXES = (".ply", ".compressed.ply", ".spz", ".sog", ".splat")
SPLAT = "splat.ply"
"""File name in an output folder of `splat`."""
WITHOUT_ORIGIN = (".spz", ".splat")
"""Formats that cannot store a cloud's origin; their coordinates are relative to it."""
_HEADER = 8192
_SPLAT = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])


@checked
def read_gaussians(path: str | Path) -> GaussianCloud:
    """Read Gaussians in any supported format (for SOG also a folder's meta.json); non-finite ones are dropped.

    Raises:
        FileFormatError: the format is not supported, or the file is truncated or has no finite Gaussian.
    """
    path = Path(path)
    if path.name.lower() == META:
        return read_sog(path)
    suffix = path.suffix.lower()
    if suffix not in (".ply", ".spz", ".sog", ".splat"):
        raise FileFormatError(path, with_what_it_is(f"Gaussians are read from {', '.join(SUFFIXES)}", path))
    with open_file(path) as stream:
        head = stream.read(_HEADER)
    if head.startswith((b"ply\n", b"ply\r")):
        return read_compressed_ply(path) if b" packed_position" in head else read_gaussian_ply(path)
    if head.startswith((b"NGSP", b"\x1f\x8b\x08")):
        return read_spz(path)
    if head.startswith(b"PK\x03\x04"):
        return read_sog(path)
    readers = {".ply": read_gaussian_ply, ".spz": read_spz, ".sog": read_sog, ".splat": _read_splat}
    return readers[suffix](path)


def gaussians_file(path: Path) -> Path:
    """The Gaussian file given by a path or contained in a folder: `splat.ply`, or the meta.json of an unpacked SOG.

    Raises:
        FileFormatError: the path is neither.
    """
    if path.is_file() and not path.name.lower().endswith((*SUFFIXES, META)):
        problem = f"not a file of trained Gaussians ({', '.join(SUFFIXES)})"
        raise FileFormatError(path, with_what_it_is(problem, path))
    is_sog_folder = not (path / SPLAT).is_file() and is_unpacked_sog(path / META)
    file = path if path.is_file() else path / (META if is_sog_folder else SPLAT)
    if not file.is_file():
        problem = "it contains no trained Gaussians (splat.ply) and no trained field (hash.npz, grid.npz)"
        raise FileFormatError(
            path, with_what_it_is(problem, path, "`epipole splat` and `epipole nerf` train them")
        )
    return file


@checked
def write_gaussians(path: str | Path, cloud: GaussianCloud) -> None:
    """Write Gaussians in the format given by the suffix; all but .ply are rounded, and .splat has only degree 0.

    Raises:
        ConfigError: the suffix is not supported.
        WorkspaceError: the file cannot be written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == ".splat":
        _write_splat(path, cloud)
    elif suffix == ".spz":
        write_spz(path, cloud)
    elif suffix == ".sog":
        write_sog(path, cloud)
    elif path.name.lower().endswith(".compressed.ply"):
        write_compressed_ply(path, cloud)
    elif suffix == ".ply":
        write_gaussian_ply(path, cloud)
    else:
        raise ConfigError(f"Gaussians are written to {', '.join(SUFFIXES)}, not to {path.name!r}")


def _read_splat(path: Path) -> GaussianCloud:
    data = file_bytes(path)
    if not data or len(data) % _SPLAT.itemsize:
        raise FileFormatError(
            path, f"not a .splat file: its {len(data)} bytes are not a multiple of {_SPLAT.itemsize}"
        )
    rows = np.frombuffer(data, _SPLAT)
    with np.errstate(all="ignore"):
        log_scales = np.log(rows["scale"])
        opacity = rows["rgba"][:, 3] / 255.0
        logits = np.log(opacity) - np.log1p(-opacity)
    parts = (
        rows["mean"],
        log_scales,
        (rows["quat"].astype(np.float32) - 128.0) / 128.0,
        logits,
        ((rows["rgba"][:, :3] / 255.0 - 0.5) / DC)[:, None],
    )
    return finite_gaussians(path, parts)


def _write_splat(path: Path, cloud: GaussianCloud) -> None:
    """Write a .splat file, the most visible Gaussians first, since viewers show a file while it loads."""
    opacity = 1.0 / (1.0 + np.exp(-cloud.opacity_logits.astype(np.float64)))
    size = np.exp(cloud.log_scales.astype(np.float64))
    order = np.argsort(-opacity * size.prod(axis=1), kind="stable")
    quats = cloud.quats_wxyz / np.linalg.norm(cloud.quats_wxyz, axis=1, keepdims=True)
    color = np.concatenate([0.5 + DC * cloud.sh[:, 0], opacity[:, None]], axis=1)
    rows = np.empty(len(cloud), _SPLAT)
    rows["mean"], rows["scale"] = cloud.means_in_world[order], size[order]
    rows["rgba"] = np.clip(np.rint(255.0 * color[order]), 0, 255)
    rows["quat"] = np.clip(np.rint(128.0 * quats[order] + 128.0), 0, 255)
    with atomic_write(path) as part:
        part.write_bytes(rows.tobytes())
