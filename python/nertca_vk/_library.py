"""The shared library of this package, declared by the header that came with it."""

import functools
import json
import os
import re
from pathlib import Path
from typing import Any, Callable, Final

import cffi

from .errors import Error, failure

PACKAGE: Final = Path(__file__).parent
HEADER: Final = PACKAGE / "nertca_vk.h"
LIBRARY: Final = PACKAGE / "libnertca_vk.so"

# What cffi's reader of declarations leaves to a preprocessor; plain `#define NAME NUMBER` it reads itself.
CPLUSPLUS_ONLY: Final = re.compile(r"^#ifdef __cplusplus$.*?^#endif.*?$", re.MULTILINE | re.DOTALL)
DIRECTIVES: Final = re.compile(r"^#(?:include|ifndef|endif).*$|^#define NERTCA_VK_H$", re.MULTILINE)

# Texts of the library are cut to this; the longest, descriptions of devices, are a tenth of it.
TEXT_BYTES: Final = 1 << 16


def declarations(header: str) -> str:
    """The header's declarations and numbers, without what is for compilers."""
    return DIRECTIVES.sub("", CPLUSPLUS_ONLY.sub("", header))


def _open(path: Path) -> Any:
    if not path.is_file():
        raise ImportError(f"{path} is missing: packages with the library are built by tools/wheel")
    library = ffi.dlopen(str(path))
    ours, theirs = library.NERTCA_ABI_VERSION, library.nertca_abi_version()
    if ours != theirs:
        raise ImportError(f"{path} has ABI {theirs}, its header {ours}: reinstall the package")
    return library


ffi: Final[Any] = cffi.FFI()
ffi.cdef(declarations(HEADER.read_text(encoding="utf-8")))
lib: Final[Any] = _open(LIBRARY)
STATUS_NAMES: Final = {
    getattr(lib, name): name.removeprefix("NERTCA_ERROR_") for name in dir(lib) if name.startswith("NERTCA_ERROR_")
}


@functools.cache
def _layout(name: str) -> tuple[Any, int]:
    return ffi.typeof(f"{name} *"), ffi.sizeof(name)


def new(name: str) -> Any:
    """A struct of the library with its size set, and zeros in all other fields."""
    pointer, size = _layout(name)
    struct = ffi.new(pointer)
    struct.size = size
    return struct


def version() -> str:
    """Version of the library, as `major.minor.patch`."""
    text: str = ffi.string(lib.nertca_version()).decode()
    return text


def error(status: int, handle: Any) -> Error:
    """What the last call on a handle (`ffi.NULL`: of none) in this thread ended with, as an exception."""
    text = ffi.new("char[]", TEXT_BYTES)
    lib.nertca_last_error(handle, text, TEXT_BYTES, ffi.NULL)
    return failure(STATUS_NAMES.get(status, "INTERNAL"), status, ffi.string(text).decode())


def check(status: int, handle: Any) -> None:
    """Raises what a call on a handle ended with, unless that was success."""
    if status != lib.NERTCA_OK:
        raise error(status, handle)


def read_text(handle: Any, ask: Callable[[Any, int, Any], int]) -> str:
    """A text that a call writes into a buffer of a size, and tells the length of."""
    length = ffi.new("size_t *")
    size = TEXT_BYTES
    while True:
        text = ffi.new("char[]", size)
        status = ask(text, size, length)
        if status != lib.NERTCA_ERROR_BUFFER:
            check(status, handle)
            found: str = ffi.string(text).decode()
            return found
        size = length[0] + 1


def as_options(options: dict[str, object]) -> Any:
    """Options as the library takes them, without those that are None."""
    given = {key: _plain(key, value) for key, value in options.items() if value is not None}
    return ffi.new("char[]", json.dumps(given).encode())


def _plain(key: str, value: object) -> object:
    """A value that JSON has; NumPy's numbers are as good as Python's."""
    try:
        plain: object = getattr(value, "item", lambda: value)()
        json.dumps(plain, allow_nan=False)
    except (TypeError, ValueError):
        raise argument_error(f"{key}: {value!r} is not a setting") from None
    return plain


def argument_error(text: str) -> Error:
    """An argument that cannot be."""
    return failure("ARGUMENT", lib.NERTCA_ERROR_ARGUMENT, text)


def as_path(path: "str | os.PathLike[str]") -> Any:
    """A file's name as the library takes it."""
    name = os.fsencode(path)
    if b"\0" in name:
        raise argument_error(f"path: {os.fspath(path)!r} has a zero inside")
    return ffi.new("char[]", name)
