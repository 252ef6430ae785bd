"""Short rows of numbers as single SIMD vectors.

A row of 8 to 20 numbers is too short for the compiler to vectorize a loop over it: it unrolls the loop to scalar instructions,
four times as slow (measured on 8 lanes, AVX-512). These functions use vectors explicitly, with explicit fused multiply-add, as
the compiler would fuse differently wherever it inlines. `lanes` is a tuple with the length of the row; arithmetic is in double
precision, whatever the type of the rows.
"""

from inspect import unwrap
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from epipole._jit.as_python import run_as_python
from epipole._jit.mode import KernelMode, kernel_mode

_DOUBLE = ir.DoubleType()


def row_intrinsic(as_python: Any) -> Any:
    """Numba's `intrinsic`, or the given function if kernels run as Python.

    Functions may be wrapped by the type checks of a test run.
    """
    if kernel_mode() is KernelMode.PYTHON:
        return lambda _function: run_as_python(unwrap(as_python))
    return lambda function: intrinsic(unwrap(function))


def _pointer(context: Any, builder: Any, array_type: Any, array: Any, width: int) -> Any:
    """Pointer to the row as a vector."""
    data = context.make_array(array_type)(context, builder, array).data
    element = context.get_value_type(array_type.dtype)
    return builder.bitcast(data, ir.VectorType(element, width).as_pointer())


def _load(context: Any, builder: Any, array_type: Any, array: Any, width: int) -> Any:
    """The row as a vector of doubles."""
    pointer = _pointer(context, builder, array_type, array, width)
    value = builder.load(pointer, align=array_type.dtype.bitwidth // 8)
    if array_type.dtype == types.float32:
        value = builder.fpext(value, ir.VectorType(_DOUBLE, width))
    return value


def _store(context: Any, builder: Any, array_type: Any, array: Any, value: Any, width: int) -> None:
    if array_type.dtype == types.float32:
        value = builder.fptrunc(value, ir.VectorType(ir.FloatType(), width))
    pointer = _pointer(context, builder, array_type, array, width)
    builder.store(value, pointer, align=array_type.dtype.bitwidth // 8)


def _spread(builder: Any, value: Any, width: int) -> Any:
    """One number in all lanes."""
    one = builder.insert_element(
        ir.Constant(ir.VectorType(_DOUBLE, width), ir.Undefined), value, cgutils.int32_t(0)
    )
    return builder.shuffle_vector(one, one, ir.Constant(ir.VectorType(ir.IntType(32), width), [0] * width))


def _fused(builder: Any, a: Any, b: Any, c: Any, width: int) -> Any:
    """The sum a b + c, rounded once."""
    vector = ir.VectorType(_DOUBLE, width)
    kind = ir.FunctionType(vector, [vector] * 3)
    function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.fma.v{width}f64")
    return builder.call(function, [a, b, c])


def _combination(num_terms: int, *, adds: bool) -> Any:
    """Code for target (+)= sum of factor row, with the arguments target, factor, row, factor, row, ..., lanes."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kinds, width = signature.args, len(signature.args[-1])
        total = _load(context, builder, kinds[0], arguments[0], width) if adds else None
        for factor in range(1, 2 * num_terms, 2):
            row = _load(context, builder, kinds[factor + 1], arguments[factor + 1], width)
            spread = _spread(builder, arguments[factor], width)
            total = builder.fmul(spread, row) if total is None else _fused(builder, spread, row, total, width)
        _store(context, builder, kinds[0], arguments[0], total, width)
        return context.get_dummy_value()

    return generate


def _add_rows(target, *terms):
    width = len(terms[-1])
    target[:width] += _sum(terms, width)


def _set_rows(target, *terms):
    width = len(terms[-1])
    target[:width] = _sum(terms, width)


def _sum(terms, width):
    return sum(factor * row[:width].astype(float) for factor, row in zip(terms[0:-1:2], terms[1:-1:2]))


def _add_product(target, x, y, lanes):
    width = len(lanes)
    target[:width] += x[:width].astype(float) * y[:width]


def _subtract_product(block, x, y, height, lanes):
    width = len(lanes)
    block[:height, :width] -= x[:, :height].T.astype(float) @ y[:, :width].astype(float)


@row_intrinsic(_subtract_product)
def subtract_product(typingctx, block, x, y, height, lanes):
    """Rows 0 to height of the block -= x^T y, where x and y have three rows, all of len(lanes) numbers; y stays in registers."""
    signature = types.void(block, x, y, types.int64, lanes)

    def generate(context, builder, signature, arguments):
        kinds, width = signature.args, len(signature.args[-1])
        index = cgutils.intp_t

        def element(k, at):
            data = context.make_array(kinds[k])(context, builder, arguments[k]).data
            return builder.gep(data, [at])

        def as_row(k, at):
            vector = ir.VectorType(context.get_value_type(kinds[k].dtype), width)
            return builder.bitcast(element(k, at), vector.as_pointer())

        def load(k, pointer, width):
            value = builder.load(pointer, align=kinds[k].dtype.bitwidth // 8)
            if kinds[k].dtype == types.float32:
                value = builder.fpext(value, _DOUBLE if width is None else ir.VectorType(_DOUBLE, width))
            return value

        rows = [load(2, as_row(2, index(c * width)), width) for c in range(3)]
        with cgutils.for_range(builder, arguments[3], intp=index) as loop:
            target = as_row(0, builder.mul(loop.index, index(width)))
            total = load(0, target, width)
            for c, row in enumerate(rows):
                factor = load(1, element(1, builder.add(loop.index, index(c * width))), None)
                total = _fused(builder, _spread(builder, builder.fneg(factor), width), row, total, width)
            builder.store(total, target, align=8)
        return context.get_dummy_value()

    return signature, generate


@row_intrinsic(_add_rows)
def add_rows(typingctx, target, a, x, b, y, c, z, lanes):
    """Row target += a x + b y + c z."""
    double = types.float64
    return types.void(target, double, x, double, y, double, z, lanes), _combination(3, adds=True)


@row_intrinsic(_add_rows)
def add_two_rows(typingctx, target, a, x, b, y, lanes):
    """Row target += a x + b y."""
    double = types.float64
    return types.void(target, double, x, double, y, lanes), _combination(2, adds=True)


@row_intrinsic(_set_rows)
def set_rows(typingctx, target, a, x, b, y, c, z, lanes):
    """Row target = a x + b y + c z; target may be one of them."""
    double = types.float64
    return types.void(target, double, x, double, y, double, z, lanes), _combination(3, adds=False)


@row_intrinsic(_set_rows)
def scale_row(typingctx, target, a, x, lanes):
    """Row target = a x; target may be x."""
    return types.void(target, types.float64, x, lanes), _combination(1, adds=False)


@row_intrinsic(_set_rows)
def set_two_rows(typingctx, target, a, x, b, y, lanes):
    """Row target = a x + b y; target may be one of them."""
    double = types.float64
    return types.void(target, double, x, double, y, lanes), _combination(2, adds=False)


@row_intrinsic(_add_product)
def add_product(typingctx, target, x, y, lanes):
    """Row target += x y, lane by lane."""
    signature = types.void(target, x, y, lanes)

    def generate(context, builder, signature, arguments):
        kinds, width = signature.args, len(signature.args[-1])
        rows = [_load(context, builder, kinds[k], arguments[k], width) for k in range(3)]
        total = _fused(builder, rows[1], rows[2], rows[0], width)
        _store(context, builder, kinds[0], arguments[0], total, width)
        return context.get_dummy_value()

    return signature, generate
