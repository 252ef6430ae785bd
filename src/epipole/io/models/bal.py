"""The text format of Bundle Adjustment in the Large (BAL; Agarwal, Snavely, Seitz and Szeliski, ECCV 2010).

Snavely's camera looks along -z with y up: p = -(X, Y) / Z, pixel = f (1 + k1 |p|^2 + k2 |p|^4) p relative to the image
center, y up. Rotated by 180 degrees about its x axis, it is a RADIAL camera with the principal point at (0, 0) and y
down; the two are bit-identical except for signs.
"""

from __future__ import annotations

import bz2
from pathlib import Path

import numpy as np

from epipole._checks import checked
from epipole.cameras import MAX_PARAMS, CameraModel
from epipole.errors import FileFormatError, ShapeError
from epipole.geometry import Rigid3, Rotation3
from epipole.io.atomic import atomic_write
from epipole.io.files import file_bytes
from epipole.optim import BundleProblem, free_params_mask

_ROTATION = np.diag([1.0, -1.0, -1.0])
_PER_CAMERA = 9
_MOST_ROTATION = 1e6  # radians; longer vectors have lost their direction to rounding
# Limits of decompressed text (problems have about 4 bytes per archive byte): ratio for small output, size, ratio beyond.
_MOST_UNPACKED, _SMALL, _MOST_UNPACKED_LARGE = 200, 1 << 24, 20


@checked
def read_bal(path: str | Path) -> BundleProblem:
    """Read a problem (.txt or .txt.bz2): one camera per frame, everything free except the principal points.

    Raises:
        FileFormatError: the file is unreadable or truncated, or has a number that is not finite or an index that is out
            of range.
    """
    path = Path(path)
    try:
        data = file_bytes(path)
        words = (_unpacked(data) if path.suffix == ".bz2" else data).split()
    except FileFormatError:
        raise
    except (OSError, ValueError, EOFError) as error:
        raise FileFormatError(path, f"cannot be read: {error}") from error
    try:
        num_cameras, num_points, num_seen = (int(word) for word in words[:3])
        values = np.array(words[3:], np.float64)
    except ValueError as error:
        raise FileFormatError(
            path, f"not a bundle adjustment problem: {error}; check that this is a BAL file"
        ) from error
    if not 0 <= min(num_cameras, num_points, num_seen) <= max(num_cameras, num_points, num_seen) < len(words):
        raise FileFormatError(
            path, f"line 1: its counts are inconsistent with the {len(values)} numbers that follow"
        )
    wanted = 4 * num_seen + _PER_CAMERA * num_cameras + 3 * num_points
    if len(values) != wanted:
        raise FileFormatError(path, f"expected {wanted} numbers after the first three, got {len(values)}")
    if not np.isfinite(values).all():
        raise FileFormatError(path, "it contains numbers that are not finite")
    seen = values[: 4 * num_seen].reshape(-1, 4)
    cameras = values[4 * num_seen :][: _PER_CAMERA * num_cameras].reshape(-1, _PER_CAMERA)
    points = values[len(values) - 3 * num_points :].reshape(-1, 3)
    if not (np.abs(cameras[:, :3]) < _MOST_ROTATION).all():
        raise FileFormatError(path, "a camera's rotation vector is too long")
    index = seen[:, :2]
    if not (index >= 0).all() or (index >= [num_cameras, num_points]).any() or (index % 1 != 0).any():
        raise FileFormatError(path, "an observation refers to a missing camera or point")
    seen = seen[np.argsort(seen[:, 1], kind="stable")]
    counts = np.bincount(seen[:, 1].astype(np.int64), minlength=num_points)
    params = np.zeros((num_cameras, MAX_PARAMS))
    params[:, [0, 3, 4]] = cameras[:, 6:9]
    model = np.full(num_cameras, int(CameraModel.RADIAL), np.int32)
    frame = seen[:, 0].astype(np.int32)
    return BundleProblem(
        Rigid3(_ROTATION @ Rotation3.exp(cameras[:, :3]).matrix, cameras[:, 3:6] @ _ROTATION),
        Rigid3.identity(1),
        model,
        params,
        points.copy(),
        np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        frame,
        np.zeros(num_seen, np.int32),
        frame.copy(),
        seen[:, 2:] * [1.0, -1.0],
        np.ones((num_cameras, 6)),
        free_params_mask(model),
        np.ones(num_points),
    )


def _unpacked(data: bytes) -> bytes:
    """Decompress bzip2 data with a size limit: a few bytes can expand to gigabytes."""
    unpacker = bz2.BZ2Decompressor()
    most = max(min(_MOST_UNPACKED * len(data), _SMALL), _MOST_UNPACKED_LARGE * len(data))
    out = unpacker.decompress(data, max_length=most + 1)
    if len(out) > most:
        raise ValueError(f"it unpacks to more than {most // len(data)} times its size")
    if not unpacker.eof:
        raise ValueError("the archive is truncated")
    return out


@checked
def write_bal(path: str | Path, problem: BundleProblem) -> None:
    """Write a problem in which every frame has one image by a RADIAL camera with its principal point at (0, 0).

    A camera shared by several frames is written once per frame; the format cannot store fixed parameters or priors.

    Raises:
        ShapeError: a camera is not of this kind, or the frames are rigs.
        WorkspaceError: the file cannot be written.
    """
    num_frames = len(problem.rig_from_world.translation)
    # A frame without observations gets the camera of its row, as in `read_bal`.
    camera = np.minimum(np.arange(num_frames), len(problem.camera_params) - 1)
    camera[problem.frame] = problem.camera
    used = np.unique(camera)
    if (camera[problem.frame] != problem.camera).any() or problem.cam_from_rig.log().any():
        raise ShapeError("BAL has one camera per frame, and no rigs")
    if (problem.camera_model[used] != int(CameraModel.RADIAL)).any() or problem.camera_params[
        used, 1:3
    ].any():
        raise ShapeError("BAL needs RADIAL cameras with the principal point at (0, 0)")
    owner = np.repeat(np.arange(len(problem.points_in_world)), np.diff(problem.offsets))
    rotation = Rotation3(_ROTATION @ problem.rig_from_world.rotation).log()
    intrinsics = problem.camera_params[camera][:, [0, 3, 4]]
    numbers = np.concatenate(
        [rotation, problem.rig_from_world.translation @ _ROTATION, intrinsics], axis=1
    ).ravel()
    pixels = problem.pixels * [1.0, -1.0]
    lines = [f"{num_frames} {len(problem.points_in_world)} {len(owner)}"]
    lines += [
        f"{f} {p} {u!r} {v!r}"
        for f, p, (u, v) in zip(problem.frame.tolist(), owner.tolist(), pixels.tolist(), strict=True)
    ]
    lines += [repr(number) for number in [*numbers.tolist(), *problem.points_in_world.ravel().tolist()]]
    text = ("\n".join(lines) + "\n").encode()
    with atomic_write(path) as part:
        part.write_bytes(bz2.compress(text) if Path(path).suffix == ".bz2" else text)
