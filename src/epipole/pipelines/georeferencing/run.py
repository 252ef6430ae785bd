"""The georeferencing job: a finished model, control points and GPS in; a model in meters east, north and up out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from epipole._checks import as_path
from epipole.config import options_of
from epipole.errors import ConfigError, EpipoleError, FileFormatError, WorkspaceError
from epipole.io.colmap.database import read_database
from epipole.io.colmap.model import find_model, read_colmap_model, write_colmap_model
from epipole.io.files import missing_in_words, read_json
from epipole.io.images.photographs import link_or_copy, read_header
from epipole.io.json_files import json_text
from epipole.io.meshes.ply import write_points_ply, write_scene_ply
from epipole.io.models.losses import SUMMARY, losses_of
from epipole.io.names import path_inside
from epipole.io.survey.control_points import ControlPoints, read_control_points
from epipole.io.survey.coordinate_systems import LOCAL, WGS84, coordinates_of, lat_lon_alt_of
from epipole.io.workspaces import DATABASE, IMAGES, workspace_of_model
from epipole.pipelines.georeferencing.config import GeoreferenceConfig
from epipole.pipelines.georeferencing.georeference import (
    GeoreferencedModel,
    georeference_model,
    require_something,
)
from epipole.pipelines.georeferencing.options import GeoreferenceKeywords
from epipole.pipelines.georeferencing.page import render_page
from epipole.pipelines.georeferencing.results import image_table, point_entries, summary_of, with_sigma
from epipole.pipelines.georeferencing.start import refuse_other_area
from epipole.pipelines.georeferencing.survey import GpsFixes, SurveyedPoints, observations_in_model
from epipole.runs import Job, ProgressCallback, Run, ignore_progress, open_run
from epipole.scene import Georeference, Reconstruction

FOLDER = "georeferenced"
"""Output folder in that of the model, unless another is given."""
GIVEN = "given"
"""Start of the source of a focal length that is known, in the summary of `reconstruct`."""
ALTITUDE_RATIO = 2.0
"""Standard deviation of GPS altitudes, relative to a horizontal coordinate."""


@dataclass(frozen=True, slots=True, eq=False)
class GeoreferenceResult:
    """Result of `georeference`, which is also in the output folder."""

    out: Path
    model: Reconstruction
    """The model in meters east, north and up; `model.georeference` is the position of its origin on Earth."""
    survey: GeoreferencedModel
    """Residuals and standard deviations."""
    points: dict[str, dict[str, Any]]
    """Everything known about each control and check point, as in `control_points.json`."""
    warnings: tuple[str, ...]
    summary: dict[str, Any]
    """As in `summary.json`."""

    def __repr__(self) -> str:
        return f"GeoreferenceResult({len(self.points)} surveyed points in {self.out})"


@dataclass(frozen=True, slots=True, eq=False)
class _Measured:
    """What the survey and the images measured, in the coordinates of the result."""

    surveyed: SurveyedPoints
    gps: GpsFixes | None
    origin: Georeference | None
    notes: list[str]


def georeference(
    workspace: str | Path,
    out: str | Path | None = None,
    config: GeoreferenceConfig | None = None,
    progress: ProgressCallback = ignore_progress,
    **options: Unpack[GeoreferenceKeywords],
) -> GeoreferenceResult:
    """Give a finished model its position on Earth, its scale and orientation, from control points and GPS.

    Args:
        workspace: output folder of `reconstruct`, or a COLMAP model; its images are in `images/`.
        out: output folder; None: `WORKSPACE/georeferenced`.
        config: options; None for the defaults.
        progress: called with the progress of each stage.
        **options: single options by name, which override `config`: `gcp="gcp_list.txt"`.

    Raises:
        FileFormatError: there is no model, or the file of control points is malformed.
        ConfigError: an option is invalid, or control points and GPS do not determine the position, or contradict the images.
        MissingDependencyError: the coordinate system of the control points needs pyproj.
        WorkspaceError: the output folder cannot be used.
    """
    config = options_of(GeoreferenceConfig, config, options, ["out", "config", "progress"])
    workspace = as_path(workspace)
    if not workspace.exists():
        raise FileFormatError(workspace, missing_in_words(workspace))
    root = _root_of(workspace)
    target = root / FOLDER if out is None else as_path(out)
    if target.resolve() == root.resolve():
        raise WorkspaceError(f"{target} is the folder of the model: choose another output folder")
    inputs = (workspace,) if config.gcp is None else (workspace, config.gcp)
    job = Job(
        kind="georeference",
        inputs=inputs,
        settings={"config": asdict(config)},
        threads=config.threads,
        progress=progress,
    )
    with open_run(job, target) as run:
        with run.stage("open"):
            run.report("open", 0, 1)
            model = _with_known_cameras(read_colmap_model(find_model(workspace)), root)
            run.report("open", 1, 1)
        with run.stage("read"):
            measured = _measured(model, root, config, run)
            require_something(measured.surveyed, measured.gps)
        with run.stage("adjust"):
            run.report("adjust", 0, 1)
            found = georeference_model(model, measured.surveyed, measured.gps, config)
            measured = replace(measured, origin=with_sigma(measured.origin, found))
            found = replace(found, model=replace(found.model, georeference=measured.origin))
            run.report("adjust", 1, 1)
        run.warnings += [*_lost_before(root), *measured.notes, *found.warnings]
        return _write(found, measured, root, run)


def _root_of(workspace: Path) -> Path:
    """The folder with the images or the database of a model; the given one if there are none."""
    return workspace_of_model(workspace, IMAGES) or workspace_of_model(workspace, DATABASE) or workspace


def _lost_before(root: Path) -> list[str]:
    """Images and further models that the reconstruction lost; its other warnings are about what is adjusted here."""
    try:
        summary = read_json(root / SUMMARY)
    except FileFormatError:
        return []
    if not isinstance(summary, dict) or not isinstance(summary.get("not_registered"), dict):
        return []
    return losses_of({**summary, "warnings": []}, root)


def _with_known_cameras(model: Reconstruction, root: Path) -> Reconstruction:
    """The model with constant intrinsics where its run was given them, and not asked to refine them."""
    try:
        stored, summary = read_json(root / "config.json"), read_json(root / SUMMARY)
    except FileFormatError:
        return model
    config = stored.get("config") if isinstance(stored, dict) else None
    sources = summary.get("focal_sources") if isinstance(summary, dict) else None
    if not isinstance(config, dict) or config.get("refine_known") or not isinstance(sources, list):
        return model
    is_given = np.array([str(source).startswith(GIVEN) for source in sources], bool)
    if len(is_given) != len(model.cameras):
        return model
    return replace(model, cameras=replace(model.cameras, is_constant=is_given))


def _measured(model: Reconstruction, root: Path, config: GeoreferenceConfig, run: Run) -> _Measured:
    points = None if config.gcp is None else read_control_points(config.gcp)
    is_local = points is not None and points.crs == LOCAL
    table, sigma, notes = (
        np.full((len(model.images), 3), np.nan),
        np.empty((len(model.images), 3)),
        list[str](),
    )
    if config.use_gps and not is_local:
        table, sigma, notes = _gps_of_images(model, root, config, run)
    known = np.isfinite(table[:, :2]).all(axis=1)
    control = exchanged = np.full((0, 3), np.nan)
    if points is not None and not is_local:
        control = lat_lon_alt_of(config.gcp or "", points.coordinates, points.crs)
        exchanged = _exchanged(points, config)
        here = table
        if model.georeference is not None and not known.any():
            here = model.georeference.lat_lon_alt_of(np.zeros((1, 3)))
        refuse_other_area(control, exchanged, here)
    crs = WGS84 if points is None or is_local else points.crs
    origin = None
    if not is_local:
        origin = model.georeference or Georeference.about(table if not len(control) else control)
        origin = None if origin is None else replace(origin, crs=crs)
    gps = None
    if known.any() and origin is not None:
        gps = GpsFixes(origin.enu_of(table), sigma)
    surveyed, more = _surveyed(model, points, control, exchanged, origin, config)
    return _Measured(surveyed, gps, origin, [*notes, *more])


def _exchanged(points: ControlPoints, config: GeoreferenceConfig) -> np.ndarray:
    """Positions if the first two columns were in the other order; NaN if that is impossible."""
    try:
        return lat_lon_alt_of(config.gcp or "", points.coordinates[:, [1, 0, 2]], points.crs)
    except FileFormatError:
        return np.full((len(points), 3), np.nan)


def _surveyed(
    model: Reconstruction,
    points: ControlPoints | None,
    control: np.ndarray,
    exchanged: np.ndarray,
    origin: Georeference | None,
    config: GeoreferenceConfig,
) -> tuple[SurveyedPoints, list[str]]:
    if points is None:
        none = np.zeros((0, 3))
        rows = np.zeros(0, np.int64)
        return SurveyedPoints((), none, none, none, np.zeros(0, bool), rows, rows, none[:, :2]), []
    unknown = sorted(set(config.check) - set(points.name))
    if unknown:
        raise ConfigError(f"check names a point that {config.gcp} does not have: {unknown[0]}")
    kept, images, pixels, notes = observations_in_model(points, model)
    if not len(kept):
        raise ConfigError(f"no observation of {config.gcp} is in a registered image: {'; '.join(notes)}")
    if origin is None:
        position, other = points.coordinates, points.coordinates[:, [1, 0, 2]]
    else:
        position = origin.enu_of(control)
        about = Georeference.about(exchanged)
        other = np.full(position.shape, np.nan) if about is None else about.enu_of(exchanged)
    sigma = np.array([config.gcp_sigma_m, config.gcp_sigma_m, config.gcp_height_sigma_m])
    is_check = points.is_check | np.isin(np.array(points.name, dtype=object), list(config.check))
    surveyed = SurveyedPoints(
        points.name,
        position,
        other,
        np.tile(sigma, (len(points), 1)),
        ~is_check,
        points.point[kept],
        images,
        pixels,
    )
    return surveyed, notes


def _gps_of_images(
    model: Reconstruction, root: Path, config: GeoreferenceConfig, run: Run
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """GPS positions (n, 3) in degrees, degrees and meters, and standard deviations in meters; from EXIF, or else the database."""
    n = len(model.images)
    table = np.full((n, 3), np.nan)
    sigma = np.tile(config.gps_sigma_m * np.array([1.0, 1.0, ALTITUDE_RATIO]), (n, 1))
    rows = np.flatnonzero(model.is_registered()).tolist()
    num_precise = 0
    for done, row in enumerate(rows):
        run.report("read", done, len(rows))
        path = path_inside(root / IMAGES, model.images.name[row])
        try:
            header = read_header(path) if path.is_file() else None
        except EpipoleError:
            header = None
        if header is None or header.gps is None:
            continue
        fix = header.gps
        table[row] = fix.lat_deg, fix.lon_deg, np.nan if fix.alt_m is None else fix.alt_m
        if header.gps_sigma_m is not None:
            sigma[row] = header.gps_sigma_m
            num_precise += 1
    run.report("read", len(rows), len(rows))
    if not np.isfinite(table).any() and (root / DATABASE).is_file():
        table = _gps_of_database(model, root / DATABASE)
    notes = (
        [f"{num_precise} GPS positions have recorded standard deviations, which are used"]
        if num_precise
        else []
    )
    return table, sigma, notes


def _gps_of_database(model: Reconstruction, database: Path) -> np.ndarray:
    """GPS positions (n, 3) in the database, whose altitude 0 stands for an unknown one."""
    stored = read_database(database, with_pairs=False)
    out = np.full((len(model.images), 3), np.nan)
    if stored.gps_lat_lon_alt is None:
        return out
    row_of = {name: row for row, name in enumerate(stored.images.name)}
    for k, name in enumerate(model.images.name):
        if name in row_of:
            out[k] = stored.gps_lat_lon_alt[row_of[name]]
    out[out[:, 2] == 0.0, 2] = np.nan
    return out


def _write(found: GeoreferencedModel, measured: _Measured, root: Path, run: Run) -> GeoreferenceResult:
    model, origin = found.model, measured.origin
    entries = point_entries(found, measured.surveyed, origin)
    with run.stage("write"):
        names = [model.images.name[row] for row in np.flatnonzero(model.is_registered())]
        _link_workspace(root, names, run)
        with run.folder.publish("model") as aside:
            write_colmap_model(model, aside / "sparse" / "0")
            write_scene_ply(aside / "points.ply", model)
            (aside / "images.csv").write_text(image_table(found, measured.origin), encoding="utf-8")
            if origin is not None and origin.crs != WGS84:
                points = coordinates_of(origin.lat_lon_alt_of(model.points.xyz_in_world), origin.crs)
                write_points_ply(aside / "points_in_crs.ply", points, model.points.rgb)
            (aside / "control_points.json").write_text(json_text(entries, indent=1), encoding="utf-8")
    summary = {
        **summary_of(found, origin),
        "warnings": run.warnings,
        "seconds": run.seconds,
        "timings_s": run.timings_s,
        "peak_memory_mb": run.peak_memory_mb,
    }
    run.folder.write_text("report.html", render_page(found, measured.surveyed, summary, entries))
    run.finish(summary)
    return GeoreferenceResult(run.root, model, found, entries, tuple(run.warnings), summary)


def _link_workspace(root: Path, names: Sequence[str], run: Run) -> None:
    """Link the images and the database, so that the output is a workspace, too."""
    found = [name for name in names if path_inside(root / IMAGES, name).is_file()]
    with run.folder.replacing(IMAGES, [f"{IMAGES}/{name}" for name in found]):
        for done, name in enumerate(found):
            run.report("write", done, len(found))
            link_or_copy(root / IMAGES / name, run.root / IMAGES / name)
    if (root / DATABASE).is_file():
        with run.folder.publish("database") as aside:
            link_or_copy((root / DATABASE).resolve(), aside / DATABASE)
    run.report("write", len(found), len(found))
