"""Memory that is needed soon: loads that are begun and not waited for."""

from __future__ import annotations

from typing import Any, cast

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic


@cast(Any, intrinsic)  # as a caller sees it: without the typing context
def fetch(typingctx: Any, column: Any, row: Any) -> Any:
    """Begin to load row `row` of a C-contiguous array, which is not waited for; it may lie behind the last."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, args[0])
        stride = builder.extract_value(array.strides, 0)
        pointer = ir.IntType(8).as_pointer()
        base = builder.ptrtoint(array.data, stride.type)
        address = builder.inttoptr(builder.add(base, builder.mul(stride, args[1])), pointer)
        number = ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [pointer, number, number, number])
        callee = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0i8")
        builder.call(callee, [address, ir.Constant(number, 0), ir.Constant(number, 3), ir.Constant(number, 1)])
        return context.get_dummy_value()

    return types.void(column, types.int64), codegen
