#!/usr/bin/env python3
"""Measures the overhead of the Python package over the C API: renders through both in turn, from one checkpoint.

    python3 tools/bench-python.py RUN/checkpoints/....safetensors [PAIRS]

Needs the wheel (tools/wheel). The structs for the C API are prepared in advance, so the difference contains all work of the
package, i.e. its checks and structs. Both render into an existing array.
"""

import statistics
import sys
import time

import numpy as np
from nertca_vk import CArm, Reconstruction, geometry
from nertca_vk._library import check, ffi, lib

SIZES = (100, 256, 512)
FIELD_MM = 130.0


def c_arm(size):
    return CArm(30.0, 20.0, sid_mm=1100.0, sod_mm=750.0, pixel_mm=FIELD_MM / 750.0 * 1100.0 / size)


def through_c(reconstruction, size):
    """A call of the C API and nothing else; the structs and the picture live as long as it."""
    view = ffi.new("nertca_view *", {"size": ffi.sizeof("nertca_view"), "width": size, "height": size, "component": 2})
    view.geometry = geometry.as_struct(c_arm(size))[0][0]
    pixels = np.empty((size, size), np.float32)
    image = ffi.new("nertca_image *", {"size": ffi.sizeof("nertca_image"), "format": lib.NERTCA_PIXELS_F32})
    image.pixels, image.pixels_bytes = ffi.from_buffer(pixels), pixels.nbytes
    handle, render = reconstruction.handle, lib.nertca_reconstruction_render

    def draw():
        check(render(handle, view, image), handle)
        return pixels

    return draw


def through_python(reconstruction, size):
    view, pixels = c_arm(size), np.empty((size, size), np.float32)
    return lambda: reconstruction.render(view, (size, size), component="dynamic", out=pixels)


def timed(draw):
    begin = time.perf_counter()
    draw()
    return 1e6 * (time.perf_counter() - begin)


def main(checkpoint, pairs=1000):
    with Reconstruction.from_checkpoint(checkpoint) as reconstruction:
        print(f"{reconstruction.context.describe()['device']['name']}, {pairs} pairs of each size")
        for size in SIZES:
            c, python = through_c(reconstruction, size), through_python(reconstruction, size)
            assert np.array_equal(c(), python()), "both must draw the same"
            # Each goes first half of the time.
            times = [(timed(c), timed(python)) if i % 2 else (timed(python), timed(c))[::-1] for i in range(pairs)]
            in_c, in_python = (statistics.median(column) for column in zip(*times))
            more = statistics.median(python - c for c, python in times)
            print(f"{size} x {size}: C {in_c:.0f} us, Python {in_python:.0f} us, "
                  f"median difference of pairs {more:.0f} us = {100 * more / in_c:.2f} %")


if __name__ == "__main__":
    if not 2 <= len(sys.argv) <= 3:
        sys.exit(__doc__)
    main(sys.argv[1], *map(int, sys.argv[2:]))
