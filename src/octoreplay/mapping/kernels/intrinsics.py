"""Single machine instructions that numba has no name for, as functions for kernels."""

# The names and the number of an intrinsic's parameters are numba's, also of those that are not needed.
# ruff: noqa: ARG001

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic


@intrinsic
def float_pointer(typing_context: Any, address: Any) -> Any:
    """The float32 pointer of an integer address."""
    pointer = types.CPointer(types.float32)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], context.get_value_type(pointer))

    return pointer(types.int64), generate


@intrinsic
def same_bits(typing_context: Any, value: Any) -> Any:
    """The int32 with the bits of a float32, or the float32 with the lowest 32 bits of an integer."""
    result = types.int32 if isinstance(value, types.Float) else types.float32

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        number = arguments[0]
        if isinstance(value, types.Integer) and value.bitwidth > result.bitwidth:
            number = builder.trunc(number, ir.IntType(result.bitwidth))
        return builder.bitcast(number, context.get_value_type(result))

    return result(value), generate


@intrinsic
def fma(typing_context: Any, a: Any, b: Any, c: Any) -> Any:
    """The float32 a x b + c, rounded once: one instruction, with the same result on every machine."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.fma(*arguments)

    return types.float32(types.float32, types.float32, types.float32), generate


@intrinsic
def prefetch_line(typing_context: Any, address: Any) -> Any:
    """Ask for the cache line at an integer address."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = builder.inttoptr(arguments[0], ir.IntType(8).as_pointer())
        number = ir.IntType(32)
        fetch = builder.module.declare_intrinsic(
            "llvm.prefetch", (pointer.type,), ir.FunctionType(ir.VoidType(), [pointer.type, number, number, number])
        )
        # Read, keep in all caches, data.
        builder.call(fetch, [pointer, number(0), number(2), number(1)])
        return context.get_dummy_value()

    return types.void(types.int64), generate
