"""epipole takes pixels and gives back space.

`epipole.reconstruct(images, out)` turns a folder of photographs into a 3D model; every other job is one call, too.
Everything is imported on first use: `import epipole` loads and compiles nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from epipole._version import __version__ as __version__

if TYPE_CHECKING:
    from epipole.api import *  # noqa: F403 - the names below, for editors and type checkers

_JOBS = (
    "reconstruct",
    "slam",
    "splat",
    "nerf",
    "render",
    "mesh",
    "stereo",
    "calibrate",
    "evaluate",
    "undistort",
    "convert",
    "view",
    "share",
    "demo",
)
_MORE_JOBS = (
    "compare_fields",
    "export_lesson",
    "stereo_many",
    "stereo_of_model",
    "examine_stereo",
    "evaluate_trajectory",
)
_CONFIGS = (
    "ReconstructConfig",
    "FeatureConfig",
    "MatchConfig",
    "PairingConfig",
    "RansacConfig",
    "MapperConfig",
    "AnchorOptions",
    "SlamConfig",
    "JobOptions",
    "StereoConfig",
    "CalibrationConfig",
    "BoardConfig",
)
_DATA = (
    "Camera",
    "CameraModel",
    "CameraOptions",
    "Reconstruction",
    "RectifiedRig",
    "Rigid3",
    "StereoRig",
    "Slam",
    "SlamCamera",
    "DepthCamera",
    "Frame",
    "read_slam_map",
    "write_slam_map",
)
_RESULTS = (
    "ReconstructionResult",
    "StereoResult",
    "StereoBatch",
    "Diagnosis",
    "CalibrationRun",
    "Conversion",
    "Evaluation",
    "DemoResult",
    "FieldComparison",
    "Rendered",
    "ExportedLesson",
    "NerfResult",
    "SharedPage",
    "SlamResult",
    "SplatResult",
    "TrackedFrame",
    "TrajectoryEvaluation",
    "ViewerHandle",
)
_ROOMS = (
    "api",
    "cameras",
    "config",
    "dense",
    "disparity_search",
    "errors",
    "features",
    "fields",
    "geometry",
    "image",
    "inertial",
    "io",
    "lesson",
    "mapping",
    "metrics",
    "optim",
    "pipelines",
    "report",
    "robust",
    "runs",
    "scale",
    "scene",
    "solvers",
    "synthetic",
    "viewer",
)
__all__ = [*_JOBS, *_MORE_JOBS, *_CONFIGS, *_DATA, *_RESULTS, *_ROOMS, "__version__"]  # noqa: PLE0604 - the names are strings


def __getattr__(name: str) -> Any:
    if name in _ROOMS:
        return import_module(f"epipole.{name}")
    if name in __all__:
        return getattr(import_module("epipole.api"), name)
    raise AttributeError(f"module 'epipole' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
