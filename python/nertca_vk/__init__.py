"""4D reconstruction of the beating coronary arteries from 3 or 4 X-ray angiography views, on Vulkan.

    import nertca_vk

    with nertca_vk.Reconstruction(phases=10) as reconstruction:
        for ... in ...:
            reconstruction.add_frame(pixels, nertca_vk.CArm(primary_deg=30.0, ...), phase=0)
        reconstruction.train()
        picture = reconstruction.render(nertca_vk.CArm(...), (512, 512), phase=3, component="dynamic")

Lengths are in mm, angles in degrees; arrays are NumPy's, images of shape (rows, columns). Failures raise subclasses of
`Error` with the library's text. Messages go to the logger `nertca_vk`. The program `nertca-vk` comes with this package.
Research software, not a medical device.
"""

from ._callbacks import Observer
from ._library import version as _version
from .context import Context, devices
from .errors import (
    ArgumentError,
    BufferTooSmallError,
    BusyError,
    CancelledError,
    DataError,
    DeviceError,
    DeviceLostError,
    DeviceMemoryError,
    DivergedError,
    Error,
    FileError,
    ForkedError,
    HandleError,
    InternalError,
    NotReadyError,
)
from .geometry import CArm, Geometry
from .intensity import Integral, Intensity, Linear, Logarithmic
from .reconstruction import Component, Projection, Quality, Reconstruction, Split
from .results import Branch, Correction, Device, Drawn, FrameStatus, Grid, Lesion, Progress, Scores, Tree

__version__ = _version()

__all__ = [
    "ArgumentError",
    "Branch",
    "BufferTooSmallError",
    "BusyError",
    "CArm",
    "CancelledError",
    "Component",
    "Context",
    "Correction",
    "DataError",
    "Device",
    "DeviceError",
    "DeviceLostError",
    "DeviceMemoryError",
    "DivergedError",
    "Drawn",
    "Error",
    "FileError",
    "ForkedError",
    "FrameStatus",
    "Geometry",
    "Grid",
    "Lesion",
    "HandleError",
    "Integral",
    "Intensity",
    "InternalError",
    "Linear",
    "Logarithmic",
    "NotReadyError",
    "Observer",
    "Progress",
    "Projection",
    "Quality",
    "Reconstruction",
    "Scores",
    "Split",
    "Tree",
    "devices",
]
