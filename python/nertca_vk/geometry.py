"""How images are taken. Patient coordinates are left, posterior, superior (LPS), in mm from the isocentre."""

import functools
from dataclasses import dataclass
from typing import Any, Union

import numpy as np
import numpy.typing as npt

from ._checks import real, reals, wrong
from ._library import ffi, new


@dataclass(frozen=True)
class CArm:
    """A C-arm's position, as DICOM states it."""

    primary_deg: float
    """Primary angle in degrees, LAO positive (PositionerPrimaryAngle)."""
    secondary_deg: float
    """Secondary angle in degrees, cranial positive (PositionerSecondaryAngle)."""
    sid_mm: float
    """Source to detector, mm."""
    sod_mm: float
    """Source to isocentre, mm."""
    pixel_mm: Union[float, tuple[float, float]]
    """Pixel pitch on the detector, mm: one number, or along columns and rows."""
    offset_mm: tuple[float, float] = (0.0, 0.0)
    """Offset of the detector's centre along columns and rows, mm."""
    table_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """How far the table has carried the patient (LPS), mm."""


Geometry = Union[CArm, npt.NDArray[np.float64]]
"""A C-arm, or a projection of shape (3, 4) from patient mm to homogeneous pixels (column, row; whole numbers are pixel
centres)."""


def as_struct(geometry: Geometry) -> tuple[Any, Any]:
    """A geometry as a `nertca_geometry *`, not to be written to, and what must be kept while it is used."""
    if isinstance(geometry, CArm):
        try:
            return _of_c_arm(geometry), None
        except TypeError:  # a list among its fields: nothing to look up later
            return _of_c_arm.__wrapped__(geometry), None
    try:
        matrix = np.asarray(geometry, dtype=np.float64)
    except (TypeError, ValueError):
        raise wrong("geometry", f"{type(geometry).__name__} is neither a CArm nor a projection") from None
    if matrix.shape != (3, 4):
        raise wrong("geometry", f"an array of shape {matrix.shape}; a CArm or a projection of shape (3, 4) is needed")
    struct = new("nertca_geometry")
    struct.matrix = kept = ffi.new("double[12]", matrix.ravel().tolist())
    return struct, kept


# A beat is drawn again and again from where it was drawn.
@functools.lru_cache(maxsize=256)
def _of_c_arm(c_arm: CArm) -> Any:
    struct = new("nertca_geometry")
    pitch: Any = c_arm.pixel_mm
    struct.primary_deg = real("primary_deg", c_arm.primary_deg)
    struct.secondary_deg = real("secondary_deg", c_arm.secondary_deg)
    struct.sid_mm = real("sid_mm", c_arm.sid_mm)
    struct.sod_mm = real("sod_mm", c_arm.sod_mm)
    struct.pixel_mm = reals("pixel_mm", [pitch, pitch] if np.ndim(pitch) == 0 else pitch, 2)
    struct.offset_mm = reals("offset_mm", c_arm.offset_mm, 2)
    struct.table_mm = reals("table_mm", c_arm.table_mm, 3)
    return struct
