"""Building blocks for SIMD code in LLVM IR, for loops that Numba does not vectorize."""

from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils

LANES = 16
"""Floats in a vector: one register of AVX-512, two of AVX2."""
FLOAT = ir.FloatType()
VECTOR = ir.VectorType(FLOAT, LANES)


class Vector:
    """A vector in the generated code."""

    def __init__(self, builder: Any, value: Any) -> None:
        """Wrap an LLVM value."""
        self.builder, self.value = builder, value

    def _other(self, other: Any) -> Any:
        return other.value if isinstance(other, Vector) else constant(other, self.value.type.count)

    def __add__(self, other: Any) -> "Vector":
        """The sum."""
        return Vector(self.builder, self.builder.fadd(self.value, self._other(other)))

    def __sub__(self, other: Any) -> "Vector":
        """The difference."""
        return Vector(self.builder, self.builder.fsub(self.value, self._other(other)))

    def __mul__(self, other: Any) -> "Vector":
        """The product."""
        return Vector(self.builder, self.builder.fmul(self.value, self._other(other)))

    def __truediv__(self, other: Any) -> "Vector":
        """The quotient."""
        return Vector(self.builder, self.builder.fdiv(self.value, self._other(other)))

    def times_plus(self, factor: Any, term: Any) -> "Vector":
        """Fused multiply-add."""
        return self._call("fma", factor, term)

    def least(self, other: Any) -> "Vector":
        """Elementwise minimum."""
        return self._this_if("<", other)

    def largest(self, other: Any) -> "Vector":
        """Elementwise maximum."""
        return self._this_if(">", other)

    def root(self) -> "Vector":
        """The square root."""
        return self._call("sqrt")

    def compare(self, relation: str, other: Any) -> Any:
        """Elementwise comparison with another vector."""
        return self.builder.fcmp_ordered(relation, self.value, self._other(other))

    def where(self, relation: str, first: "Vector", second: Any, other: float = 0.0) -> "Vector":
        """This vector where the comparison of first and second holds, elsewhere another number."""
        compare = first.compare(relation, second)
        return Vector(self.builder, self.builder.select(compare, self.value, self._other(other)))

    def taken(self, lanes: list[int]) -> "Vector":
        """Shuffle lanes."""
        which = ir.Constant(ir.VectorType(ir.IntType(32), len(lanes)), list(lanes))
        return Vector(self.builder, self.builder.shuffle_vector(self.value, self.value, which))

    def _this_if(self, relation: str, other: Any) -> "Vector":
        # One instruction; LLVM's minnum and maxnum, which handle NaN, take three.
        value = self._other(other)
        return Vector(self.builder, self.builder.select(self.compare(relation, other), self.value, value))

    def _call(self, name: str, *others: Any) -> "Vector":
        arguments, kind = [self.value, *(self._other(o) for o in others)], self.value.type
        function = cgutils.get_or_insert_function(
            self.builder.module,
            ir.FunctionType(kind, [kind] * len(arguments)),
            f"llvm.{name}.v{kind.count}f32",
        )
        return Vector(self.builder, self.builder.call(function, arguments))


def constant(value: Any, lanes: int = LANES) -> Any:
    """A compile-time constant in all lanes."""
    return ir.Constant(ir.VectorType(FLOAT, lanes), [float(np.float32(value))] * lanes)


def lanes_of(builder: Any, values: np.ndarray) -> Vector:
    """A compile-time constant vector."""
    return Vector(builder, ir.Constant(ir.VectorType(FLOAT, len(values)), values.astype(float).tolist()))


def spread(builder: Any, value: Any, lanes: int = LANES) -> Vector:
    """A run-time scalar in all lanes."""
    none = ir.Constant(ir.VectorType(FLOAT, lanes), ir.Undefined)
    return Vector(builder, builder.insert_element(none, value, cgutils.int32_t(0))).taken([0] * lanes)


class Row:
    """Vectors of a flat array, at offsets from an index."""

    def __init__(self, builder: Any, data: Any, at: Any) -> None:
        """Wrap the data pointer of an array and an index."""
        self.builder, self.data, self.at = builder, data, at

    def _pointer(self, offset: int) -> Any:
        at = self.builder.add(self.at, cgutils.intp_t(offset))
        return self.builder.bitcast(self.builder.gep(self.data, [at]), VECTOR.as_pointer())

    def get(self, offset: int) -> Vector:
        """Load the vector at an offset."""
        return Vector(self.builder, self.builder.load(self._pointer(offset), align=4))

    def put(self, offset: int, value: Vector) -> None:
        """Store a vector at an offset."""
        self.builder.store(value.value, self._pointer(offset), align=4)


def row_of(context: Any, builder: Any, kind: Any, array: Any, at: Any) -> Row:
    """Row of a flat array that is an argument of a kernel."""
    return Row(builder, context.make_array(kind)(context, builder, array).data, at)


def table_of(builder: Any, name: str, values: np.ndarray) -> Any:
    """Pointer to a constant table."""
    kind = ir.ArrayType(FLOAT, len(values))
    table = cgutils.global_constant(builder, name, ir.Constant(kind, values.astype(float).tolist()))
    table.align = 4 * LANES
    return builder.bitcast(table, FLOAT.as_pointer())
