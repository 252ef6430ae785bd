"""Rigid motions of space, SE(3), in batches."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from epipole._checks import as_float_array, checked
from epipole.errors import ShapeError
from epipole.geometry.batch import Batch, in_words
from epipole.geometry.rotation3 import Rotation3, skew


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Rigid3(Batch):
    """A batch of rigid motions, `x_in_target = rotation @ x_in_source + translation`.

    Variables are named `target_from_source`, so that products read as cancellation:
    `cam_from_world = cam_from_body @ body_from_world`. Tangents are (translation, rotation).
    """

    rotation: Float64[np.ndarray, "*batch 3 3"]
    translation: Float64[np.ndarray, "*batch 3"]
    _items = ((3, 3), (3,))
    _rotations = "rotation"

    @staticmethod
    def identity(*batch: int) -> Rigid3:
        """The identity, repeated over the batch shape."""
        return Rigid3._of(Rotation3.identity(*batch).matrix, np.zeros((*batch, 3)))

    @staticmethod
    def from_matrix(matrix: Any) -> Rigid3:
        """From (..., 4, 4) or (..., 3, 4) matrices [R t].

        Raises:
            ShapeError: wrong shape, a last row is not (0, 0, 0, 1), or an R is not a rotation.
        """
        m = as_float_array(matrix, "matrix")
        if m.shape[-2:] not in ((4, 4), (3, 4)):
            raise ShapeError(f"matrix must have shape (..., 4, 4) or (..., 3, 4), got {m.shape}")
        if m.shape[-2] == 4 and not (np.abs(m[..., 3, :] - [0.0, 0.0, 0.0, 1.0]) < 1e-6).all():
            raise ShapeError("matrix must end in the row (0, 0, 0, 1), or have three rows")
        return Rigid3(np.ascontiguousarray(m[..., :3, :3]), np.ascontiguousarray(m[..., :3, 3]))

    def as_matrix(self) -> Float64[np.ndarray, "*batch 4 4"]:
        """Homogeneous 4x4 matrices."""
        out = np.zeros((*self.translation.shape[:-1], 4, 4))
        out[..., :3, :3], out[..., :3, 3], out[..., 3, 3] = self.rotation, self.translation, 1.0
        return out

    @staticmethod
    def from_quat_wxyz(quat_wxyz: Any, translation: Any) -> Rigid3:
        """From quaternions (w, x, y, z) and translations."""
        return Rigid3(
            Rotation3.from_quat_wxyz(quat_wxyz).matrix, as_float_array(translation, "translation", 3).copy()
        )

    @staticmethod
    def exp(xi: Any) -> Rigid3:
        """From the twist (rho, phi), with R = e^phi and t = V(phi) rho (Murray, Li and Sastry 1994, prop. 2.9)."""
        xi = as_float_array(xi, "xi", 6)
        rho, phi = xi[..., :3], np.ascontiguousarray(xi[..., 3:])
        translation = (left_jacobian(phi) @ rho[..., None])[..., 0]
        return Rigid3._of(Rotation3.exp(phi).matrix, translation)

    def log(self) -> Float64[np.ndarray, "*batch 6"]:
        """The twist (rho, phi) with exp(log(T)) = T."""
        phi = Rotation3._of(self.rotation).log()
        rho = np.linalg.solve(left_jacobian(phi), self.translation[..., None])[..., 0]
        return np.concatenate([rho, phi], axis=-1)

    def inverse(self) -> Rigid3:
        """source_from_target."""
        back = Rotation3._of(self.rotation).inverse()
        return Rigid3._of(back.matrix, -back.apply(self.translation))

    @checked
    def __matmul__(self, other: Rigid3) -> Rigid3:
        """Composition: c_from_b @ b_from_a = c_from_a."""
        self.check_fits(other.batch_shape(), "other")
        return Rigid3._of(self.rotation @ other.rotation, self.apply(other.translation))

    def apply(self, points: Any) -> Float64[np.ndarray, "*batch 3"]:
        """Move points (..., 3) from source to target coordinates; the batch shapes broadcast."""
        return Rotation3._of(self.rotation).apply(points) + self.translation

    def or_identity(self) -> Rigid3:
        """The same motions, with the identity for unknown ones (NaN)."""
        is_known = np.isfinite(self.rotation).all(axis=(-2, -1)) & np.isfinite(self.translation).all(axis=-1)
        return Rigid3._of(
            np.where(is_known[..., None, None], self.rotation, np.eye(3)),
            np.where(is_known[..., None], self.translation, 0.0),
        )

    def adjoint(self) -> Float64[np.ndarray, "*batch 6 6"]:
        """Ad with T exp(xi) T^-1 = exp(Ad xi): [[R, [t]x R], [0, R]]."""
        out = np.zeros((*self.translation.shape[:-1], 6, 6))
        out[..., :3, :3] = out[..., 3:, 3:] = self.rotation
        out[..., :3, 3:] = skew(self.translation) @ self.rotation
        return out

    def _in_words(self) -> str:
        return f"{Rotation3._of(self.rotation)._in_words()}, translation {in_words(self.translation)}"

    def centers(self) -> Float64[np.ndarray, "*batch 3"]:
        """The target's origin in source coordinates: the camera centers, for cam_from_world."""
        return self.inverse().translation


def left_jacobian(phi: Any) -> Float64[np.ndarray, "*batch 3 3"]:
    """V(phi) = integral over u in [0, 1] of exp(u phi): the left Jacobian of SO(3)."""
    phi = as_float_array(phi, "phi", 3)
    angle = np.linalg.norm(phi, axis=-1)[..., None, None]
    first = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    small = angle < 1e-2
    safe = np.where(small, 1.0, angle)
    second = np.where(small, 1 / 6 - angle**2 / 120 + angle**4 / 5040, (safe - np.sin(safe)) / safe**3)
    cross = skew(phi)
    return np.eye(3) + first * cross + second * (cross @ cross)
