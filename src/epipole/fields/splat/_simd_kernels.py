"""SIMD code for a block of 4 x 4 pixels and one Gaussian, the innermost operation of blending.

The compiler does not vectorize a loop over pixels (measured on rows of 8, on one thread: 0.14 billion pixel-Gaussian
pairs per second against 1.3 billion). Alpha is computed as the eighth power of a polynomial of degree 4 in ln(alpha) /
8, whose relative error is at most 2.2e-5 from 1/255 to 0.99 (minimax, by reweighted least squares).
"""

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils

from epipole._simd_kernels import row_intrinsic
from epipole.fields._adam_kernels import LEAST, MOMENTUM, SQUARES
from epipole.fields.nerf._vector_kernels import (
    LANES,
    Row,
    Vector,
    constant,
    lanes_of,
    row_of,
    spread,
    table_of,
)

SIDE = 4
"""Pixels along the side of a block, which has as many pixels as a vector has lanes."""
ROW = 16
"""Floats of a voxel: one cache line."""
ACROSS = 4
"""Blocks along the side of a tile."""
PLANE = ACROSS * ACROSS * LANES
"""Pixels of a tile, and stride between the planes of its state."""
LARGEST_ALPHA, LEAST_ALPHA = np.float32(0.99), np.float32(1.0 / 255.0)
LARGEST_EIGHTH, LEAST_EIGHTH = np.log(LARGEST_ALPHA) / np.float32(8), np.log(LEAST_ALPHA) / np.float32(8)
POWERS = tuple(np.float32(v) for v in (0.02930516, 0.15935027, 0.49814505, 0.99982846, 0.99999723))
PIXEL_Y, PIXEL_X = (
    (SIDE * of_block[:, None] + of_lane).astype(np.float32).ravel()
    for of_block, of_lane in zip(
        np.divmod(np.arange(ACROSS * ACROSS), ACROSS), np.divmod(np.arange(LANES), SIDE)
    )
)
"""Pixel coordinates in a tile, block by block, in the order of a plane."""
SUMS = 10
"""Sums per Gaussian and tile: g, g dx, g dx^2, g dy, g dx dy, g dy^2 (g = dL/dpower), dL/dcolor (3), dL/ddepth."""


def _alpha(at, x, y, xx, xy, yy, peak):
    """dx, dy, unclamped ln(alpha) / 8, and alpha."""
    dx, dy = PIXEL_X[at : at + LANES] - np.float32(x), PIXEL_Y[at : at + LANES] - np.float32(y)
    eighth = dx * (xx * dx + xy * dy) + (yy * dy * dy + peak)
    t = np.minimum(eighth, LARGEST_EIGHTH)
    out = np.polyval(POWERS, np.maximum(t, LEAST_EIGHTH)).astype(np.float32)
    return dx, dy, eighth, np.where(t >= LEAST_EIGHTH, out**8, np.float32(0.0))


def _blend_block(state, at, x, y, xx, xy, yy, peak, red, green, blue, depth):
    alpha = _alpha(at, x, y, xx, xy, yy, peak)[-1]
    weight = alpha * state[at : at + LANES]
    state[at : at + LANES] -= weight
    for k, value in enumerate((red, green, blue, depth), 1):
        state[at + k * PLANE : at + k * PLANE + LANES] += weight * value


def _blend_block_backward(state, at, sums, x, y, xx, xy, yy, peak, red, green, blue, depth):
    dx, dy, eighth, alpha = _alpha(at, x, y, xx, xy, yy, peak)
    left, rest, *wanted = (state[at + k * PLANE : at + k * PLANE + LANES] for k in range(7))
    weight = alpha * left
    value = red * wanted[0] + green * wanted[1] + blue * wanted[2] + depth * wanted[3] + wanted[4]
    through = left.copy()
    left -= weight
    rest -= weight * value
    by_power = alpha * (through * value - rest / (np.float32(1.0) - alpha))
    by_power = np.where(eighth < LARGEST_EIGHTH, by_power, np.float32(0.0))
    terms = (1, dx, dx * dx, dy, dx * dy, dy * dy)
    for k, term in enumerate(terms):
        sums[k * LANES : (k + 1) * LANES] += by_power * term
    for k in range(4):
        sums[(6 + k) * LANES : (7 + k) * LANES] += weight * wanted[k]


def _touched_blocks(x, y, slope, reach, narrowing, down, half_height, last_row):
    column, row = np.divmod(np.arange(LANES, dtype=np.float32), np.float32(ACROSS))[::-1]
    first = np.maximum(row * SIDE - y, -half_height)
    last = np.minimum(np.minimum(row * SIDE + (SIDE - 1), last_row) - y, half_height)
    at_right, at_left = (np.minimum(np.maximum(end, first), last) for end in (down, -down))
    to_right, to_left = (
        np.sqrt(np.maximum(reach - narrowing * at * at, 0)) - sign * slope * at
        for at, sign in ((at_right, 1), (at_left, -1))
    )
    touches = (first <= last) & (x + to_right >= SIDE * column) & (x - to_left <= SIDE * column + (SIDE - 1))
    return int(touches @ (1 << np.arange(LANES)))


def _fetch(values, at):
    pass


def _lowest_bit(bits):
    return (bits & -bits).bit_length() - 1


def _written_alpha(
    builder: Any, at: Any, x: Any, y: Any, xx: Any, xy: Any, yy: Any, peak: Any
) -> tuple[Vector, Vector, Vector, Vector]:
    """Dx, dy, unclamped ln(alpha) / 8, and alpha."""
    dx = Row(builder, table_of(builder, "pixel_x", PIXEL_X), at).get(0) - spread(builder, x)
    dy = Row(builder, table_of(builder, "pixel_y", PIXEL_Y), at).get(0) - spread(builder, y)
    inner = spread(builder, xx).times_plus(dx, spread(builder, xy) * dy)
    eighth = dx.times_plus(inner, dy.times_plus(spread(builder, yy) * dy, spread(builder, peak)))
    t = eighth.least(LARGEST_EIGHTH)
    power = Vector(builder, constant(POWERS[0]))
    for c in POWERS[1:]:
        power = power.times_plus(t, c)
    power = power * power
    power = power * power
    return dx, dy, eighth, (power * power).where(">=", eighth, LEAST_EIGHTH)


@row_intrinsic(_touched_blocks)
def touched_blocks(typingctx, x, y, slope, reach, narrowing, down, half_height, last_row):
    """Bit mask of the blocks of a tile, row by row, that an ellipse centered at (x, y) touches.

    `down` is the height of its rightmost point below the center; its leftmost point is at the same height above. The
    sides are convex, so in a row of blocks each reaches farthest at the height nearest to its extreme point.
    """
    signature = types.int64(*[types.float32] * 8)

    def generate(context, builder, signature, arguments):
        # Both sides of each row of blocks share one vector (right, then left): the square root is the slowest step.
        rows = LANES // ACROSS
        low, slope, reach, narrowing, down, tall, end = (
            spread(builder, value, 2 * rows) for value in arguments[1:]
        )
        top = lanes_of(builder, np.tile(SIDE * np.arange(rows), 2))
        sign = lanes_of(builder, np.repeat([1, -1], rows))
        first = (top - low).largest(tall * -1.0)
        last = ((top + (SIDE - 1)).least(end) - low).least(tall)
        at = (down * sign).largest(first).least(last)
        out = (reach - narrowing * at * at).largest(0.0).root() - sign * slope * at
        out = out.where("<=", first, last, other=-np.inf)
        of_row, left = np.arange(LANES) // ACROSS, SIDE * (np.arange(LANES) % ACROSS)
        before = spread(builder, arguments[0]) - lanes_of(builder, left)
        touches = builder.and_(
            (before + out.taken(of_row.tolist())).compare(">=", 0.0),
            (before - out.taken((rows + of_row).tolist())).compare("<=", SIDE - 1),
        )
        bits = builder.bitcast(touches, ir.IntType(LANES))
        return builder.zext(bits, ir.IntType(64))

    return signature, generate


@row_intrinsic(_fetch)
def fetch(typingctx, values, at):
    """Prefetch values[at] of a flat array."""
    signature = types.void(values, types.int64)

    def generate(context, builder, signature, arguments):
        byte, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte, number, number, number])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0i8")
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        address = builder.bitcast(builder.gep(data, [arguments[1]]), byte)
        builder.call(function, [address, *(cgutils.int32_t(flag) for flag in (0, 3, 1))])
        return context.get_dummy_value()

    return signature, generate


@row_intrinsic(_lowest_bit)
def lowest_bit(typingctx, bits):
    """Index of the lowest set bit of a nonzero number."""
    signature = types.int64(types.int64)

    def generate(context, builder, signature, arguments):
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return signature, generate


@row_intrinsic(_blend_block)
def blend_block(typingctx, state, at, x, y, xx, xy, yy, peak, red, green, blue, depth):
    """Blend a Gaussian behind pixels state[at : at + 16]; planes: transmittance, red, green, blue, depth.

    (x, y) is the Gaussian's center in the tile.
    """
    signature = types.void(state, types.int64, *[types.float32] * 10)

    def generate(context, builder, signature, arguments):
        row = row_of(context, builder, signature.args[0], arguments[0], arguments[1])
        *_, alpha = _written_alpha(builder, *arguments[1:8])
        left = row.get(0)
        weight = alpha * left
        row.put(0, left - weight)
        for k in range(4):
            value = spread(builder, arguments[8 + k])
            row.put((k + 1) * PLANE, weight.times_plus(value, row.get((k + 1) * PLANE)))
        return context.get_dummy_value()

    return signature, generate


@row_intrinsic(_blend_block_backward)
def blend_block_backward(typingctx, state, at, sums, x, y, xx, xy, yy, peak, red, green, blue, depth):
    """Add the derivatives at pixels state[at : at + 16] to sums (SUMS, 16).

    Planes: transmittance, contribution to the loss of all Gaussians from this one on, and dL/d of red, green, blue,
    depth and coverage.
    """
    signature = types.void(state, types.int64, sums, *[types.float32] * 10)

    def generate(context, builder, signature, arguments):
        row = row_of(context, builder, signature.args[0], arguments[0], arguments[1])
        total = row_of(context, builder, signature.args[2], arguments[2], cgutils.intp_t(0))
        dx, dy, eighth, alpha = _written_alpha(builder, arguments[1], *arguments[3:9])
        color = [spread(builder, value) for value in arguments[9:13]]
        left, wanted = row.get(0), [row.get(k * PLANE) for k in range(2, 7)]
        weight = alpha * left
        row.put(0, left - weight)
        value = wanted[4]
        for one, by in zip(color, wanted):
            value = one.times_plus(by, value)
        rest = row.get(PLANE) - weight * value
        row.put(PLANE, rest)
        one = Vector(builder, constant(1.0))
        by_power = (alpha * (left * value - rest / (one - alpha))).where("<", eighth, LARGEST_EIGHTH)
        by_x, by_y = by_power * dx, by_power * dy
        parts = [by_power, by_x, by_x * dx, by_y, by_y * dx, by_y * dy, *(weight * by for by in wanted[:4])]
        for k, part in enumerate(parts):
            total.put(k * LANES, total.get(k * LANES) + part)
        return context.get_dummy_value()

    return signature, generate


def _sum_of_lanes(values, at):
    total, width = values[at : at + LANES].copy(), LANES // 2
    while width:
        total, width = total[:width] + total[width:], width // 2
    return total[0]


@row_intrinsic(_sum_of_lanes)
def sum_of_lanes(typingctx, values, at):
    """Sum of values[at : at + 16], by pairwise halving."""
    signature = types.float32(values, types.int64)

    def generate(context, builder, signature, arguments):
        total, width = row_of(context, builder, signature.args[0], *arguments).get(0).value, LANES // 2
        while width:
            kind = ir.VectorType(ir.IntType(32), width)
            split = (ir.Constant(kind, list(range(k, k + width))) for k in (0, width))
            total = builder.fadd(*(builder.shuffle_vector(total, total, half) for half in split))
            width //= 2
        return builder.extract_element(total, cgutils.int32_t(0))

    return signature, generate


def _add_row(out, at, values, row, weight):
    out[at : at + ROW] += weight * values[row : row + ROW]


@row_intrinsic(_add_row)
def add_row(typingctx, out, at, values, row, weight):
    """out[at : at + 16] += weight * values[row : row + 16], of flat arrays."""
    signature = types.void(out, types.int64, values, types.int64, types.float32)

    def generate(context, builder, signature, arguments):
        total = row_of(context, builder, signature.args[0], arguments[0], arguments[1])
        source = row_of(context, builder, signature.args[2], arguments[2], arguments[3])
        weight = spread(builder, arguments[4])
        for offset in range(0, ROW, LANES):
            total.put(offset, source.get(offset).times_plus(weight, total.get(offset)))
        return context.get_dummy_value()

    return signature, generate


def _adam_row(values, gradient, mean, square, at, rates):
    row = slice(at, at + ROW)
    mean[row] = MOMENTUM * mean[row] + (1 - MOMENTUM) * gradient[row]
    square[row] = SQUARES * square[row] + (1 - SQUARES) * gradient[row] * gradient[row]
    values[row] -= rates * mean[row] / (np.sqrt(square[row]) + LEAST)
    gradient[row] = 0.0


@row_intrinsic(_adam_row)
def adam_row(typingctx, values, gradient, mean, square, at, rates):
    """Adam step (Kingma and Ba, ICLR 2015) of numbers at : at + 16 of flat arrays; clears their gradient.

    Without bias correction, the first step of a number has the size of the learning rate for these betas.
    """
    signature = types.void(values, gradient, mean, square, types.int64, rates)

    def generate(context, builder, signature, arguments):
        rows = [row_of(context, builder, signature.args[k], arguments[k], arguments[4]) for k in range(4)]
        rates = row_of(context, builder, signature.args[5], arguments[5], cgutils.intp_t(0))
        moved, by, mean, square = rows
        for offset in range(0, ROW, LANES):
            g = by.get(offset)
            m = mean.get(offset) * MOMENTUM + g * (1 - MOMENTUM)
            v = square.get(offset) * SQUARES + g * g * (1 - SQUARES)
            mean.put(offset, m)
            square.put(offset, v)
            moved.put(offset, moved.get(offset) - rates.get(offset) * m / (v.root() + LEAST))
            by.put(offset, Vector(builder, constant(0.0)))
        return context.get_dummy_value()

    return signature, generate
