"""One call per job: what the command line does, from Python."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from epipole import __version__, _parallel
from epipole._jit import compile_seconds
from epipole.calibration.pipeline import CalibrationRun, run_calibration
from epipole.config import CalibrationConfig, ReconstructConfig, StereoConfig, options_of
from epipole.errors import ConfigError, DegenerateGeometryError, EpipoleError, FileFormatError, NoModelError
from epipole.geometry import Rigid3, depth_map_to_point_cloud
from epipole.image import color_map, undistort_image, undistorted_camera
from epipole.io.atomic import atomic_write
from epipole.io.calibration_files import write_ros_yaml
from epipole.io.colmap import read_colmap_model, write_colmap_model
from epipole.io.photographs import read_rgb
from epipole.io.truth import read_truth
from epipole.metrics import camera_errors, relative_pose_auc
from epipole.report.calibration import CalibrationPage, render_calibration_page
from epipole.report.sfm import ImageRow, ReportContent, render_report
from epipole.report.stereo import StereoPage, render_stereo_page
from epipole.scene import Cameras, Reconstruction, StereoRig
from epipole.sfm.pipeline import PipelineResult, run_pipeline
from epipole.sfm.workspace import write_json
from epipole.stereo import RectifiedRig, rectify
from epipole.stereo.batch import StereoBatch, is_many, list_pairs, read_summary, run_batch, summary_of
from epipole.stereo.doctor import Diagnosis, examine
from epipole.stereo.pipeline import REASON_COLORS, StereoFiles, StereoResult, read_stereo, run_stereo
from epipole.stereo.rectification import is_right_of_left
from epipole.viewer import DepthView, ViewerHandle, view_depth
from epipole.viewer import view as open_viewer
from epipole.workflow import Progress, ProgressCallback, ignore_progress, load, timed

MAX_INLIERS_SHOWN = 400


def _path(given: str | Path) -> Path:
    """A path that was really given: an empty word would be the present folder.

    Raises:
        ConfigError: it is empty.
    """
    if str(given) == "":
        raise ConfigError("a path is empty")
    return Path(given)


@dataclass(frozen=True, slots=True, eq=False)
class ReconstructionResult:
    """What `reconstruct` gives back; everything is also in the output folder."""

    out: Path
    models: tuple[Reconstruction, ...]
    """Largest first; more than one when the pictures do not connect."""
    reasons: dict[str, str]
    """Why each picture without a place has none."""
    warnings: tuple[str, ...]
    timings_s: dict[str, float]
    summary: dict[str, Any]
    """As in `summary.json`."""

    @property
    def model(self) -> Reconstruction:
        """The largest model."""
        return self.models[0]

    def __repr__(self) -> str:
        return f"ReconstructionResult({self.model!r} in {self.out})"


def reconstruct(
    images: str | Path,
    out: str | Path,
    config: ReconstructConfig | None = None,
    progress: ProgressCallback = ignore_progress,
) -> ReconstructionResult:
    """Make a 3D model from a folder of photographs or a video, with a report; a stopped run continues.

    Args:
        images: folder of photographs (JPEG, PNG, TIFF, WebP; sub-folders too) or a video file.
        out: output folder, made if missing.
        config: options; None for the defaults.
        progress: called with the progress of each stage.

    Raises:
        NoModelError: the pictures give no model; the message says why.
        WorkspaceError: the output folder cannot be used.
        ConfigError: an option does not fit the pictures.
    """
    config, out = options_of(ReconstructConfig, config), _path(out)
    begin = time.perf_counter()
    _parallel.set_num_threads(config.threads)
    result = run_pipeline(_path(images), out, config, progress)
    settings = asdict(config)
    write_json(out / "config.json", {"version": __version__, "seed": config.mapper.seed, "config": settings})
    with timed(result.timings_s, "report"):
        content = _report_content(result, settings)
        with atomic_write(out / "report.html") as aside:
            aside.write_text(render_report(content), encoding="utf-8")
    summary = _summary(result, time.perf_counter() - begin)
    write_json(out / "summary.json", summary)
    return ReconstructionResult(
        out, result.models, result.reasons, result.warnings, result.timings_s, summary
    )


def _summary(result: PipelineResult, seconds: float) -> dict[str, Any]:
    model = result.models[0]
    residuals = result.mapped.gps_residuals_m[0]
    return {
        "version": __version__,
        "num_images": len(result.images) + len(result.images.left_out),
        "num_registered": int(model.is_registered().sum()),
        "models": [
            {
                "num_registered": int(m.is_registered().sum()),
                "num_points": len(m.points),
                "num_observations": len(m.tracks.image),
                "mean_reprojection_error_px": m.mean_reprojection_error_px(),
                "match_agreement": agreement,
            }
            for m, agreement in zip(result.models, result.mapped.agreements)
        ],
        "num_points": len(model.points),
        "num_observations": len(model.tracks.image),
        "mean_reprojection_error_px": model.mean_reprojection_error_px(),
        "is_metric": residuals is not None,
        "median_gps_residual_m": None if residuals is None else float(np.nanmedian(residuals)),
        "cameras": [repr(model.cameras[c]) for c in range(len(model.cameras))],
        "focal_sources": list(result.images.focal_sources),
        "not_registered": result.reasons,
        "warnings": list(result.warnings),
        "seconds": seconds,
        "compile_seconds": compile_seconds(),
        "timings_s": result.timings_s,
    }


def _report_content(result: PipelineResult, settings: dict[str, Any]) -> ReportContent:
    model = result.models[0]
    component = np.full(len(result.images), -1)
    for number in reversed(range(len(result.models))):
        component[result.models[number].is_registered()] = number
    rows, thumbnails, inliers = [], {}, {}
    per_model = [(_observations_per_image(m)) for m in result.models]
    for i, name in enumerate(result.images.names):
        shown = max(int(component[i]), 0)
        counts, errors = per_model[shown]
        placed = bool(component[i] >= 0)
        rows.append(
            ImageRow(
                name,
                placed,
                int(component[i]),
                result.num_keypoints[i],
                int(counts[i]) if placed else 0,
                float(errors[i]) if placed else float("nan"),
                "" if placed else result.reasons.get(name, ""),
            )
        )
        thumbnails[name] = load(result.feature_files[i], "thumbnail")["thumbnail"].tobytes()
        camera = model.cameras[int(model.camera_of_image[i])]
        own = result.models[shown].tracks.keypoint[result.models[shown].tracks.image == i]
        pixels = model.images.keypoints_of(i)[np.sort(own)[:: max(1, len(own) // MAX_INLIERS_SHOWN)]]
        inliers[name] = (pixels + 0.5) / [camera.width, camera.height]
    rows += [ImageRow(n, False, -1, 0, 0, float("nan"), why) for n, why in result.images.left_out.items()]
    residuals = result.mapped.gps_residuals_m[0]
    scale_note = "unknown scale: pictures alone cannot tell"
    if residuals is not None:
        scale_note = f"metres from GPS (median distance of the cameras from their fixes {np.nanmedian(residuals):.2f} m)"
    sources = result.images.focal_sources
    return ReportContent(
        title=result.images.folder.name or str(result.images.folder),
        reconstruction=model,
        view_graph=result.view_graph,
        image_rows=tuple(rows),
        other_components=tuple(int(m.is_registered().sum()) for m in result.models[1:]),
        camera_lines=tuple(
            f"{model.cameras[c]!r}; focal length first: {sources[c]}" for c in range(len(sources))
        ),
        timings=dict(result.timings_s),
        compile_seconds=compile_seconds(),
        warnings=result.warnings,
        settings=settings,
        version=__version__,
        thumbnails=thumbnails,
        inliers=inliers,
        scale_note=scale_note,
        is_metric=residuals is not None,
    )


def _observations_per_image(model: Reconstruction) -> tuple[np.ndarray, np.ndarray]:
    n = len(model.images)
    counts = np.bincount(model.tracks.image, minlength=n)
    sums = np.bincount(model.tracks.image, model.reprojection_errors_px(), n)
    return counts, np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)


def find_model(path: str | Path) -> Path:
    """The folder of the COLMAP model inside a workspace, or the folder itself if it is one.

    Raises:
        FileFormatError: there is none.
    """
    path = _path(path)
    for folder in (path, path / "sparse" / "0", path / "sparse"):
        if (folder / "cameras.bin").is_file() or (folder / "cameras.txt").is_file():
            return folder
    raise FileFormatError(path, "holds no model (no cameras.bin or cameras.txt, nor sparse/0)")


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """How far a model's cameras are from known ones."""

    num_truth: int
    num_registered: int
    """Of the known cameras."""
    position_mean: float
    """After the best similarity, in the truth's unit."""
    position_median: float
    position_max: float
    rotation_mean_deg: float
    rotation_max_deg: float
    auc: dict[int, float]
    """Area under the recall curve of relative pose errors over all pairs, up to 1, 3 and 5 degrees."""


def evaluate(out: str | Path, truth: str | Path) -> Evaluation:
    """Compare a model's cameras with known ones.

    Args:
        out: a workspace or a COLMAP model.
        truth: a COLMAP model, a folder of Strecha `.camera` files or a Middlebury `_par.txt` file.

    Raises:
        FileFormatError: one of them cannot be read, or they share no pictures.
        DegenerateGeometryError: fewer than two known cameras are registered.
    """
    model, known = read_colmap_model(find_model(out)), read_truth(truth)
    row = {name: i for i, name in enumerate(model.images.name)}
    cams_from_world, is_registered = model.cams_from_world(), model.is_registered()
    rotation, translation = np.full((len(known.names), 3, 3), np.nan), np.full((len(known.names), 3), np.nan)
    for n, name in enumerate(known.names):
        if name in row and is_registered[row[name]]:
            rotation[n] = cams_from_world.rotation[row[name]]
            translation[n] = cams_from_world.translation[row[name]]
    found = np.isfinite(translation).all(axis=1)
    if not found.any():
        raise FileFormatError(
            Path(truth), "none of its pictures is registered in the model; do the names agree?"
        )
    if found.sum() < 2:
        raise DegenerateGeometryError("only one known camera is registered; errors need at least two")
    estimated = Rigid3(rotation, translation)
    errors = camera_errors(estimated, known.cams_from_world)
    auc = relative_pose_auc(estimated, known.cams_from_world, found, (1, 3, 5))
    return Evaluation(
        len(known.names),
        int(found.sum()),
        errors.mean_position,
        errors.median_position,
        errors.max_position,
        errors.mean_rotation_deg,
        errors.max_rotation_deg,
        {degrees: float(value) for degrees, value in zip((1, 3, 5), auc)},
    )


def undistort(out: str | Path, progress: ProgressCallback = ignore_progress) -> Path:
    """Write `OUT/undistorted`: pictures without distortion and a PINHOLE model, as splat trainers and MVS read them.

    Returns:
        The folder: `images/` and `sparse/0/`.

    Raises:
        FileFormatError: there is no model, a picture is missing, or its format cannot be written.
    """
    out = _path(out)
    model = read_colmap_model(find_model(out))
    target = out / "undistorted"
    pinholes = [undistorted_camera(model.cameras[c]) for c in range(len(model.cameras))]
    registered = np.flatnonzero(model.is_registered())
    camera_of_image = model.camera_of_image
    for n, image in enumerate(registered):
        name, c = model.images.name[image], int(camera_of_image[image])
        rgb = undistort_image(read_rgb(out / "images" / name), model.cameras[c], pinholes[c])
        with atomic_write(target / "images" / name) as aside:
            _write_picture(aside, rgb, target / "images" / name)
        progress(Progress("undistort", n + 1, len(registered)))
    write_colmap_model(_without_distortion(model, pinholes), target / "sparse" / "0")
    return target


def _write_picture(aside: Path, rgb: np.ndarray, final: Path) -> None:
    try:
        written = cv2.imwrite(str(aside), rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 96])
    except cv2.error:  # an unknown suffix, HEIC's for one
        written = False
    if not written:
        raise FileFormatError(
            final, "pictures are not written in this format; convert yours to JPEG or PNG first"
        )


def _without_distortion(model: Reconstruction, pinholes: list) -> Reconstruction:
    pixels = model.images.keypoints_px.copy()
    for image in range(len(model.images)):
        c = int(model.camera_of_image[image])
        own = slice(model.images.keypoint_offsets[image], model.images.keypoint_offsets[image + 1])
        rays = model.cameras[c].unproject(pixels[own])
        pixels[own] = np.nan_to_num(pinholes[c].project(rays), nan=-1e6)
    cameras = Cameras.from_list(pinholes, is_constant=[True] * len(pinholes))
    return replace(model, cameras=cameras, images=replace(model.images, keypoints_px=pixels))


def stereo(
    left: str | Path,
    right: str | Path,
    out: str | Path,
    config: StereoConfig | None = None,
    rig: RectifiedRig | StereoRig | None = None,
) -> StereoResult:
    """Disparities of a pair with their standard deviations, with a rig also depth and points, and a report.

    Args:
        left: picture whose pixels get a disparity.
        right: the other.
        out: output folder, made if missing.
        config: options; None for the defaults.
        rig: two calibrated cameras, by which the pair is rectified first; or what is known of a rectified pair;
            None: the pair counts as rectified, and there are disparities but no depth.

    Raises:
        FileFormatError: a picture cannot be read.
        ShapeError: the pictures are no pair, or not of the calibration's size.
        ConfigError: left and right are swapped in the calibration.
        DegenerateGeometryError: the pair cannot be rectified.
        WorkspaceError: the output folder cannot be used.
    """
    config, out = options_of(StereoConfig, config), _path(out)
    result = run_stereo(_path(left), _path(right), out, config, rig)
    page = StereoPage(
        *(result.left_rgb, result.right_rgb, result.disparities, REASON_COLORS),
        *(result.depths, result.rig, result.warnings, __version__),
    )
    with atomic_write(out / "report.html") as aside:
        aside.write_text(render_stereo_page(page), encoding="utf-8")
    write_json(out / "config.json", _stereo_settings(config, rig, _path(left), _path(right)))
    return result


def stereo_many(
    left: str | Path,
    right: str | Path,
    out: str | Path,
    config: StereoConfig | None = None,
    rig: RectifiedRig | StereoRig | None = None,
    progress: ProgressCallback = ignore_progress,
) -> StereoBatch:
    """`stereo` for every pair of two folders, or of stereo video (twice the same file: both pictures side by side).

    A pair that cannot be measured is named with its reason and does not stop the others; a stopped run continues.

    Raises:
        FileFormatError: there are no pairs.
        WorkspaceError: the output folder cannot be used.
    """
    config, out = options_of(StereoConfig, config), _path(out)
    pairs = list_pairs(_path(left), _path(right), out, config.max_frames)
    batch = run_batch(
        *(pairs, out, lambda one, two: _stereo_settings(config, rig, one, two)),
        lambda one, two, folder: stereo(one, two, folder, config, rig),
        progress,
    )
    write_json(out / "summary.json", {"version": __version__, **summary_of(batch, pairs, read_summary(out))})
    return batch


def stereo_of_model(
    workspace: str | Path, first: str, second: str, out: str | Path, config: StereoConfig | None = None
) -> StereoResult:
    """`stereo` for two pictures of a finished reconstruction, rectified by their places; depth in the model's unit.

    Args:
        workspace: output folder of `reconstruct`.
        first: name of the picture whose pixels get depth, unless it stands right of the other one.
        second: name of the other.
        out: output folder.
        config: options.

    Raises:
        FileFormatError: there is no model, or a picture is not in it.
        DegenerateGeometryError: the two pictures cannot be rectified.
    """
    workspace = _path(workspace)
    model = read_colmap_model(find_model(workspace))
    rows = {name: k for k, name in enumerate(model.images.name)}
    registered, places = model.is_registered(), model.cams_from_world()
    for name in (first, second):
        if name not in rows or not registered[rows[name]]:
            raise FileFormatError(workspace, f"{name} has no place in the model")
    if first == second:
        raise DegenerateGeometryError("a picture makes no pair with itself")
    one, two = rows[first], rows[second]
    cameras, of_image = model.cameras, model.camera_of_image
    rig = StereoRig(
        cameras[int(of_image[one])], cameras[int(of_image[two])], places[two] @ places[one].inverse()
    )
    note: tuple[str, ...] = ()
    if is_right_of_left(rig):
        rig, first, second = rig.swapped(), second, first
        note = (f"{first} stands left of {second}: its pixels have the depth",)
    pictures = workspace / "images"
    found = stereo(pictures / first, pictures / second, out, config, rig)
    return replace(found, warnings=(*note, *found.warnings))


def examine_stereo(
    left: str | Path, right: str | Path, rig: RectifiedRig | StereoRig | None = None, max_frames: int = 8
) -> Diagnosis:
    """What is wrong with a pair, or with several of one rig: swapped, rows that do not match, not synchronous.

    Args:
        left: a picture, a folder or a video.
        right: the other.
        rig: as for `stereo`.
        max_frames: pairs looked at, at most.

    Raises:
        FileFormatError: a picture cannot be read, or there is no pair.
    """
    left, right = _path(left), _path(right)
    if not is_many(left, right):
        return examine([(read_rgb(left), read_rgb(right))], rig)
    with tempfile.TemporaryDirectory() as scratch:
        pairs = list(list_pairs(left, right, Path(scratch), max_frames).values())
        chosen = np.unique(np.linspace(0, len(pairs) - 1, min(len(pairs), max_frames)).astype(int))
        read, unread = [], []
        for k in chosen:
            try:
                read.append((read_rgb(pairs[k][0]), read_rgb(pairs[k][1])))
            except FileFormatError as error:
                unread.append(str(error))
        if not read:
            raise FileFormatError(left, "no pair of it can be read")
        found = examine(read, rig)
        return replace(found, notes=(*found.notes, *unread))


def _stereo_settings(
    config: StereoConfig, rig: RectifiedRig | StereoRig | None, left: Path, right: Path
) -> dict[str, Any]:
    """All that the result depends on: other pictures or another calibration of the same name are not the same pair."""
    described: Any = asdict(rig) if isinstance(rig, RectifiedRig) else rig
    if isinstance(rig, StereoRig):
        described = {
            "cameras": [[c.model.name, c.width, c.height, c.params.tolist()] for c in (rig.left, rig.right)],
            "right_from_left": rig.right_from_left.as_matrix().tolist(),
            "covariance": None if rig.covariance is None else rig.covariance.tolist(),
        }
    pictures = [[str(p), p.stat().st_size, p.stat().st_mtime_ns] for p in (left, right)]
    return {"version": __version__, "config": asdict(config), "rig": described, "pictures": pictures}


def calibrate(
    images: str | Path,
    out: str | Path,
    config: CalibrationConfig | None = None,
    right: str | Path | None = None,
    progress: ProgressCallback = ignore_progress,
) -> CalibrationRun:
    """Calibrate a camera, or a pair, from pictures of a board, with a report.

    Writes `calibration.json` (with covariances), `opencv.yaml`, ROS' `ros.yaml` (of a pair `ros_left.yaml` and
    `ros_right.yaml`) and `report.html`.

    Args:
        images: folder of pictures; of a pair's: sub-folders left and right, or files left01.jpg and right01.jpg.
        out: output folder, made if missing.
        config: board and options.
        right: folder of the right camera's pictures.
        progress: called with the progress.

    Raises:
        FileFormatError: there are no pictures.
        DegenerateGeometryError: the board is seen too seldom, or the views leave something open.
        WorkspaceError: the output folder cannot be used.
    """
    config, out = options_of(CalibrationConfig, config), _path(out)
    run = run_calibration(_path(images), out, config, None if right is None else _path(right), progress)
    found = run.calibration
    write_json(out / "config.json", {"version": __version__, "config": asdict(config)})
    if len(found.cameras) == 1:
        write_ros_yaml(out / "ros.yaml", found.cameras[0], "camera")
    else:
        _write_ros_pair(out, found.rig())
    names = tuple(tuple(path.name for path in own) for own in run.pictures)
    problems = {Path(name).name: reason for name, reason in run.problems.items()}
    page = CalibrationPage(found, run.check, run.verdict, names, problems, __version__)
    with atomic_write(out / "report.html") as aside:
        aside.write_text(render_calibration_page(page), encoding="utf-8")
    return run


def _write_ros_pair(out: Path, rig: StereoRig) -> None:
    """ROS asks for rectification; a pair that cannot be rectified goes without its files."""
    try:
        rectified = rectify(rig)
    except EpipoleError:
        return
    flat = rectified.rig
    for name, camera, rotation, offset in (
        ("left", rig.left, rectified.rectified_from_left, 0.0),
        ("right", rig.right, rectified.rectified_from_right, -flat.focal_px * flat.baseline),
    ):
        projection = np.column_stack([flat.K, [offset, 0.0, 0.0]])
        write_ros_yaml(out / f"ros_{name}.yaml", camera, name, rotation, projection)


def view(out: str | Path, *, port: int = 8080, host: str = "127.0.0.1", block: bool = True) -> ViewerHandle:
    """Show what a folder holds in the browser: a model with its cameras and pictures, or a pair's depth.

    Raises:
        FileFormatError: there is neither.
    """
    out = _path(out)
    if (out / "disparity.pfm").is_file():
        return view_depth(_depth_view(read_stereo(out)), port=port, host=host, block=block)
    if done := read_summary(out).get("done"):
        raise FileFormatError(out, f"it holds several pairs: choose one, {out / str(done[0])} for one")
    model = read_colmap_model(find_model(out))
    return open_viewer(model, _picture_loader(out / "images"), port=port, host=host, block=block)


def _depth_view(files: StereoFiles) -> DepthView:
    cloud = depth_map_to_point_cloud(files.depths, files.K)
    depth = files.depths[cloud.mask].astype(np.float64)
    with np.errstate(invalid="ignore"):
        logarithm = np.log(np.where(files.depths > 0, files.depths, np.nan))
    return DepthView(
        cloud.points_in_cam,
        files.left_rgb[cloud.mask],
        np.nan_to_num(files.sigma_depth[cloud.mask] / depth, nan=np.inf).astype(np.float64),
        files.left_rgb,
        color_map(logarithm),
        float(files.K[0, 0]),
    )


def _picture_loader(folder: Path) -> Callable[[str], np.ndarray | None]:
    def load_picture(name: str) -> np.ndarray | None:
        try:
            return read_rgb(folder / name, 640)
        except FileFormatError:
            return None

    return load_picture


__all__ = [
    "Evaluation",
    "NoModelError",
    "ReconstructionResult",
    "calibrate",
    "evaluate",
    "examine_stereo",
    "reconstruct",
    "stereo",
    "stereo_many",
    "stereo_of_model",
    "undistort",
    "view",
]
