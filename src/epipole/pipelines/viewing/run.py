"""What the viewer shows of a path: the job that it is of knows."""

from __future__ import annotations

from pathlib import Path

from epipole._checks import as_path
from epipole.pipelines.fields import scene as field_scene
from epipole.pipelines.sfm import scene as sfm_scene
from epipole.pipelines.slam import scene as slam_scene
from epipole.pipelines.stereo import scene as stereo_scene
from epipole.viewer import ViewerHandle


def view(
    out: str | Path, *, port: int | None = None, host: str = "127.0.0.1", block: bool = True
) -> ViewerHandle:
    """Show an output folder in the browser: a model with its pictures, a path and its map, a pair's depth, or Gaussians.

    Args:
        out: output folder of a job, a COLMAP model, or a PLY file of Gaussians.
        port: where to listen; None: 8080, or the next free port if that is in use, which the handle's note says.
        host: the address to listen on; "0.0.0.0" lets other machines in.
        block: return only when the user interrupts with Ctrl-C.

    Raises:
        FileFormatError: the folder holds nothing that can be shown.
        ConfigError: the port is in use or out of range, or the host is no address of this machine.
    """
    path = as_path(out)
    own = (scene for scene in (stereo_scene, slam_scene, field_scene) if scene.is_mine(path))
    scene = next(own, sfm_scene)
    return scene.show(path, port=port, host=host, block=block)
