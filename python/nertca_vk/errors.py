"""What can go wrong: one exception for each kind of status, with the library's own text."""


class Error(Exception):
    """Any failure of the library. `status` is its number in `nertca_vk.h`, the message its text."""

    status: int

    def __init__(self, text: str, status: int = 0) -> None:
        super().__init__(text)
        self.status = status

    def __reduce__(self) -> tuple[object, ...]:
        return type(self), (str(self), self.status)


class ArgumentError(Error, ValueError):
    """An argument is out of range, has the wrong shape or type, or contradicts another."""


class HandleError(Error):
    """The object was closed."""


class DataError(Error):
    """Data given (a checkpoint, say) are malformed."""


class FileError(Error):
    """The operating system refused a file operation."""


class DeviceError(Error):
    """No device fits, or it lacks what was asked for; where a package must be installed, the text names it."""


class DeviceLostError(Error):
    """The device stopped answering: close everything made from the context, then the context."""


class DeviceMemoryError(Error):
    """Memory ran out, or the context's limit was reached."""


class DivergedError(Error):
    """Training diverged; the last good state is kept."""


class CancelledError(Error):
    """A callback ended the call."""


class BusyError(Error):
    """It cannot be done while something else goes on: training, or objects that are still open."""


class BufferTooSmallError(Error):
    """A result grew while it was fetched; ask again."""


class NotReadyError(Error):
    """It needs something that is still to come: frames, or training."""


class ForkedError(Error):
    """Used in a child process after a fork: Vulkan does not survive one. Start processes with `spawn` instead."""


class InternalError(Error):
    """A fault of the library. Please report it."""


BY_STATUS: dict[str, type[Error]] = {
    "ARGUMENT": ArgumentError,
    "HANDLE": HandleError,
    "DATA": DataError,
    "IO": FileError,
    "DEVICE": DeviceError,
    "DEVICE_LOST": DeviceLostError,
    "MEMORY": DeviceMemoryError,
    "DIVERGED": DivergedError,
    "CANCELLED": CancelledError,
    "BUSY": BusyError,
    "BUFFER": BufferTooSmallError,
    "NOT_READY": NotReadyError,
    "FORKED": ForkedError,
    "INTERNAL": InternalError,
}
"""By the name of the status in `nertca_vk.h`, without `NERTCA_ERROR_`."""


def failure(name: str, status: int, text: str) -> Error:
    """The exception of a status, by its name."""
    return BY_STATUS.get(name, InternalError)(text, status)
