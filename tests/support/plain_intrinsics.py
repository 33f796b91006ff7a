"""Python functions in place of the kernels' intrinsics, for measuring coverage with the compiler off.

``NUMBA_DISABLE_JIT=1`` runs kernels as Python, where intrinsics do not exist.
"""

from __future__ import annotations

import ctypes

import numpy as np

from octoreplay.mapping.kernels import intrinsics

OCTET = (8,)


def float_array(address: int, shape: tuple[int, ...]) -> np.ndarray:
    """Return a view of the float32 at an address."""
    size = int(np.prod(shape))
    return np.frombuffer((ctypes.c_float * size).from_address(int(address)), np.float32).reshape(shape)


def same_bits(value: np.generic) -> np.generic:
    """Return the int32 with the bits of a float32, or the float32 with the lowest 32 bits of an integer."""
    if isinstance(value, np.float32):
        return value.view(np.int32)
    return np.uint32(int(value) & 0xFFFFFFFF).view(np.float32)


def fma(a: np.float32, b: np.float32, c: np.float32) -> np.float32:
    """Return a x b + c; the product is exact, and the sum is rounded to float64 and then to float32."""
    return np.float32(float(a) * float(b) + float(c))


def count_ones(mask: np.uint64) -> int:
    return int(mask).bit_count()


def lowest_one(mask: np.uint64) -> int:
    return (int(mask) & -int(mask)).bit_length() - 1


def highest_one(mask: np.uint64) -> int:
    return int(mask).bit_length() - 1


def copy_octet(target: int, source: int) -> None:
    float_array(target, OCTET)[:] = float_array(source, OCTET)


def max_octet(target: int, source: int) -> None:
    found = float_array(target, OCTET)
    np.maximum(found, float_array(source, OCTET), out=found)


def add_octet(target: int, source: int) -> None:
    found = float_array(target, OCTET)
    found += float_array(source, OCTET)


def add_marked_octet(
    target: int, marks: np.uint64, own_from: int, own_to: int, own_steps: int, other_steps: int,
    miss: np.float32, least: np.float32, most: np.float32,
) -> None:  # fmt: skip
    values, of_cells = float_array(target, OCTET), np.array([marks], "<u8").view(np.uint8)
    is_own = (of_cells >= own_from) & (of_cells <= own_to)
    steps = np.where(is_own, float_array(own_steps, OCTET), float_array(other_steps, OCTET))
    new = np.clip(values + np.where(of_cells == 1, miss, steps), least, most)
    values[:] = np.where(of_cells != 0, new, values)


def prefetch_line(address: int) -> None:
    """Do nothing: prefetching has no result."""


def install() -> None:
    """Replace the intrinsics; to be called before any kernel is imported."""
    for function in (
        float_array, same_bits, fma, count_ones, lowest_one, highest_one, copy_octet, max_octet, add_octet,
        add_marked_octet, prefetch_line,
    ):  # fmt: skip
        setattr(intrinsics, function.__name__, function)
