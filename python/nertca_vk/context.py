"""Contexts: a device with limits, whose messages go to the logger `nertca_vk`."""

import json
import os
from typing import Any, Optional, Union

from ._callbacks import ON_LOG
from ._library import as_options, check, ffi, lib, new, read_text
from ._life import Life, claim_process, end_with
from .results import Device


def devices() -> list[Device]:
    """The Vulkan devices of this machine, usable or not.

    Raises DeviceError where the Vulkan loader or a driver is missing; the text names what to install.
    """
    claim_process("devices: listed")
    found = json.loads(read_text(ffi.NULL, lib.nertca_devices))
    fields = Device.__dataclass_fields__
    return [Device(**{name: device[name] for name in fields}) for device in found]


class Context:
    """A device with limits. Make one per device, and any number of reconstructions in it; close it last.

    device: index, part of the name, or UUID; "none" for a context that checks and keeps frames but cannot train; the best
        device when None.
    validation: whether the Khronos validation layer looks on; it reports to the log.
    cache_dir: where compiled kernels are kept between processes.
    memory_limit_mib: ceiling on device memory of everything made from the context.
    deterministic: refuses what would make results depend on timing, as frames added while training in the background.
    layers: "f32" or "matrices", how the network is computed, for which the device decides otherwise.

    Raises DeviceError where no device fits; where a package must be installed, the text names it.
    """

    def __init__(
        self,
        device: Optional[str] = None,
        *,
        validation: bool = False,
        cache_dir: "Union[str, os.PathLike[str], None]" = None,
        memory_limit_mib: Optional[int] = None,
        deterministic: bool = False,
        layers: Optional[str] = None,
    ) -> None:
        claim_process("context: opened")
        options = as_options(
            {
                "device": None if device is None else str(device),
                "validation": bool(validation),
                "cache_dir": None if cache_dir is None else os.fspath(cache_dir),
                "memory_limit_mib": memory_limit_mib,
                "deterministic": bool(deterministic),
                "layers": layers,
            }
        )
        log = new("nertca_log")
        log.callback, log.level = ON_LOG, lib.NERTCA_LOG_INFO
        made = ffi.new("nertca_context **")
        check(lib.nertca_context_create(options, log, made), ffi.NULL)
        self._life = Life("context", made[0], lib.nertca_context_destroy)
        end_with(self, self._life.end)

    @property
    def handle(self) -> Any:
        """The library's handle, a `nertca_context *` of cffi."""
        return self._life.handle

    def describe(self) -> dict[str, Any]:
        """What the device can do, which ways of computing were chosen and why, and memory in use (bytes)."""
        handle = self.handle
        described: dict[str, Any] = json.loads(
            read_text(handle, lambda text, size, length: int(lib.nertca_context_describe(handle, text, size, length)))
        )
        return described

    def close(self) -> None:
        """Closes the device; again does nothing. Raises BusyError while reconstructions made from it are open."""
        self._life.end()

    def __enter__(self) -> "Context":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
