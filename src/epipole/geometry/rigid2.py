"""Rigid motions of the plane, SE(2), in batches."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from epipole._checks import as_float_array, checked
from epipole.geometry.batch import Batch, in_words
from epipole.geometry.rigid3 import Rigid3
from epipole.geometry.rotation3 import Rotation3


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Rigid2(Batch):
    """A batch of rigid motions of the plane, `x_in_target = rotation @ x_in_source + translation`."""

    angle_rad: Float64[np.ndarray, "*batch"]
    """Counterclockwise, within (-pi, pi]."""
    translation: Float64[np.ndarray, "*batch 2"]
    _items = ((), (2,))

    def __post_init__(self) -> None:
        """Wrap the angle to (-pi, pi]."""
        Batch.__post_init__(self)
        # Arithmetic on 0-dimensional arrays gives scalars: convert back to an array.
        object.__setattr__(self, "angle_rad", np.asarray(np.pi - np.mod(np.pi - self.angle_rad, 2 * np.pi)))

    @staticmethod
    def identity(*batch: int) -> Rigid2:
        """The identity, repeated over the batch shape."""
        return Rigid2(np.zeros(batch), np.zeros((*batch, 2)))

    @staticmethod
    def exp(xi: Any) -> Rigid2:
        """From the twist (rho, phi), with the translation V(phi) rho, V = [[sin, cos - 1], [1 - cos, sin]] / phi."""
        xi = as_float_array(xi, "xi", 3)
        rho, phi = xi[..., :2], xi[..., 2]
        along, across = np.sinc(phi / np.pi), 0.5 * phi * np.sinc(phi / (2 * np.pi)) ** 2
        shift = np.stack(
            [along * rho[..., 0] - across * rho[..., 1], across * rho[..., 0] + along * rho[..., 1]], axis=-1
        )
        return Rigid2(phi.copy(), shift)

    def log(self) -> Float64[np.ndarray, "*batch 3"]:
        """The twist (rho, phi) with exp(log(T)) = T."""
        half = 0.5 * self.angle_rad
        small = np.abs(half) < 1e-4
        along = np.where(small, 1.0 - half * half / 3.0, half / np.tan(np.where(small, 1.0, half)))
        x, y = self.translation[..., 0], self.translation[..., 1]
        return np.stack([along * x + half * y, along * y - half * x, self.angle_rad], axis=-1)

    def _in_words(self) -> str:
        degrees = in_words(np.rad2deg(self.angle_rad))
        return f"{degrees} degrees, translation {in_words(self.translation)}"

    def adjoint(self) -> Float64[np.ndarray, "*batch 3 3"]:
        """Ad with T exp(xi) T^-1 = exp(Ad xi): [[R, (t_y, -t_x)], [0, 1]]."""
        out = np.zeros((*self.angle_rad.shape, 3, 3))
        out[..., :2, :2] = self.rotation()
        out[..., 0, 2], out[..., 1, 2] = self.translation[..., 1], -self.translation[..., 0]
        out[..., 2, 2] = 1.0
        return out

    def rotation(self) -> Float64[np.ndarray, "*batch 2 2"]:
        """Rotation matrices."""
        cos, sin = np.cos(self.angle_rad), np.sin(self.angle_rad)
        return np.stack([np.stack([cos, -sin], axis=-1), np.stack([sin, cos], axis=-1)], axis=-2)

    def inverse(self) -> Rigid2:
        """source_from_target."""
        back = np.swapaxes(self.rotation(), -1, -2)
        return Rigid2(np.asarray(-self.angle_rad), -(back @ self.translation[..., None])[..., 0])

    @checked
    def __matmul__(self, other: Rigid2) -> Rigid2:
        """Composition: c_from_b @ b_from_a = c_from_a."""
        self.check_fits(other.batch_shape(), "other")
        return Rigid2(np.asarray(self.angle_rad + other.angle_rad), self.apply(other.translation))

    def apply(self, points: Any) -> Float64[np.ndarray, "*batch 2"]:
        """Move points (..., 2) from source to target coordinates; the batch shapes broadcast."""
        points = as_float_array(points, "points", 2)
        self.check_fits(points.shape[:-1], "points")
        return (self.rotation() @ points[..., None])[..., 0] + self.translation

    def as_rigid3(self) -> Rigid3:
        """The same motion, of the plane z = 0 in space."""
        rotation = np.zeros((*self.angle_rad.shape, 3))
        rotation[..., 2] = self.angle_rad
        shift = np.zeros((*self.angle_rad.shape, 3))
        shift[..., :2] = self.translation
        return Rigid3(Rotation3.exp(rotation).matrix, shift)

    @staticmethod
    @checked
    def from_rigid3(motion: Rigid3) -> Rigid2:
        """The part of a motion in space within the plane z = 0."""
        angle = np.arctan2(
            motion.rotation[..., 1, 0] - motion.rotation[..., 0, 1],
            motion.rotation[..., 0, 0] + motion.rotation[..., 1, 1],
        )
        return Rigid2(np.asarray(angle), motion.translation[..., :2].copy())
