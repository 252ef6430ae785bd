"""Top two similarities of byte descriptors, with the processor's products of whole numbers (VNNI, else AVX2).

x86 processors with VNNI multiply 4 x 16 (or 4 x 8) bytes and accumulate them as integers in one instruction: four
times the throughput of a float32 product, and exact. AVX2 alone multiplies 2 x 8 words of 16 bits: twice that of a float32
product. `tile_top_two` is the micro-kernel: ROWS descriptors of image 1 against VECTORS * LANES of image 2, in registers.
The best and second best of each row and the best of each column are updated on the fly, so similarities are never written to
memory.

    a . b = (a - SHIFT) . b + SHIFT * sum(b)  VNNI multiplies signed by unsigned bytes; words need no shift
    key   = similarity << GROUP_BITS | rank   larger key: larger similarity, then earlier column

`_matching_kernels.top_two` gives the same numbers on any processor, from a float32 product.
"""

from contextlib import suppress

import numpy as np
from llvmlite import binding, ir
from numba import types
from numba.extending import intrinsic

from epipole._jit import kernel
from epipole._jit.mode import KernelMode, kernel_mode

WIDTH = 128  # bytes of a descriptor
VECTORS = 2
GROUP_BITS = 13
GROUP_MASK = (1 << GROUP_BITS) - 1
MOST_SIMILARITY = 1 << (32 - GROUP_BITS)


def _cpu_features():
    """What the processor has; nothing in Python, or where that is unknown."""
    if kernel_mode() is KernelMode.PYTHON:
        return {}
    try:
        return binding.get_host_cpu_features()
    except RuntimeError:  # unknown on this platform
        return {}


def _byte_lanes(features):
    """Integers per register of the byte dot product; 0 if the processor has none."""
    if features.get("avx512vnni") and features.get("avx512vl"):
        return 16
    return 8 if features.get("avxvnni") else 0


def _dot_in(module, lanes, factors):
    """The VNNI instruction, declared in a module for vectors of these factors."""
    words = ir.VectorType(ir.IntType(32), lanes)
    name = f"llvm.x86.avx512.vpdpbusd.{32 * lanes}"
    return module.declare_intrinsic(name, fnty=ir.FunctionType(words, [words, factors, factors]))


def _byte_factors(lanes):
    """Type of the factors in this LLVM: bytes or, up to version 21, words; None if unsupported."""
    for kind in (ir.VectorType(ir.IntType(8), 4 * lanes), ir.VectorType(ir.IntType(32), lanes)):
        module = ir.Module()
        dot = _dot_in(module, lanes, kind)
        builder = ir.IRBuilder(ir.Function(module, dot.ftype, "trial").append_basic_block())
        builder.ret(builder.call(dot, builder.function.args))
        with suppress(RuntimeError):
            binding.parse_assembly(str(module)).verify()
            return kind
    return None


FEATURES = _cpu_features()
LANES = _byte_lanes(FEATURES)
FACTORS = _byte_factors(LANES) if LANES else None
if FACTORS is not None:  # four bytes per lane and step
    GROUP, SHIFT, ROWS = 4, 128, 8
    ROW_TYPE, COLUMN_TYPE = np.int8, np.uint8
else:  # two words; 16 registers hold the sums of four rows
    GROUP, SHIFT, ROWS = 2, 0, 4
    ROW_TYPE = COLUMN_TYPE = np.int16
    LANES = 8 if FEATURES.get("avx2") else 0
    FACTORS = ir.VectorType(ir.IntType(16), 2 * LANES) if LANES else None
STEPS = WIDTH // GROUP
ROW_BYTES = WIDTH * 4 // GROUP
COLUMNS = VECTORS * LANES
MOST_COLUMNS = LANES << GROUP_BITS


def _emit_tile(builder, address, tile):
    """Emit the LLVM code of the micro-kernel; `address` maps a name to the pointer of that array."""
    word, long = ir.IntType(32), ir.IntType(64)
    words = ir.VectorType(word, LANES)
    size = 4 * LANES
    if GROUP == 4:
        dot = _dot_in(builder.module, LANES, FACTORS)
    else:
        kind = ir.FunctionType(words, [FACTORS, FACTORS])
        dot = builder.module.declare_intrinsic("llvm.x86.avx2.pmadd.wd", fnty=kind)
    pairs = [(r, v) for r in range(ROWS) for v in range(VECTORS)]

    def slot(name, offset, kind):
        offset = ir.Constant(long, offset) if isinstance(offset, int) else offset
        return builder.bitcast(builder.gep(address[name], [offset]), kind.as_pointer())

    def load(name, offset, kind):
        value = builder.load(slot(name, offset, kind))
        value.align = 1
        return value

    def store(value, name, offset):
        builder.store(value, slot(name, offset, words)).align = 1

    def splat(value):
        nothing = ir.Constant(words, ir.Undefined)
        first = builder.insert_element(nothing, value, ir.Constant(word, 0))
        return builder.shuffle_vector(first, nothing, ir.Constant(words, [0] * LANES))

    def larger(x, y):
        return builder.select(builder.icmp_unsigned(">", x, y), x, y)

    def smaller(x, y):
        return builder.select(builder.icmp_unsigned("<", x, y), x, y)

    def add_products(total, column, row):
        if GROUP == 4:
            return builder.call(dot, [total, column, row])
        return builder.add(total, builder.call(dot, [column, row]))

    # sums[r, v] = bias[v] + sum over the steps of GROUP numbers of row r times those of each column of v
    before, bias = builder.block, [load("bias", size * v, words) for v in range(VECTORS)]
    loop, after = builder.append_basic_block("steps"), builder.append_basic_block("top_two")
    builder.branch(loop)
    builder.position_at_end(loop)
    step = builder.phi(long)
    step.add_incoming(ir.Constant(long, 0), before)
    sums = {pair: builder.phi(words) for pair in pairs}
    column_step = builder.mul(step, ir.Constant(long, size * VECTORS))
    columns = [
        load("columns", builder.add(column_step, ir.Constant(long, size * v)), FACTORS)
        for v in range(VECTORS)
    ]
    row_step = builder.mul(step, ir.Constant(long, 4))
    rows = [
        builder.bitcast(
            splat(load("rows", builder.add(row_step, ir.Constant(long, ROW_BYTES * r)), word)), FACTORS
        )
        for r in range(ROWS)
    ]
    added = {(r, v): add_products(sums[r, v], columns[v], rows[r]) for r, v in pairs}
    for r, v in pairs:
        sums[r, v].add_incoming(bias[v], before)
        sums[r, v].add_incoming(added[r, v], loop)
    following = builder.add(step, ir.Constant(long, 1))
    step.add_incoming(following, loop)
    builder.cbranch(builder.icmp_unsigned("<", following, ir.Constant(long, STEPS)), loop, after)

    builder.position_at_end(after)
    for v in range(VECTORS):
        highest = load("column_best", size * v, words)
        for r in range(ROWS):
            highest = larger(highest, added[r, v])
        store(highest, "column_best", size * v)
    first_group = builder.mul(builder.trunc(tile, word), ir.Constant(word, VECTORS))
    shift = ir.Constant(words, [GROUP_BITS] * LANES)
    for r in range(ROWS):
        best, second = load("best", size * r, words), load("second", size * r, words)
        for v in range(VECTORS):
            rank = builder.sub(ir.Constant(word, GROUP_MASK - v), first_group)
            key = builder.or_(builder.shl(added[r, v], shift), splat(rank))
            second = larger(second, smaller(key, best))
            best = larger(best, key)
        store(best, "best", size * r)
        store(second, "second", size * r)


@intrinsic
def tile_top_two(_context, rows, columns, bias, best, second, column_best, tile):
    """Process one tile; all arrays are given by address.

    rows (ROWS, 128) ROW_TYPE, columns (STEPS, COLUMNS, GROUP) COLUMN_TYPE, bias (COLUMNS,): SHIFT * sum(b);
    best, second (ROWS, LANES): running keys; column_best (COLUMNS,): running similarities; tile: its index.
    """
    names = ("rows", "columns", "bias", "best", "second", "column_best")

    def generate(context, builder, _signature, arguments):
        address = {
            name: builder.inttoptr(value, ir.IntType(8).as_pointer()) for name, value in zip(names, arguments)
        }
        _emit_tile(builder, address, arguments[-1])
        return context.get_dummy_value()

    return types.void(*[types.uintp] * len(names), types.intp), generate


@kernel
def most_squared_length(descriptors):
    """Largest sum of squares of a row of bytes."""
    most = np.int32(0)
    for i in range(len(descriptors)):
        row, total = descriptors[i], np.int32(0)
        for k in range(len(row)):
            total += np.int32(row[k]) * np.int32(row[k])
        most = max(most, total)
    return most


@kernel
def pack_rows(descriptors, rows):
    """Descriptors (n, 128) minus SHIFT, in the layout of `byte_top_two`; rows beyond n are padded as zero descriptors."""
    for i in range(rows.shape[0] * ROWS):
        out = rows[i // ROWS, i % ROWS]
        for k in range(WIDTH):
            value = np.int16(descriptors[i, k]) if i < len(descriptors) else np.int16(0)
            out[k] = ROW_TYPE(value - np.int16(SHIFT))


@kernel
def pack_columns(descriptors, columns, bias):
    """Descriptors (m, 128) in groups, as for `byte_top_two`, and SHIFT times their sums; zeros beyond m."""
    for j in range(columns.shape[0] * COLUMNS):
        tile, lane, total = columns[j // COLUMNS], j % COLUMNS, np.uint32(0)
        for step in range(STEPS):
            for k in range(GROUP):
                value = descriptors[j, GROUP * step + k] if j < len(descriptors) else np.uint8(0)
                tile[step, lane, k] = value
                total += np.uint32(value)
        bias[j // COLUMNS, lane] = np.uint32(SHIFT) * total


@kernel(allocates=True)
def byte_top_two(rows, columns, bias, best, second, best_column, column_best):
    """Best, second best and the best's column for every row; the best for every column.

    rows (n / ROWS, ROWS, 128), columns (tiles, STEPS, COLUMNS, GROUP), bias and column_best (tiles, COLUMNS) uint32,
    best and second (n,) uint32, best_column (n,) int32.
    """
    lane_best, lane_second = np.empty((ROWS, LANES), np.uint32), np.empty((ROWS, LANES), np.uint32)
    for block in range(len(rows)):
        lane_best[:] = 0
        lane_second[:] = 0
        for tile in range(len(columns)):
            tile_top_two(
                rows[block].ctypes.data,
                columns[tile].ctypes.data,
                bias[tile].ctypes.data,
                lane_best.ctypes.data,
                lane_second.ctypes.data,
                column_best[tile].ctypes.data,
                tile,
            )
        for r in range(ROWS):
            high, low, lane = np.uint32(0), np.uint32(0), 0
            for c in range(LANES):
                if lane_best[r, c] > high:
                    low = max(high, lane_second[r, c])
                    high, lane = lane_best[r, c], c
                else:
                    low = max(low, lane_best[r, c])
            at = block * ROWS + r
            best[at], second[at] = high >> GROUP_BITS, low >> GROUP_BITS
            best_column[at] = (GROUP_MASK - (high & GROUP_MASK)) * LANES + lane
