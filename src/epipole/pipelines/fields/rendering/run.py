"""The `render` job: render a field from given cameras to images or a video."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from shutil import rmtree
from time import perf_counter
from typing import Unpack

import numpy as np

from epipole._checks import as_path
from epipole.config import options_of
from epipole.errors import ConfigError, FileFormatError
from epipole.image import color_range
from epipole.io.atomic import part_beside
from epipole.io.files import missing_in_words
from epipole.io.gaussians.files import gaussians_file, is_unpacked_sog
from epipole.io.images.rgba import write_png
from epipole.io.images.video_files import GIF_SUFFIX, VIDEO_SUFFIX, write_video
from epipole.io.models.losses import losses_in
from epipole.pipelines.fields.cameras import RenderView, orbit, render_views_of_model
from epipole.pipelines.fields.config import RenderConfig
from epipole.pipelines.fields.kinds import kind_in
from epipole.pipelines.fields.options import RenderKeywords
from epipole.pipelines.fields.rendering.camera_path import path_along
from epipole.pipelines.fields.rendering.image_units import IMAGE, UNITS, ViewPayload, unit_of_view
from epipole.pipelines.fields.rendering.renderer import (
    FieldFile,
    Rendering,
    in_bytes,
    opened_field,
    renderer_of,
)
from epipole.pipelines.fields.scene import (
    BACKGROUNDS,
    CAMERAS,
    SUMMARY,
    first_view_of_positions,
    is_result,
    recorded_antialiased,
    recorded_background,
    recorded_first_view,
)
from epipole.pipelines.fields.surfaces import StoredField, surface_of
from epipole.runs import (
    ExecutorChoice,
    Job,
    PassedExecutor,
    Progress,
    ProgressCallback,
    Unit,
    chosen_executor,
    ignore_progress,
    load,
    open_run,
    refuse_existing,
    replacing_file,
    run_units,
)
from epipole.runs.folder import check_output_path

WHERE = ("cluster", "shared_folder")
"""Options of where images are rendered, which do not affect them."""
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
    executor: PassedExecutor | None = None,
    **options: Unpack[RenderKeywords],
) -> RenderResult:
    """Render trained Gaussians, a trained grid or a neural field.

    Args:
        source: an output folder of `splat` or `nerf`, or a file of Gaussians.
        out: a video (.mp4, or .gif), or a new folder for PNG images; output of an earlier call is replaced.
        config: cameras and image size; None for the defaults.
        progress: called with the progress.
        executor: executor for images, instead of the config's cluster, as for `reconstruct`; None: one image after
            the other, each with all threads.
        **options: single options by name, which override `config`.

    Raises:
        ConfigError: an option is unknown or invalid, the images of a video would differ in size, or `out` has the
            suffix of another file type.
        FileFormatError: the source or the cameras cannot be read.
        NoModelError: no camera has a pose.
        WorkspaceError: the output exists and no earlier call wrote it, or it cannot be written.
    """
    source, out = as_path(source), as_path(out)
    wanted = options_of(RenderConfig, config, options, ["config", "progress", "executor"])
    if not source.exists():
        raise FileFormatError(source, missing_in_words(source))
    inputs = (source,) if wanted.cameras is None else (source, wanted.cameras)
    _check_target(out, inputs)
    work = chosen_executor(executor, wanted.cluster, has_shared_folder=wanted.shared_folder, default="inline")
    rendering, views = _rendering_and_views(source, wanted)
    if wanted.cameras is not None:
        for loss in losses_in(wanted.cameras):
            progress(Progress("render", 0, len(views), loss))
    frames = _Frames(rendering, views, progress)
    if out.suffix.lower() in FILES:
        with replacing_file(out, "render", inputs) as aside:
            write_video(aside, (image for _, image in frames.rendered_for_file(work, out)), wanted.fps)
    else:
        settings = {name: value for name, value in asdict(wanted).items() if name not in WHERE}
        settings["cameras"] = None if wanted.cameras is None else str(wanted.cameras)
        job = Job(kind="render", inputs=(source,), settings=settings, progress=progress, executor=work)
        with open_run(job, out) as run:
            with run.stage("render"), run.folder.publish("images") as aside:
                images = (
                    frames.rendered()
                    if work == "inline"
                    else frames.rendered_elsewhere(run.root / UNITS, partial(run.do, stage="render"))
                )
                for view, image in images:
                    write_png(aside / f"{view.name}.png", image)
            run.finish()
    opened_field.cache_clear()
    return RenderResult(out, len(views), len(views) / max(frames.spent_s, 1e-9))


class _Frames:
    """The images of views, rendered here or elsewhere."""

    def __init__(self, rendering: Rendering, views: Sequence[RenderView], progress: ProgressCallback) -> None:
        self.rendering, self.views, self.progress = rendering, views, progress
        self.spent_s = 0.0
        """Time of rendering."""

    def rendered(self) -> Iterator[tuple[RenderView, np.ndarray]]:
        """Render one image after the other, each with all threads."""
        render_view = renderer_of(self.rendering)
        for n, view in enumerate(self.views):
            start = perf_counter()
            image, _ = render_view(view)
            self.spent_s += perf_counter() - start
            yield view, in_bytes(image)
            self.progress(Progress("render", n + 1, len(self.views)))

    def rendered_elsewhere(
        self, folder: Path, do: Callable[[list[Unit]], object]
    ) -> Iterator[tuple[RenderView, np.ndarray]]:
        """Render all images as units of work in a folder, which is removed."""
        units = [unit_of_view(folder, ViewPayload(self.rendering, view)) for view in self.views]
        start = perf_counter()
        do(units)
        self.spent_s = perf_counter() - start
        for view, unit in zip(self.views, units):
            image = load(unit.path, IMAGE)["image"]
            unit.path.unlink()
            yield view, image
        with suppress(OSError):  # it may hold files of the user
            folder.rmdir()

    def rendered_for_file(self, work: ExecutorChoice, out: Path) -> Iterator[tuple[RenderView, np.ndarray]]:
        """The same for a single file, which has no folder for the results of an interrupted run."""
        if work == "inline":
            yield from self.rendered()
            return
        folder = part_beside(out)
        try:
            yield from self.rendered_elsewhere(
                folder, partial(run_units, stage="render", executor=work, progress=self.progress)
            )
        finally:
            rmtree(folder, ignore_errors=True)


def _rendering_and_views(source: Path, wanted: RenderConfig) -> tuple[Rendering, list[RenderView]]:
    """What to render, and the cameras.

    Raises:
        FileFormatError: the source or the cameras cannot be read.
        NoModelError: no camera has a pose.
        ConfigError: the path of the cameras is requested, but they are not known.
    """
    found = kind_in(source)
    file = gaussians_file(source) if found is None else found[1]
    stored = file.parent if is_unpacked_sog(file) else file
    antialiased = wanted.antialiased
    if antialiased is None:
        antialiased = recorded_antialiased((source if source.is_dir() else source.parent) / SUMMARY)
    rendering = Rendering(FieldFile.now(stored), wanted.output, _background(source, wanted), antialiased)
    field = opened_field(rendering.field)
    if field.kind is None and not len(field.content):
        raise FileFormatError(file, "has no Gaussians")
    views = (
        _path(source, wanted) or _orbit_around(field, wanted)
        if wanted.cameras is None
        else render_views_of_model(wanted.cameras, wanted)
    )
    if wanted.output == "depth":
        see = surface_of(field, antialiased=antialiased)
        rendering = replace(rendering, limits=color_range(see(views[0]).surface()))
    return rendering, views


def _orbit_around(field: StoredField, wanted: RenderConfig) -> list[RenderView]:
    """Views on an orbit that starts at the first view."""
    first = recorded_first_view(field.file.with_name(SUMMARY))
    if first is None:
        kind, content = field.kind, field.content
        positions = content.centers_in_world if kind is None else kind.positions(content)
        first = first_view_of_positions(positions)
    position, look_at, up = first
    return orbit(position, look_at, up, wanted)


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


def _background(source: Path, wanted: RenderConfig) -> float:
    """Gray value of the background: as requested, as recorded by the training, or black."""
    if wanted.background != "auto":
        return BACKGROUNDS[wanted.background]
    return recorded_background((source if source.is_dir() else source.parent) / SUMMARY) or 0.0
