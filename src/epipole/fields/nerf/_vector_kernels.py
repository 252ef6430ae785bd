"""Words for code in vectors of the processor, as kernels have LLVM write it: what Numba's loops do not become."""

from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils

LANES = 16
"""Numbers of a vector: one register of AVX-512, two of AVX2."""
FLOAT = ir.FloatType()
VECTOR = ir.VectorType(FLOAT, LANES)


class Vector:
    """A vector of the code that is being written."""

    def __init__(self, builder: Any, value: Any) -> None:
        """Of a value of LLVM's."""
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
        """The product with a factor and a term, rounded once."""
        return self._call("fma", factor, term)

    def least(self, other: Any) -> "Vector":
        """The smaller of both, lane by lane."""
        return self._this_if("<", other)

    def largest(self, other: Any) -> "Vector":
        """The larger of both, lane by lane."""
        return self._this_if(">", other)

    def root(self) -> "Vector":
        """The square root."""
        return self._call("sqrt")

    def compare(self, relation: str, other: Any) -> Any:
        """Where its relation to another holds, lane by lane."""
        return self.builder.fcmp_ordered(relation, self.value, self._other(other))

    def where(self, relation: str, first: "Vector", second: Any, other: float = 0.0) -> "Vector":
        """Itself where the relation of first and second holds, else another number."""
        compare = first.compare(relation, second)
        return Vector(self.builder, self.builder.select(compare, self.value, self._other(other)))

    def taken(self, lanes: list[int]) -> "Vector":
        """These of its lanes, one after the other."""
        which = ir.Constant(ir.VectorType(ir.IntType(32), len(lanes)), list(lanes))
        return Vector(self.builder, self.builder.shuffle_vector(self.value, self.value, which))

    def _this_if(self, relation: str, other: Any) -> "Vector":
        # one instruction; that of LLVM's minnum and maxnum, which look for NaN, is three
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
    """One number in all lanes, known when the code is written."""
    return ir.Constant(ir.VectorType(FLOAT, lanes), [float(np.float32(value))] * lanes)


def lanes_of(builder: Any, values: np.ndarray) -> Vector:
    """Numbers known when the code is written."""
    return Vector(builder, ir.Constant(ir.VectorType(FLOAT, len(values)), values.astype(float).tolist()))


def spread(builder: Any, value: Any, lanes: int = LANES) -> Vector:
    """One number in all lanes, known when the code runs."""
    none = ir.Constant(ir.VectorType(FLOAT, lanes), ir.Undefined)
    return Vector(builder, builder.insert_element(none, value, cgutils.int32_t(0))).taken([0] * lanes)


class Row:
    """Vectors of a flat array, seen from one place in it."""

    def __init__(self, builder: Any, data: Any, at: Any) -> None:
        """Of where the array begins, and the place."""
        self.builder, self.data, self.at = builder, data, at

    def _pointer(self, offset: int) -> Any:
        at = self.builder.add(self.at, cgutils.intp_t(offset))
        return self.builder.bitcast(self.builder.gep(self.data, [at]), VECTOR.as_pointer())

    def get(self, offset: int) -> Vector:
        """The one that begins so much later."""
        return Vector(self.builder, self.builder.load(self._pointer(offset), align=4))

    def put(self, offset: int, value: Vector) -> None:
        """Write it."""
        self.builder.store(value.value, self._pointer(offset), align=4)


def row_of(context: Any, builder: Any, kind: Any, array: Any, at: Any) -> Row:
    """Of a flat array that a kernel holds."""
    return Row(builder, context.make_array(kind)(context, builder, array).data, at)


def table_of(builder: Any, name: str, values: np.ndarray) -> Any:
    """Where numbers lie that are known when the code is written."""
    kind = ir.ArrayType(FLOAT, len(values))
    table = cgutils.global_constant(builder, name, ir.Constant(kind, values.astype(float).tolist()))
    table.align = 4 * LANES
    return builder.bitcast(table, FLOAT.as_pointer())
