"""The library from Python through ctypes: loads a checkpoint of `nertca-vk train` and draws a beat.

    python3 embed.py CHECKPOINT.safetensors [PICTURE.png] [LIBRARY.so]

Needs numpy, and matplotlib for the picture.
"""
import ctypes as c
import sys

import numpy as np

COMPONENT_DYNAMIC, PIXELS_F32 = 2, 3


class Geometry(c.Structure):
    _fields_ = [("size", c.c_size_t), ("primary_deg", c.c_double), ("secondary_deg", c.c_double),
                ("sid_mm", c.c_double), ("sod_mm", c.c_double), ("pixel_mm", c.c_double * 2),
                ("offset_mm", c.c_double * 2), ("table_mm", c.c_double * 3), ("matrix", c.POINTER(c.c_double))]


class View(c.Structure):
    _fields_ = [("size", c.c_size_t), ("geometry", Geometry), ("width", c.c_uint32), ("height", c.c_uint32),
                ("phase", c.c_uint32), ("component", c.c_uint32), ("projection", c.c_uint32), ("quality", c.c_uint32)]


class Image(c.Structure):
    _fields_ = [("size", c.c_size_t), ("pixels", c.c_void_p), ("pixels_bytes", c.c_size_t),
                ("stride_bytes", c.c_size_t), ("format", c.c_uint32), ("low", c.c_double), ("high", c.c_double)]


class Library:
    """Calls that raise the library's own text when they fail."""

    def __init__(self, path):
        self.library = c.CDLL(path)

    def __getattr__(self, name):
        function = getattr(self.library, "nertca_" + name)

        def call(*arguments):
            status = function(*arguments)
            if status != 0:
                text = c.create_string_buffer(512)
                self.library.nertca_last_error(None, text, c.c_size_t(512), None)
                raise RuntimeError(f"nertca_{name}: {text.value.decode()} (status {status})")

        return call


def main(checkpoint, picture="embed-python.png", path="libnertca_vk.so.0"):
    library = Library(path)
    context, reconstruction = c.c_void_p(), c.c_void_p()
    library.context_create(None, None, c.byref(context))
    library.reconstruction_create(context, b"phases = 1", c.byref(reconstruction))
    library.reconstruction_load(reconstruction, checkpoint.encode())

    size = 160
    pitch = 120.0 / 750.0 * 1100.0 / size  # 120 mm at the isocentre
    geometry = Geometry(c.sizeof(Geometry), 30.0, 20.0, 1100.0, 750.0, (pitch, pitch))
    pixels = np.zeros((size, size), np.float32)
    image = Image(c.sizeof(Image), pixels.ctypes.data, pixels.nbytes, 0, PIXELS_F32)
    beat = []
    while True:
        view = View(c.sizeof(View), geometry, size, size, len(beat), COMPONENT_DYNAMIC)
        try:
            library.reconstruction_render(reconstruction, c.byref(view), c.byref(image))
        except RuntimeError as error:
            if not beat or "phase" not in str(error):
                raise
            break  # one phase too many
        beat.append(pixels.copy())
    print(f"{len(beat)} phases; largest line integral {max(p.max() for p in beat):.4f}")

    try:
        import matplotlib
        matplotlib.use("Agg")
        import matplotlib.pyplot as plot
        figure, axes = plot.subplots(1, min(4, len(beat)), figsize=(12, 3.2), squeeze=False)
        for index, axis in enumerate(axes[0]):
            phase = index * len(beat) // len(axes[0])
            axis.imshow(beat[phase], cmap="gray_r")
            axis.set_title(f"phase {phase}")
            axis.axis("off")
        figure.savefig(picture, bbox_inches="tight")
        print("wrote", picture)
    except ImportError:
        print("matplotlib is not installed: no picture")

    library.reconstruction_destroy(reconstruction)
    library.context_destroy(context)


if __name__ == "__main__":
    if not 2 <= len(sys.argv) <= 4:
        sys.exit(__doc__)
    main(*sys.argv[1:])
