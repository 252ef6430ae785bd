"""What the viewer shows of a path, and what a page of its own does: the job that it is of knows."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

from epipole._checks import as_path
from epipole._declared import checked
from epipole.errors import ConfigError, FileFormatError
from epipole.io.atomic import atomic_write
from epipole.pipelines.fields import scene as field_scene
from epipole.pipelines.sfm import scene as sfm_scene
from epipole.pipelines.slam import scene as slam_scene
from epipole.pipelines.stereo import scene as stereo_scene
from epipole.pipelines.viewing.config import MOST_SHARED, USUAL_SHARED
from epipole.viewer import ViewerHandle

PAGE_SUFFIXES = (".html", ".htm")


@dataclass(frozen=True, slots=True)
class SharedPage:
    """What `share` has written."""

    file: Path
    shown: str
    """What it shows, and of how much, in words."""
    num_bytes: int


def view(
    out: str | Path, *, port: int | None = None, host: str = "127.0.0.1", block: bool = True
) -> ViewerHandle:
    """Show an output folder in the browser: a model with its pictures, a path and its map, a pair's depth, or Gaussians.

    Args:
        out: output folder of a job, a COLMAP model, or a file of Gaussians.
        port: where to listen; None: 8080, or the next free port if that is in use, which the handle's note says.
        host: the address to listen on; "0.0.0.0" lets other machines in.
        block: return only when the user interrupts with Ctrl-C.

    Raises:
        FileFormatError: the folder holds nothing that can be shown.
        ConfigError: the port is in use or out of range, or the host is no address of this machine.
    """
    path = as_path(out)
    return _scene_of(path).show(path, port=port, host=host, block=block)


@checked
def share(out: str | Path, file: str | Path, *, share_max: int = USUAL_SHARED) -> SharedPage:
    """Write one HTML page that shows Gaussians in any browser, without a server and with nothing loaded from elsewhere.

    Args:
        out: output folder of `splat` or `nerf`, or a file of Gaussians.
        file: the page, which is replaced if it is there.
        share_max: at most so many Gaussians are in it, the most visible.

    Raises:
        FileFormatError: the path is damaged, or is not there.
        ConfigError: the path holds something else than Gaussians, or the page's name does not end in .html.
        WorkspaceError: the page cannot be written.
    """
    path, page_file = as_path(out), as_path(file)
    if page_file.suffix.lower() not in PAGE_SUFFIXES:
        raise ConfigError(f"share writes a page: its name must end in .html, got {page_file.name!r}")
    if not 1 <= share_max <= MOST_SHARED:
        raise ConfigError(f"share_max must be from 1 to {MOST_SHARED}, got {share_max}")
    if not path.exists():
        raise FileFormatError(path, "there is no such file or folder")
    make = getattr(_scene_of(path), "share", None)
    if make is None:
        raise ConfigError(
            f"share takes Gaussians so far (folders of splat or nerf, or their files), not {path}"
        )
    page = make(path, share_max)
    data = page.html.encode("utf-8")
    with atomic_write(page_file) as part:
        part.write_bytes(data)
    return SharedPage(page_file, page.shown, len(data))


def _scene_of(path: Path) -> ModuleType:
    own = (scene for scene in (stereo_scene, slam_scene, field_scene) if scene.is_mine(path))
    return next(own, sfm_scene)
