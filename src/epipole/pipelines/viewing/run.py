"""The viewing job: chooses how to show a path, and writes self-contained pages."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from epipole._checks import as_path, checked
from epipole.errors import ConfigError, FileFormatError
from epipole.io.contents_in_words import with_what_it_is
from epipole.io.files import missing_in_words
from epipole.pipelines.calibration import scene as calibration
from epipole.pipelines.fields import scene as fields
from epipole.pipelines.georeferencing import scene as georeferencing
from epipole.pipelines.localization import scene as localization
from epipole.pipelines.sfm.page import scene as sfm
from epipole.pipelines.slam.output import scene as slam
from epipole.pipelines.stereo import scene as stereo
from epipole.pipelines.surfaces import scene as surfaces
from epipole.pipelines.viewing import files
from epipole.pipelines.viewing.config import MOST_SHARED, USUAL_SHARED
from epipole.report.space_scene import SpaceScene
from epipole.runs import refuse_existing, replacing_file
from epipole.viewer import ViewerHandle, view_scene
from epipole.viewer.scene_page import scene_page

PAGE_SUFFIXES = (".html", ".htm")
KINDS: tuple[tuple[Callable[[Path], bool], Callable[[Path], SpaceScene]], ...] = (
    (fields.is_mine, fields.scene),
    (files.is_ply, files.scene_of_ply),
    (files.is_glb, files.scene_of_glb),
    (stereo.is_pair_file, stereo.scene_of_file),
    (files.is_depth_map, files.scene_of_depth_map),
    (stereo.is_mine, stereo.scene),
    (slam.is_mine, slam.scene),
    (slam.is_map, slam.scene_of_map),
    (slam.is_trajectory, slam.scene_of_trajectory),
    (calibration.is_mine, calibration.scene),
    (localization.is_mine, localization.scene),
    (georeferencing.is_mine, georeferencing.scene),
    (surfaces.is_mine, surfaces.scene),
)
"""Checked in this order; anything else is a model, or cannot be shown."""


@dataclass(frozen=True, slots=True)
class SharedPage:
    """Result of `share`."""

    file: Path
    shown: str
    """Description of what the page shows."""
    num_bytes: int


@checked
def view(
    out: str | Path, *, port: int | None = None, host: str = "127.0.0.1", block: bool = True
) -> ViewerHandle:
    """Show a result or a file in the browser.

    Args:
        out: output folder of a job, a COLMAP model, a transforms.json, a PLY file (points, triangles or Gaussians),
            other files of Gaussians, a GLB file (textured mesh), a depth map (PFM, 16-bit PNG), a trajectory (TUM,
            KITTI, EuRoC), a SLAM map, or a calibration.
        port: the port to listen on; None: 8080, or the next free port if that is in use (see the handle's note).
        host: the address to listen on; "0.0.0.0" allows connections from other machines.
        block: return only after Ctrl-C.

    Raises:
        FileFormatError: the path contains nothing that can be shown, or is damaged.
        ConfigError: the port is in use or out of range, or the host is not an address of this machine.
    """
    return view_scene(scene_of(as_path(out)), port=port, host=host, block=block)


@checked
def share(out: str | Path, file: str | Path, *, share_max: int = USUAL_SHARED) -> Path:
    """Write a self-contained HTML page that shows a result or a file in any browser, without a server.

    Args:
        out: as in `view`.
        file: the page; one written by an earlier call is replaced.
        share_max: largest number of points (sampled evenly) and of Gaussians (merged) in the page; a page with a
            textured mesh has about 10 bytes times this number.

    Raises:
        FileFormatError: the path does not exist, contains nothing that can be shown, or is damaged.
        ConfigError: the page's name does not end in .html.
        WorkspaceError: the page cannot be written, or exists and was not written by an earlier call.
    """
    return write_page(out, file, share_max).file


def write_page(out: str | Path, file: str | Path, share_max: int) -> SharedPage:
    """`share`, and what the page shows."""
    path, page_file = as_path(out), as_path(file)
    if page_file.suffix.lower() not in PAGE_SUFFIXES:
        raise ConfigError(f"share writes an HTML page, so its name must end in .html, got {page_file.name!r}")
    if not 1 <= share_max <= MOST_SHARED:
        raise ConfigError(f"share_max must be from 1 to {MOST_SHARED}, got {share_max}")
    scene = scene_of(path)
    refuse_existing([page_file], "view", (path,))
    page = scene_page(scene, share_max)
    data = page.html.encode("utf-8")
    with replacing_file(page_file, "view", (path,)) as part:
        part.write_bytes(data)
    num_bytes = page_file.stat().st_size if page_file.is_file() else len(data)
    return SharedPage(page_file, page.shown, num_bytes)


def scene_of(path: Path) -> SpaceScene:
    """The scene of a path.

    Raises:
        FileFormatError: there is nothing to show, or it is damaged.
    """
    if not path.exists():
        raise FileFormatError(path, missing_in_words(path))
    make = next((make for is_mine, make in KINDS if is_mine(path)), None)
    if make is None and path.is_file() and path.suffix.lower() != ".json":
        advice = "`epipole view --help` lists what can be shown"
        raise FileFormatError(path, with_what_it_is("not a file that can be shown", path, advice))
    return (make or sfm.scene)(path)
