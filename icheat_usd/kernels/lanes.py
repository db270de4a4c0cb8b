"""Arithmetic with 16 floats at once that only some kernels need, beside that of `kernels.simd`."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types

from icheat_usd.kernels.simd import _call, _operation, floats

_LANES = ir.VectorType(ir.FloatType(), 16)


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
