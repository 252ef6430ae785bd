"""Renders of Gaussians and their derivatives, whatever computes them.

Two functions are all that a trainer or a renderer needs: `render_view` and `backward`. Behind them stands a backend, a
module with functions of the same names that is imported when it is first used. The Numba kernels are the reference.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any, NamedTuple, Protocol, cast, runtime_checkable

import numpy as np
from jaxtyping import Float32

from epipole import _parallel
from epipole._checks import MOST_RENDERED_PIXELS, Declared, check_fields, check_pixels, checked
from epipole.cameras import Camera, CameraModel
from epipole.errors import ConfigError, ShapeError
from epipole.fields.splat._blend_kernels import put_over
from epipole.geometry import Rigid3
from epipole.scene.gaussian_cloud import GaussianCloud

ROWS_TOGETHER = 64
"""Image rows processed as one task."""
MOST_BLUR_PX = 1e6
BACKENDS = {"numba": "epipole.fields.splat.numba_backend"}
"""Module of each backend."""


@dataclass(frozen=True, slots=True)
class RenderOptions:
    """Options for rendering Gaussians."""

    blur_px: float = 0.3
    """Variance added to each projected Gaussian, in square pixels, so that none is thinner than a pixel."""
    antialiased: bool = False
    """Reduce the opacity to compensate for the blur (2D filter of Yu et al., Mip-Splatting, 2024)."""
    near: float = 0.01
    """Near plane, in world units."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: a value is negative, too large or not finite.
        """
        check_fields(self)
        if not 0 <= self.blur_px <= MOST_BLUR_PX:
            raise ConfigError(f"blur_px must be from 0 to {MOST_BLUR_PX:g}, got {self.blur_px:g}")
        if not 0 < self.near < np.inf:
            raise ConfigError(f"near must be positive and finite, got {self.near:g}")


class Cloud(NamedTuple):
    """Arrays of a cloud, as the kernels read them."""

    means: np.ndarray
    log_scales: np.ndarray
    quats_wxyz: np.ndarray
    logits: np.ndarray
    sh: np.ndarray


class View(NamedTuple):
    """A camera and its pose, as the kernels read them."""

    rotation: np.ndarray
    translation: np.ndarray
    center: np.ndarray
    focal: np.ndarray
    middle: np.ndarray
    reach: np.ndarray
    """Tangents of half the field of view, horizontal and vertical."""
    width: int
    height: int
    near_plane: float
    blur: float
    antialiased: bool


@dataclass(frozen=True, slots=True, eq=False)
class Rendering(Declared):
    """Render of Gaussians without a background."""

    color: Float32[np.ndarray, "h w 3"]
    """RGB times coverage."""
    depth: Float32[np.ndarray, "h w"]
    """Along the optical axis, times coverage."""
    coverage: Float32[np.ndarray, "h w"]
    """1 minus the transmittance."""
    num_evaluated: int
    """Number of Gaussian-pixel pairs that were evaluated."""
    record: Any
    """What the backend keeps for its backward pass."""

    @checked
    def over(self, background: Float32[np.ndarray, " 3"]) -> Float32[np.ndarray, "h w 3"]:
        """The image over a background color."""
        out, height = np.empty_like(self.color), len(self.coverage)
        _parallel.map_chunks(
            lambda a, b, _: put_over(self.color, self.coverage, background, a, b, out),
            height,
            -(-height // ROWS_TOGETHER),
        )
        return out


class ImageGradient(NamedTuple):
    """Derivatives of a loss w.r.t. a render; None: zero."""

    color: np.ndarray
    """(h, w, 3)"""
    depth: np.ndarray | None = None
    """(h, w)"""
    coverage: np.ndarray | None = None
    """(h, w)"""


class CloudGradient(NamedTuple):
    """Derivatives of a loss w.r.t. the arrays of a cloud; zero for invisible Gaussians."""

    means: np.ndarray
    log_scales: np.ndarray
    quats_wxyz: np.ndarray
    logits: np.ndarray
    sh: np.ndarray
    center: np.ndarray
    """(n, 2) w.r.t. the image position, in pixels."""


class Gradient(NamedTuple):
    """Derivatives of a loss that a backward pass found."""

    cloud: CloudGradient
    is_visible: np.ndarray
    """(n,) whether each Gaussian touched the image."""
    by_pose: np.ndarray
    """(6,) w.r.t. xi = (translation, rotation) in exp(xi) @ cam_from_world."""


@runtime_checkable
class Backend(Protocol):
    """What a backend's module provides; arguments and results as for `render_view` and `backward`."""

    def render(self, cloud: Cloud, view: View, opacity_factors: np.ndarray | None) -> Rendering:
        """Render."""

    def backward(
        self,
        cloud: Cloud,
        view: View,
        rendering: Rendering,
        by_image: ImageGradient,
        reused: CloudGradient | None,
    ) -> Gradient:
        """Differentiate."""


@checked
def view_of(camera: Camera, cam_from_world: Rigid3, options: RenderOptions) -> View:
    """A camera and its pose, as the kernels read them.

    Raises:
        ConfigError: the camera has distortion or too many pixels.
        ShapeError: cam_from_world is not a single pose.
    """
    check_pixels(camera.width, camera.height, MOST_RENDERED_PIXELS)
    if camera.model not in (CameraModel.PINHOLE, CameraModel.SIMPLE_PINHOLE):
        raise ConfigError("Gaussians are rendered with a PINHOLE camera: undistort the images first")
    if cam_from_world.batch_shape() != ():
        raise ShapeError(
            f"cam_from_world must be a single pose, got a batch of {cam_from_world.batch_shape()}"
        )
    matrix = camera.K
    focal, middle = np.array([matrix[0, 0], matrix[1, 1]]), matrix[:2, 2].copy()
    return View(
        np.ascontiguousarray(cam_from_world.rotation).reshape(9).astype(np.float64),
        cam_from_world.translation.astype(np.float64),
        cam_from_world.inverse().translation.astype(np.float64),
        focal,
        middle,
        0.5 * np.array([camera.width, camera.height]) / focal,
        camera.width,
        camera.height,
        float(options.near),
        float(options.blur_px),
        bool(options.antialiased),
    )


@checked
def render(
    cloud: GaussianCloud, camera: Camera, cam_from_world: Rigid3, options: RenderOptions | None = None
) -> Rendering:
    """Render Gaussians (Kerbl et al. 2023); the result does not depend on the number of threads.

    Args:
        cloud: Gaussians.
        camera: pinhole camera.
        cam_from_world: its pose.
        options: rendering options; None for the defaults.

    Raises:
        ConfigError: the camera has distortion or too many pixels.
        ShapeError: cam_from_world is not a single finite pose.
    """
    if not np.isfinite(cam_from_world.as_matrix()).all():
        raise ShapeError("cam_from_world is not finite")
    if cloud.origin_in_world.any():
        cam_from_world = cam_from_world @ Rigid3(
            np.eye(3), cloud.origin_in_world
        )  # relative to the cloud's origin
    view = view_of(camera, cam_from_world, RenderOptions() if options is None else options)
    return render_view(arrays_of(cloud), view)


def arrays_of(cloud: GaussianCloud) -> Cloud:
    """Contiguous arrays of a cloud."""
    parts = (cloud.means_in_world, cloud.log_scales, cloud.quats_wxyz, cloud.opacity_logits, cloud.sh)
    return Cloud(*(np.ascontiguousarray(part) for part in parts))


def backend_of(name: str) -> Backend:
    """The backend of this name, imported now if it was not.

    Raises:
        ConfigError: there is no backend of this name.
    """
    if name not in BACKENDS:
        raise ConfigError(f"backend must be one of {', '.join(BACKENDS)}, got {name!r:.40}")
    return cast(Backend, import_module(BACKENDS[name]))


def render_view(
    cloud: Cloud, view: View, opacity_factors: np.ndarray | None = None, backend: str = "numba"
) -> Rendering:
    """Render Gaussians.

    Args:
        cloud: Gaussians.
        view: camera and pose.
        opacity_factors: (n,); None: 1.
        backend: one of BACKENDS.
    """
    return backend_of(backend).render(cloud, view, opacity_factors)


def backward(
    cloud: Cloud,
    view: View,
    rendering: Rendering,
    by_image: ImageGradient,
    reused: CloudGradient | None = None,
    backend: str = "numba",
) -> Gradient:
    """Derivatives of a loss w.r.t. the Gaussians and the pose.

    Args:
        cloud: Gaussians that were rendered.
        view: camera and pose.
        rendering: their render by the same backend.
        by_image: derivatives of the loss w.r.t. the render.
        reused: an earlier gradient of as many Gaussians, whose memory is written again; rows of Gaussians that are
            invisible now keep their old values.
        backend: one of BACKENDS.
    """
    return backend_of(backend).backward(cloud, view, rendering, by_image, reused)
