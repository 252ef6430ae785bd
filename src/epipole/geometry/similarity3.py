"""Similarities of space, Sim(3), in batches: the gauge freedom of a reconstruction from images alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from epipole._checks import as_float_array, checked
from epipole.geometry.batch import Batch, in_words
from epipole.geometry.rigid3 import Rigid3
from epipole.geometry.rotation3 import Rotation3, skew

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(24)
_NODES, _WEIGHTS = 0.5 * (_NODES + 1.0), 0.5 * _WEIGHTS


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Similarity3(Batch):
    """A batch of similarities, `x_in_target = scale * rotation @ x_in_source + translation`.

    Tangents are (translation, rotation, log of scale).
    """

    scale: Float64[Any, "*batch"]  # stored as an array; numbers are accepted
    rotation: Float64[np.ndarray, "*batch 3 3"]
    translation: Float64[np.ndarray, "*batch 3"]
    _items = ((), (3, 3), (3,))
    _rotations = "rotation"

    @staticmethod
    def identity(*batch: int) -> Similarity3:
        """The identity, repeated over the batch shape."""
        return Similarity3(np.ones(batch), Rotation3.identity(*batch).matrix, np.zeros((*batch, 3)))

    @staticmethod
    def exp(xi: Any) -> Similarity3:
        """From the tangent (rho, phi, sigma), with s = e^sigma, R = e^phi, t = W(phi, sigma) rho (Strasdat 2012)."""
        xi = as_float_array(xi, "xi", 7)
        phi, sigma = np.ascontiguousarray(xi[..., 3:6]), np.asarray(xi[..., 6])
        translation = (_translation_jacobian(phi, sigma) @ xi[..., :3, None])[..., 0]
        return Similarity3(np.exp(sigma), Rotation3.exp(phi).matrix, translation)

    def log(self) -> Float64[np.ndarray, "*batch 7"]:
        """The tangent (rho, phi, sigma) with exp(log(S)) = S."""
        phi, sigma = Rotation3._of(self.rotation).log(), np.asarray(np.log(self.scale))
        rho = np.linalg.solve(_translation_jacobian(phi, sigma), self.translation[..., None])[..., 0]
        return np.concatenate([rho, phi, sigma[..., None]], axis=-1)

    def inverse(self) -> Similarity3:
        """source_from_target."""
        back = Rotation3._of(self.rotation).inverse()
        translation = -back.apply(self.translation) / self.scale[..., None]
        return Similarity3(1.0 / self.scale, back.matrix, translation)

    @checked
    def __matmul__(self, other: Similarity3) -> Similarity3:
        """Composition: c_from_b @ b_from_a = c_from_a."""
        self.check_fits(other.batch_shape(), "other")
        return Similarity3(
            self.scale * other.scale, self.rotation @ other.rotation, self.apply(other.translation)
        )

    def apply(self, points: Any) -> Float64[np.ndarray, "*batch 3"]:
        """Move points (..., 3) from source to target coordinates; the batch shapes broadcast."""
        return self.scale[..., None] * Rotation3._of(self.rotation).apply(points) + self.translation

    def adjoint(self) -> Float64[np.ndarray, "*batch 7 7"]:
        """Ad with S exp(xi) S^-1 = exp(Ad xi): [[sR, [t]x R, -t], [0, R, 0], [0, 0, 1]]."""
        out = np.zeros((*self.translation.shape[:-1], 7, 7))
        out[..., :3, :3] = self.scale[..., None, None] * self.rotation
        out[..., :3, 3:6] = skew(self.translation) @ self.rotation
        out[..., :3, 6] = -self.translation
        out[..., 3:6, 3:6] = self.rotation
        out[..., 6, 6] = 1.0
        return out

    def _in_words(self) -> str:
        return f"scale {in_words(self.scale)}, {Rigid3._of(self.rotation, self.translation)._in_words()}"

    @checked
    def move_cam_from_source(self, cam_from_source: Rigid3) -> Rigid3:
        """cam_from_target for cameras given in source coordinates; the camera's unit of length scales, too.

        The pixels do not change: x_cam' = s (R_cs x_source + t_cs) with x_target = S x_source.
        """
        self.check_fits(cam_from_source.batch_shape(), "cam_from_source")
        rotation = cam_from_source.rotation @ np.swapaxes(self.rotation, -1, -2)
        moved = (rotation @ self.translation[..., None])[..., 0]
        return Rigid3(rotation, self.scale[..., None] * cam_from_source.translation - moved)


def _translation_jacobian(phi: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """W = integral over u in [0, 1] of e^(sigma u) exp(u phi), by Gauss quadrature.

    24 nodes give full double precision for |phi| <= pi and |sigma| <= 5, without the four small-argument branches of the
    closed form.
    """
    angle = np.linalg.norm(phi, axis=-1)[..., None]
    grown = _WEIGHTS * np.exp(sigma[..., None] * _NODES)
    zeroth = grown.sum(-1)[..., None, None]
    first = (grown * _NODES * np.sinc(angle * _NODES / np.pi)).sum(-1)[..., None, None]
    second = (grown * 0.5 * (_NODES * np.sinc(angle * _NODES / (2 * np.pi))) ** 2).sum(-1)[..., None, None]
    cross = skew(phi)
    return zeroth * np.eye(3) + first * cross + second * (cross @ cross)
