"""Rotations of space, SO(3), in batches."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from epipole._checks import as_float_array, checked
from epipole.errors import ShapeError
from epipole.geometry.batch import Batch, in_words


def skew(vectors: Any) -> Float64[np.ndarray, "*batch 3 3"]:
    """The matrix [v]x of the cross product, [v]x w = v x w. Shape (..., 3) -> (..., 3, 3)."""
    v = as_float_array(vectors, "vectors", 3)
    zero = np.zeros(v.shape[:-1])
    rows = [zero, -v[..., 2], v[..., 1], v[..., 2], zero, -v[..., 0], -v[..., 1], v[..., 0], zero]
    return np.stack(rows, axis=-1).reshape(*v.shape[:-1], 3, 3)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Rotation3(Batch):
    """A batch of rotations, `x_in_target = matrix @ x_in_source`."""

    matrix: Float64[np.ndarray, "*batch 3 3"]
    _items = ((3, 3),)
    _rotations = "matrix"

    @staticmethod
    def identity(*batch: int) -> Rotation3:
        """The identity, repeated over the batch shape."""
        return Rotation3._of(np.broadcast_to(np.eye(3), (*batch, 3, 3)).copy())

    @staticmethod
    def exp(phi_rad: Any) -> Rotation3:
        """Rotation about axis phi by |phi| radians (Rodrigues 1840)."""
        phi = as_float_array(phi_rad, "phi_rad", 3)
        angle = np.linalg.norm(phi, axis=-1)[..., None, None]
        # np.sinc(x) = sin(pi x) / (pi x) is exact at zero, so no small-angle branch is needed.
        first = np.sinc(angle / np.pi)
        second = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
        cross = skew(phi)
        return Rotation3._of(np.eye(3) + first * cross + second * (cross @ cross))

    def log(self) -> Float64[np.ndarray, "*batch 3"]:
        """The rotation vector in radians, |phi| <= pi, computed from the quaternion, which is stable near 0 and pi."""
        quat = self.as_quat_wxyz()
        norm = np.linalg.norm(quat[..., 1:], axis=-1, keepdims=True)
        angle = 2 * np.arctan2(norm, quat[..., :1])
        scale = np.where(norm > 1e-12, angle / np.where(norm > 1e-12, norm, 1.0), 2.0)
        return scale * quat[..., 1:]

    @staticmethod
    def from_quat_wxyz(quat_wxyz: Any) -> Rotation3:
        """From quaternions (w, x, y, z) of any nonzero length.

        Raises:
            ShapeError: wrong shape, or a quaternion is zero.
        """
        q = as_float_array(quat_wxyz, "quat_wxyz", 4)
        size = np.linalg.norm(q, axis=-1, keepdims=True)
        if (size == 0.0).any():
            raise ShapeError("quat_wxyz must not be zero, as a zero quaternion is not a rotation")
        w, x, y, z = np.moveaxis(q / size, -1, 0)
        rows = [
            1 - 2 * (y * y + z * z),
            2 * (x * y - w * z),
            2 * (x * z + w * y),
            2 * (x * y + w * z),
            1 - 2 * (x * x + z * z),
            2 * (y * z - w * x),
            2 * (x * z - w * y),
            2 * (y * z + w * x),
            1 - 2 * (x * x + y * y),
        ]
        return Rotation3._of(np.stack(rows, axis=-1).reshape(*q.shape[:-1], 3, 3))

    def as_quat_wxyz(self) -> Float64[np.ndarray, "*batch 4"]:
        """Unit quaternions (w, x, y, z), w >= 0.

        The symmetric 4x4 matrix of Bar-Itzhack (2000) is 4 q q^T - I for a rotation matrix; its row with the largest diagonal
        entry is the quaternion up to scale, without cancellation.
        """
        m = self.matrix
        trace = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
        k = np.empty((*m.shape[:-2], 4, 4))
        k[..., 0, 0] = 1 + trace
        for a in range(3):
            b, c = (a + 1) % 3, (a + 2) % 3
            k[..., a + 1, a + 1] = 1 + 2 * m[..., a, a] - trace
            k[..., 0, a + 1] = k[..., a + 1, 0] = m[..., c, b] - m[..., b, c]
            k[..., a + 1, b + 1] = k[..., b + 1, a + 1] = m[..., a, b] + m[..., b, a]
        best = np.argmax(np.diagonal(k, axis1=-2, axis2=-1), axis=-1)
        quat = np.take_along_axis(k, best[..., None, None], axis=-2)[..., 0, :]
        quat = quat / np.linalg.norm(quat, axis=-1, keepdims=True)
        return np.where(quat[..., :1] < 0, -quat, quat)

    @staticmethod
    def nearest(matrix: Any) -> Rotation3:
        """The nearest rotation to a 3x3 matrix in the Frobenius norm (Schoenemann 1966, with det = +1).

        Raises:
            ShapeError: it is not a finite 3x3 matrix.
        """
        u, _, vt = np.linalg.svd(as_float_array(matrix, "matrix", 3, 3, finite=True))
        sign = np.sign(np.linalg.det(u @ vt))
        u[..., :, 2] *= np.where(sign < 0, -1.0, 1.0)[..., None]
        return Rotation3(u @ vt)

    @staticmethod
    def from_two_vectors(source: Any, target: Any) -> Rotation3:
        """The smallest rotation from one direction (3,) to another; about any orthogonal axis if they are opposite.

        Raises:
            ShapeError: a vector is not three finite numbers, or is zero.
        """
        a, b = (_unit(v, name) for v, name in ((source, "source"), (target, "target")))
        axis = np.cross(a, b)
        sin, cos = float(np.linalg.norm(axis)), float(a @ b)
        if sin < 1e-12:
            other = np.cross(a, np.eye(3)[np.argmin(np.abs(a))])
            return Rotation3.identity() if cos > 0 else Rotation3.exp(np.pi * other / np.linalg.norm(other))
        return Rotation3.exp(np.arctan2(sin, cos) * axis / sin)

    def inverse(self) -> Rotation3:
        """source_from_target."""
        return Rotation3._of(np.ascontiguousarray(np.swapaxes(self.matrix, -1, -2)))

    @checked
    def __matmul__(self, other: Rotation3) -> Rotation3:
        """Composition: c_from_b @ b_from_a = c_from_a."""
        self.check_fits(other.batch_shape(), "other")
        return Rotation3._of(self.matrix @ other.matrix)

    def apply(self, points: Any) -> Float64[np.ndarray, "*batch 3"]:
        """Rotate points (..., 3); the batch shapes broadcast."""
        points = as_float_array(points, "points", 3)
        self.check_fits(points.shape[:-1], "points")
        return (self.matrix @ points[..., None])[..., 0]

    def adjoint(self) -> Float64[np.ndarray, "*batch 3 3"]:
        """Ad with R exp(phi) R^-1 = exp(Ad phi): the matrix itself."""
        return self.matrix

    def _in_words(self) -> str:
        phi = self.log()
        angle = np.linalg.norm(phi)
        around = f" about {in_words(phi / angle)}" if angle > 0 else ""
        return f"{in_words(np.rad2deg(angle))} degrees{around}"

    def angle_rad(self) -> Float64[np.ndarray, "*batch"]:
        """The rotation angle in [0, pi], also accurate for small angles."""
        return np.asarray(np.linalg.norm(self.log(), axis=-1))


def _unit(vector: Any, name: str) -> Float64[np.ndarray, 3]:
    out = as_float_array(vector, name, 3, finite=True)
    length = np.linalg.norm(out)
    if out.ndim != 1 or not length > 0:
        raise ShapeError(f"{name} must be one nonzero direction (3,), got {out}")
    return out / length
