"""What pixel values mean."""

from dataclasses import dataclass
from typing import Any, Union

from ._checks import real, wrong
from ._library import lib


def _scale(scale: float) -> float:
    if scale == 0:
        raise wrong("scale", "is 0")
    return real("scale", scale)


@dataclass(frozen=True)
class Integral:
    """Pixel values `p` are line integrals of attenuation: `p * scale + offset`."""

    scale: float = 1.0
    offset: float = 0.0

    def fill(self, frame: Any) -> None:
        """Writes it into a `nertca_frame`."""
        frame.intensity = lib.NERTCA_INTENSITY_INTEGRAL
        frame.scale, frame.offset = _scale(self.scale), real("offset", self.offset)


@dataclass(frozen=True)
class Logarithmic:
    """Logarithmic detector: the line integral is `(i0 - p) * scale`."""

    i0: float
    """Value of an unattenuated ray."""
    scale: float = 1.0

    def fill(self, frame: Any) -> None:
        """Writes it into a `nertca_frame`."""
        frame.intensity = lib.NERTCA_INTENSITY_LOG
        frame.i0, frame.scale = real("i0", self.i0), _scale(self.scale)


@dataclass(frozen=True)
class Linear:
    """Detector linear in intensity: the line integral is `-ln(p / i0)`."""

    i0: float
    """Value of an unattenuated ray."""

    def fill(self, frame: Any) -> None:
        """Writes it into a `nertca_frame`."""
        frame.intensity = lib.NERTCA_INTENSITY_LINEAR
        frame.i0 = real("i0", self.i0)


Intensity = Union[Integral, Logarithmic, Linear]
