"""Machine instructions that numba does not expose, as functions for kernels."""

# numba fixes the names and the number of an intrinsic's parameters, including unused ones.
# ruff: noqa: ARG001

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numba.np import arrayobj


@intrinsic
def float_array(typing_context: Any, address: Any, shape: Any) -> Any:
    """Return a float32 array with the ``shape`` (a tuple) at the integer ``address``; it owns no memory."""
    result = types.Array(types.float32, len(shape), "C")

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(result)(context, builder)
        size = context.get_value_type(types.intp)
        sizes = [
            context.cast(builder, builder.extract_value(arguments[1], n), axis, types.intp)
            for n, axis in enumerate(signature.args[1])
        ]
        strides = [size(result.dtype.bitwidth // 8)]
        for length in sizes[:0:-1]:
            strides.insert(0, builder.mul(strides[0], length))
        arrayobj.populate_array(
            array, builder.inttoptr(arguments[0], array.data.type), sizes, strides, strides[-1], meminfo=None
        )
        # numba's accessor of the finished structure.
        return array._getvalue()  # noqa: SLF001

    return result(types.int64, shape), generate


@intrinsic
def same_bits(typing_context: Any, value: Any) -> Any:
    """Return the int32 with the bits of a float32, or the float32 with the lowest 32 bits of an integer."""
    result = types.int32 if isinstance(value, types.Float) else types.float32

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        number = arguments[0]
        if isinstance(value, types.Integer) and value.bitwidth > result.bitwidth:
            number = builder.trunc(number, ir.IntType(result.bitwidth))
        return builder.bitcast(number, context.get_value_type(result))

    return result(value), generate


@intrinsic
def fma(typing_context: Any, a: Any, b: Any, c: Any) -> Any:
    """Return the float32 a x b + c, rounded once, with the same result on every machine."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.fma(*arguments)

    return types.float32(types.float32, types.float32, types.float32), generate


@intrinsic
def count_ones(typing_context: Any, mask: Any) -> Any:
    """Return the number of ones in a uint64."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.ctpop(arguments[0])

    return types.int64(types.uint64), generate


@intrinsic
def lowest_one(typing_context: Any, mask: Any) -> Any:
    """Return the position of the lowest one in a uint64 that is not 0."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.cttz(arguments[0], ir.IntType(1)(1))

    return types.int64(types.uint64), generate


@intrinsic
def highest_one(typing_context: Any, mask: Any) -> Any:
    """Return the position of the highest one in a uint64 that is not 0."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        number = ir.IntType(64)
        return builder.sub(number(63), builder.ctlz(arguments[0], ir.IntType(1)(1)))

    return types.int64(types.uint64), generate


def _octets(builder: Any, addresses: Any) -> list[Any]:
    """Return pointers to vectors of eight float32: the compiler would unroll a loop over eight values."""
    return [builder.inttoptr(address, ir.VectorType(ir.FloatType(), 8).as_pointer()) for address in addresses]


@intrinsic
def copy_octet(typing_context: Any, target: Any, source: Any) -> Any:
    """Copy eight float32 from the integer address ``source`` to ``target``."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        target, source = _octets(builder, arguments)
        builder.store(builder.load(source, align=4), target, align=4)
        return context.get_dummy_value()

    return types.void(types.int64, types.int64), generate


@intrinsic
def max_octet(typing_context: Any, target: Any, source: Any) -> Any:
    """Replace eight float32 at the integer address ``target`` by their maxima with those at ``source``."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        target, source = _octets(builder, arguments)
        old, new = builder.load(target, align=4), builder.load(source, align=4)
        builder.store(builder.select(builder.fcmp_ordered(">", new, old), new, old), target, align=4)
        return context.get_dummy_value()

    return types.void(types.int64, types.int64), generate


@intrinsic
def add_octet(typing_context: Any, target: Any, source: Any) -> Any:
    """Add eight float32 at the integer address ``source`` to those at ``target``."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        target, source = _octets(builder, arguments)
        total = builder.fadd(builder.load(target, align=4), builder.load(source, align=4))
        builder.store(total, target, align=4)
        return context.get_dummy_value()

    return types.void(types.int64, types.int64), generate


@intrinsic
def add_marked_octet(
    typing_context: Any, target: Any, marks: Any, own_from: Any, own_to: Any, own_steps: Any, other_steps: Any,
    miss: Any, least: Any, most: Any,
) -> Any:  # fmt: skip
    """Add the log-odds of eight marks (kernels/evidence.py) to eight float32, clamped to [``least``, ``most``].

    A cell without a mark keeps its value. A mark of 1 adds ``miss``, one in ``own_from`` to ``own_to`` the cell's own
    step, and every other mark the cell's other step.

    - ``target``: integer address of the values, changed in place.
    - ``marks`` uint64: a mark in each byte.
    - ``own_from``, ``own_to`` uint8.
    - ``own_steps``, ``other_steps``: integer addresses of eight float32.
    - ``miss``, ``least``, ``most``: float32.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        octet = ir.VectorType(ir.IntType(8), 8)

        def repeat(number: Any) -> Any:
            """Return a vector of eight equal numbers."""
            empty = ir.Constant(ir.VectorType(number.type, 8), ir.Undefined)
            first = builder.insert_element(empty, number, ir.IntType(32)(0))
            return builder.shuffle_vector(first, empty, ir.Constant(ir.VectorType(ir.IntType(32), 8), [0] * 8))

        target, own_steps, other_steps = _octets(builder, (arguments[0], arguments[4], arguments[5]))
        marks = builder.bitcast(arguments[1], octet)
        own_from, own_to, miss, least, most = (repeat(arguments[n]) for n in (2, 3, 6, 7, 8))
        is_own = builder.and_(builder.icmp_unsigned(">=", marks, own_from), builder.icmp_unsigned("<=", marks, own_to))
        is_miss = builder.icmp_unsigned("==", marks, ir.Constant(octet, [1] * 8))
        is_marked = builder.icmp_unsigned("!=", marks, ir.Constant(octet, [0] * 8))
        step = builder.select(is_own, builder.load(own_steps, align=4), builder.load(other_steps, align=4))
        old = builder.load(target, align=4)
        new = builder.fadd(old, builder.select(is_miss, miss, step))
        new = builder.select(builder.fcmp_ordered(">", least, new), least, new)
        new = builder.select(builder.fcmp_ordered("<", most, new), most, new)
        builder.store(builder.select(is_marked, new, old), target, align=4)
        return context.get_dummy_value()

    number = types.float32
    signature = types.void(
        types.int64, types.uint64, types.uint8, types.uint8, types.int64, types.int64, number, number, number
    )
    return signature, generate


@intrinsic
def prefetch_line(typing_context: Any, address: Any) -> Any:
    """Prefetch the cache line at an integer address."""

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
