"""Matches as rays of two cameras, and the derivatives of their Sampson residuals and parallax by the motion.

Matches are unit rays r with their derivatives by pixels, D = d r / d x (3 x 2), so that residuals of any camera model are in
pixels: s = r2^T E r1 / sqrt(|D1^T E^T r2|^2 + |D2^T E r1|^2), E = [t]x R (the tangent Sampson error: Terekhov and Larsson,
ICCV 2023). All functions take batches of motions (..., 3, 3), (..., 3).
"""

from __future__ import annotations

import numpy as np

from epipole.cameras import Camera
from epipole.geometry import Rotation3, skew


class Matches:
    """Unit rays of both cameras, (n, 3), d ray / d pixel (n, 3, 2), and d pixel / d ray (n, 2, 3) of the second."""

    def __init__(self, pixels1: np.ndarray, pixels2: np.ndarray, camera1: Camera, camera2: Camera) -> None:
        self.pixels1, self.pixels2 = pixels1, pixels2
        self.ray1, self.spread1 = camera1.unproject_with_jacobian(pixels1)
        self.ray2, self.spread2 = camera2.unproject_with_jacobian(pixels2)
        self.jacobian2 = camera2.project_with_jacobian(self.ray2)[1]
        self.log_area = float(np.log(float(camera2.width) * float(camera2.height)))

    def __len__(self) -> int:
        return len(self.ray1)

    def are_finite(self) -> np.ndarray:
        """(n,) whether both pixels have a ray."""
        parts = (self.ray1, self.ray2, self.spread1.reshape(-1, 6), self.spread2.reshape(-1, 6))
        return np.logical_and.reduce([np.isfinite(part).all(axis=1) for part in parts])

    def chosen(self, rows: np.ndarray) -> Matches:
        """Some of the matches."""
        out = Matches.__new__(Matches)
        for name in ("pixels1", "pixels2", "ray1", "ray2", "jacobian2", "spread1", "spread2"):
            setattr(out, name, getattr(self, name)[rows])
        out.log_area = self.log_area
        return out

    def moved(self, image: int, axis: int, step_px: float) -> Matches:
        """The matches with one pixel coordinate changed."""
        out = self.chosen(np.arange(len(self)))
        if image == 1:
            out.ray1 = self.ray1 + step_px * self.spread1[:, :, axis]
        else:
            out.ray2 = self.ray2 + step_px * self.spread2[:, :, axis]
        return out

    def sampson(self, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
        """(..., n) signed Sampson residuals in pixels of motions (..., 3, 3), (..., 3)."""
        return self._sampson(skew(translation) @ rotation)[0]

    def jacobian(self, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
        """(..., n, 5) derivatives of the residuals by (rotation from the left, step of t in its tangent plane)."""
        essential = skew(translation) @ rotation
        residual, size, a, b = self._sampson(essential)
        by_parameter = _essential_derivatives(rotation, translation)  # (..., 5, 3, 3)
        ratio = (residual / size)[..., None]
        first = self.ray1 - ratio * np.einsum("njc,...nc->...nj", self.spread1, a)
        second = ratio * np.einsum("nic,...nc->...ni", self.spread2, b)
        # ds/dE_ij = (r2_i (r1 - e/m D1 a)_j - e/m (D2 b)_i r1_j) / sqrt(m)
        along = np.einsum("ni,...pij,...nj->...np", self.ray2, by_parameter, first, optimize=True)
        back = np.einsum("...ni,...pij,nj->...np", second, by_parameter, self.ray1, optimize=True)
        return (along - back) / size[..., None]

    def _sampson(self, essential: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        line2 = self.ray1 @ np.swapaxes(essential, -1, -2)
        line1 = self.ray2 @ essential
        a = np.einsum("njc,...nj->...nc", self.spread1, line1)
        b = np.einsum("nic,...ni->...nc", self.spread2, line2)
        size = np.sqrt((a**2).sum(-1) + (b**2).sum(-1) + 1e-300)
        return (self.ray2 * line2).sum(-1) / size, size, a, b

    def parallax(self, rotation: np.ndarray, translation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(..., n) displacement along the epipolar line in image 2 in pixels, positive in front, and pixels per inverse depth."""
        far = self.ray1 @ np.swapaxes(rotation, -1, -2)
        t = translation[..., None, :]
        across = t - far * (far * t).sum(-1, keepdims=True)
        direction = np.einsum("ncj,...nj->...nc", self.jacobian2, across)
        speed = np.sqrt((direction**2).sum(-1) + 1e-300)
        shift = np.einsum("ncj,...nj->...nc", self.jacobian2, self.ray2 - far)
        return (shift * direction).sum(-1) / speed, speed


def moved_motion(
    step: np.ndarray, rotation: np.ndarray, translation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Steps (..., 5) of motions: exp(phi) R, and t along a great circle."""
    tangent = np.einsum("...k,...kj->...j", step[..., 3:], tangents_of(translation))
    angle = np.linalg.norm(tangent, axis=-1, keepdims=True)
    moved = np.cos(angle) * translation + np.sinc(angle / np.pi) * tangent
    return Rotation3.exp(step[..., :3]).matrix @ rotation, moved


def tangents_of(translation: np.ndarray) -> np.ndarray:
    """(..., 2, 3) unit vectors orthogonal to t and to each other, as in the kernels of the robust loop."""
    axis = np.eye(3)[np.argmin(np.abs(translation), axis=-1)]
    first = axis - translation * (axis * translation).sum(-1, keepdims=True)
    first = first / np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(translation, first)], axis=-2)


def _essential_derivatives(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """(..., 5, 3, 3): derivatives of [t]x R by a rotation from the left and a step of t."""
    by_rotation = skew(translation)[..., None, :, :] @ skew(np.eye(3)) @ rotation[..., None, :, :]
    by_step = skew(tangents_of(translation)) @ rotation[..., None, :, :]
    return np.concatenate([by_rotation, by_step], axis=-3)
