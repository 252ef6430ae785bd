"""Gaussians in the files that splats are passed on in: PLY, compressed PLY, SPZ, SOG and .splat.

Compressed PLY (16 bytes a Gaussian and 45 of harmonics) and SPZ (Niantic; gzip before version 4, zstd from then on) are read and written
by `gsply`. SPZ's axes are right, up, back: turned half around x from those of a PLY file. A .splat holds 32 bytes a Gaussian: place,
deviations, colour with opacity, and rotation in whole numbers; it has no harmonics.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from epipole._declared import checked
from epipole.errors import ConfigError, FileFormatError
from epipole.io._finite_gaussians import MOST_LOGIT, finite_gaussians
from epipole.io._sog_files import META
from epipole.io._sog_files import is_sog as is_sog
from epipole.io._spz_sizes import check_spz
from epipole.io.atomic import atomic_write
from epipole.io.files import file_bytes, open_file, read_by_others
from epipole.io.gaussian_ply import read_gaussian_ply, write_gaussian_ply
from epipole.io.sog import read_sog, write_sog
from epipole.scene.gaussian_cloud import DC, NUM_SH, GaussianCloud

if TYPE_CHECKING:
    from gsply import GSData

SUFFIXES = (".ply", ".compressed.ply", ".spz", ".sog", ".splat")
_SPLAT = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])
_TURNED = np.array([1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)
"""Signs of the harmonics after half a turn around x."""


@checked
def read_gaussians(path: str | Path) -> GaussianCloud:
    """Read Gaussians of any of the formats (of SOG the meta.json of a folder, too); those with a number that is not finite are left out.

    Raises:
        FileFormatError: it is of no such format, is cut short, or holds no Gaussian that is finite.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == ".splat":
        return _read_splat(path)
    if suffix == ".spz":
        return _read_spz(path)
    if suffix == ".sog" or path.name.lower() == META:
        return read_sog(path)
    if suffix != ".ply":
        raise FileFormatError(path, f"Gaussians are read from {', '.join(SUFFIXES)}")
    return _read_compressed_ply(path) if _is_compressed(path) else read_gaussian_ply(path)


@checked
def write_gaussians(path: str | Path, cloud: GaussianCloud) -> None:
    """Write Gaussians in the format of the file's name; all but .ply are rounded, and .splat has no harmonics above degree 0.

    Raises:
        ConfigError: the name has none of the endings.
        WorkspaceError: the file cannot be written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == ".splat":
        _write_splat(path, cloud)
    elif suffix == ".spz":
        _write_by(path, ".spz", lambda part, gsply: gsply.write_spz(part, _gsdata(_half_turned(cloud))))
    elif suffix == ".sog":
        write_sog(path, cloud)
    elif path.name.lower().endswith(".compressed.ply"):
        _write_by(
            path,
            ".compressed.ply",
            lambda part, gsply: gsply.plywrite(part, _gsdata(cloud), compressed=True),
        )
    elif suffix == ".ply":
        write_gaussian_ply(path, cloud)
    else:
        raise ConfigError(f"Gaussians are written to {', '.join(SUFFIXES)}, not to {path.name!r}")


def _write_by(path: Path, ending: str, write: Callable[[Path, Any], None]) -> None:
    """Let gsply write beside, with the ending that it looks at, then move it into its place."""
    import gsply

    with atomic_write(path) as part:
        aside = part.with_name(part.name + ending)
        try:
            write(aside, gsply)
            aside.replace(part)
        finally:
            aside.unlink(missing_ok=True)


def _gsdata(cloud: GaussianCloud) -> GSData:
    """As gsply wants it: unit rotations, coefficients above degree 0 apart."""
    from gsply import GSData

    quats = cloud.quats_wxyz / np.linalg.norm(cloud.quats_wxyz, axis=1, keepdims=True)
    made: GSData = GSData.from_arrays(
        means=cloud.means_in_world,
        scales=cloud.log_scales,
        quats=quats,
        opacities=cloud.opacity_logits,
        sh0=np.ascontiguousarray(cloud.sh[:, 0]),
        shN=np.ascontiguousarray(cloud.sh[:, 1:]) if cloud.sh_degree else None,
    )
    return made


def _cloud(path: Path, data: GSData) -> GaussianCloud:
    """What gsply has read, checked.

    Raises:
        FileFormatError: nothing of it is finite.
    """
    n = len(data.means)
    rest = np.zeros((n, 0, 3)) if data.shN is None else np.asarray(data.shN).reshape(n, -1, 3)
    if rest.shape[1] + 1 not in NUM_SH:
        raise FileFormatError(path, f"{rest.shape[1]} harmonics are those of no degree")
    logits = np.clip(np.asarray(data.opacities), -MOST_LOGIT, MOST_LOGIT).reshape(-1)
    sh = np.concatenate([np.asarray(data.sh0)[:, None], rest], axis=1)
    parts = (data.means, data.scales, data.quats, logits, sh)
    return finite_gaussians(path, [np.asarray(part, np.float32) for part in parts])


def _half_turned(cloud: GaussianCloud) -> GaussianCloud:
    """Seen with y and z the other way round."""
    half = np.array([1, -1, -1], np.float32)
    return GaussianCloud(
        cloud.means_in_world * half,
        cloud.log_scales,
        cloud.quats_wxyz * np.array([1, 1, -1, -1], np.float32),
        cloud.opacity_logits,
        cloud.sh * _TURNED[: cloud.sh.shape[1], None],
    )


def _is_compressed(path: Path) -> bool:
    with open_file(path) as stream:
        return b" packed_position" in stream.read(8192)


def _read_compressed_ply(path: Path) -> GaussianCloud:
    import gsply

    _check_ply_size(path)
    with read_by_others(path, "is a damaged compressed PLY"):
        data = gsply.plyread(path)
    return _cloud(path, data)


def _check_ply_size(path: Path) -> None:
    """Refuse a header that promises more vertices than the file has bytes for.

    Raises:
        FileFormatError: it does, or is no header.
    """
    with open_file(path) as stream:
        head = stream.read(8192)
    counts = [line.split() for line in head.split(b"end_header")[0].splitlines() if line[:8] == b"element "]
    named = {words[1]: words[2] for words in counts if len(words) == 3}
    count = named.get(b"vertex", b"")
    if not count.isdigit() or b"end_header" not in head:
        raise FileFormatError(path, "is a damaged compressed PLY (no header that tells its vertices)")
    if int(count) * 16 > path.stat().st_size:
        raise FileFormatError(path, f"is cut short: {int(count)} vertices are promised")


def _read_spz(path: Path) -> GaussianCloud:
    import gsply

    check_spz(path, file_bytes(path))
    with read_by_others(path, "is a damaged SPZ file"):
        found = gsply.read_spz(path)
    return _half_turned(_cloud(path, found))


def _read_splat(path: Path) -> GaussianCloud:
    data = file_bytes(path)
    if not data or len(data) % _SPLAT.itemsize:
        raise FileFormatError(path, f"is no .splat file: {len(data)} bytes are no rows of {_SPLAT.itemsize}")
    rows = np.frombuffer(data, _SPLAT)
    with np.errstate(all="ignore"):
        log_scales = np.log(rows["scale"])
        opacity = np.clip(rows["rgba"][:, 3] / 255.0, 1e-7, 1 - 1e-7)
    parts = (
        rows["mean"],
        log_scales,
        (rows["quat"].astype(np.float32) - 128.0) / 128.0,
        np.log(opacity / (1.0 - opacity)),
        ((rows["rgba"][:, :3] / 255.0 - 0.5) / DC)[:, None],
    )
    return finite_gaussians(path, [np.asarray(part, np.float32) for part in parts])


def _write_splat(path: Path, cloud: GaussianCloud) -> None:
    """The most visible first, as viewers that show a file while it loads want it."""
    opacity = 1.0 / (1.0 + np.exp(-cloud.opacity_logits.astype(np.float64)))
    size = np.exp(cloud.log_scales.astype(np.float64))
    order = np.argsort(-opacity * size.prod(axis=1), kind="stable")
    quats = cloud.quats_wxyz / np.linalg.norm(cloud.quats_wxyz, axis=1, keepdims=True)
    colour = np.concatenate([0.5 + DC * cloud.sh[:, 0], opacity[:, None]], axis=1)
    rows = np.empty(len(cloud), _SPLAT)
    rows["mean"], rows["scale"] = cloud.means_in_world[order], size[order]
    rows["rgba"] = np.clip(np.rint(255.0 * colour[order]), 0, 255)
    rows["quat"] = np.clip(np.rint(128.0 * quats[order] + 128.0), 0, 255)
    with atomic_write(path) as part:
        part.write_bytes(rows.tobytes())
