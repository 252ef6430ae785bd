"""The first stage: which pictures there are, and with what cameras they were taken."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int32

from epipole.cameras import Camera, CameraModel, camera_model_named
from epipole.errors import ConfigError, FileFormatError, MissingDependencyError, NoModelError
from epipole.io.colmap import params_from_colmap
from epipole.io.photographs import PhotographHeader, list_photographs, read_header
from epipole.pipelines.sfm.config import ReconstructConfig
from epipole.runs import Progress, ProgressCallback
from epipole.scene import Cameras

PRIOR_FOCAL = 1.2
"""Focal length assumed where nothing is known, in units of the longer side."""
MIN_SIZE_PX = 32


@dataclass(frozen=True, slots=True, eq=False)
class ImageSet:
    """The pictures that take part, in order of their names."""

    folder: Path
    names: tuple[str, ...]
    cameras: Cameras
    camera_of_image: Int32[np.ndarray, " n"]
    focal_sources: tuple[str, ...]
    """Where each camera's focal length comes from, in words."""
    lat_lon_alt: Float64[np.ndarray, "n 3"]
    """GPS of the EXIF, altitude 0 where not recorded; NaN for none."""
    timestamps_s: Float64[np.ndarray, " n"]
    fingerprints: tuple[str, ...]
    """Changes when the picture's file changes."""
    left_out: dict[str, str]
    """Pictures that cannot take part, and why."""
    is_video: bool = False

    def __len__(self) -> int:
        return len(self.names)

    def without(self, failures: dict[int, str]) -> ImageSet:
        """The set without the pictures of these rows."""
        if not failures:
            return self
        keep = np.array([i not in failures for i in range(len(self))], bool)
        return replace(
            self,
            names=tuple(n for n, k in zip(self.names, keep) if k),
            camera_of_image=self.camera_of_image[keep],
            lat_lon_alt=self.lat_lon_alt[keep],
            timestamps_s=self.timestamps_s[keep],
            fingerprints=tuple(f for f, k in zip(self.fingerprints, keep) if k),
            left_out={**self.left_out, **{self.names[i]: why for i, why in failures.items()}},
        )


def read_image_set(
    folder: Path,
    config: ReconstructConfig,
    *,
    ignore: tuple[Path, ...] = (),
    timestamps_s: dict[str, float] | None = None,
    progress: ProgressCallback,
) -> ImageSet:
    """Read the headers of all pictures of a folder and group them by camera.

    Pictures of the same make, model, size and focal length share a camera; so do all of one size where none of
    this is recorded.

    Raises:
        NoModelError: there are no pictures that can be read.
        ConfigError: the camera options do not fit.
    """
    listed = list_photographs(folder, ignore=ignore)
    if not listed.names:
        hint = f" {listed.advice}" if listed.advice else ""
        raise NoModelError(f"{folder} holds no photographs (JPEG, PNG, TIFF, WebP).{hint}")
    headers: dict[str, PhotographHeader] = {}
    left_out = dict.fromkeys(listed.unreadable, listed.advice)
    for n, name in enumerate(listed.names):
        try:
            header = read_header(folder / name)
            if min(header.width, header.height) < MIN_SIZE_PX:
                left_out[name] = f"too small ({header.width}x{header.height}) to hold features"
            else:
                headers[name] = header
        except (FileFormatError, MissingDependencyError) as error:
            left_out[name] = str(error).removeprefix(f"{folder / name}: ")
        progress(Progress("read", n + 1, len(listed.names)))
    if not headers:
        reasons = "; ".join(f"{n}: {why}" for n, why in list(left_out.items())[:3])
        raise NoModelError(f"none of the pictures in {folder} can be used ({reasons})")
    times = timestamps_s or {}
    cameras, camera_of_image, sources = _group_cameras(headers, config)
    return ImageSet(
        folder,
        tuple(headers),
        cameras,
        camera_of_image,
        sources,
        np.array([_gps_row(h) for h in headers.values()]),
        np.array([times.get(n, np.nan) for n in headers]),
        tuple(_fingerprint(folder / n) for n in headers),
        left_out,
        bool(times),
    )


def _gps_row(header: PhotographHeader) -> tuple[float, float, float]:
    if header.gps is None:
        return (np.nan, np.nan, np.nan)
    return (header.gps.lat_deg, header.gps.lon_deg, header.gps.alt_m or 0.0)


def _fingerprint(path: Path) -> str:
    state = path.stat()
    return f"{state.st_size}-{state.st_mtime_ns}"


def _group_cameras(
    headers: dict[str, PhotographHeader], config: ReconstructConfig
) -> tuple[Cameras, Int32[np.ndarray, " n"], tuple[str, ...]]:
    known = config.known_params()
    model = camera_model_named(config.camera_model or ("PINHOLE" if known else "SIMPLE_RADIAL"))
    sizes = {(h.width, h.height) for h in headers.values()}
    if known is not None or config.single_camera:
        if len(sizes) > 1:
            listed = ", ".join(f"{w}x{h}" for w, h in sorted(sizes))
            raise ConfigError(f"a single camera needs pictures of one size, but there are {listed}")
        width, height = next(iter(sizes))
        one = np.zeros(len(headers), np.int32)
        if known is not None:
            camera = Camera(model, width, height, _known_params(model, known))
            constant = not config.refine_known
            return Cameras.from_list([camera], is_constant=[constant]), one, ("given",)
        found = [h for h in headers.values() if h.focal_px]
        camera, source = _camera_of(found[0] if found else next(iter(headers.values())), model)
        return Cameras.from_list([camera], is_focal_trusted=[bool(found)]), one, (source,)
    groups: dict[tuple, int] = {}
    cameras: list[Camera] = []
    sources: list[str] = []
    rows: list[int] = []
    for header in headers.values():
        # A picture without camera and focal length in its EXIF may come from any camera: sizes decide.
        key = (header.make, header.model, header.width, header.height, round(header.focal_px or 0.0, 1))
        if key not in groups:
            groups[key] = len(cameras)
            camera, source = _camera_of(header, model)
            cameras.append(camera)
            sources.append(source)
        rows.append(groups[key])
    trusted = [not s.startswith("assumed") for s in sources]
    return Cameras.from_list(cameras, is_focal_trusted=trusted), np.array(rows, np.int32), tuple(sources)


def _known_params(model: CameraModel, known: tuple[float, ...]) -> np.ndarray:
    if len(known) != model.num_params:
        names = ",".join(model.param_names)
        raise ConfigError(f"{model.name} takes {model.num_params} parameters ({names}), got {len(known)}")
    if not np.isfinite(known).all():
        raise ConfigError("camera_params must be finite numbers")
    return params_from_colmap(model, np.array(known))


def _camera_of(header: PhotographHeader, model: CameraModel) -> tuple[Camera, str]:
    focal = header.focal_px or PRIOR_FOCAL * max(header.width, header.height)
    source = f"EXIF, {header.focal_source}" if header.focal_px else f"assumed {PRIOR_FOCAL} x the longer side"
    return Camera(
        model, header.width, header.height, model.initial_params(focal, header.width, header.height)
    ), source
