"""Explicit SIMD kernels over rows of disparities.

Costs are bytes, path sums are 16-bit integers, and loops process 32 disparities at a time. Numba promotes integers as Python does, so
the compiler would not vectorize such loops. A row is a range of a flat array, given by the array and the index of its first element.
"""

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils

from epipole._simd_kernels import row_intrinsic

LANES = 32

_BYTE, _SHORT, _LONG = ir.IntType(8), ir.IntType(16), ir.IntType(64)
_BYTES, _SHORTS = ir.VectorType(_BYTE, LANES), ir.VectorType(_SHORT, LANES)


class _Code:
    """Emits LLVM code for rows; `kinds` and `values` are an intrinsic's arguments."""

    def __init__(self, context: Any, builder: Any, signature: Any, values: Any) -> None:
        self.context, self.builder = context, builder
        self.kinds, self.values = signature.args, values

    def data(self, argument: int) -> Any:
        """Pointer to the first element of an array."""
        kind = self.kinds[argument]
        return self.context.make_array(kind)(self.context, self.builder, self.values[argument]).data

    def items(self, argument: int) -> list[Any]:
        """The elements of a tuple."""
        return [
            self.builder.extract_value(self.values[argument], k) for k in range(len(self.kinds[argument]))
        ]

    def load(self, data: Any, at: Any, vector: Any = _BYTES) -> Any:
        pointer = self.builder.bitcast(self.builder.gep(data, [at]), vector.as_pointer())
        return self.builder.load(pointer, align=1)

    def store(self, value: Any, data: Any, at: Any) -> None:
        pointer = self.builder.bitcast(self.builder.gep(data, [at]), value.type.as_pointer())
        self.builder.store(value, pointer, align=1)

    def spread(self, value: Any, element: Any = _BYTE) -> Any:
        """Broadcast an integer to all lanes."""
        if value.type.width > element.width:
            value = self.builder.trunc(value, element)
        vector = ir.VectorType(element, LANES)
        one = self.builder.insert_element(ir.Constant(vector, ir.Undefined), value, cgutils.int32_t(0))
        zeros = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
        return self.builder.shuffle_vector(one, one, zeros)

    def call(self, name: str, *values: Any) -> Any:
        """Call an LLVM vector intrinsic."""
        vector = values[0].type
        suffix = f"v{LANES}i{vector.element.width}"
        kind = ir.FunctionType(vector, [vector] * len(values))
        function = cgutils.get_or_insert_function(self.builder.module, kind, f"llvm.{name}.{suffix}")
        return self.builder.call(function, values)

    def least(self, vector: Any) -> Any:
        """The smallest lane."""
        element = vector.type.element
        name = f"llvm.vector.reduce.umin.v{LANES}i{element.width}"
        kind = ir.FunctionType(element, [vector.type])
        function = cgutils.get_or_insert_function(self.builder.module, kind, name)
        return self.builder.zext(self.builder.call(function, [vector]), _LONG)

    def long(self, value: int) -> Any:
        return ir.Constant(_LONG, value)


def _count_bits(left, at_left, right, at_right, width, planes, out, at_out, blocks):
    total, count = np.zeros(blocks * LANES, np.uint8), blocks * LANES
    for p in range(planes):
        start = at_right + p * width
        total += np.bitwise_count(left[at_left + p] ^ right[start : start + count])
    out[at_out : at_out + count] = total


def _extend_paths(paths, at_before, least, jump, step, costs, at_cost, at_now, sums, at_sums, blocks):
    count, total, found = blocks * LANES, 0, []
    cost = costs[at_cost : at_cost + count].astype(np.int64)
    for before, low, far, now in zip(at_before, least, jump, at_now):
        row = paths[before - 1 : before + count + 1].astype(np.int64)
        beside = np.minimum(np.minimum(row[:-2], row[2:]) + step, 255)
        best = np.minimum(np.minimum(row[1:-1], beside), min(low + far, 255))
        path = np.minimum((best - low) % 256 + cost, 255)
        paths[now : now + count] = path
        found.append(int(path.min()))
        total = total + path
    sums[at_sums : at_sums + count] = total
    return tuple(found)


def _least_two(sums, at_sums, more, at_more, blocks):
    row, added = sums[at_sums : at_sums + blocks * LANES], more[at_more : at_more + blocks * LANES]
    first = int(np.argmin(row))
    row += added
    at = int(np.argmin(row))
    is_far = np.abs(np.arange(len(row)) - at) > 1
    return at, int(row[at]), int(np.where(is_far, row, 65535).min()), first, int(np.argmin(added))


def _keep_lower(sums, at_sums, best, winners, at_best, blocks):
    row, kept = sums[at_sums : at_sums + blocks * LANES], slice(at_best, at_best + blocks * LANES)
    is_lower = row < best[kept]
    winners[kept] = np.where(is_lower, np.arange(len(row)), winners[kept])
    best[kept] = np.minimum(row, best[kept])


@row_intrinsic(_count_bits)
def count_bits(typingctx, left, at_left, right, at_right, width, planes, out, at_out, blocks):
    """Row of costs: out[at_out + d] = Hamming distance of left[at_left + p] and right[at_right + p width + d] over p < planes."""
    long = types.int64
    signature = types.void(left, long, right, long, long, long, out, long, long)

    def generate(context, builder, signature, values):
        code = _Code(context, builder, signature, values)
        left, right, out = code.data(0), code.data(2), code.data(6)
        at_left, at_right, width, planes, at_out = values[1], values[3], values[4], values[5], values[7]
        total = cgutils.alloca_once(builder, _BYTES)
        with cgutils.for_range(builder, values[8]) as block:
            step = builder.mul(block.index, code.long(LANES))
            builder.store(ir.Constant(_BYTES, [0] * LANES), total)
            with cgutils.for_range(builder, planes) as plane:
                one = builder.load(builder.gep(left, [builder.add(at_left, plane.index)]))
                slot = builder.add(builder.add(at_right, step), builder.mul(plane.index, width))
                bits = code.call("ctpop", builder.xor(code.spread(one), code.load(right, slot)))
                builder.store(builder.add(builder.load(total), bits), total)
            code.store(builder.load(total), out, builder.add(at_out, step))
        return context.get_dummy_value()

    return signature, generate


@row_intrinsic(_extend_paths)
def extend_paths(
    typingctx, paths, at_before, least, jump, step, costs, at_cost, at_now, sums, at_sums, blocks
):
    """Advance several paths by one pixel: L(d) = C(d) + min(L'(d), L'(d +- 1) + P1, min L' + P2) - min L'.

    Hirschmueller (PAMI 2008, eq. 13). paths: bytes with L' at at_before[k], to which L is written at at_now[k]; each row is enclosed
    by bytes of 255. least: min L' of each path; jump: its P2; step: P1. The sum over the paths is written to sums. Returns the
    minimum of each L. Values fit into a byte as long as C + P2 < 256.
    """
    long, count = types.int64, len(at_before)
    several = types.UniTuple(long, count)
    signature = several(paths, several, several, several, long, costs, long, several, sums, long, long)

    def generate(context, builder, signature, values):
        code = _Code(context, builder, signature, values)
        paths, costs, sums = code.data(0), code.data(5), code.data(8)
        at_before, least, jump, at_now = (code.items(k) for k in (1, 2, 3, 7))
        step, low = code.spread(values[4]), [code.spread(value) for value in least]
        reach = [code.call("uadd.sat", a, code.spread(b)) for a, b in zip(low, jump)]
        full = ir.Constant(_BYTES, [255] * LANES)
        nearest = [cgutils.alloca_once_value(builder, full) for _ in range(count)]
        with cgutils.for_range(builder, values[10]) as block:
            d = builder.mul(block.index, code.long(LANES))
            cost = code.load(costs, builder.add(values[6], d))
            total = None
            for k in range(count):
                slot = builder.add(at_before[k], d)
                below = code.load(paths, builder.sub(slot, code.long(1)))
                above = code.load(paths, builder.add(slot, code.long(1)))
                beside = code.call("uadd.sat", code.call("umin", below, above), step)
                best = code.call("umin", code.call("umin", code.load(paths, slot), beside), reach[k])
                path = code.call("uadd.sat", builder.sub(best, low[k]), cost)
                code.store(path, paths, builder.add(at_now[k], d))
                builder.store(code.call("umin", builder.load(nearest[k]), path), nearest[k])
                wide = builder.zext(path, _SHORTS)
                total = wide if total is None else builder.add(total, wide)
            code.store(total, sums, builder.add(values[9], d))
        found = [code.least(builder.load(value)) for value in nearest]
        return context.make_tuple(builder, signature.return_type, found)

    return signature, generate


class _Lowest:
    """Running minimum of a row and its first index, block by block."""

    def __init__(self, code: _Code) -> None:
        self.code, self.builder = code, code.builder
        self.full = ir.Constant(_SHORTS, [65535] * LANES)
        self.value = cgutils.alloca_once_value(self.builder, self.full)
        self.slot = cgutils.alloca_once_value(self.builder, self.full)

    def see(self, block: Any, positions: Any) -> None:
        before, builder = self.builder.load(self.value), self.builder
        is_lower = builder.icmp_unsigned("<", block, before)
        builder.store(builder.select(is_lower, block, before), self.value)
        builder.store(builder.select(is_lower, positions, builder.load(self.slot)), self.slot)

    def found(self) -> tuple[Any, Any]:
        """(index, value)."""
        values, builder = self.builder.load(self.value), self.builder
        lowest = self.code.least(values)
        is_lowest = builder.icmp_unsigned("==", values, self.code.spread(lowest, _SHORT))
        return self.code.least(builder.select(is_lowest, builder.load(self.slot), self.full)), lowest


@row_intrinsic(_least_two)
def least_two(typingctx, sums, at_sums, more, at_more, blocks):
    """(d, lowest, second, d1, d2) of the row sums += more: index and value of its minimum, and the minimum not adjacent to it.

    d1 and d2: indices of the minima of sums before the addition, and of more. Of equal values the first index is returned.
    """
    long = types.int64
    signature = types.UniTuple(long, 5)(sums, long, more, long, long)

    def generate(context, builder, signature, values):
        code = _Code(context, builder, signature, values)
        sums, more = code.data(0), code.data(2)
        lanes = ir.Constant(_SHORTS, list(range(LANES)))
        both, first, other = _Lowest(code), _Lowest(code), _Lowest(code)
        with cgutils.for_range(builder, values[4]) as block:
            step = builder.mul(block.index, code.long(LANES))
            slot = builder.add(values[1], step)
            row, added = (
                code.load(sums, slot, _SHORTS),
                code.load(more, builder.add(values[3], step), _SHORTS),
            )
            disparity = builder.add(code.spread(step, _SHORT), lanes)
            first.see(row, disparity)
            other.see(added, disparity)
            row = builder.add(row, added)
            both.see(row, disparity)
            code.store(row, sums, slot)
        at, lowest = both.found()
        best = cgutils.alloca_once_value(builder, both.full)
        near = code.spread(builder.sub(at, code.long(1)), _SHORT)
        with cgutils.for_range(builder, values[4]) as block:
            step = builder.mul(block.index, code.long(LANES))
            row = code.load(sums, builder.add(values[1], step), _SHORTS)
            away = builder.sub(
                builder.add(code.spread(step, _SHORT), lanes), near
            )  # 0, 1, 2: the minimum and its neighbors
            is_far = builder.icmp_unsigned(">", away, ir.Constant(_SHORTS, [2] * LANES))
            row = builder.select(is_far, row, both.full)
            builder.store(code.call("umin", builder.load(best), row), best)
        found = [at, lowest, code.least(builder.load(best)), first.found()[0], other.found()[0]]
        return context.make_tuple(builder, signature.return_type, found)

    return signature, generate


@row_intrinsic(_keep_lower)
def keep_lower(typingctx, sums, at_sums, best, winners, at_best, blocks):
    """Where sums[d] < best[at_best + d], store it there, and d in winners[at_best + d]."""
    long = types.int64
    signature = types.void(sums, long, best, winners, long, long)

    def generate(context, builder, signature, values):
        code = _Code(context, builder, signature, values)
        sums, best, winners = code.data(0), code.data(2), code.data(3)
        lanes = ir.Constant(_SHORTS, list(range(LANES)))
        with cgutils.for_range(builder, values[5]) as block:
            step = builder.mul(block.index, code.long(LANES))
            slot = builder.add(values[4], step)
            row = code.load(sums, builder.add(values[1], step), _SHORTS)
            before = code.load(best, slot, _SHORTS)
            disparity = builder.add(code.spread(step, _SHORT), lanes)
            is_lower = builder.icmp_unsigned("<", row, before)
            code.store(builder.select(is_lower, row, before), best, slot)
            kept = code.load(winners, slot, _SHORTS)
            code.store(builder.select(is_lower, disparity, kept), winners, slot)
        return context.get_dummy_value()

    return signature, generate
