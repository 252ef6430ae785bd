"""Reads the files of a table in a process with little memory and time; says how each ended.

Each line of standard input is (reader, paths, most MiB that it may take). The reader is a name of `READERS`.
"""

import json
import os
import resource
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

from epipole.errors import EpipoleError
from epipole.fields.nerf.hash_files import read_hash
from epipole.fields.nerf.voxel_files import read_grid
from epipole.io.bags.recording import bag_frames, read_bag
from epipole.io.calibration import files as calibration_files
from epipole.io.colmap.database import read_database
from epipole.io.colmap.model import read_colmap_model
from epipole.io.g2o import read_g2o
from epipole.io.gaussians.files import read_gaussians
from epipole.io.images import depth_maps, photographs, video
from epipole.io.meshes.ply import read_points_ply
from epipole.io.models.bal import read_bal
from epipole.io.models.transforms import read_transforms
from epipole.io.sequences import stereo_folders, stereo_video
from epipole.io.truth import read_truth
from epipole.pipelines.stereo.files import read_stereo

SECONDS = 10

READERS: dict[str, Callable[..., Any]] = {
    "calibration": calibration_files.read_calibration,
    "rig": calibration_files.read_stereo_rig,
    "pfm": depth_maps.read_pfm,
    "png16": depth_maps.read_png16,
    "header": photographs.read_header,
    "gray": photographs.read_gray,
    "rgb": photographs.read_rgb,
    "small": lambda path: photographs.read_rgb(path, 64),
    "mask": lambda path: photographs.read_mask(path.parent, path.stem),
    "copy": lambda path: photographs.copy_or_rotate(path, path.with_suffix(".copy.jpg")),
    "bal": read_bal,
    "g2o": read_g2o,
    "colmap": lambda path: read_colmap_model(path if path.is_dir() else path.parent),
    "database": read_database,
    "ply": read_points_ply,
    "transforms": read_transforms,
    "truth": lambda path: read_truth(path.parent),
    "stereo": lambda path: read_stereo(path.parent),
    "frame size": video.frame_size,
    "frames": lambda path: video.extract_frames(path, path.parent / "frames", max_frames=2),
    "pairs": lambda path: stereo_video.extract_pairs(path, path, path.parent / "frames", 2),
    "grid": read_grid,
    "hash": read_hash,
    "gaussians": read_gaussians,
    "bag": lambda path: [frame.gray() for frame in bag_frames(read_bag(path))],
    "folders": lambda path: stereo_folders.pair_folders(path, path.parent),
}


CLEAR, STATUS = Path("/proc/self/clear_refs"), Path("/proc/self/status")


def resident_kib(what: str) -> int:
    """Of this process: VmRSS now, VmHWM at most."""
    return int(STATUS.read_text().split(what + ":")[1].split()[0])


def _stop(number: int, frame: FrameType | None) -> None:
    raise TimeoutError(f"more than {SECONDS} s")


def _has_no_memory(error: BaseException) -> bool:
    """Whether it was the limit of this process that stopped a reader."""
    cause = error.__cause__ or error.__context__
    words = ("Insufficient memory", "OutOfMemory")
    is_own = isinstance(error, MemoryError) or any(word in str(error) for word in words)
    return is_own or (cause is not None and _has_no_memory(cause))


def ending(read: Callable[..., Any], paths: list[Path], most_mib: int) -> str:
    """How a call ends: 'read', 'refused: ...', or what must not be."""
    before = resident_kib("VmRSS")
    CLEAR.write_text("5")  # the peak begins anew
    signal.alarm(SECONDS)
    try:
        read(*paths)
        said = "read"
    except EpipoleError as error:
        said = f"refused: {error}"
        if not any(path.name in said for path in paths) and not any(
            path.parent.name in said for path in paths
        ):
            said = f"no file is named: {error}"
        if _has_no_memory(error):
            said = f"the memory ran out: {error}"
        if len(said) > 8192:
            said = f"a message of {len(said)} letters"
    except BaseException as error:  # noqa: BLE001 - the test shows it
        said = f"{type(error).__name__}: {error}"[:1000]
    finally:
        signal.alarm(0)
    grown = resident_kib("VmHWM") - before
    return f"took {grown >> 10} MB" if grown > most_mib << 10 else said


def main() -> None:
    """Answer line by line."""
    signal.signal(signal.SIGALRM, _stop)
    pages = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (pages + (1 << 30),) * 2)
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    for line in sys.stdin:
        reader, paths, most_mib = json.loads(line)
        answers.write(json.dumps(ending(READERS[reader], [Path(p) for p in paths], most_mib)) + "\n")


if __name__ == "__main__":
    main()
