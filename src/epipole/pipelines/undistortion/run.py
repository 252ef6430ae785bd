"""The undistortion job: undistorted images and a PINHOLE model, for splat trainers and MVS; STMaps for compositing.

Each image is a unit of work. Its result is the content of the image file, which moves to `images` when all are done.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from epipole._checks import as_path, checked
from epipole._checks.tables import Expected, Table
from epipole.cameras import Camera
from epipole.errors import FileFormatError
from epipole.image import distortion_stmap, undistort_image, undistorted_camera, undistortion_stmap
from epipole.io.atomic import atomic_write
from epipole.io.colmap.model import find_model, read_colmap_model, write_colmap_model
from epipole.io.contents_in_words import with_what_it_is
from epipole.io.images.photographs import GrayRange, common_range
from epipole.io.images.stmaps import write_stmap
from epipole.io.images.writing import encoded_photograph
from epipole.io.models.images import ModelImage, ModelImages
from epipole.io.models.losses import losses_in
from epipole.runs import (
    Job,
    PassedExecutor,
    ProgressCallback,
    Run,
    Unit,
    chosen_executor,
    digest,
    has_own_model,
    ignore_progress,
    load,
    open_run,
)
from epipole.scene import Cameras, Reconstruction

STMAPS = "stmaps"
"""Folder of the maps, and their group in the folder's marker."""
UNITS = "units"
"""Folder of the results of a run that has not ended."""
FORMAT = 1
"""Increase when the images of the same files change."""
FILE: Table = {"content": Expected("uint8", "n")}
_MAKERS = {"undistort": undistortion_stmap, "distort": distortion_stmap}


@checked
def undistort(
    out: str | Path,
    progress: ProgressCallback = ignore_progress,
    *,
    target: str | Path | None = None,
    model: int | None = None,
    stmaps: bool = False,
    executor: PassedExecutor | None = None,
) -> Path:
    """Write undistorted images and a PINHOLE model, for splat trainers and MVS.

    An interrupted run continues with the images that are left. STMaps are `stmaps/camera_1_undistort.tif` and `stmaps/camera_1_distort.tif`, with the camera's number in the model.

    Args:
        out: output folder of a reconstruction, or a model in it (`OUT/sparse/1`).
        progress: called with the progress.
        target: where to write; None: `OUT/undistorted`, or `OUT/undistorted-1` for model 1 and so on.
        model: number of the model in `OUT/sparse`; None: the largest, 0.
        stmaps: also write maps that undistort, and distort again, the images of each camera in compositing programs.
        executor: executor for images, as for `reconstruct`; None: threads.

    Returns:
        The folder, with `images/`, `sparse/0/` and, with `stmaps`, `stmaps/`.

    Raises:
        FileFormatError: there is no such model, an image is missing or does not fit its camera, or its format cannot be written.
        DegenerateGeometryError: a camera's distortion is invalid over almost all of its images.
        WorkspaceError: the folder contains something else, or cannot be written.
    """
    given = as_path(out)
    folder = find_model(given) if model is None else _model_numbered(given, model)
    workspace = _workspace_of(folder, given)
    if not (workspace / "images").is_dir():
        raise FileFormatError(workspace, with_what_it_is("has no images folder next to its model", workspace))
    found = read_colmap_model(folder)
    registered = np.flatnonzero(found.is_registered())
    names = [found.images.name[image] for image in registered]
    files = ModelImages(found, workspace / "images", is_own=has_own_model(workspace))
    images = [files.find(name) for name in names]
    cameras = _cameras_of_files(found, registered, images)
    pinholes = _pinholes(found, cameras)
    is_further = folder.parent.name == "sparse" and folder.name != "0"
    usual = workspace / (f"undistorted-{folder.name}" if is_further else "undistorted")
    limits = common_range([image.path for image in images])
    work = chosen_executor(executor, None, has_shared_folder=True)
    job = Job(kind="undistort", inputs=(folder,), settings={}, progress=progress, executor=work)
    with open_run(job, usual if target is None else as_path(target)) as run:
        run.warnings += [] if model is not None else losses_in(given)
        for warning in run.warnings:
            run.report("undistort", 0, len(names), warning)
        of_image = [pinholes[int(found.camera_of_image[row])] for row in registered]
        _write_images(run, [ImagePayload(*one, limits) for one in zip(images, of_image, names)])
        _write_stmaps(run, cameras if stmaps else {}, pinholes)
        with run.folder.publish("model") as aside:
            write_colmap_model(without_distortion(found, pinholes), aside / "sparse" / "0")
        run.finish({"num_images": len(names), "warnings": run.warnings})
        return run.root


@dataclass(frozen=True, slots=True, eq=False)
class ImagePayload:
    """Input of the unit of one image."""

    image: ModelImage
    pinhole: Camera
    name: str
    """The undistorted image, whose suffix gives the format. Not a path: no worker needs the file of an earlier run."""
    limits: GrayRange | None


def _write_images(run: Run, payloads: Sequence[ImagePayload]) -> None:
    """Undistort images, or continue with those that an interrupted run has left."""
    units = [_unit(run.root / UNITS, payload) for payload in payloads]
    with run.folder.replacing("images", [f"images/{payload.name}" for payload in payloads]):
        run.do(units, "undistort")
        for unit, payload in zip(units, payloads):
            _move(unit, run.root / "images" / payload.name)
    with suppress(OSError):  # it may hold files of the user
        (run.root / UNITS).rmdir()


def _unit(folder: Path, payload: ImagePayload) -> Unit:
    """The unit of an image; its key covers the state of the file, and everything that is done to it."""
    image, state = payload.image, payload.image.path.stat()
    cameras = [
        [one.model.name, one.width, one.height, one.params.tolist()]
        for one in (image.camera, payload.pinhole)
    ]
    file = [str(image.path), state.st_size, state.st_mtime_ns, image.orientation, Path(payload.name).suffix]
    key = digest("undistort", FORMAT, file, cameras, payload.limits)
    return Unit(folder / f"{key}.npz", key, undistorted_file, payload)


def undistorted_file(payload: ImagePayload) -> dict[str, np.ndarray]:
    """Content of the undistorted image's file."""
    rgb = payload.image.read(limits=payload.limits)
    undistorted = undistort_image(rgb, payload.image.camera, payload.pinhole)
    return {"content": np.frombuffer(encoded_photograph(Path(payload.name), undistorted), np.uint8)}


def _move(unit: Unit, path: Path) -> None:
    """Write the image of a unit, whose file is then needed no more: the disk holds only one image twice."""
    content = load(unit.path, FILE)["content"]
    with atomic_write(path) as aside:
        aside.write_bytes(content.tobytes())
    unit.path.unlink()


def _write_stmaps(run: Run, cameras: Mapping[int, Camera], pinholes: Sequence[Camera]) -> None:
    """Write the maps of cameras, and remove those of an earlier run."""
    maps = {f"{STMAPS}/camera_{c + 1}_{kind}.tif": (c, kind) for c in cameras for kind in _MAKERS}
    with run.folder.replacing(STMAPS, list(maps)):
        for name, (c, kind) in maps.items():
            write_stmap(run.root / name, _MAKERS[kind](cameras[c], pinholes[c]))


def _cameras_of_files(
    model: Reconstruction, registered: np.ndarray, images: Sequence[ModelImage]
) -> dict[int, Camera]:
    """The cameras of registered images by their row, at the scale of the image files.

    Raises:
        FileFormatError: images of one camera have different sizes.
    """
    used: dict[int, Camera] = {}
    for row, image in zip(registered, images):
        own, first = image.camera, used.setdefault(int(model.camera_of_image[row]), image.camera)
        if (own.width, own.height) != (first.width, first.height):
            raise FileFormatError(
                image.path,
                f"is {own.width} x {own.height}, but other images of its camera are {first.width} x {first.height}: scale all"
                " images of a camera to the same size",
            )
    return dict(sorted(used.items()))


def _pinholes(model: Reconstruction, used: Mapping[int, Camera]) -> list[Camera]:
    """The model's cameras without distortion; those in use at the scale of the image files.

    Raises:
        DegenerateGeometryError: a camera's distortion is invalid over almost all of its images.
    """
    out = []
    for c in range(len(model.cameras)):
        camera, K = model.cameras[c], model.cameras[c].K
        unused = Camera("PINHOLE", camera.width, camera.height, [K[0, 0], K[1, 1], K[0, 2], K[1, 2]])
        out.append(undistorted_camera(used[c]) if c in used else unused)
    return out


def _model_numbered(workspace: Path, number: int) -> Path:
    folder = workspace / "sparse" / str(number)
    if not folder.is_dir():
        there = sorted(path.name for path in (workspace / "sparse").glob("*") if path.is_dir())
        raise FileFormatError(
            workspace,
            f"holds no model {number}; there are {', '.join(there)}" if there else "holds no models",
        )
    return find_model(folder)


def _workspace_of(folder: Path, given: Path) -> Path:
    """The folder with the images: the given one, or a parent of the model's folder."""
    at = folder.resolve()
    positions = (given, folder, at.parent, at.parent.parent)
    return next((position for position in positions if (position / "images").is_dir()), given)


def without_distortion(model: Reconstruction, pinholes: list[Camera]) -> Reconstruction:
    """The model with undistorted keypoints and cameras."""
    pixels = model.images.keypoints_px.copy()
    for image in range(len(model.images)):
        c = int(model.camera_of_image[image])
        own = slice(model.images.keypoint_offsets[image], model.images.keypoint_offsets[image + 1])
        rays = model.cameras[c].unproject(pixels[own])
        pixels[own] = np.nan_to_num(pinholes[c].project(rays), nan=-1e6)
    cameras = Cameras.from_list(pinholes, is_constant=[True] * len(pinholes))
    return replace(model, cameras=cameras, images=replace(model.images, keypoints_px=pixels))
