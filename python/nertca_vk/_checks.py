"""What is given from Python, as the library takes it; what does not fit is an error that names it."""

import functools
import operator
from typing import Any, Final, Sequence, Union

import numpy as np
import numpy.typing as npt

from ._library import argument_error, ffi, lib
from .errors import Error

Pixels = Union[npt.NDArray[np.uint8], npt.NDArray[np.uint16], npt.NDArray[np.float32], npt.NDArray[np.float64]]
"""An image of shape (rows, columns)."""

LARGEST_U32: Final = 2**32 - 1
FLOAT32: Final = np.dtype(np.float32)
PIXEL_FORMATS: Final = {
    np.dtype(np.uint8): lib.NERTCA_PIXELS_U8,
    np.dtype(np.uint16): lib.NERTCA_PIXELS_U16,
    np.dtype(np.float32): lib.NERTCA_PIXELS_F32,
}


def wrong(name: str, problem: str) -> Error:
    """An argument that cannot be."""
    return argument_error(f"{name}: {problem}")


def whole(name: str, value: int, lowest: int = 0, highest: int = LARGEST_U32) -> int:
    """A whole number within bounds; NumPy's are as good as Python's."""
    try:
        number = operator.index(value)
    except TypeError:
        raise wrong(name, f"{value!r} is not a whole number") from None
    if not lowest <= number <= highest:
        raise wrong(name, f"{number}; {lowest} to {highest} are accepted")
    return number


def real(name: str, value: float) -> float:
    """A number; the library looks at whether it is finite and makes sense."""
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        raise wrong(name, f"{value!r} is not a number") from None


def reals(name: str, values: Sequence[float], count: int) -> list[float]:
    """So many numbers."""
    try:
        found = [float(value) for value in values]
    except (TypeError, ValueError, OverflowError):
        raise wrong(name, f"{values!r} are not {count} numbers") from None
    if len(found) != count:
        raise wrong(name, f"{len(found)} numbers where {count} are needed")
    return found


@functools.cache
def _constants(prefix: str) -> dict[str, int]:
    """The header's constants that begin alike: numbers by the rest of their names, in small letters."""
    return {name.removeprefix(prefix).lower(): getattr(lib, name) for name in dir(lib) if name.startswith(prefix)}


@functools.cache
def _names(prefix: str) -> dict[int, str]:
    return {number: name for name, number in _constants(prefix).items()}


def constant(name: str, value: str, prefix: str) -> int:
    """The number of one of the header's constants, by the end of its name in small letters."""
    known = _constants(prefix)
    if value not in known:
        raise wrong(name, f"{value!r} is not one of {', '.join(known)}")
    return known[value]


def constant_name(number: int, prefix: str) -> str:
    """The end of a constant's name, in small letters, by its number."""
    return _names(prefix).get(number, str(number))


def image(name: str, values: object, dtypes: Sequence[npt.DTypeLike]) -> "np.ndarray[Any, np.dtype[Any]]":
    """An image of one of some types, rows following each other at once in the machine's byte order: copied where it is
    not so already."""
    array = np.asarray(values)
    native = array.dtype.newbyteorder("=")
    if native not in dtypes:
        accepted = ", ".join(np.dtype(dtype).name for dtype in dtypes)
        raise wrong(name, f"values of type {array.dtype} are not supported; {accepted} are accepted")
    if array.ndim != 2:
        raise wrong(name, f"an array of shape {array.shape}; (rows, columns) is needed")
    return np.ascontiguousarray(array, dtype=native)


def target(name: str, out: object, shape: tuple[int, ...]) -> "npt.NDArray[np.float32]":
    """Room for results: a new array, or the caller's own where it fits."""
    if out is None:
        return np.empty(shape, np.float32)
    # The same object is told at once.
    if not isinstance(out, np.ndarray) or (out.dtype is not FLOAT32 and out.dtype != FLOAT32) or out.shape != shape:
        found = f"{out.dtype} of shape {out.shape}" if isinstance(out, np.ndarray) else type(out).__name__
        raise wrong(name, f"{found}; a float32 array of shape {shape} is needed")
    if not out.flags.carray:  # in C's order, aligned, and to be written to
        raise wrong(name, "is read-only, or its rows are not contiguous")
    return out


BYTES: Final = ffi.typeof("char[]")


def readable(array: "np.ndarray[Any, np.dtype[Any]]") -> Any:
    """A pointer to an array's bytes, which stay where they are while it lives."""
    return ffi.from_buffer(array)


def writable(array: "np.ndarray[Any, np.dtype[Any]]") -> Any:
    """As `readable`, for the library to write to."""
    return ffi.from_buffer(BYTES, array, True)
