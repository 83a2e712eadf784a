"""The package knows all of the header: what is added there must be taken up here, or named as left out."""

import re
from dataclasses import fields
from pathlib import Path

import nertca_vk
import pytest
from nertca_vk import _library, errors, results

PACKAGE = Path(nertca_vk.__file__).parent
# Made by the caller from what it has: devices of its own, buffers and semaphores of the device.
LEFT_OUT = {
    "nertca_context_adopt",
    "nertca_reconstruction_render_buffer",
    "nertca_reconstruction_sample_buffer",
    "nertca_buffer_create",
    "nertca_buffer_export_fd",
    "nertca_buffer_memory",
    "nertca_buffer_destroy",
    "nertca_semaphore_create",
    "nertca_semaphore_export_fd",
    "nertca_semaphore_signal",
    "nertca_semaphore_destroy",
    "nertca_status_text",
}


def test_every_function_is_called() -> None:
    declared = set(re.findall(r"^[a-z].*?\b(nertca_\w+)\(", _library.HEADER.read_text(), re.MULTILINE))
    declared = {name for name in declared if not name.endswith("_callback")}
    assert len(declared) > 30
    called = {name for path in PACKAGE.glob("*.py") for name in re.findall(r"\blib\.(nertca_\w+)", path.read_text())}
    called |= set(re.findall(r"\blibrary\.(nertca_\w+)", (PACKAGE / "_library.py").read_text()))
    assert declared - called == LEFT_OUT


def test_every_status_has_an_exception() -> None:
    assert set(_library.STATUS_NAMES.values()) == set(errors.BY_STATUS)
    assert len(set(errors.BY_STATUS.values())) == len(errors.BY_STATUS)
    for name, kind in errors.BY_STATUS.items():
        assert issubclass(kind, nertca_vk.Error) and getattr(nertca_vk, kind.__name__) is kind
        status = getattr(_library.lib, f"NERTCA_ERROR_{name}")
        found = errors.failure(name, status, "text")
        assert type(found) is kind and found.status == status and str(found) == "text"


@pytest.mark.parametrize(
    "struct, known",
    [
        ("nertca_progress", results.Progress),
        ("nertca_correction", results.Correction),
        ("nertca_scores", results.Scores),
        ("nertca_frame_status", results.FrameStatus),
        ("nertca_drawn", results.Drawn),
        ("nertca_geometry", nertca_vk.CArm),
        ("nertca_grid", results.Grid),
    ],
)
def test_structs_are_known_whole(struct: str, known: type) -> None:
    declared = {name for name, _ in _library.ffi.typeof(struct).fields} - {"size"}
    if known is nertca_vk.CArm:
        declared -= {"matrix"}  # an array in its place
    if known is results.Grid:
        declared -= {"component", "phase"}  # arguments beside it
    assert declared == {field.name for field in fields(known)}


@pytest.mark.parametrize("struct", ["nertca_frame", "nertca_view", "nertca_image", "nertca_tree"])
def test_every_field_of_other_structs_is_set_or_known(struct: str) -> None:
    kept_at_zero = {"stride_bytes", "mask_stride_bytes", "low", "high"}  # rows follow each other; for 8-bit pictures
    source = "".join((PACKAGE / name).read_text() for name in ("reconstruction.py", "intensity.py"))
    for name, _ in _library.ffi.typeof(struct).fields:
        assert name in kept_at_zero or re.search(rf'\.{name}\b|"{name}"', source), f"{struct}.{name}"
