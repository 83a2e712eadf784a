"""A small moving scene: line integrals of a blob that moves over a gradient, seen from three sides."""

from typing import Any, Iterator

import numpy as np
import numpy.typing as npt
from nertca_vk import CArm, Context, Reconstruction

SIZE = 20
VIEWS = 3
PHASES = 3
ANGLES_DEG = ((-30.0, 20.0), (40.0, -10.0), (85.0, 15.0))
# Small enough for a CPU driver.
SETTINGS: dict[str, object] = {
    "train.rays": 21,
    "train.chunk_samples": 1024,
    "train.iterations": 60,
    "train.checkpoint_every": 20,
    "march.static_samples": 24,
    "march.render_samples": 32,
    "static.grid": 9,
    "dynamic.half_extent_mm": 20,
}


def geometry(view: int) -> CArm:
    primary_deg, secondary_deg = ANGLES_DEG[view]
    return CArm(primary_deg, secondary_deg, sid_mm=1000.0, sod_mm=600.0, pixel_mm=120.0 / SIZE)


def pixels(view: int, phase: int) -> npt.NDArray[np.float32]:
    row, column = np.mgrid[0:SIZE, 0:SIZE] / SIZE
    distance2 = (column - 0.4 - 0.1 * phase) ** 2 + (row - 0.5 + 0.05 * view) ** 2
    integrals: npt.NDArray[np.float64] = 0.8 + 0.3 * column - 0.2 * row + 0.5 * np.exp(-distance2 / 0.005)
    return integrals.astype(np.float32)


def empty(context: Context, **settings: object) -> Reconstruction:
    return Reconstruction(
        PHASES,
        depth_half_extent_mm=90.0,
        vessel_attenuation_per_mm=0.01,
        settings={**SETTINGS, **settings},
        context=context,
    )


def frames() -> Iterator[tuple[int, int, npt.NDArray[np.float32]]]:
    for view in range(VIEWS):
        for phase in range(PHASES):
            yield view, phase, pixels(view, phase)


def filled(context: Context, **settings: object) -> Reconstruction:
    made = empty(context, **settings)
    for view, phase, image in frames():
        made.add_frame(image, geometry(view), phase=phase)
    return made


def endless(context: Context) -> Reconstruction:
    """One whose training does not end by itself while a test looks on."""
    return filled(context, **{"train.iterations": 1_000_000})


def drawn(reconstruction: Reconstruction, **options: Any) -> npt.NDArray[np.float32]:
    return reconstruction.render(geometry(0), (SIZE, SIZE), quality="exact", **options)
