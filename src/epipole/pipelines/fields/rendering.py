"""The `render` job: render a field from given cameras to images or a video."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from time import perf_counter
from typing import Unpack

import numpy as np

from epipole._checks import as_path
from epipole.config import options_of
from epipole.errors import ConfigError, FileFormatError
from epipole.fields.normals import normals_of
from epipole.fields.splat.rasterizer import RenderOptions
from epipole.fields.splat.rasterizer import render as rasterize
from epipole.image import color_map, color_range
from epipole.io.files import missing_in_words
from epipole.io.images.rgba import write_png
from epipole.io.images.video_files import GIF_SUFFIX, VIDEO_SUFFIX, write_video
from epipole.io.models.losses import losses_in
from epipole.pipelines.fields.camera_path import path_along
from epipole.pipelines.fields.cameras import RenderView, orbit, render_views_of_model
from epipole.pipelines.fields.config import RenderConfig
from epipole.pipelines.fields.kinds import kind_in
from epipole.pipelines.fields.options import RenderKeywords
from epipole.pipelines.fields.scene import (
    BACKGROUNDS,
    CAMERAS,
    SUMMARY,
    first_view_of_positions,
    is_result,
    recorded_antialiased,
    recorded_background,
    recorded_first_view,
    seen_gaussians,
)
from epipole.pipelines.fields.surfaces import seen_from
from epipole.runs import (
    Job,
    Progress,
    ProgressCallback,
    ignore_progress,
    open_run,
    refuse_existing,
    replacing_file,
)
from epipole.runs.folder import check_output_path

FILES = (VIDEO_SUFFIX, GIF_SUFFIX)
"""Suffixes of what is one file; anything else is a folder of images."""


@dataclass(frozen=True, slots=True)
class RenderResult:
    """Result of `render`."""

    out: Path
    num_frames: int
    frames_per_s: float
    """Rendering speed, without writing files."""


def render(
    source: str | Path,
    out: str | Path,
    config: RenderConfig | None = None,
    progress: ProgressCallback = ignore_progress,
    **options: Unpack[RenderKeywords],
) -> RenderResult:
    """Render trained Gaussians, a trained grid or a neural field.

    Args:
        source: an output folder of `splat` or `nerf`, or a file of Gaussians.
        out: a video (.mp4, or .gif), or a new folder for PNG images; output of an earlier call is replaced.
        config: cameras and image size; None for the defaults.
        progress: called with the progress.
        **options: single options by name, which override `config`.

    Raises:
        ConfigError: an option is unknown or invalid, the images of a video would differ in size, or `out` has the
            suffix of another file type.
        FileFormatError: the source or the cameras cannot be read.
        NoModelError: no camera has a pose.
        WorkspaceError: the output exists and no earlier call wrote it, or it cannot be written.
    """
    source, out = as_path(source), as_path(out)
    wanted = options_of(RenderConfig, config, options, ["config", "progress"])
    if not source.exists():
        raise FileFormatError(source, missing_in_words(source))
    inputs = (source,) if wanted.cameras is None else (source, wanted.cameras)
    _check_target(out, inputs)
    color = np.full(3, _background(source, wanted), np.float32)
    image_of, first_view = _drawer(source, wanted, color)
    if wanted.cameras is None:
        views = _path(source, wanted) or orbit(*first_view, wanted)
    else:
        views = render_views_of_model(wanted.cameras, wanted)
        for loss in losses_in(wanted.cameras):
            progress(Progress("render", 0, len(views), loss))
    if wanted.output != "color":
        image_of = _surface_drawer(source, wanted.output, views[0])
    spent = [0.0]

    def images() -> Iterator[tuple[RenderView, np.ndarray]]:
        for n, render_view in enumerate(views):
            start = perf_counter()
            rendered = image_of(render_view)
            spent[0] += perf_counter() - start
            yield render_view, np.rint(255 * np.clip(rendered, 0, 1)).astype(np.uint8)
            progress(Progress("render", n + 1, len(views)))

    if out.suffix.lower() in FILES:
        with replacing_file(out, "render", inputs) as aside:
            write_video(aside, (image for _, image in images()), wanted.fps)
    else:
        settings = {**asdict(wanted), "cameras": None if wanted.cameras is None else str(wanted.cameras)}
        with open_run(Job(kind="render", inputs=(source,), settings=settings, progress=progress), out) as run:
            with run.stage("render"), run.folder.publish("images") as aside:
                for render_view, image in images():
                    write_png(aside / f"{render_view.name}.png", image)
            run.finish()
    return RenderResult(out, len(views), len(views) / max(spent[0], 1e-9))


def _path(source: Path, wanted: RenderConfig) -> list[RenderView]:
    """Views along the training cameras; empty for an orbit.

    Raises:
        ConfigError: the path of the cameras is requested, but they are not known.
    """
    if wanted.path == "orbit" or wanted.orbit_options:
        return []
    known = (source if source.is_dir() else source.parent) / CAMERAS
    if is_result(source) and known.is_file():
        return path_along(render_views_of_model(known, wanted), wanted.frames)
    if wanted.path == "cameras":
        raise ConfigError(f"path=cameras needs {known}, which a training writes, but there is none")
    return []


def _check_target(out: Path, inputs: tuple[Path, ...]) -> None:
    """Check, before any work, that the output is a video or a folder and may be written.

    Raises:
        ConfigError: it has the suffix of another file type.
        WorkspaceError: it exists and was not written by `render`.
    """
    if out.suffix.lower() in FILES:
        refuse_existing([out], "render", inputs)
        return
    is_file_name = bool(out.suffix) and not out.suffix[1:].isdecimal()  # views_0.5 is the name of a folder
    if is_file_name and not out.is_dir():
        raise ConfigError(
            f"render writes a video ({VIDEO_SUFFIX}), a {GIF_SUFFIX}, or a folder of PNG images, but {out} ends in"
            f" {out.suffix}"
        )
    check_output_path(out, "render", inputs[:1])


def _drawer(
    source: Path, wanted: RenderConfig, color: np.ndarray
) -> tuple[Callable[[RenderView], np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Function that renders a view of the field, and position, target and up vector of its first view."""
    found = kind_in(source)
    if found is not None:
        kind, file = found
        field = kind.read(file)
        position, look_at, up = recorded_first_view(file.with_name(SUMMARY)) or first_view_of_positions(
            kind.positions(field)
        )
        return (
            lambda each: kind.render(field, each.camera, each.cam_from_world, color)[0],
            (position, look_at, up),
        )
    (cloud, view), requested = seen_gaussians(source), wanted.antialiased
    if requested is None:
        requested = recorded_antialiased((source if source.is_dir() else source.parent) / SUMMARY)
    options = RenderOptions(antialiased=requested)
    return (
        lambda each: rasterize(cloud, each.camera, each.cam_from_world, options).over(color),
        (view.position, view.look_at, view.up),
    )


def _surface_drawer(source: Path, output: str, first: RenderView) -> Callable[[RenderView], np.ndarray]:
    """Function that renders depth, normals or coverage of a view, as an image from 0 to 1."""
    see, _ = seen_from(source)
    limits = color_range(see(first).surface())

    def depth(render_view: RenderView) -> np.ndarray:
        return color_map(see(render_view).surface(), limits) / np.float32(255.0)

    def normals(render_view: RenderView) -> np.ndarray:
        return np.nan_to_num(0.5 + 0.5 * normals_of(see(render_view).surface(), render_view.camera))

    def coverage(render_view: RenderView) -> np.ndarray:
        return np.repeat(see(render_view).coverage[..., None], 3, axis=2)

    return {"depth": depth, "normals": normals, "coverage": coverage}[output]


def _background(source: Path, wanted: RenderConfig) -> float:
    """Gray value of the background: as requested, as recorded by the training, or black."""
    if wanted.background != "auto":
        return BACKGROUNDS[wanted.background]
    return recorded_background((source if source.is_dir() else source.parent) / SUMMARY) or 0.0
