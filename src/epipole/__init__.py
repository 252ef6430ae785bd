"""epipole takes pixels and gives back space.

`epipole.reconstruct(images, out)` turns a folder of photographs into a 3D model. Everything is imported on
first use: `import epipole` loads and compiles nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from epipole.api import calibrate as calibrate
    from epipole.api import evaluate as evaluate
    from epipole.api import reconstruct as reconstruct
    from epipole.api import undistort as undistort

__version__ = "0.1.0"

_API = ("reconstruct", "calibrate", "evaluate", "undistort")
_ROOMS = (
    *("geometry", "cameras", "image", "features", "solvers", "optim", "robust", "scene", "io"),
    *("metrics", "synthetic", "workflow", "mapping", "sfm", "stereo", "calibration", "report", "viewer"),
)
__all__ = [*_API, "__version__"]  # noqa: PLE0604 - the names are strings


def __getattr__(name: str) -> Any:
    if name in _API:
        return getattr(import_module("epipole.api"), name)
    if name in _ROOMS:
        return import_module(f"epipole.{name}")
    raise AttributeError(f"module 'epipole' has no attribute {name!r}")
