"""COLMAP's structure from motion through pycolmap: `python -m benchmarks.peers.pycolmap_sfm IMAGES OUT MAPPER`.

The global mapper starts from the database of the incremental run.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any

from benchmarks.peers.base import Limits
from benchmarks.tasks.sfm import SfmTask


class PycolmapSfm:
    """pycolmap with its "incremental" or "global" mapper."""

    def __init__(self, mapper: str, needs: str | None = None, *, shared_camera: bool = False) -> None:
        self.mapper = mapper
        self.shared_camera = shared_camera
        self.name = f"pycolmap-{mapper}"
        self.needs = needs

    def version(self) -> str | None:
        """The installed version of pycolmap; None if it is not installed."""
        try:
            return metadata.version("pycolmap")
        except metadata.PackageNotFoundError:
            return None

    def command(self, task: SfmTask, out: Path, limits: Limits) -> list[str]:
        """The command line of one complete run."""
        known = []
        if task.camera_model is not None and task.camera_params is not None:
            params = ",".join(map(repr, task.camera_params))
            known = ["--camera-model", task.camera_model, "--camera-params", params]
        if self.shared_camera:
            known.append("--shared-camera")
        database = ["--database", str(out.parent / self.needs / "database.db")] if self.needs else []
        numbers = [str(limits.max_image_size), str(limits.max_num_features), str(limits.num_threads)]
        module = [sys.executable, "-m", "benchmarks.peers.pycolmap_sfm"]
        return [*module, str(task.images), str(out), self.mapper, "--limits", *numbers, *known, *database]


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="One run of pycolmap's structure-from-motion.")
    parser.add_argument("images", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("mapper", choices=("incremental", "global"))
    parser.add_argument("--limits", type=int, nargs=3, default=(3200, 8192, 2))
    parser.add_argument("--camera-model")
    parser.add_argument("--camera-params", default="")
    parser.add_argument("--shared-camera", action="store_true", help="use one camera for all images")
    parser.add_argument("--database", type=Path)
    return parser.parse_args()


def main() -> None:
    """Run one mapper on a folder; write models to OUT/sparse and the time of each stage to OUT/summary.json."""
    import pycolmap

    arguments = _arguments()
    limits = Limits(*arguments.limits)
    arguments.out.mkdir(parents=True)
    database, seconds = arguments.out / "database.db", {}
    is_known = arguments.camera_model is not None
    if arguments.database is not None:
        shutil.copyfile(arguments.database, database)
    else:
        _front_end(pycolmap, arguments, database, limits, seconds)
    sparse = arguments.out / "sparse"
    sparse.mkdir()
    with _timed(seconds, "mapping"):
        if arguments.mapper == "incremental":
            models = _incremental(pycolmap, database, arguments.images, sparse, limits, is_known)
        else:
            models = _global(pycolmap, database, arguments.images, sparse, limits, is_known)
    summary = {"seconds": seconds, "registered": [m.num_reg_images() for m in models.values()]}
    (arguments.out / "summary.json").write_text(json.dumps(summary))


@contextmanager
def _timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    seconds[stage] = time.perf_counter() - start


def _front_end(
    pycolmap: Any, arguments: argparse.Namespace, database: Path, limits: Limits, seconds: dict[str, float]
) -> None:
    """Extract features and match all pairs, on the CPU."""
    from benchmarks.tasks.sfm import IMAGE_SUFFIXES

    reader, is_known = pycolmap.ImageReaderOptions(), arguments.camera_model is not None
    if is_known:
        reader.camera_model, reader.camera_params = arguments.camera_model, arguments.camera_params
    mode = pycolmap.CameraMode.SINGLE if is_known or arguments.shared_camera else pycolmap.CameraMode.AUTO
    extraction, matching = pycolmap.FeatureExtractionOptions(), pycolmap.FeatureMatchingOptions()
    extraction.max_image_size, extraction.num_threads = limits.max_image_size, limits.num_threads
    extraction.sift.max_num_features = limits.max_num_features
    matching.num_threads = limits.num_threads
    names = sorted(p.name for p in arguments.images.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES)
    device = pycolmap.Device.cpu
    with _timed(seconds, "features"):
        pycolmap.extract_features(
            database,
            arguments.images,
            image_names=names,
            camera_mode=mode,
            reader_options=reader,
            extraction_options=extraction,
            device=device,
        )
    with _timed(seconds, "matches"):
        pycolmap.match_exhaustive(database, matching_options=matching, device=device)


def _incremental(
    pycolmap: Any, database: Path, images: Path, sparse: Path, limits: Limits, is_known: bool
) -> dict[int, Any]:
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = limits.num_threads
    if is_known:
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
        options.ba_refine_principal_point = False
        options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    return pycolmap.incremental_mapping(database, images, sparse, options)


def _global(
    pycolmap: Any, database: Path, images: Path, sparse: Path, limits: Limits, is_known: bool
) -> dict[int, Any]:
    """Run the global mapper, after view-graph calibration if no calibration is given, as COLMAP recommends."""
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = options.mapper.num_threads = limits.num_threads
    adjustment = options.mapper.bundle_adjustment
    adjustment.ceres.solver_options.num_threads = limits.num_threads
    if is_known:
        adjustment.refine_focal_length = adjustment.refine_extra_params = False
        adjustment.refine_principal_point = False
    else:
        pycolmap.calibrate_view_graph(database)
    return pycolmap.global_mapping(database, images, sparse, options)


if __name__ == "__main__":
    main()
