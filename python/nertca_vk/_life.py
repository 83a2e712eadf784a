"""Handles of the library: who may use them, and how they end. They end when they are closed, when nobody refers to them
any more, and when the interpreter exits; in a forked child they are left alone."""

import os
import weakref
from typing import Any, Callable, Final, Optional

from ._library import check, ffi, lib
from .errors import Error, ForkedError, HandleError

_first_user: Optional[int] = None


def _forked(what: str) -> ForkedError:
    text = f"{what} in a child process after a fork; start processes with `spawn`"
    return ForkedError(text, lib.NERTCA_ERROR_FORKED)


def claim_process(what: str) -> None:
    """Refuses to open devices in the fork of a process that has used some: drivers and threads are in pieces there."""
    global _first_user
    process = os.getpid()
    if _first_user is None:
        _first_user = process
    elif _first_user != process:
        raise _forked(what)


class Life:
    """A handle from its creation to its end."""

    def __init__(self, name: str, handle: Any, destroy: Callable[[Any], int]) -> None:
        self._name = name
        self._handle = handle
        self._destroy = destroy
        self._process = os.getpid()

    @property
    def handle(self) -> Any:
        """For the library."""
        handle = self._handle
        if not handle:
            raise HandleError(f"{self._name}: is closed", lib.NERTCA_ERROR_HANDLE)
        if self._process != os.getpid():
            raise _forked(f"{self._name}: used")
        return handle

    @property
    def is_open(self) -> bool:
        return bool(self._handle != ffi.NULL) and self._process == os.getpid()

    def end(self) -> None:
        """Destroys it, unless that has been done."""
        if self.is_open:
            handle = self._handle
            status = self._destroy(handle)
            if status != lib.NERTCA_ERROR_HANDLE:  # another thread was faster
                check(status, handle)
            self._handle = ffi.NULL


def end_with(owner: object, end: Callable[[], None]) -> None:
    """Calls `end`, which must not refer to the owner, when the owner is gone or the interpreter exits."""

    def quietly() -> None:
        try:
            end()
        except Error:
            pass  # in use by a callback at this very moment: then the process' end is its end

    weakref.finalize(owner, quietly)


__all__: Final = ["Life", "claim_process", "end_with"]
