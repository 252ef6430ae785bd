"""A camera: model, image size and parameters, with projection and unprojection."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from epipole._checks import as_float_array, as_points, check_fields, checked
from epipole.cameras import _camera_kernels as kernels
from epipole.cameras.models import MAX_PARAMS, CameraModel, as_camera_model
from epipole.errors import ConfigError, ShapeError

_ZEROS_OF_K = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0]])
"""1 where a calibration matrix without skew is zero."""


@dataclass(frozen=True, slots=True, eq=False, init=False)
class Camera:
    """A camera's intrinsics. Axes: x right, y down, z forward; pixel (0, 0) is the center of the top-left pixel."""

    model: CameraModel
    width: int
    height: int
    params: Float64[np.ndarray, " p"]

    def __init__(self, model: CameraModel | str | int, width: int, height: int, params: Any) -> None:
        """Create a camera, such as `Camera("PINHOLE", 640, 480, [500, 500, 319.5, 239.5])`.

        Args:
            model: the model, its name or its number.
            width: image width in pixels.
            height: image height in pixels.
            params: the parameters in the order of `model.param_names`.

        Raises:
            ConfigError: the model is unknown, or the parameters do not fit it or are out of range.
            ShapeError: the parameters are not numbers.
        """
        put = object.__setattr__
        put(self, "model", as_camera_model(model))
        put(self, "width", width)
        put(self, "height", height)
        put(self, "params", as_float_array(params, "params"))
        self.__post_init__()

    @staticmethod
    @checked
    def from_K(K: Any, size: tuple[int, int], distortion: Any = None, *, is_fisheye: bool = False) -> Camera:
        """A camera from OpenCV's calibration matrix and distortion coefficients, with the same pixel convention.

        Args:
            K: calibration matrix (3, 3), without skew.
            size: width and height of the images in pixels.
            distortion: None; k1, k2, p1, p2 and, optionally, k3 to k6; k1 to k4 for fisheye. Trailing zeros are ignored:
                no other coefficient gives a PINHOLE camera, up to four OPENCV, more FULL_OPENCV.
            is_fisheye: whether the coefficients are those of `cv2.fisheye`.

        Raises:
            ConfigError: the matrix is invalid or has skew, or no supported model has these coefficients.
            ShapeError: an array has the wrong shape.
        """
        matrix = as_float_array(K, "K")
        found = as_float_array(() if distortion is None else distortion, "distortion").ravel()
        if matrix.shape != (3, 3):
            raise ShapeError(f"K must be (3, 3), got {matrix.shape}")
        if not np.array_equal(matrix * _ZEROS_OF_K, np.zeros((3, 3))) or matrix[2, 2] != 1.0:
            raise ConfigError(f"K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], got {matrix.tolist()}")
        if not np.isfinite(found).all():
            raise ConfigError(f"distortion must be finite numbers, got {found.tolist()}")
        used = len(np.trim_zeros(found, "b"))
        if used > (4 if is_fisheye else 8):
            kind = "a fisheye camera has k1 to k4" if is_fisheye else "thin prism and tilt are not supported"
            raise ConfigError(f"distortion has {used} nonzero coefficients: {kind}")
        model, count = CameraModel.FULL_OPENCV, 8
        if is_fisheye or used <= 4:
            model, count = (CameraModel.OPENCV_FISHEYE if is_fisheye else CameraModel.OPENCV), 4
        if not used and not is_fisheye:
            model, count = CameraModel.PINHOLE, 0
        coefficients = np.zeros(count)
        coefficients[:used] = found[:used]
        width, height = size
        params = [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *coefficients]
        return Camera(model, width, height, params)

    def __post_init__(self) -> None:
        """Check the parameters and the size.

        Raises:
            ConfigError: the parameters do not fit the model, or a value is out of range.
        """
        check_fields(self)
        names = self.model.param_names
        if self.params.shape != (len(names),):
            raise ConfigError(
                f"{self.model.name} has {len(names)} parameters ({', '.join(names)}), got {self.params.size}"
            )
        bad = [n for n, value in zip(names, self.params) if not np.isfinite(value)]
        if bad:
            raise ConfigError(f"camera parameter {', '.join(bad)} must be finite")
        shortest = min(self.params[i] for i in self.model.focal_indices)
        if shortest <= 0:
            raise ConfigError(f"the focal length must be positive, got {shortest:g}")
        if self.width < 1 or self.height < 1:
            raise ConfigError(f"the image size must be positive, got {self.width}x{self.height}")

    @property
    def focal_px(self) -> float:
        """Mean focal length in pixels."""
        return float(np.mean([self.params[i] for i in self.model.focal_indices]))

    @property
    def K(self) -> Float64[np.ndarray, "3 3"]:
        """The calibration matrix, without distortion."""
        focal = [self.params[i] for i in self.model.focal_indices]
        cx, cy = (self.params[i] for i in self.model.principal_point_indices)
        return np.array([[focal[0], 0.0, cx], [0.0, focal[-1], cy], [0.0, 0.0, 1.0]])

    def padded_params(self) -> Float64[np.ndarray, 12]:
        """Parameters padded with zeros to the longest model, as in camera columns."""
        return np.concatenate([self.params, np.zeros(MAX_PARAMS - len(self.params))])

    def project(self, points_in_cam: Any) -> Float64[np.ndarray, "n 2"]:
        """Pixels of points (n, 3) in camera coordinates; NaN where the camera cannot see them."""
        points = as_points(points_in_cam, "points_in_cam", 3)
        out = np.empty((len(points), 2))
        kernels.project_all(int(self.model), self.padded_params(), points, out)
        return out

    def project_with_jacobian(
        self, points_in_cam: Any
    ) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, "n 2 3"], Float64[np.ndarray, "n 2 p"]]:
        """Pixels, d pixels / d points and d pixels / d params."""
        points = as_points(points_in_cam, "points_in_cam", 3)
        n = len(points)
        out, jac_points, jac_params = np.empty((n, 2)), np.empty((n, 2, 3)), np.empty((n, 2, MAX_PARAMS))
        kernels.project_with_jacobian_all(
            int(self.model), self.padded_params(), points, out, jac_points, jac_params
        )
        return out, jac_points, jac_params[:, :, : len(self.params)]

    def unproject(self, pixels: Any) -> Float64[np.ndarray, "n 3"]:
        """Unit directions in camera coordinates of pixels (n, 2); NaN where the distortion has no inverse."""
        pixels = as_points(pixels, "pixels", 2)
        out = np.empty((len(pixels), 3))
        kernels.unproject_all(int(self.model), self.padded_params(), pixels, out)
        return out

    def unproject_with_jacobian(
        self, pixels: Any
    ) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3 2"]]:
        """Unit directions d, and d direction / d pixels.

        With P = d(pixel)/d(point) at d (2x3), where P d = 0, the inverse on the tangent plane is the pseudo-inverse
        P^T (P P^T)^-1.
        """
        rays = self.unproject(pixels)
        _, jac, _ = self.project_with_jacobian(rays)
        a, b = jac[:, 0], jac[:, 1]
        aa, bb, ab = (a * a).sum(axis=1), (b * b).sum(axis=1), (a * b).sum(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            over = 1.0 / (aa * bb - ab * ab)[:, None]
            out = np.stack(
                [over * (bb[:, None] * a - ab[:, None] * b), over * (aa[:, None] * b - ab[:, None] * a)],
                axis=2,
            )
        return rays, out

    @checked
    def scaled_to(self, width: int, height: int) -> Camera:
        """The camera for the same images resampled to another size (aligning pixel edges, not centers)."""
        sx, sy = width / self.width, height / self.height
        params = as_float_array(self.params, "params").copy()
        focal = self.model.focal_indices
        for position, index in enumerate(focal):
            params[index] *= (sx + sy) / 2 if len(focal) == 1 else (sx, sy)[position]
        cx, cy = self.model.principal_point_indices
        params[cx], params[cy] = (params[cx] + 0.5) * sx - 0.5, (params[cy] + 0.5) * sy - 0.5
        return Camera(self.model, width, height, params)

    def __repr__(self) -> str:
        values = ", ".join(f"{n} {v:.6g}" for n, v in zip(self.model.param_names, self.params))
        return f"Camera({self.model.name}, {self.width}x{self.height}, {values})"
