"""IMU measurements between two instants: integration, residuals and derivatives, interval by interval.

Equations of Forster, Carlone, Dellaert and Scaramuzza (T-RO 2017). Small matrices are multiplied in loops that skip zeros: most blocks
are empty, and a call of NumPy takes longer than their product.
"""

import math

import numpy as np

from epipole._jit import kernel

SMALL = 1e-4
"""Angles in radians below which a series replaces the closed form: its next term is below 1e-16."""


@kernel
def _exponential(x, y, z, out):
    """Rotation matrix of a rotation vector (Rodrigues)."""
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    a, b = 1.0 - square / 6.0, 0.5 - square / 24.0
    if angle > SMALL:
        a, b = math.sin(angle) / angle, 2.0 * (math.sin(0.5 * angle) / angle) ** 2
    _by_powers(x, y, z, a, b, out)


@kernel
def _by_powers(x, y, z, a, b, out):
    """I + a K + b K^2 for the cross-product matrix K of a vector."""
    out[0, 0] = 1.0 - b * (y * y + z * z)
    out[1, 1] = 1.0 - b * (x * x + z * z)
    out[2, 2] = 1.0 - b * (x * x + y * y)
    out[0, 1], out[1, 0] = b * x * y - a * z, b * x * y + a * z
    out[0, 2], out[2, 0] = b * x * z + a * y, b * x * z - a * y
    out[1, 2], out[2, 1] = b * y * z - a * x, b * y * z + a * x


@kernel
def _logarithm(r, out):
    """Rotation vector of a rotation matrix, by the largest component of its quaternion (Shepperd, J. Guidance and Control 1978)."""
    trace = r[0, 0] + r[1, 1] + r[2, 2]
    i = 0
    for k in range(1, 3):
        if r[k, k] > r[i, i]:
            i = k
    if trace >= r[i, i]:
        w = 1.0 + trace
        out[0], out[1], out[2] = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    else:
        j, k = (i + 1) % 3, (i + 2) % 3
        w = r[k, j] - r[j, k]
        out[i] = 1.0 + r[i, i] - r[j, j] - r[k, k]
        out[j], out[k] = r[i, j] + r[j, i], r[i, k] + r[k, i]
    if w < 0.0:
        w = -w
        for axis in range(3):
            out[axis] = -out[axis]
    sine = math.sqrt(out[0] * out[0] + out[1] * out[1] + out[2] * out[2])
    factor = 2.0 / w if sine < SMALL * SMALL * w else 2.0 * math.atan2(sine, w) / sine
    for axis in range(3):
        out[axis] *= factor


@kernel
def _right_jacobian(x, y, z, out):
    """Right Jacobian of SO(3) (equation 8)."""
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    a, b = -0.5 + square / 24.0, 1.0 / 6.0 - square / 120.0
    if angle > SMALL:
        a = -2.0 * (math.sin(0.5 * angle) / angle) ** 2
        b = (angle - math.sin(angle)) / (square * angle) if angle > 0.01 else b
    _by_powers(x, y, z, a, b, out)


@kernel
def _inverse_right_jacobian(x, y, z, out):
    """Its inverse (equation 9)."""
    square = x * x + y * y + z * z
    half = 0.5 * math.sqrt(square)
    b = 1.0 / 12.0 + square / 720.0
    if half > 0.005:
        b = (1.0 - half * math.cos(half) / math.sin(half)) / square
    _by_powers(x, y, z, 0.5, b, out)


@kernel
def _multiply(a, b, out):
    """The product a @ b."""
    for i in range(len(out)):
        for j in range(out.shape[1]):
            out[i, j] = 0.0
        for k in range(a.shape[1]):
            factor = a[i, k]
            if factor != 0.0:
                for j in range(out.shape[1]):
                    out[i, j] += factor * b[k, j]


@kernel
def _multiply_transposed(a, b, out):
    """The product a^T @ b of 3 x 3 matrices."""
    for i in range(3):
        for j in range(3):
            out[i, j] = a[0, i] * b[0, j] + a[1, i] * b[1, j] + a[2, i] * b[2, j]


@kernel
def _put_cross(factor, x, y, z, matrix, row, column):
    """Write the cross-product matrix of a vector, times a factor, into a block of 3 x 3 whose diagonal is zero."""
    matrix[row, column + 1], matrix[row + 1, column] = -factor * z, factor * z
    matrix[row, column + 2], matrix[row + 2, column] = factor * y, -factor * y
    matrix[row + 1, column + 2], matrix[row + 2, column + 1] = -factor * x, factor * x


@kernel(allocates=True)
def integrate(dt, gyro, accel, densities, out):
    """Integrate the steps dt (m, s) of m intervals with samples (m, s + 1, 3) at their ends (equations 33 and 37).

    densities = (gyroscope, accelerometer), squared. out = (rotation (m, 3, 3), velocity (m, 3), position (m, 3), covariance (m, 9, 9),
    derivative by the biases (m, 9, 6)) of the state (rotation, velocity, position); A.9 to A.20 propagate the last two. Steps of no length are
    skipped.
    """
    rotation, velocity, position, covariance, by_bias = out
    increment, rotated, lever = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    change, by_noise = np.zeros((9, 9)), np.zeros((9, 6))
    once, by_before, force = np.zeros((9, 9)), np.zeros((9, 6)), np.zeros(3)
    for m in range(len(dt)):
        r, v, p = rotation[m], velocity[m], position[m]
        r[:], v[:], p[:], covariance[m], by_bias[m] = 0.0, 0.0, 0.0, 0.0, 0.0
        r[0, 0], r[1, 1], r[2, 2] = 1.0, 1.0, 1.0
        for s in range(dt.shape[1]):
            h = dt[m, s]
            if not h > 0.0:
                continue
            x = 0.5 * (gyro[m, s, 0] + gyro[m, s + 1, 0]) * h
            y = 0.5 * (gyro[m, s, 1] + gyro[m, s + 1, 1]) * h
            z = 0.5 * (gyro[m, s, 2] + gyro[m, s + 1, 2]) * h
            _exponential(x, y, z, increment)
            _multiply(r, increment, rotated)
            for i in range(3):
                force[i] = 0.0
                for k in range(3):
                    force[i] += 0.5 * (r[i, k] * accel[m, s, k] + rotated[i, k] * accel[m, s + 1, k])
            _cross(-force[0], -force[1], -force[2], r, lever)
            _transition(h, x, y, z, increment, lever, change)
            _noise_of_step(h, x, y, z, r, lever, by_noise)
            _multiply(change, covariance[m], once)
            _propagate(once, change, by_noise, densities, h, covariance[m])
            _multiply(change, by_bias[m], by_before)
            for i in range(9):
                for j in range(6):
                    by_bias[m, i, j] = by_before[i, j] - by_noise[i, j]
            for i in range(3):
                p[i] += v[i] * h + 0.5 * force[i] * h * h
                v[i] += force[i] * h
                for j in range(3):
                    r[i, j] = rotated[i, j]


@kernel
def _propagate(once, change, by_noise, densities, h, covariance):
    """Write once @ change^T + the noise of a step of h seconds."""
    for i in range(9):
        for j in range(9):
            total = 0.0
            for k in range(9):
                total += once[i, k] * change[j, k]
            for k in range(6):
                total += by_noise[i, k] * densities[k // 3] / h * by_noise[j, k]
            covariance[i, j] = total


@kernel
def _cross(x, y, z, matrix, out):
    """Cross product of a vector with each column."""
    for j in range(3):
        out[0, j] = y * matrix[2, j] - z * matrix[1, j]
        out[1, j] = z * matrix[0, j] - x * matrix[2, j]
        out[2, j] = x * matrix[1, j] - y * matrix[0, j]


@kernel
def _transition(h, x, y, z, increment, lever, change):
    """Transition of the error state over a step of h seconds that rotates by (x, y, z)."""
    change[:] = 0.0
    for i in range(3):
        change[3 + i, 3 + i], change[6 + i, 6 + i], change[6 + i, 3 + i] = 1.0, 1.0, h
        for j in range(3):
            change[i, j] = increment[j, i]
            change[3 + i, j], change[6 + i, j] = lever[i, j] * h, 0.5 * lever[i, j] * h * h


@kernel
def _noise_of_step(h, x, y, z, rotation, lever, by_noise):
    """Derivative of the error state by the errors of the measurements; half of a step's rotation comes before its mean force."""
    by_noise[:] = 0.0
    _put_cross(-0.5 * h, x, y, z, by_noise, 0, 0)
    for i in range(3):
        by_noise[i, i] = h
        for j in range(3):
            by_noise[3 + i, j], by_noise[6 + i, j] = (
                0.5 * lever[i, j] * h * h,
                0.25 * lever[i, j] * h * h * h,
            )
            by_noise[3 + i, 3 + j], by_noise[6 + i, 3 + j] = rotation[i, j] * h, 0.5 * rotation[i, j] * h * h


@kernel(allocates=True)
def compare(states, gravity, measured, differentiate, out):
    """Whitened residuals of m intervals, and their derivatives if wanted (equations 45 and A.21 to A.33).

    states = (rotation (m + 1, 3, 3), velocity, position, bias (m + 1, 6)), gravity = (vector, (3, 3) its derivatives by log scale and
    rotation), measured = (seconds, rotation, velocity, position, derivative by the biases, biases used in the integration (6,), whitening
    (m, 9, 9), lower triangular). out = (residual (m, 9); derivatives by the state at the beginning (m, 9, 15), at the end (m, 9, 9), and by
    scale and gravity (m, 9, 3)).
    """
    rotation, bias = states[0], states[3]
    seconds, measured_rotation, _, _, by_bias, integrated_at, whitening = measured
    residual, here, following, by_gravity = out
    back, there, off, expected = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    corrected, angle, speed, distance, one = np.zeros(9), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(9)
    blocks = np.zeros((9, 15)), np.zeros((9, 9)), np.zeros((9, 3))
    for m in range(len(seconds)):
        root = whitening[m]
        for i in range(9):
            corrected[i] = 0.0
            for k in range(6):
                corrected[i] += by_bias[m, i, k] * (bias[m, k] - integrated_at[k])
        for i in range(3):
            for j in range(3):
                back[i, j] = rotation[m, j, i]
        _exponential(corrected[0], corrected[1], corrected[2], off)
        _multiply(measured_rotation[m], off, expected)
        _multiply(back, rotation[m + 1], there)
        _multiply_transposed(expected, there, off)
        _logarithm(off, angle)
        _motion(m, states, gravity[0], back, seconds[m], speed, distance)
        _residual(m, measured, angle, speed, distance, corrected, one)
        for i in range(9):
            residual[m, i] = 0.0
            for k in range(i + 1):
                residual[m, i] += root[i, k] * one[k]
        if differentiate:
            vectors, matrices = (angle, speed, distance, corrected), (back, there, off)
            _differentiate(vectors, matrices, gravity[1], by_bias[m], seconds[m], blocks)
            _whiten(root, blocks[0], here[m])
            _whiten(root, blocks[1], following[m])
            _whiten(root, blocks[2], by_gravity[m])


@kernel
def _motion(m, states, gravity, back, dt, speed, distance):
    """Change of velocity and of position over an interval, without gravity, in the axes at its beginning."""
    _, velocity, position, _ = states
    for i in range(3):
        speed[i], distance[i] = 0.0, 0.0
        for k in range(3):
            faster = velocity[m + 1, k] - velocity[m, k] - gravity[k] * dt
            further = position[m + 1, k] - position[m, k] - velocity[m, k] * dt - 0.5 * gravity[k] * dt * dt
            speed[i] += back[i, k] * faster
            distance[i] += back[i, k] * further


@kernel
def _residual(m, measured, angle, speed, distance, corrected, out):
    """The motion of the states minus the measured one, which is corrected for the biases."""
    for i in range(3):
        out[i] = angle[i]
        out[3 + i] = speed[i] - measured[2][m, i] - corrected[3 + i]
        out[6 + i] = distance[i] - measured[3][m, i] - corrected[6 + i]


@kernel
def _whiten(root, block, out):
    """The product root @ block for a lower triangular root."""
    for i in range(9):
        for j in range(block.shape[1]):
            out[i, j] = 0.0
        for k in range(i + 1):
            for j in range(block.shape[1]):
                out[i, j] += root[i, k] * block[k, j]


@kernel(allocates=True)
def _differentiate(vectors, matrices, by_gravity, by_bias, dt, out):
    """Derivatives of one interval's residuals, before whitening.

    vectors = (residual rotation, change of velocity and of position in the first axes, correction for the biases), matrices = (rotation into
    the first axes, relative rotation, residual rotation).
    """
    angle, speed, distance, corrected = vectors
    back, there, off = matrices
    first, second, third = out
    right, jacobian = np.zeros((3, 3)), np.zeros((3, 3))
    once, rotated = np.zeros((3, 3)), np.zeros((3, 3))
    first[:], second[:], third[:] = 0.0, 0.0, 0.0
    _inverse_right_jacobian(angle[0], angle[1], angle[2], right)
    # The rotation correction exp(c) comes first: -J_r^-1(r) exp(r)^T J_r(c) dc/db.
    _right_jacobian(corrected[0], corrected[1], corrected[2], jacobian)
    _multiply_transposed(off, jacobian, once)
    _multiply(right, once, rotated)
    _put_cross(1.0, speed[0], speed[1], speed[2], first, 3, 0)
    _put_cross(1.0, distance[0], distance[1], distance[2], first, 6, 0)
    for i in range(3):
        for j in range(3):
            second[i, j] = right[i, j]
            second[3 + i, 3 + j], second[6 + i, 6 + j] = back[i, j], back[i, j]
            first[3 + i, 3 + j], first[6 + i, 3 + j], first[6 + i, 6 + j] = (
                -back[i, j],
                -back[i, j] * dt,
                -back[i, j],
            )
            for k in range(3):
                first[i, j] -= right[i, k] * there[j, k]
                third[3 + i, j] -= back[i, k] * by_gravity[k, j] * dt
                third[6 + i, j] -= 0.5 * back[i, k] * by_gravity[k, j] * dt * dt
        for j in range(6):
            first[3 + i, 9 + j], first[6 + i, 9 + j] = -by_bias[3 + i, j], -by_bias[6 + i, j]
            for k in range(3):
                first[i, 9 + j] -= rotated[i, k] * by_bias[k, j]


@kernel
def add_normal_equations(at, jacobian, residual, matrix, gradient):
    """Add J^T J and J^T r of m intervals, whose unknowns are the columns `at` (m, c), to a matrix and a gradient."""
    for m in range(len(at)):
        for r in range(jacobian.shape[1]):
            for i in range(at.shape[1]):
                factor = jacobian[m, r, i]
                if factor != 0.0:
                    gradient[at[m, i]] += factor * residual[m, r]
                    for j in range(at.shape[1]):
                        matrix[at[m, i], at[m, j]] += factor * jacobian[m, r, j]
