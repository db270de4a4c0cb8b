"""Short vectors as values in compiled loops, for the few kernels where that pays.

Written in LLVM's vector types, so they run anywhere: one register with
AVX-512, several where registers are shorter. A loop over such values keeps
its sums in registers, which compiled loops over arrays do not (2.5 times the speed).
Addresses are integers, from `address_of` plus bytes; nothing is bounds-checked.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, cast

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.errors import TypingError
from numba.extending import intrinsic, models, register_model

from icheat_usd.kernels._jit import kernel

_F32, _I8, _I16, _I32 = ir.FloatType(), ir.IntType(8), ir.IntType(16), ir.IntType(32)
_F16X = ir.VectorType(_F32, 16)
_F4X = ir.VectorType(_F32, 4)
_I16X = ir.VectorType(_I32, 16)
_W32X = ir.VectorType(_I16, 32)


class Vector(types.Type):
    """The type of a vector of one LLVM type."""

    def __init__(self, name: str, llvm: ir.VectorType) -> None:
        super().__init__(name=name)
        self.llvm = llvm


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, fe_type.llvm)


floats = Vector("floats", _F16X)  #: 16 float32
color = Vector("color", _F4X)  #: 4 float32
integers = Vector("integers", _I16X)  #: 16 int32
words = Vector("words", _W32X)  #: 32 int16

Emit = Callable[[Any, Any], Any]


def _operation(result: types.Type, *arguments: types.Type) -> Callable[[Emit], Any]:
    """Make ``emit(builder, values)`` callable from compiled code."""

    def decorate(emit: Emit) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            value = emit(builder, values)
            return context.get_dummy_value() if value is None else value

        def typed(typingctx: Any, *given: types.Type) -> Any:
            for has, wanted in zip(given, arguments, strict=True):
                if isinstance(wanted, types.Integer) and not isinstance(has, types.Integer):
                    raise TypingError(f"{emit.__name__}: an address has become {has}")
            return result(*arguments), codegen

        names = ["typingctx", *(f"value_{i}" for i in range(len(arguments)))]
        parameters = [inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD) for name in names]
        vars(typed)["__signature__"] = inspect.Signature(parameters)
        typed.__name__, typed.__doc__ = emit.__name__, emit.__doc__
        return cast(Any, intrinsic)(typed)

    return decorate


@kernel
def address_of(array: np.ndarray) -> int:
    """Where an array's first entry lies; signed, since signed and unsigned integers add up to a float."""
    return np.int64(array.ctypes.data)


def _at(builder: Any, address: Any, kind: Any) -> Any:
    return builder.inttoptr(address, kind.as_pointer())


def _load(builder: Any, address: Any, kind: Any) -> Any:
    return builder.load(_at(builder, address, kind), align=1 if kind.element == _I8 else 4)


def _spread(builder: Any, scalar: Any, kind: Any) -> Any:
    undefined = ir.Constant(kind, ir.Undefined)
    one = builder.insert_element(undefined, scalar, ir.Constant(_I32, 0))
    return builder.shuffle_vector(one, undefined, ir.Constant(ir.VectorType(_I32, kind.count), [0] * kind.count))


def _picked(builder: Any, a: Any, b: Any, lanes: list[int]) -> Any:
    """Lanes of two vectors, those of `b` counted on from those of `a`."""
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(_I32, len(lanes)), lanes))


def _call(builder: Any, name: str, kind: Any, *values: Any) -> Any:
    function = cgutils.get_or_insert_function(builder.module, ir.FunctionType(kind, [kind] * len(values)), name)
    return builder.call(function, values)


# 16 floats


@_operation(floats)
def zeros(builder: Any, values: Any) -> Any:
    """All 0."""
    return ir.Constant(_F16X, [0.0] * 16)


@_operation(floats, types.int64)
def load(builder: Any, values: Any) -> Any:
    """16 float32 from an address."""
    return _load(builder, values[0], _F16X)


@_operation(floats, types.int64)
def load_int8(builder: Any, values: Any) -> Any:
    """16 int8 from an address."""
    small = _load(builder, values[0], ir.VectorType(_I8, 16))
    return builder.sitofp(builder.sext(small, _I16X), _F16X)


@_operation(floats, types.int64)
def load_spread(builder: Any, values: Any) -> Any:
    """The float32 at an address in all 16 places."""
    return _spread(builder, builder.load(_at(builder, values[0], _F32), align=4), _F16X)


@_operation(floats, types.float32)
def spread(builder: Any, values: Any) -> Any:
    """One float32 in all 16 places."""
    return _spread(builder, values[0], _F16X)


@_operation(floats, floats, floats, floats)
def multiply_add(builder: Any, values: Any) -> Any:
    """``a * b + c``, rounded once where the machine can."""
    return _call(builder, "llvm.fmuladd.v16f32", _F16X, *values)


@_operation(floats, floats, floats)
def plus(builder: Any, values: Any) -> Any:
    """``a + b``."""
    return builder.fadd(*values)


@_operation(floats, floats, floats)
def larger(builder: Any, values: Any) -> Any:
    """The larger of `a` and ``|b|``, place by place; `a` where `b` is not a number."""
    return _larger(builder, values[0], _size(builder, values[1], _I16X))


@_operation(floats, floats)
def positive(builder: Any, values: Any) -> Any:
    """What is above 0, and 0 in the other places."""
    return _positive(builder, values[0])


@_operation(types.float32, floats)
def total(builder: Any, values: Any) -> Any:
    """Sum of all 16, in halves."""
    total = _halved(builder, values[0], lambda builder, a, b: builder.fadd(a, b))
    return builder.extract_element(total, ir.Constant(_I32, 0))


@_operation(types.float32, floats)
def peak(builder: Any, values: Any) -> Any:
    """The largest of all 16, of which none is below 0."""
    return builder.extract_element(_halved(builder, values[0], _larger), ir.Constant(_I32, 0))


def _positive(builder: Any, value: Any) -> Any:
    zero = ir.Constant(value.type, [0.0] * value.type.count)
    return builder.select(builder.fcmp_ordered(">", value, zero), value, zero)


def _larger(builder: Any, a: Any, b: Any) -> Any:
    """The larger of two, `a` where `b` is not a number."""
    return builder.select(builder.fcmp_ordered(">", b, a), b, a)


def _halved(builder: Any, value: Any, combine: Any, size: int = 1) -> Any:
    """Combine the halves of a vector until `size` numbers are left."""
    while value.type.count > size:
        half = value.type.count // 2
        low, high = list(range(half)), list(range(half, 2 * half))
        value = combine(builder, _picked(builder, value, value, low), _picked(builder, value, value, high))
    return value


@_operation(floats, floats)
def rounded(builder: Any, values: Any) -> Any:
    """To the nearest whole number, the even one of two."""
    return _call(builder, "llvm.rint.v16f32", _F16X, values[0])


@_operation(types.void, types.int64, floats)
def store_int8(builder: Any, values: Any) -> None:
    """16 whole numbers within -128..127 as int8 to an address."""
    kind = ir.VectorType(_I8, 16)
    small = builder.trunc(builder.fptosi(values[1], _I16X), kind)
    builder.store(small, _at(builder, values[0], kind), align=1)


@_operation(types.void, types.int64, floats)
def store(builder: Any, values: Any) -> None:
    """16 float32 to an address."""
    builder.store(values[1], _at(builder, values[0], _F16X), align=4)


@_operation(types.void, types.int64, floats, floats, floats)
def store_colors(builder: Any, values: Any) -> None:
    """16 colours as red, green, blue, 0 to an address."""
    red_green = _picked(builder, values[1], values[2], list(range(32)))
    blue_zero = _picked(builder, values[3], ir.Constant(_F16X, [0.0] * 16), list(range(32)))
    colors = _picked(builder, red_green, blue_zero, [part * 16 + lane for lane in range(16) for part in range(4)])
    builder.store(colors, _at(builder, values[0], ir.VectorType(_F32, 64)), align=4)


@_operation(types.void, types.int64, floats, floats, floats, floats)
def store_fours(builder: Any, values: Any) -> None:
    """16 times four float32, one of each vector, to an address."""
    first, last = (_picked(builder, values[k], values[k + 1], list(range(32))) for k in (1, 3))
    fours = _picked(builder, first, last, [part * 16 + lane for lane in range(16) for part in range(4)])
    builder.store(fours, _at(builder, values[0], ir.VectorType(_F32, 64)), align=4)


# Four floats: a colour and a pad


@_operation(color)
def black(builder: Any, values: Any) -> Any:
    """All 0."""
    return ir.Constant(_F4X, [0.0] * 4)


@_operation(color, types.float32, types.float32, types.float32)
def color_of(builder: Any, values: Any) -> Any:
    """Red, green and blue, and 0."""
    found = ir.Constant(_F4X, [0.0] * 4)
    for lane, value in enumerate(values):
        found = builder.insert_element(found, value, ir.Constant(_I32, lane))
    return found


@_operation(color, types.float32, types.float32)
def weights_of_corners(builder: Any, values: Any) -> Any:
    """``(1 - x)(1 - y), x(1 - y), (1 - x)y, xy``."""
    (x, y), one = values, ir.Constant(_F32, 1.0)
    left, top = builder.fsub(one, x), builder.fsub(one, y)
    found = ir.Constant(_F4X, ir.Undefined)
    for lane, (a, b) in enumerate(((left, top), (x, top), (left, y), (x, y))):
        found = builder.insert_element(found, builder.fmul(a, b), ir.Constant(_I32, lane))
    return found


@_operation(types.boolean, color)
def is_black(builder: Any, values: Any) -> Any:
    """Whether red, green and blue are all 0."""
    rgb = _picked(builder, values[0], values[0], [0, 1, 2])
    bits = builder.bitcast(builder.fcmp_unordered("!=", rgb, ir.Constant(rgb.type, [0.0] * 3)), ir.IntType(3))
    return builder.icmp_unsigned("==", bits, ir.Constant(ir.IntType(3), 0))


@_operation(color, types.int64)
def load_color(builder: Any, values: Any) -> Any:
    """Four float32 from an address."""
    return _load(builder, values[0], _F4X)


@_operation(color, types.int64)
def load_rgb(builder: Any, values: Any) -> Any:
    """Three float32 from an address, and 0."""
    kind = ir.VectorType(_F32, 3)
    return _picked(builder, _load(builder, values[0], kind), ir.Constant(kind, [0.0] * 3), [0, 1, 2, 3])


@_operation(types.void, types.int64, color)
def store_rgb(builder: Any, values: Any) -> None:
    """The first three to an address."""
    rgb = _picked(builder, values[1], values[1], [0, 1, 2])
    builder.store(rgb, _at(builder, values[0], ir.VectorType(_F32, 3)), align=4)


@_operation(types.float32, types.int64)
def load_one(builder: Any, values: Any) -> Any:
    """The float32 at an address."""
    return builder.load(_at(builder, values[0], _F32), align=4)


@_operation(types.int64, types.int64)
def load_number(builder: Any, values: Any) -> Any:
    """The int32 at an address."""
    return builder.sext(builder.load(_at(builder, values[0], _I32), align=4), ir.IntType(64))


@_operation(types.int64, types.int64)
def load_byte(builder: Any, values: Any) -> Any:
    """A whole number of 8 bits, from 0 up, from an address."""
    return builder.zext(builder.load(_at(builder, values[0], _I8)), ir.IntType(64))


@_operation(color, types.int64, types.int64, color)
def weighted_sum(builder: Any, values: Any) -> Any:
    """Sum of four colours: addresses of the first colour and of four int32 that count colours from it; four weights."""
    total = ir.Constant(_F4X, [0.0] * 4)
    for k in range(4):
        skip = ir.Constant(ir.IntType(64), 4 * k)
        index = builder.load(_at(builder, builder.add(values[1], skip), _I32), align=4)
        weight = _picked(builder, values[2], values[2], [k] * 4)
        offset = builder.shl(builder.sext(index, ir.IntType(64)), ir.Constant(ir.IntType(64), 4))
        value = _load(builder, builder.add(values[0], offset), _F4X)
        total = _call(builder, "llvm.fmuladd.v4f32", _F4X, value, weight, total)
    return total


@_operation(color, color)
def positive_color(builder: Any, values: Any) -> Any:
    """What is above 0, and 0 in the other channels."""
    return _positive(builder, values[0])


@_operation(color, color, types.float32)
def scaled(builder: Any, values: Any) -> Any:
    """A colour times a number."""
    return builder.fmul(values[0], _spread(builder, values[1], _F4X))


@_operation(color, color, color)
def color_product(builder: Any, values: Any) -> Any:
    """``a * b`` channel by channel."""
    return builder.fmul(*values)


@_operation(color, color, types.float32, color)
def scale_add(builder: Any, values: Any) -> Any:
    """``a * number + c``, rounded once where the machine can."""
    return _call(builder, "llvm.fmuladd.v4f32", _F4X, values[0], _spread(builder, values[1], _F4X), values[2])


@_operation(color, color, color, color)
def color_add(builder: Any, values: Any) -> Any:
    """``a * b + c`` channel by channel, rounded once where the machine can."""
    return _call(builder, "llvm.fmuladd.v4f32", _F4X, *values)


@_operation(floats, color)
def four_times(builder: Any, values: Any) -> Any:
    """A colour four times."""
    return _picked(builder, values[0], values[0], [0, 1, 2, 3] * 4)


_IN_FIVES = [0] * 5 + [1] * 5 + [2] * 5 + [3]  #: lanes: five of each channel, and the pad


@_operation(floats, color)
def spread_in_fives(builder: Any, values: Any) -> Any:
    """Five times red, five times green, five times blue, and the pad."""
    return _picked(builder, values[0], values[0], _IN_FIVES)


@_operation(floats, types.float32, color, color, floats)
def add_in_fives(builder: Any, values: Any) -> Any:
    """A number and the four of `b` times each channel of `c`, added to the last; rounded once where the machine can."""
    first = builder.insert_element(ir.Constant(_F4X, [0.0] * 4), values[0], ir.Constant(_I32, 0))
    numbers = _picked(builder, first, values[1], [0, 4, 5, 6, 7] * 3 + [1])
    channels = _picked(builder, values[2], values[2], _IN_FIVES)
    return _call(builder, "llvm.fmuladd.v16f32", _F16X, numbers, channels, values[3])


@_operation(floats, *(types.float32,) * 5)
def sixteen_of(builder: Any, values: Any) -> Any:
    """Five numbers three times over, and 0."""
    found = ir.Constant(ir.VectorType(_F32, 8), [0.0] * 8)
    for lane, value in enumerate(values):
        found = builder.insert_element(found, value, ir.Constant(_I32, lane))
    return _picked(builder, found, found, [0, 1, 2, 3, 4] * 3 + [5])


@_operation(color, floats)
def sum_of_fives(builder: Any, values: Any) -> Any:
    """Sums of the first five, of the next five and of the next five, in their order, and 0."""
    lanes = [_picked(builder, values[0], ir.Constant(_F16X, [0.0] * 16), [k, 5 + k, 10 + k, 16]) for k in range(5)]
    found = lanes[0]
    for lane in lanes[1:]:
        found = builder.fadd(found, lane)
    return found


@_operation(color, color, color, color, color, color, color)
def add_corners(builder: Any, values: Any) -> Any:
    """Four colours, each times one of the numbers of `weights`, the first, added to the last."""
    weights, *colors, total = values
    for lane, value in enumerate(colors):
        total = _call(builder, "llvm.fmuladd.v4f32", _F4X, value, _picked(builder, weights, weights, [lane] * 4), total)
    return total


@_operation(color, color, color)
def difference(builder: Any, values: Any) -> Any:
    """``a - b``."""
    return builder.fsub(*values)


@_operation(color, color, color)
def ratios(builder: Any, values: Any) -> Any:
    """``a / b`` where `b` is above 0, and 0 in the other channels."""
    a, b = values
    zero = ir.Constant(_F4X, [0.0] * 4)
    return builder.select(builder.fcmp_ordered(">", b, zero), builder.fdiv(a, b), zero)


@_operation(types.float32, color, types.int64)
def channel(builder: Any, values: Any) -> Any:
    """One of the four."""
    return builder.extract_element(values[0], values[1])


@_operation(color, color, color)
def plus_size(builder: Any, values: Any) -> Any:
    """``a + |b|``."""
    return builder.fadd(values[0], _size(builder, values[1], ir.VectorType(_I32, 4)))


def _size(builder: Any, value: Any, bits: Any) -> Any:
    """Size of each float of a vector; `bits` is the type of whole numbers as wide as it."""
    size = builder.and_(builder.bitcast(value, bits), ir.Constant(bits, [0x7FFFFFFF] * bits.count))
    return builder.bitcast(size, value.type)


@_operation(color, floats)
def largest_of_fours(builder: Any, values: Any) -> Any:
    """The largest of each channel of four colours, of which none is below 0."""
    return _halved(builder, values[0], _larger, 4)


@_operation(types.void, types.int64, color)
def store_color(builder: Any, values: Any) -> None:
    """Four float32 to an address."""
    builder.store(values[1], _at(builder, values[0], _F4X), align=4)


# Integers: products of 16-bit numbers, summed exactly


@_operation(integers)
def no_sum(builder: Any, values: Any) -> Any:
    """All 0."""
    return ir.Constant(_I16X, [0] * 16)


@_operation(words, types.int64)
def widen(builder: Any, values: Any) -> Any:
    """32 int8 from an address."""
    return builder.sext(_load(builder, values[0], ir.VectorType(_I8, 32)), _W32X)


@_operation(words, types.int64, types.int64)
def widen_two(builder: Any, values: Any) -> Any:
    """Pairs of one int8 of 16 at an address and one of 16 at another."""
    low, high = (builder.sext(_load(builder, value, ir.VectorType(_I8, 16)), _I16X) for value in values)
    low = builder.and_(low, ir.Constant(_I16X, [0xFFFF] * 16))
    high = builder.shl(high, ir.Constant(_I16X, [16] * 16))
    return builder.bitcast(builder.or_(low, high), _W32X)


@_operation(types.int64, types.int64, types.int64, types.int64, types.float32, types.int64, types.int64)
def store_large(builder: Any, values: Any) -> Any:
    """Numbers of those of 16 terms that are `least` or more, one after the other to an address; how many they are.

    Terms are ``size[index] * worth``: addresses of 16 int32 indices, of 16
    float32 worths and of the sizes, `least`, the number of the first term, and the address for int32 numbers.
    """
    index, worth, size, least, first, place = values
    i64, flags = ir.IntType(64), ir.VectorType(ir.IntType(1), 16)
    offset = builder.shl(builder.sext(_load(builder, index, _I16X), ir.VectorType(i64, 16)), _all(i64, 2))
    address = builder.add(offset, _spread(builder, size, ir.VectorType(i64, 16)))
    pointers = builder.inttoptr(address, ir.VectorType(_F32.as_pointer(), 16))
    gather = cgutils.get_or_insert_function(
        builder.module,
        ir.FunctionType(_F16X, [pointers.type, _I32, flags, _F16X]),
        "llvm.masked.gather.v16f32.v16p0f32",
    )
    every = ir.Constant(flags, [1] * 16)
    found = builder.call(gather, [pointers, ir.Constant(_I32, 4), every, ir.Constant(_F16X, [0.0] * 16)])
    term = builder.fmul(found, _load(builder, worth, _F16X))
    large = builder.fcmp_ordered(">=", term, _spread(builder, least, _F16X))
    number = builder.add(_spread(builder, builder.trunc(first, _I32), _I16X), ir.Constant(_I16X, list(range(16))))
    keep = cgutils.get_or_insert_function(
        builder.module,
        ir.FunctionType(ir.VoidType(), [_I16X, _I32.as_pointer(), flags]),
        "llvm.masked.compressstore.v16i32",
    )
    builder.call(keep, [number, builder.inttoptr(place, _I32.as_pointer()), large])
    bits = builder.bitcast(large, _I16)
    return builder.zext(builder.ctpop(bits), i64)


def _all(kind: Any, number: int) -> Any:
    return ir.Constant(ir.VectorType(kind, 16), [number] * 16)


@_operation(words, types.int64)
def spread_pair(builder: Any, values: Any) -> Any:
    """The two int16 at an address, 16 times."""
    pair = builder.load(_at(builder, values[0], _I32), align=4)
    return builder.bitcast(_spread(builder, pair, _I16X), _W32X)


@_operation(integers, words, words, integers)
def add_dot(builder: Any, values: Any) -> Any:
    """``x[2i] * y[2i] + x[2i + 1] * y[2i + 1] + sum[i]``: one instruction with AVX-512 VNNI, two with AVX2."""
    wide = ir.VectorType(_I32, 32)
    product = builder.mul(builder.sext(values[0], wide), builder.sext(values[1], wide))
    even = _picked(builder, product, product, list(range(0, 32, 2)))
    odd = _picked(builder, product, product, list(range(1, 32, 2)))
    return builder.add(values[2], builder.add(even, odd))


@_operation(words, floats, floats)
def rounded_pairs(builder: Any, values: Any) -> Any:
    """Pairs ``(a[i], b[i])`` as int16; both below 2^15 in size, rounded to nearest."""
    # Adding 1.5 * 2^23 leaves the whole number in the low bits of the sum.
    shift = ir.Constant(_F16X, [12582912.0] * 16)
    low, high = (builder.bitcast(builder.fadd(value, shift), _I16X) for value in values)
    low = builder.and_(low, ir.Constant(_I16X, [0xFFFF] * 16))
    high = builder.shl(high, ir.Constant(_I16X, [16] * 16))
    return builder.bitcast(builder.or_(low, high), _W32X)


@_operation(floats, floats, floats)
def product(builder: Any, values: Any) -> Any:
    """``a * b``."""
    return builder.fmul(*values)


@_operation(floats, integers, types.float32)
def as_floats(builder: Any, values: Any) -> Any:
    """Integers times a number."""
    return builder.fmul(builder.sitofp(values[0], _F16X), _spread(builder, values[1], _F16X))


@_operation(types.void, types.int64, words)
def store_words(builder: Any, values: Any) -> None:
    """32 int16 to an address."""
    builder.store(values[1], _at(builder, values[0], _W32X), align=4)


@_operation(types.uint64, types.int64)
def load_word(builder: Any, values: Any) -> Any:
    """Eight bytes from an address, the first of them lowest."""
    return builder.load(_at(builder, values[0], ir.IntType(64)), align=1)


@_operation(types.int64, types.uint64)
def lowest_bit(builder: Any, values: Any) -> Any:
    """Number of the lowest bit that is set; one is."""
    i64, flag = ir.IntType(64), ir.IntType(1)
    function = builder.module.declare_intrinsic("llvm.cttz", [i64], ir.FunctionType(i64, [i64, flag]))
    return builder.call(function, [values[0], ir.Constant(flag, 1)])


@_operation(types.void, types.int64)
def set_byte(builder: Any, values: Any) -> None:
    """1 to the byte at an address."""
    byte = ir.IntType(8)
    builder.store(ir.Constant(byte, 1), _at(builder, values[0], byte), align=1)


@_operation(types.void, types.int64)
def fetch(builder: Any, values: Any) -> None:
    """Ask for the cache line of an address; it will be read soon."""
    pointer = ir.IntType(8).as_pointer()
    kind = ir.FunctionType(ir.VoidType(), [pointer, _I32, _I32, _I32])
    function = builder.module.declare_intrinsic("llvm.prefetch", [pointer], kind)
    read, soon, data = (ir.Constant(_I32, flag) for flag in (0, 2, 1))
    builder.call(function, [builder.inttoptr(values[0], pointer), read, soon, data])
