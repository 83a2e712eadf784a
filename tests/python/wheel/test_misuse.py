"""Whatever is given, the answer is an exception that names it."""

import os
import pickle
from pathlib import Path
from typing import Any, Callable

import nertca_vk
import numpy as np
import pytest
from nertca_vk import ArgumentError, CArm, Context, Grid, Reconstruction
from scene import PHASES, SIZE, empty, filled, geometry, pixels

NAN = float("nan")
GOOD = pixels(0, 0)
C_ARM = geometry(0)


def with_value(value: float) -> Any:
    image = GOOD.copy()
    image[3, 7] = value
    return image


class Liar:
    """Says it is an array, and is none."""

    def __array__(self, *_: object, **__: object) -> Any:
        raise RuntimeError("no")


@pytest.mark.parametrize(
    "image, said",
    [
        (with_value(NAN), "column 7, row 3"),
        (with_value(np.inf), "column 7, row 3"),
        (np.full((SIZE, SIZE), 1e300), "not a finite number"),
        (GOOD.astype(np.int32), "int32"),
        (GOOD.astype(np.float16), "float16"),
        (GOOD.astype(complex), "complex128"),
        (GOOD.astype(object), "object"),
        (GOOD.astype(str), "U"),
        (np.zeros(GOOD.shape, "M8[s]"), "datetime64"),
        (np.zeros(GOOD.shape, [("a", "f4"), ("b", "f4")]), "a"),
        (GOOD.ravel(), r"shape \(400,\)"),
        (GOOD[None], r"shape \(1, 20, 20\)"),
        (np.float32(3.0), r"shape \(\)"),
        (np.zeros((0, SIZE), np.float32), "height: 0"),
        (np.zeros((SIZE, 0), np.float32), "width: 0"),
        (np.zeros((1, 8193), np.float32), "width: 8193"),
        (None, "object"),
        ("pixels", "U"),
    ],
)
def test_images_that_cannot_be(context: Context, image: Any, said: str) -> None:
    with empty(context) as made, np.errstate(over="ignore"):
        with pytest.raises(ArgumentError, match=said):
            made.add_frame(image, C_ARM, phase=0)
        assert made.add_frame(GOOD, C_ARM, phase=0) == 0, "nothing was added before"


def test_arrays_that_are_no_arrays(context: Context) -> None:
    with empty(context) as made, pytest.raises(RuntimeError):
        made.add_frame(Liar(), C_ARM, phase=0)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "options, said",
    [
        ({}, "phase: either phase or time_s"),
        ({"phase": 0, "time_s": 1.0}, "phase: either phase or time_s"),
        ({"phase": PHASES}, "phases go from 0 to 2"),
        ({"phase": -1}, "phase: -1"),
        ({"phase": 1 << 40}, "phase"),
        ({"phase": 0.5}, "phase: 0.5 is not a whole number"),
        ({"time_s": NAN}, "time"),
        ({"time_s": "now"}, "time_s: 'now' is not a number"),
        ({"phase": 0, "split": "test"}, "split: 'test' is not one of train, validation"),
        ({"phase": 0, "mask": np.zeros((SIZE, SIZE + 1), bool)}, r"mask: has shape \(20, 21\)"),
        ({"phase": 0, "mask": np.zeros((SIZE, SIZE))}, "mask: values of type float64"),
        ({"phase": 0, "intensity": nertca_vk.Linear(i0=0.0)}, "i0"),
        ({"phase": 0, "intensity": nertca_vk.Linear(i0=NAN)}, "i0"),
        ({"phase": 0, "intensity": nertca_vk.Integral(scale=0.0)}, "scale: is 0"),
        ({"phase": 0, "intensity": nertca_vk.Integral(scale=NAN)}, "scale"),
        ({"phase": 0, "intensity": nertca_vk.Logarithmic(i0=np.inf)}, "i0"),
    ],
)
def test_frames_that_cannot_be(context: Context, options: Any, said: str) -> None:
    with empty(context) as made, pytest.raises(ArgumentError, match=said):
        made.add_frame(GOOD, C_ARM, **options)


@pytest.mark.parametrize(
    "given, said",
    [
        (CArm(NAN, 0, 1000, 600, 1), "primary_deg"),
        (CArm(0, 0, 0, 600, 1), "sid_mm"),
        (CArm(0, 0, 1000, 10, 1), "sod_mm"),
        (CArm(0, 0, 1000, 600, -1.0), "pixel_mm"),
        (CArm(0, 0, 1000, 600, (1.0, 1.0, 1.0)), "pixel_mm: 3 numbers where 2"),  # type: ignore[arg-type]
        (CArm(0, 0, 1000, 600, 1.0, offset_mm=(NAN, 0.0)), "offset_mm"),
        (CArm(0, 0, 1000, 600, 1.0, table_mm=(1.0, 2.0)), "table_mm: 2 numbers where 3"),  # type: ignore[arg-type]
        (CArm("left", 0, 1000, 600, 1.0), "primary_deg: 'left' is not a number"),  # type: ignore[arg-type]
        (np.zeros((3, 4)), "matrix"),
        (np.full((3, 4), NAN), "matrix"),
        (np.eye(4), r"shape \(4, 4\)"),
        (None, "geometry"),
        ("LAO 30", "geometry"),
    ],
)
def test_geometries_that_cannot_be(context: Context, given: Any, said: str) -> None:
    with filled(context) as made:
        made.train(1)
        for call in (
            lambda: made.add_frame(GOOD, given, phase=0),
            lambda: made.set_geometry(0, given),
        ):
            with pytest.raises(ArgumentError, match=said):
                call()
        if "sod_mm" not in said:  # the source may stand inside the vessels of a picture
            with pytest.raises(ArgumentError, match=said):
                made.render(given, (SIZE, SIZE))


@pytest.mark.parametrize(
    "options, said",
    [
        ({"shape": (0, 5)}, "shape: 0"),
        ({"shape": (5, 9000)}, "shape: 9000"),
        ({"shape": (2.5, 5)}, "shape: 2.5"),
        ({"phase": PHASES}, "phase"),
        ({"phase": -1}, "phase"),
        ({"phase": -0.5}, "phase: -0.5"),
        ({"phase": NAN}, "phase: nan"),
        ({"phase": PHASES + 0.5}, "phase"),
        ({"phase": 0.5, "projection": "mip"}, "between two phases"),
        ({"component": "vessels"}, "component: 'vessels' is not one of "),
        ({"projection": "mean"}, "projection"),
        ({"quality": "best"}, "quality"),
        ({"out": np.zeros((SIZE, SIZE))}, "out: float64"),
        ({"out": np.zeros((SIZE, SIZE + 1), np.float32)}, "out"),
        ({"out": np.zeros((SIZE, 2 * SIZE), np.float32)[:, ::2]}, "out"),
        ({"out": np.frombuffer(bytes(4 * SIZE * SIZE), np.float32).reshape(SIZE, SIZE)}, "out: is read-only"),
        ({"out": [[0.0]]}, "out: list"),
    ],
)
def test_views_that_cannot_be(context: Context, options: Any, said: str) -> None:
    with filled(context) as made:
        made.train(1)
        with pytest.raises(ArgumentError, match=said):
            made.render(**{"geometry": C_ARM, "shape": (SIZE, SIZE), **options})


@pytest.mark.parametrize(
    "grid, said",
    [
        (Grid((0, 0, 0), (1, 1, 1), (0, 1, 1)), "grid.points: 0"),
        (Grid((0, 0, 0), (1, 1, 1), (5000, 1, 1)), "grid.points: 5000"),
        (Grid((0, 0, 0), (1, 1, 0), (1, 1, 1)), "spacing"),
        (Grid((NAN, 0, 0), (1, 1, 1), (1, 1, 1)), "origin"),
        (Grid((0, 0), (1, 1, 1), (1, 1, 1)), "grid.origin_mm: 2 numbers where 3"),  # type: ignore[arg-type]
        (Grid((0, 0, 0), (1, 1, 1), (1, 1)), "grid.points: 2 numbers where 3"),  # type: ignore[arg-type]
    ],
)
def test_grids_that_cannot_be(context: Context, grid: Grid, said: str) -> None:
    with filled(context) as made:
        made.train(1)
        with pytest.raises(ArgumentError, match=said):
            made.volume(grid)


def test_grids_too_large_for_any_memory(context: Context) -> None:
    with filled(context) as made:
        made.train(1)
        with pytest.raises(ArgumentError, match="points"):
            made.volume(Grid((0, 0, 0), (1, 1, 1), (4096, 4096, 4096)))


@pytest.mark.parametrize("times", [[1.0], [2.0, 1.0], [0.0, NAN], [[1.0, 2.0]], ["a"], None])
def test_r_peaks_that_cannot_be(context: Context, times: Any) -> None:
    with empty(context) as made, pytest.raises(ArgumentError):
        made.set_r_peaks(times)


@pytest.mark.parametrize("points", [[1.0, 2.0, 3.0], [[1.0, 2.0]], [[0.0, 0.0, NAN]], [["a", "b", "c"]], None])
def test_priors_that_cannot_be(points: Any) -> None:
    with nertca_vk.Context(device="none") as bare, nertca_vk.Reconstruction(3, context=bare) as made:
        made.set_prior([[0.0, 1.0, 2.0], [0.0, 1.0, 3.0]])
        made.set_prior([])
        with pytest.raises(ArgumentError):
            made.set_prior(points)


def test_options_that_cannot_be(context: Context) -> None:
    for options in (
        {"phases": 0},
        {"phases": -1},
        {"phases": 2.5},
        {"phases": 3, "still": True},
        {"phases": 3, "preset": "slow"},
        {"phases": 3, "depth_half_extent_mm": NAN},
        {"phases": 3, "vessel_attenuation_per_mm": -1.0},
        {"phases": 3, "settings": {"train.iteration": 5}},
        {"phases": 3, "settings": {"train.iterations": "many"}},
        {"phases": 3, "settings": {"train.iterations": object()}},
    ):
        with pytest.raises(ArgumentError):
            Reconstruction(context=context, **options)
    for asked in ({"memory_limit_mib": 0}, {"layers": "f16"}, {"memory_limit_mib": -5}):
        with pytest.raises(ArgumentError):
            Context(**asked)
    with pytest.raises(nertca_vk.DeviceError, match="no device matches"):
        Context("a device that nobody has")


def test_before_and_after_its_time(context: Context, tmp_path: Path) -> None:
    with empty(context) as made:
        early: list[Callable[[], object]] = [
            lambda: made.train(),
            lambda: made.render(C_ARM, (SIZE, SIZE)),
            lambda: made.volume(),
            lambda: made.tree(),
            lambda: made.save(tmp_path / "nothing"),
            lambda: made.save_bytes(),
        ]
        for call in early:
            with pytest.raises(nertca_vk.NotReadyError):
                call()
        wrong: list[Callable[[], object]] = [
            lambda: made.correction(0),
            lambda: made.set_geometry(0, C_ARM),
            lambda: made.train(-1),
        ]
        for call in wrong:
            with pytest.raises(ArgumentError):
                call()
    for again in (made.close, made.close):
        again()
    late: list[Callable[[], object]] = [
        lambda: made.train(),
        lambda: made.start(),
        lambda: made.stop(),
        lambda: made.wait(),
        lambda: made.progress(),
        lambda: made.add_frame(GOOD, C_ARM, phase=0),
        lambda: made.render(C_ARM, (SIZE, SIZE)),
        lambda: made.__enter__().evaluate(),
    ]
    for call in late:
        with pytest.raises(nertca_vk.HandleError, match="closed"):
            call()


def test_a_context_is_closed_last() -> None:
    context = Context("none")
    made = Reconstruction(2, context=context)
    with pytest.raises(nertca_vk.BusyError):
        context.close()
    with pytest.raises(nertca_vk.DeviceError, match="without a device"):
        made.start()
    made.close()
    context.close()
    context.close()
    with pytest.raises(nertca_vk.HandleError, match="context: is closed"):
        Reconstruction(2, context=context)


def test_checkpoints_that_cannot_be(context: Context, tmp_path: Path) -> None:
    with filled(context) as made:
        made.train(2)
        good = made.save_bytes()
        (tmp_path / "file").write_bytes(b"")
        with pytest.raises(nertca_vk.FileError, match="file"):
            made.save(tmp_path / "file" / "checkpoint")
        with pytest.raises(ArgumentError, match="path: .* has a zero inside"):
            made.save("a\0b")
        with pytest.raises(ArgumentError, match="UTF-8"):
            made.save(os.fsdecode(os.fsencode(tmp_path) + b"/\xff"))
        with pytest.raises(TypeError):
            made.save(5)  # type: ignore[arg-type]
    (tmp_path / "empty").write_bytes(b"")
    for bad in (b"", b"checkpoint", good[:1000], good[:-1], b"\xff" * 64):
        with pytest.raises(nertca_vk.Error):
            Reconstruction.from_checkpoint(bad, context=context)
    with pytest.raises(nertca_vk.DataError):
        Reconstruction.from_checkpoint(tmp_path / "empty", context=context)
    with pytest.raises(nertca_vk.FileError, match="missing"):
        Reconstruction.from_checkpoint(tmp_path / "missing", context=context)
    with pytest.raises(TypeError):
        Reconstruction.from_checkpoint(good, context=context).load_bytes("text")  # type: ignore[arg-type]


def test_handles_do_not_travel(context: Context) -> None:
    with empty(context) as made:
        for thing in (made, context):
            with pytest.raises(TypeError):
                pickle.dumps(thing)
    error = pickle.loads(pickle.dumps(ArgumentError("text", -1)))
    assert type(error) is ArgumentError and error.status == -1 and str(error) == "text"


def test_a_tree_needs_vessels(context: Context) -> None:
    with filled(context) as made:
        made.train(2)
        with pytest.raises(ArgumentError, match="threshold_per_mm"):
            made.tree(threshold_per_mm=1e9)
        for bad in ({"threshold_per_mm": -1.0}, {"least_branch_mm": -1.0}, {"threshold_per_mm": "high"}):
            with pytest.raises(ArgumentError):
                made.tree(**bad)
