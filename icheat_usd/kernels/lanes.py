"""Arithmetic with 16 floats at once that only some kernels need, beside that of `kernels.simd`."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types

from icheat_usd.kernels.simd import _call, _operation, _picked, color, floats

_LANES = ir.VectorType(ir.FloatType(), 16)
_I16, _I32, _I64 = ir.IntType(16), ir.IntType(32), ir.IntType(64)


@_operation(floats, floats, floats)
def minus(builder: Any, values: Any) -> Any:
    """``a - b``."""
    return builder.fsub(*values)


@_operation(floats, floats, floats)
def ratio(builder: Any, values: Any) -> Any:
    """``a / b``, as IEEE arithmetic has it where b is 0."""
    return builder.fdiv(*values)


@_operation(floats, floats)
def root(builder: Any, values: Any) -> Any:
    """Square roots."""
    return _call(builder, "llvm.sqrt.v16f32", _LANES, values[0])


@_operation(floats, floats, floats, floats, floats)
def where_above(builder: Any, values: Any) -> Any:
    """Place by place, the third where the first is above the second, else the fourth; NaN is above nothing."""
    return builder.select(builder.fcmp_ordered(">", values[0], values[1]), values[2], values[3])


@_operation(types.void, types.int64, floats)
def store_whole(builder: Any, values: Any) -> None:
    """Whole numbers as 16 int32 to an address."""
    kind = ir.VectorType(ir.IntType(32), 16)
    place = builder.inttoptr(values[0], kind.as_pointer())
    builder.store(builder.fptosi(values[1], kind), place, align=4)


# Colours as four bfloat16, in 8 bytes: the leading half of each float32


@_operation(types.void, types.int64, color)
def store_short(builder: Any, values: Any) -> None:
    """A colour to an address, rounded to the nearest numbers of 8 significant bits."""
    wide, half = ir.VectorType(_I32, 4), ir.VectorType(_I16, 4)
    up = builder.add(builder.bitcast(values[1], wide), ir.Constant(wide, [0x8000] * 4))
    short = builder.trunc(builder.lshr(up, ir.Constant(wide, [16] * 4)), half)
    builder.store(short, builder.inttoptr(values[0], half.as_pointer()), align=8)


@_operation(floats, types.int64)
def load_short(builder: Any, values: Any) -> Any:
    """16 bfloat16 from an address."""
    wide, half = ir.VectorType(_I32, 16), ir.VectorType(_I16, 16)
    short = builder.load(builder.inttoptr(values[0], half.as_pointer()), align=2)
    return builder.bitcast(builder.shl(builder.zext(short, wide), ir.Constant(wide, [16] * 16)), _LANES)


@_operation(floats, types.int64, types.int64, types.int64, floats)
def add_short_fours(builder: Any, values: Any) -> Any:
    """Add four weighted colours, each in four lanes of its own.

    Addresses of four uint32, which are the weights as float32 and in the bits of a mask number colours; of the first
    colour; the mask; the sums so far.
    """
    entries, colors, mask, sums = values
    four = ir.VectorType(_I32, 4)
    numbers = builder.load(builder.inttoptr(entries, four.as_pointer()), align=4)
    mask = builder.trunc(mask, _I32)
    found = ir.Constant(ir.VectorType(_I64, 4), ir.Undefined)
    for lane in range(4):
        at = ir.Constant(_I32, lane)
        number = builder.zext(builder.and_(builder.extract_element(numbers, at), mask), _I64)
        place = builder.add(colors, builder.shl(number, ir.Constant(_I64, 3)))
        color = builder.load(builder.inttoptr(place, _I64.as_pointer()), align=8)
        found = builder.insert_element(found, color, at)
    wide = ir.VectorType(_I32, 16)
    whole = builder.zext(builder.bitcast(found, ir.VectorType(_I16, 16)), wide)
    light = builder.bitcast(builder.shl(whole, ir.Constant(wide, [16] * 16)), _LANES)
    weights = builder.bitcast(numbers, ir.VectorType(ir.FloatType(), 4))
    spread = _picked(builder, weights, weights, [lane // 4 for lane in range(16)])
    return _call(builder, "llvm.fmuladd.v16f32", _LANES, light, spread, sums)


@_operation(color, types.int64, types.float32, color)
def add_short(builder: Any, values: Any) -> Any:
    """Add a colour from an address times a number."""
    wide, half, four = ir.VectorType(_I32, 4), ir.VectorType(_I16, 4), ir.VectorType(ir.FloatType(), 4)
    short = builder.load(builder.inttoptr(values[0], half.as_pointer()), align=8)
    light = builder.bitcast(builder.shl(builder.zext(short, wide), ir.Constant(wide, [16] * 4)), four)
    weight = builder.insert_element(ir.Constant(four, ir.Undefined), values[1], ir.Constant(_I32, 0))
    return _call(builder, "llvm.fmuladd.v4f32", four, light, _picked(builder, weight, weight, [0] * 4), values[2])


@_operation(color, floats)
def sum_of_fours(builder: Any, values: Any) -> Any:
    """Sum of the four colours of 16 lanes."""
    parts = [_picked(builder, values[0], values[0], list(range(first, first + 4))) for first in range(0, 16, 4)]
    return builder.fadd(builder.fadd(parts[0], parts[1]), builder.fadd(parts[2], parts[3]))
