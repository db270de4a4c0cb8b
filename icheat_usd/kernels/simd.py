"""Sixteen floats as one value in compiled loops, for the few kernels where that pays.

Written in LLVM's vector types, so they run anywhere: one register with
AVX-512, several where registers are shorter. A loop over such values keeps
its sums in registers, which compiled loops over arrays do not (2.5 times the speed).
Addresses are integers, from `address_of` plus bytes; nothing is bounds-checked.
"""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, models, register_model

from icheat_usd.kernels._jit import kernel

WIDTH = 16

_FLOATS = ir.VectorType(ir.FloatType(), WIDTH)


class Floats(types.Type):
    """The type of a vector of `WIDTH` float32."""

    def __init__(self) -> None:
        super().__init__(name="Floats")


floats = Floats()


@register_model(Floats)
class _FloatsModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, _FLOATS)


@kernel
def address_of(array: np.ndarray) -> int:
    """Where an array's first entry lies; signed, since signed and unsigned integers add up to a float."""
    return np.int64(array.ctypes.data)


def _at(builder: Any, address: Any, kind: Any) -> Any:
    return builder.inttoptr(address, kind.as_pointer())


def _spread(builder: Any, scalar: Any) -> Any:
    one = builder.insert_element(ir.Constant(_FLOATS, ir.Undefined), scalar, ir.Constant(ir.IntType(32), 0))
    lanes = ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), [0] * WIDTH)
    return builder.shuffle_vector(one, ir.Constant(_FLOATS, ir.Undefined), lanes)


@cast(Any, intrinsic)  # as a caller sees it: without the typing context
def zeros(typingctx: Any) -> Any:
    """All 0."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return ir.Constant(_FLOATS, [0.0] * WIDTH)

    return floats(), codegen


@cast(Any, intrinsic)
def load_int8(typingctx: Any, address: Any) -> Any:
    """16 int8 from an address, as floats."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kind = ir.VectorType(ir.IntType(8), WIDTH)
        value = builder.load(_at(builder, args[0], kind), align=1)
        return builder.sitofp(builder.sext(value, ir.VectorType(ir.IntType(32), WIDTH)), _FLOATS)

    return floats(types.int64), codegen


@cast(Any, intrinsic)
def load(typingctx: Any, address: Any) -> Any:
    """16 float32 from an address."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.load(_at(builder, args[0], _FLOATS), align=4)

    return floats(types.int64), codegen


@cast(Any, intrinsic)
def load_spread(typingctx: Any, address: Any) -> Any:
    """The float32 at an address in all 16 places."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _spread(builder, builder.load(_at(builder, args[0], ir.FloatType()), align=4))

    return floats(types.int64), codegen


@cast(Any, intrinsic)
def scale_four(typingctx: Any, address: Any, factor: Any, target: Any) -> Any:
    """Four float32 from `address` times `factor` to `target`."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kind = ir.VectorType(ir.FloatType(), 4)
        lanes = ir.Constant(ir.VectorType(ir.IntType(32), 4), [0] * 4)
        one = builder.insert_element(ir.Constant(kind, ir.Undefined), args[1], ir.Constant(ir.IntType(32), 0))
        value = builder.load(_at(builder, args[0], kind), align=4)
        product = builder.fmul(value, builder.shuffle_vector(one, ir.Constant(kind, ir.Undefined), lanes))
        builder.store(product, _at(builder, args[2], kind), align=4)
        return context.get_dummy_value()

    return types.void(types.int64, types.float32, types.int64), codegen


@cast(Any, intrinsic)
def spread(typingctx: Any, value: Any) -> Any:
    """One float32 in all 16 places."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _spread(builder, args[0])

    return floats(types.float32), codegen


@cast(Any, intrinsic)
def multiply_add(typingctx: Any, a: Any, b: Any, c: Any) -> Any:
    """``a * b + c``, rounded once where the machine can."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kind = ir.FunctionType(_FLOATS, [_FLOATS] * 3)
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.fmuladd.v16f32")
        return builder.call(function, args)

    return floats(floats, floats, floats), codegen


@cast(Any, intrinsic)
def store(typingctx: Any, address: Any, value: Any) -> Any:
    """16 float32 to an address."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        builder.store(args[1], _at(builder, args[0], _FLOATS), align=4)
        return context.get_dummy_value()

    return types.void(types.int64, floats), codegen


@cast(Any, intrinsic)
def store_colors(typingctx: Any, address: Any, red: Any, green: Any, blue: Any) -> Any:
    """16 colours as red, green, blue, 0 to an address."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pair = ir.Constant(ir.VectorType(ir.IntType(32), 2 * WIDTH), list(range(2 * WIDTH)))
        turn = [part * WIDTH + lane for lane in range(WIDTH) for part in range(4)]
        red_green = builder.shuffle_vector(args[1], args[2], pair)
        blue_zero = builder.shuffle_vector(args[3], ir.Constant(_FLOATS, [0.0] * WIDTH), pair)
        colors = builder.shuffle_vector(
            red_green, blue_zero, ir.Constant(ir.VectorType(ir.IntType(32), 4 * WIDTH), turn)
        )
        builder.store(colors, _at(builder, args[0], ir.VectorType(ir.FloatType(), 4 * WIDTH)), align=4)
        return context.get_dummy_value()

    return types.void(types.int64, floats, floats, floats), codegen
