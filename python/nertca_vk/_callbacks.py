"""Calls from the library into Python: log messages and progress.

The library is given a number for each listener, not a pointer: a listener that is gone is not found, and nothing dangles.
"""

import itertools
import logging
import threading
from typing import Any, Callable, Final, Optional, cast

from ._checks import constant_name
from ._library import ffi, lib
from .results import Progress, State

Observer = Callable[[Progress], object]
"""Told how far training is; a true result ends it."""

LOGGER: Final = logging.getLogger("nertca_vk")
LEVELS: Final = {
    lib.NERTCA_LOG_ERROR: logging.ERROR,
    lib.NERTCA_LOG_WARNING: logging.WARNING,
    lib.NERTCA_LOG_INFO: logging.INFO,
}


class Listener:
    """What one training tells its observer, and what came of it. The library finds it while it is open."""

    _open: "dict[int, Listener]" = {}
    _numbers = itertools.count(1)

    def __init__(self, observer: Optional[Observer]) -> None:
        self.observer = observer
        self.stop = False
        self._raised: Optional[BaseException] = None
        self._number = next(self._numbers)
        self._open[self._number] = self

    @property
    def user(self) -> Any:
        """What the library hands back with each call."""
        return ffi.cast("void *", self._number)

    def close(self) -> None:
        """Forgets it: training has ended."""
        self._open.pop(self._number, None)

    def tell(self, progress: Any) -> int:
        """Non-zero where training is to end."""
        try:
            wanted = self.observer is not None and self.observer(progress_of(progress))
        except BaseException as error:  # it cannot pass through the library: whoever waits for training gets it
            self._raised = error
            return 1
        return int(bool(wanted) or self.stop)

    def raised(self) -> Optional[BaseException]:
        """What the observer raised, or a signal's handler beside it; told once."""
        error, self._raised = self._raised, None
        return error or _strays.pop(threading.get_ident(), None)

    @classmethod
    def find(cls, user: Any) -> "Optional[Listener]":
        return cls._open.get(int(ffi.cast("uintptr_t", user)))


def progress_of(struct: Any) -> Progress:
    """A `nertca_progress`."""
    return Progress(
        state=cast(State, constant_name(struct.state, "NERTCA_STATE_")),
        step=struct.step,
        iterations=struct.iterations,
        frames=struct.frames,
        loss=struct.loss,
        psnr_db=struct.psnr_db,
        iterations_per_s=struct.iterations_per_s,
    )


def _on_progress(progress: Any, user: Any) -> int:
    listener = Listener.find(user)
    return listener.tell(progress) if listener else 1


def _on_log(level: int, text: Any, user: Any) -> None:
    LOGGER.log(LEVELS.get(level, logging.INFO), "%s", ffi.string(text).decode(errors="replace"))


_strays: "dict[int, BaseException]" = {}


def _keep_stray(kind: Any, error: BaseException, trace: Any) -> None:
    """Ctrl-C is raised wherever Python is at that moment: also in a callback, but outside of the observer."""
    _strays[threading.get_ident()] = error


ON_PROGRESS: Final = ffi.callback("nertca_progress_callback", _on_progress, error=1, onerror=_keep_stray)
ON_LOG: Final = ffi.callback("nertca_log_callback", _on_log, onerror=_keep_stray)
