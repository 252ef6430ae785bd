"""Estimation of unknown intrinsics by reconstructing some of the frames with structure from motion."""

from __future__ import annotations

import tempfile
from collections.abc import Generator, Iterable
from contextlib import closing
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from shutil import copyfile
from typing import Any, NamedTuple

import cv2
import numpy as np

from epipole.cameras import Camera
from epipole.errors import ConfigError, EpipoleError, NoModelError
from epipole.features.flow import track_points
from epipole.geometry import Rigid3
from epipole.image.encoding import encoded_image
from epipole.io.bags.recording import is_bag
from epipole.io.calibration.camera_params import text_of_camera
from epipole.io.calibration.files import CalibrationFile, write_calibration
from epipole.io.images.photographs import read_gray, read_header
from epipole.io.images.video import count_frames, is_video, opened_video
from epipole.io.models.losses import losses_of
from epipole.io.sequences.sequence import read_sequence
from epipole.mapping import bundle_problem_of
from epipole.optim import BundleConfig, Loss, adjust_bundle, bundle_covariance, with_fixed_gauge
from epipole.pipelines.sfm.run import ReconstructionResult, reconstruct
from epipole.pipelines.slam.config import CameraOptions, JobOptions, OdometryConfig
from epipole.pipelines.slam.output.map_file import camera_of_map
from epipole.pipelines.slam.sources.live_cameras import camera_indices
from epipole.pipelines.slam.tracking.corners import new_corners
from epipole.runs import Progress, ProgressCallback

MOST_IMAGES, LEAST_IMAGES = 30, 8
MOST_FRAMES = 1500
"""Largest number of frames that are considered."""
APART = 0.12
"""Median motion of the points from one selected image to the next, as a fraction of the image width."""
LEAST_TRACKED = 80
MOST_SIGMA = 0.005
"""Largest relative uncertainty of an accepted focal length. In rooms and on an arc it was 0.1 to 0.3 %. On a street and in
front of a cube it was 0.8 and 0.9 %, and the focal lengths were 3 and 8 % off: these cameras have several distortion parameters
and an off-center principal point."""
ADVICE = "pass camera_params (fx,fy,cx,cy) or a calibration"


@dataclass(frozen=True, slots=True, eq=False)
class FoundCamera:
    """An estimated camera, or the camera of a known map."""

    camera: Camera
    num_images: int
    """Images that the estimate is based on; 0 for the camera of a known map."""
    sigma_px: float
    """Calibrated uncertainty of the focal length."""
    losses: tuple[str, ...] = ()
    """Warnings of the reconstruction."""

    def notes(self) -> list[str]:
        """Notes for the user."""
        if not self.num_images:
            return ["the camera intrinsics are unknown: those of the known map are used"]
        return [
            f"the camera intrinsics are unknown: they were estimated from {self.num_images} of the images ({self.camera};"
            f" focal length +- {self.sigma_px:.1f} px). A calibration is more accurate",
            *(f"estimating the camera: {loss}" for loss in self.losses),
        ]

    @property
    def source(self) -> str:
        """Source of the intrinsics, for the summary."""
        return f"estimated from {self.num_images} of the images" if self.num_images else "the known map"

    def summary(self) -> dict[str, Any]:
        """Entries for the summary."""
        return {
            "camera": repr(self.camera),
            "images": self.num_images,
            "focal_sigma_px": self.sigma_px,
            "warnings": list(self.losses),
        }

    def write(self, path: Path) -> None:
        """Write a calibration file for the next run."""
        intrinsics = CalibrationFile((self.camera,), Rigid3.identity(1))
        write_calibration(
            path, intrinsics, {"estimated_from_images": self.num_images, "focal_sigma_px": self.sigma_px}
        )


class _Image(NamedTuple):
    gray: np.ndarray
    file: Path | None


class _Images(NamedTuple):
    num: int
    """Announced number of images."""
    each: Generator[_Image, None, None]


def find_camera(
    source: Path, job: JobOptions, given: CameraOptions, progress: ProgressCallback
) -> FoundCamera | None:
    """Estimate the camera of a video or a folder of images; None if it is known, or for other sources.

    Args:
        source: source of the frames.
        job: selection of the frames.
        given: given camera options.
        progress: called during the reconstruction.

    Raises:
        ConfigError: the images do not determine the intrinsics; the message says why.
        FileFormatError: the source cannot be read.
    """
    is_given = given.camera_params or given.calibration or job.sensor == "rig"
    if is_given or is_bag(source) or camera_indices(source):
        return None
    images = _images(source, job)
    if images is None:
        return None
    if job.map:
        return FoundCamera(camera_of_map(job.map[0]), 0, 0.0)
    return _camera_of(images, job, given, progress)


def _images(source: Path, job: JobOptions) -> _Images | None:
    """The images of a video or a folder; None if the folder has a calibration, or more than one camera is used."""
    if is_video(source) and job.sensor == "stereo":
        return None
    if is_video(source):
        return _Images(count_frames(source)[0], _of_video(opened_video(source)))
    sequence = read_sequence(source, job.fps)
    is_known = sequence.camera or sequence.camera_problem or sequence.rig or sequence.depth
    if job.sensor not in ("auto", "mono") or is_known:
        return None  # a calibration that does not fit the images is rejected later, when they are opened
    read_header(sequence.frames[0].image)  # rejects an unsupported image with the reason
    return _Images(len(sequence), _of_files([frame.image for frame in sequence.frames]))


def _of_video(video: cv2.VideoCapture) -> Generator[_Image, None, None]:
    try:
        while True:
            is_read, image = video.read()
            if not is_read:
                return
            yield _Image(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), None)
    finally:
        video.release()


def _of_files(files: Iterable[Path]) -> Generator[_Image, None, None]:
    for file in files:
        try:
            yield _Image(read_gray(file), file)
        except EpipoleError:
            continue  # tracking reports it


def _camera_of(
    images: _Images, job: JobOptions, given: CameraOptions, progress: ProgressCallback
) -> FoundCamera:
    num = max(0, min(job.max_frames or MOST_FRAMES, MOST_FRAMES, (images.num - job.start) // job.stride))
    wanted = islice(images.each, job.start, job.start + num * job.stride, job.stride)
    with tempfile.TemporaryDirectory(prefix="epipole-camera-") as name, closing(images.each):
        folder = Path(name) / "images"
        folder.mkdir()
        selected = _select(_counted(wanted, num, progress), max(1, num // MOST_IMAGES), folder)
        progress(Progress("choose", num, num))
        if len(selected) < LEAST_IMAGES:
            raise ConfigError(
                f"the camera intrinsics are unknown, and {len(selected)} images are too few to estimate them ({LEAST_IMAGES} are"
                f" needed): {ADVICE}"
            )
        model: dict[str, Any] = {} if given.camera_model is None else {"camera_model": given.camera_model}
        try:
            found = reconstruct(folder, Path(name) / "model", progress=progress, single_camera=True, **model)
        except NoModelError as error:
            raise ConfigError(
                f"the camera intrinsics are unknown, and the images cannot be reconstructed ({error}): {ADVICE}"
            ) from error
        losses = []
        for loss in losses_of(found.summary, None):
            for copy, name_in_source in selected.items():
                loss = loss.replace(copy, name_in_source)
            losses.append(loss)
        return _judged(found, losses)


def _counted(images: Iterable[_Image], num: int, progress: ProgressCallback) -> Generator[_Image, None, None]:
    for n, image in enumerate(images):
        progress(Progress("choose", min(n, num - 1), num))
        yield image


def _select(images: Iterable[_Image], usual: int, folder: Path) -> dict[str, str]:
    """Write every `usual`-th image, and images in between once the points have moved far enough.

    Returns:
        The source name of each written file; for a video, the number among the considered images.
    """
    view, since = _View(), 0
    selected: dict[str, str] = {}
    for number, (gray, file) in enumerate(images):
        since += 1
        if not view.is_apart(gray) and selected and since < usual:
            continue
        name = folder / f"{len(selected):06d}{'.png' if file is None else file.suffix}"
        if file is None:
            name.write_bytes(encoded_image(".png", gray))
        else:
            copyfile(file, name)  # keeps EXIF
        view.start(gray)
        selected[name.name], since = f"image {number}" if file is None else file.name, 0
        if len(selected) == MOST_IMAGES:
            break
    return selected


class _View:
    """Tracks the points of the image that was selected last."""

    def __init__(self) -> None:
        self._config = OdometryConfig()
        self._before: np.ndarray | None = None
        self._initialize = self._now = np.zeros((0, 2))

    def start(self, gray: np.ndarray) -> None:
        self._before = gray
        self._initialize = self._now = new_corners(gray, np.zeros((0, 2)), self._config)

    def is_apart(self, gray: np.ndarray) -> bool:
        """Track the points into the next image; whether they have moved far enough or are lost."""
        if self._before is None or self._before.shape != gray.shape:
            return self._before is None
        there, found_mask = track_points(self._before, gray, self._now, None, self._config)
        self._before, self._now, self._initialize = gray, there[found_mask], self._initialize[found_mask]
        shift = np.linalg.norm(self._now - self._initialize, axis=1)
        return len(shift) < LEAST_TRACKED or float(np.median(shift)) > APART * gray.shape[1]


def _judged(found: ReconstructionResult, losses: Iterable[str]) -> FoundCamera:
    """The camera, if the images determine its focal length well enough.

    Raises:
        ConfigError: they do not.
    """
    count = int(found.model.is_registered().sum())
    if count < LEAST_IMAGES:
        raise ConfigError(
            f"the camera intrinsics are unknown, and only {count} of the selected images could be registered: {ADVICE}"
        )
    config, problem = BundleConfig(loss=Loss.CAUCHY), with_fixed_gauge(bundle_problem_of(found.model))
    result = adjust_bundle(problem, config)
    spread = bundle_covariance(problem, result, config, clustered=True).camera_params[0, 0, 0]
    intrinsics = found.model.cameras[0]
    sigma_px = float(np.sqrt(spread))
    if not sigma_px <= MOST_SIGMA * intrinsics.focal_px:
        known = (
            f"determine the focal length only to {sigma_px / intrinsics.focal_px:.1%}"
            if np.isfinite(sigma_px)
            else "do not determine the focal length"
        )
        raise ConfigError(
            f"the camera intrinsics are unknown, and the images {known}: {ADVICE}. The best fit is"
            f" --camera-model {intrinsics.model.name} --camera-params {text_of_camera(intrinsics)}"
        )
    return FoundCamera(intrinsics, count, _honest_sigma_px(found, sigma_px), tuple(losses))


def _honest_sigma_px(found: ReconstructionResult, formal_px: float) -> float:
    """Calibrated uncertainty of the focal length from the reconstruction, which includes model errors; at least the formal one."""
    given = [focal["sigma_px"] for focal in found.summary.get("focals", []) if focal["camera"] == 0]
    return max(formal_px, float(given[0])) if given and given[0] is not None else formal_px
