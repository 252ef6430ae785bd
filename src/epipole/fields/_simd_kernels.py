"""A block of 4 x 4 pixels and one Gaussian, as vectors of the processor: what blending does most.

The compiler does not turn a loop over pixels into vector instructions by itself (measured on rows of 8: 0.14 billion pairs of a pixel and
a Gaussian a second on one thread against 1.3 billion). exp(p) is the eighth power of a polynomial of degree 6 of p / 8, for p from -6 to 0 within 4e-4
of itself; what is smaller is held at -12, where the polynomial still falls, for it is not drawn.
"""

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils

from epipole._simd_kernels import row_intrinsic

SIDE = 4
"""Pixels along the side of a block."""
LANES = SIDE * SIDE
MOMENTUM, SQUARES, LEAST = np.float32(0.9), np.float32(0.99), np.float32(1e-15)
"""Adam's betas and epsilon (Kingma and Ba, ICLR 2015)."""
ROW = 16
"""Numbers of a voxel: one cache line."""
ACROSS = 4
"""Blocks across a tile."""
PLANE = ACROSS * ACROSS * LANES
"""Pixels of a tile, block by block: numbers between a plane of its state and the next."""
LARGEST_ALPHA, LEAST_ALPHA = np.float32(0.99), np.float32(1.0 / 255.0)
LEAST_POWER = np.float32(-12.0)
POWERS = tuple(np.float32(v) for v in (1 / 720, 1 / 120, 1 / 24, 1 / 6, 0.5, 1.0, 1.0))
SUMS = 10
"""Kept of a Gaussian in a tile: of g, g dx, g dx^2, g dy, g dx dy, g dy^2 with g = dL/dpower, and dL/dcolour (3), dL/ddepth."""
_FLOAT = ir.FloatType()
_VECTOR = ir.VectorType(_FLOAT, LANES)


def _exp(p: Any) -> Any:
    y = p * np.float32(0.125)
    out = POWERS[0]
    for c in POWERS[1:]:
        out = out * y + c
    out = out * out
    out = out * out
    return out * out


def _alpha(x, y, half_a, b, half_c, opacity):
    lanes = np.arange(LANES, dtype=np.float32)
    dx, dy = np.float32(x) + lanes % SIDE, np.float32(y) + lanes // SIDE
    power = -(dx * (half_a * dx + b * dy) + half_c * dy * dy)
    return dx, dy, opacity * _exp(np.clip(power, LEAST_POWER, np.float32(0.0)))


def _blend_block(state, at, x, y, half_a, b, half_c, opacity, red, green, blue, depth):
    _, _, raw = _alpha(x, y, half_a, b, half_c, opacity)
    alpha = np.where(raw >= LEAST_ALPHA, np.minimum(raw, LARGEST_ALPHA), np.float32(0.0))
    weight = alpha * state[at : at + LANES]
    state[at : at + LANES] -= weight
    for k, value in enumerate((red, green, blue, depth), 1):
        state[at + k * PLANE : at + k * PLANE + LANES] += weight * value


def _unblend_block(state, at, sums, x, y, half_a, b, half_c, opacity, red, green, blue, depth):
    dx, dy, raw = _alpha(x, y, half_a, b, half_c, opacity)
    alpha = np.where(raw >= LEAST_ALPHA, np.minimum(raw, LARGEST_ALPHA), np.float32(0.0))
    left, rest, *wanted = (state[at + k * PLANE : at + k * PLANE + LANES] for k in range(7))
    weight = alpha * left
    value = red * wanted[0] + green * wanted[1] + blue * wanted[2] + depth * wanted[3] + wanted[4]
    through = left.copy()
    left -= weight
    rest -= weight * value
    by_power = alpha * (through * value - rest / (np.float32(1.0) - alpha))
    by_power = np.where(raw < LARGEST_ALPHA, by_power, np.float32(0.0))
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


class _Vector:
    """A vector of the code that is being written."""

    def __init__(self, builder: Any, value: Any) -> None:
        self.builder, self.value = builder, value

    def _other(self, other: Any) -> Any:
        return other.value if isinstance(other, _Vector) else _constant(other)

    def __add__(self, other: Any) -> "_Vector":
        return _Vector(self.builder, self.builder.fadd(self.value, self._other(other)))

    def __sub__(self, other: Any) -> "_Vector":
        return _Vector(self.builder, self.builder.fsub(self.value, self._other(other)))

    def __mul__(self, other: Any) -> "_Vector":
        return _Vector(self.builder, self.builder.fmul(self.value, self._other(other)))

    def __truediv__(self, other: Any) -> "_Vector":
        return _Vector(self.builder, self.builder.fdiv(self.value, self._other(other)))

    def times_plus(self, factor: Any, term: Any) -> "_Vector":
        """The product with a factor and a term, rounded once."""
        return self._call("fma", factor, term)

    def least(self, other: Any) -> "_Vector":
        """The smaller of both, lane by lane."""
        return self._call("minnum", other)

    def largest(self, other: Any) -> "_Vector":
        """The larger of both, lane by lane."""
        return self._call("maxnum", other)

    def root(self) -> "_Vector":
        """The square root."""
        return self._call("sqrt")

    def holds(self, relation: str, other: Any) -> Any:
        """Where its relation to another holds, lane by lane."""
        return self.builder.fcmp_ordered(relation, self.value, self._other(other))

    def where(self, relation: str, first: "_Vector", second: Any) -> "_Vector":
        """Itself where the relation of first and second holds, else 0."""
        holds = first.holds(relation, second)
        return _Vector(self.builder, self.builder.select(holds, self.value, _constant(0.0)))

    def _call(self, name: str, *others: Any) -> "_Vector":
        arguments = [self.value, *(self._other(o) for o in others)]
        kind = ir.FunctionType(_VECTOR, [_VECTOR] * len(arguments))
        function = cgutils.get_or_insert_function(self.builder.module, kind, f"llvm.{name}.v{LANES}f32")
        return _Vector(self.builder, self.builder.call(function, arguments))


def _constant(value: Any) -> Any:
    return ir.Constant(_VECTOR, [float(np.float32(value))] * LANES)


def _lanes(builder: Any, values: np.ndarray) -> _Vector:
    return _Vector(builder, ir.Constant(_VECTOR, values.astype(float).tolist()))


def _spread(builder: Any, value: Any) -> _Vector:
    """One number in all lanes."""
    one = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), value, cgutils.int32_t(0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    return _Vector(builder, builder.shuffle_vector(one, one, zeros))


class _Row:
    """A block's numbers in each plane of an array."""

    def __init__(self, context: Any, builder: Any, kind: Any, array: Any, at: Any) -> None:
        self.builder, self.at = builder, at
        self.data = context.make_array(kind)(context, builder, array).data

    def _pointer(self, offset: int) -> Any:
        at = self.builder.add(self.at, cgutils.intp_t(offset))
        return self.builder.bitcast(self.builder.gep(self.data, [at]), _VECTOR.as_pointer())

    def get(self, offset: int) -> _Vector:
        return _Vector(self.builder, self.builder.load(self._pointer(offset), align=4))

    def put(self, offset: int, value: _Vector) -> None:
        self.builder.store(value.value, self._pointer(offset), align=4)


def _written_alpha(
    builder: Any, x: Any, y: Any, half_a: Any, b: Any, half_c: Any, opacity: Any
) -> tuple[_Vector, _Vector, _Vector]:
    """Dx, dy, and alpha before it is bounded."""
    across, down = (_lanes(builder, part) for part in np.divmod(np.arange(LANES), SIDE)[::-1])
    dx, dy = _spread(builder, x) + across, _spread(builder, y) + down
    inner = _spread(builder, half_a).times_plus(dx, _spread(builder, b) * dy)
    minus_power = dx.times_plus(inner, _spread(builder, half_c) * dy * dy)
    t = (minus_power * -0.125).least(0.0).largest(LEAST_POWER * np.float32(0.125))
    power = _Vector(builder, _constant(POWERS[0]))
    for c in POWERS[1:]:
        power = power.times_plus(t, c)
    power = power * power
    power = power * power
    return dx, dy, power * power * _spread(builder, opacity)


@row_intrinsic(_touched_blocks)
def touched_blocks(typingctx, x, y, slope, reach, narrowing, down, half_height, last_row):
    """Which blocks of a tile an ellipse with its middle at (x, y) touches, one bit each, row by row.

    `down` is how far below its middle its rightmost point is, its leftmost is as far above. Its sides are curved outwards: in a row of blocks
    each is furthest at the height that is nearest to its own end.
    """
    signature = types.int64(*[types.float32] * 8)

    def generate(context, builder, signature, arguments):
        x, y, slope, reach, narrowing, down, half_height, last_row = (
            _spread(builder, value) for value in arguments
        )
        left, top = (_lanes(builder, SIDE * part) for part in np.divmod(np.arange(LANES), ACROSS)[::-1])
        zero, beyond = _Vector(builder, _constant(0.0)), SIDE - 1
        first = (top - y).largest(zero - half_height)
        last = ((top + beyond).least(last_row) - y).least(half_height)
        at_right, at_left = (end.largest(first).least(last) for end in (down, zero - down))
        aside = [(reach - narrowing * at * at).largest(0.0).root() for at in (at_right, at_left)]
        to_right, to_left = aside[0] - slope * at_right, zero - aside[1] - slope * at_left
        touches = first.holds("<=", last)
        touches = builder.and_(touches, (x + to_right).holds(">=", left))
        touches = builder.and_(touches, (x + to_left).holds("<=", left + beyond))
        bits = builder.bitcast(touches, ir.IntType(LANES))
        return builder.zext(bits, ir.IntType(64))

    return signature, generate


@row_intrinsic(_fetch)
def fetch(typingctx, values, at):
    """Begin to read values[at] of a flat array, which is wanted soon."""
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
    """The number of the lowest bit that is set, of a number that is not 0."""
    signature = types.int64(types.int64)

    def generate(context, builder, signature, arguments):
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return signature, generate


@row_intrinsic(_blend_block)
def blend_block(typingctx, state, at, x, y, half_a, b, half_c, opacity, red, green, blue, depth):
    """Pixels state[at : at + 16] behind which a Gaussian comes next; planes: transmittance, red, green, blue, depth.

    (x, y) is the first pixel's place seen from the Gaussian's middle.
    """
    signature = types.void(state, types.int64, *[types.float32] * 10)

    def generate(context, builder, signature, arguments):
        row = _Row(context, builder, signature.args[0], arguments[0], arguments[1])
        _, _, raw = _written_alpha(builder, *arguments[2:8])
        alpha = raw.least(LARGEST_ALPHA).where(">=", raw, LEAST_ALPHA)
        left = row.get(0)
        weight = alpha * left
        row.put(0, left - weight)
        for k in range(4):
            value = _spread(builder, arguments[8 + k])
            row.put((k + 1) * PLANE, weight.times_plus(value, row.get((k + 1) * PLANE)))
        return context.get_dummy_value()

    return signature, generate


@row_intrinsic(_unblend_block)
def unblend_block(typingctx, state, at, sums, x, y, half_a, b, half_c, opacity, red, green, blue, depth):
    """The same pixels' derivatives, added to sums (SUMS, 16).

    Planes: transmittance, what all Gaussians from here on give to the loss, and dL/d of red, green, blue, depth and coverage.
    """
    signature = types.void(state, types.int64, sums, *[types.float32] * 10)

    def generate(context, builder, signature, arguments):
        row = _Row(context, builder, signature.args[0], arguments[0], arguments[1])
        total = _Row(context, builder, signature.args[2], arguments[2], cgutils.intp_t(0))
        dx, dy, raw = _written_alpha(builder, *arguments[3:9])
        colour = [_spread(builder, value) for value in arguments[9:13]]
        alpha = raw.least(LARGEST_ALPHA).where(">=", raw, LEAST_ALPHA)
        left, wanted = row.get(0), [row.get(k * PLANE) for k in range(2, 7)]
        weight = alpha * left
        row.put(0, left - weight)
        value = wanted[4]
        for one, by in zip(colour, wanted):
            value = one.times_plus(by, value)
        rest = row.get(PLANE) - weight * value
        row.put(PLANE, rest)
        one = _Vector(builder, _constant(1.0))
        by_power = (alpha * (left * value - rest / (one - alpha))).where("<", raw, LARGEST_ALPHA)
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
    """Of values[at : at + 16]: each with the one half as many lanes further, and so on."""
    signature = types.float32(values, types.int64)

    def generate(context, builder, signature, arguments):
        total, width = _Row(context, builder, signature.args[0], *arguments).get(0).value, LANES // 2
        while width:
            kind = ir.VectorType(ir.IntType(32), width)
            halves = (ir.Constant(kind, list(range(k, k + width))) for k in (0, width))
            total = builder.fadd(*(builder.shuffle_vector(total, total, half) for half in halves))
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
        total = _Row(context, builder, signature.args[0], arguments[0], arguments[1])
        source = _Row(context, builder, signature.args[2], arguments[2], arguments[3])
        weight = _spread(builder, arguments[4])
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
    """Adam's step (Kingma and Ba, ICLR 2015) of numbers at : at + 16 of flat arrays, whose derivatives are cleared.

    What is moved for the first time moves by its rate: with these betas that needs no correction.
    """
    signature = types.void(values, gradient, mean, square, types.int64, rates)

    def generate(context, builder, signature, arguments):
        rows = [_Row(context, builder, signature.args[k], arguments[k], arguments[4]) for k in range(4)]
        rates = _Row(context, builder, signature.args[5], arguments[5], cgutils.intp_t(0))
        moved, by, mean, square = rows
        for offset in range(0, ROW, LANES):
            g = by.get(offset)
            m = mean.get(offset) * MOMENTUM + g * (1 - MOMENTUM)
            v = square.get(offset) * SQUARES + g * g * (1 - SQUARES)
            mean.put(offset, m)
            square.put(offset, v)
            moved.put(offset, moved.get(offset) - rates.get(offset) * m / (v.root() + LEAST))
            by.put(offset, _Vector(builder, _constant(0.0)))
        return context.get_dummy_value()

    return signature, generate
