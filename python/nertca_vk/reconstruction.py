"""Reconstructions: frames in; training; views, volumes, trees and scores out."""

import functools
import os
import threading
import time
from typing import Any, Hashable, Literal, Mapping, Optional, Sequence, Union, cast

import numpy as np
import numpy.typing as npt

from ._callbacks import ON_PROGRESS, Listener, Observer, progress_of
from ._checks import (
    LARGEST_U32,
    PIXEL_FORMATS,
    Pixels,
    constant,
    constant_name,
    image,
    readable,
    real,
    reals,
    target,
    whole,
    writable,
    wrong,
)
from ._library import as_options, as_path, check, ffi, lib, new, read_text
from ._life import Life, end_with
from .context import Context
from .errors import BufferTooSmallError, Error
from .geometry import Geometry, as_struct
from .intensity import Integral, Intensity
from .results import Branch, Correction, CorrectionKind, Drawn, FrameStatus, FrameUse, Grid, Lesion, Progress, Scores, Tree

Component = Literal["total", "static", "dynamic"]
"""Both fields, the static background, or the dynamic field."""
Projection = Literal["drr", "mip"]
"""Line integrals of attenuation, or the largest attenuation along each ray (1/mm)."""
Quality = Literal["live", "exact"]
"""Through volumes baked from the fields, at display rates and as fine as 0.8 mm, or through the fields themselves."""
Split = Literal["train", "validation"]
"""To train on, or to score with only."""

# How long a wait leaves Ctrl-C unheard.
SLICE_MS = 100
# Of a volume: room is made before the library can refuse.
MOST_POINTS = 1 << 30
# Checkpoints may grow by a few bytes between being measured and being copied.
ROOM_BYTES = 4096


def _as_grid(grid: Grid) -> Any:
    """A `nertca_grid *` of phase 0."""
    if len(grid.points) != 3:
        raise wrong("grid.points", f"{len(grid.points)} numbers where 3 are needed")
    left, posterior, superior = (whole("grid.points", n, 1, 4096) for n in grid.points)
    if left * posterior * superior > MOST_POINTS:
        raise wrong("grid.points", f"{left} x {posterior} x {superior} exceeds the maximum, 2^30 points in total")
    struct = new("nertca_grid")
    struct.origin_mm = reals("grid.origin_mm", grid.origin_mm, 3)
    struct.spacing_mm = reals("grid.spacing_mm", grid.spacing_mm, 3)
    struct.points = [left, posterior, superior]
    return struct


def _as_view(
    geometry: Geometry, rows: int, columns: int, phase: float, component: str, projection: str, quality: str
) -> tuple[Any, Any]:
    """A `nertca_view *`, not to be written to, and what must be kept while it is used."""
    view = new("nertca_view")
    view.height, view.width = whole("shape", rows, 1, 8192), whole("shape", columns, 1, 8192)
    stated, kept = as_struct(geometry)
    view.geometry = stated[0]
    if isinstance(phase, (float, np.floating)):
        moment = real("phase", phase)
        if not 0 <= moment < LARGEST_U32:
            raise wrong("phase", f"{moment} is not a time in the beat, counted in phases from 0")
        view.phase, view.after_phase = int(moment), moment % 1.0
    else:
        view.phase = whole("phase", phase)
    view.component = constant("component", component, "NERTCA_COMPONENT_")
    view.projection = constant("projection", projection, "NERTCA_PROJECTION_")
    view.quality = constant("quality", quality, "NERTCA_QUALITY_")
    return view, kept


# A beat is drawn again and again from where it was drawn. Typed: True is no phase where 1 is one.
_known_view = functools.lru_cache(maxsize=1024, typed=True)(_as_view)


class _Room(threading.local):
    """Structs that each thread fills anew for each call."""

    def __init__(self) -> None:
        self.picture = new("nertca_image")
        self.picture.format = lib.NERTCA_PIXELS_F32


_ROOM = _Room()


class _Core:
    """What a reconstruction is without its object in Python: what ends when that is gone."""

    def __init__(self, context: Context, owns_context: bool, handle: Any) -> None:
        self.context = context
        self.owns_context = owns_context
        self.life = Life("reconstruction", handle, lib.nertca_reconstruction_destroy)
        self.listeners: set[Listener] = set()
        self.background: Optional[Listener] = None

    def end(self) -> None:
        for listener in tuple(self.listeners):
            listener.stop = True
        try:
            self.life.end()
        except Error:
            for listener in tuple(self.listeners):
                listener.stop = False
            raise
        for listener in tuple(self.listeners):
            listener.close()
        self.listeners.clear()
        if self.owns_context:
            self.context.close()


class Reconstruction:
    """A reconstruction of the beating coronary arteries: its frames, its training, its fields.

    phases: cardiac phases; for an object at rest, 1, or 2 where frames of phase 1 show it without vessels.
    still: whether the object is at rest, as in `dataset.json`: its vessels are seen by what stands out of each view, not by motion, and
        the result has one phase, 0.
    preset: "fast", "fast-mlp", "paper", "public-code", "nert-ca", "nerf-ca", "r2-gaussian", "x-gaussian" or "sax-nerf".
    depth_half_extent_mm: attenuation is searched within this distance of the isocentre plane; 100 when None.
    vessel_attenuation_per_mm: of filled vessels, where known: sets the Dice threshold.
    settings: every key that `nertca-vk train --print-config` shows, as in `{"train.iterations": 800}`.
    context: where to compute; on the best device, in a context of its own, when None.

    Everything may be called from any thread, and every call lets other threads of Python run meanwhile. Use it in a `with`
    statement, or close it: both end its training and free its memory.
    """

    def __init__(
        self,
        phases: int,
        *,
        still: bool = False,
        preset: Optional[str] = None,
        depth_half_extent_mm: Optional[float] = None,
        vessel_attenuation_per_mm: Optional[float] = None,
        settings: Optional[Mapping[str, object]] = None,
        context: Optional[Context] = None,
    ) -> None:
        options = as_options(
            {
                "phases": whole("phases", phases),
                "still": True if still else None,
                "preset": preset,
                "depth_half_extent_mm": depth_half_extent_mm,
                "vessel_attenuation_per_mm": vessel_attenuation_per_mm,
                **(settings or {}),
            }
        )
        ours = Context() if context is None else context
        made = ffi.new("nertca_reconstruction **")
        try:
            check(lib.nertca_reconstruction_create(ours.handle, options, made), ours.handle)
        except BaseException:
            if context is None:
                ours.close()
            raise
        self._core = _Core(ours, context is None, made[0])
        self._frames = 0
        self._adding = threading.Lock()
        self._finding_tree = threading.Lock()
        end_with(self, self._core.end)

    @classmethod
    def from_checkpoint(
        cls, checkpoint: "Union[bytes, str, os.PathLike[str]]", *, context: Optional[Context] = None
    ) -> "Reconstruction":
        """A reconstruction that goes on from a checkpoint file, or the bytes of one: of `save`, or of `nertca-vk train`."""
        made = cls(1, context=context)
        try:
            if isinstance(checkpoint, bytes):
                made.load_bytes(checkpoint)
            else:
                made.load(checkpoint)
        except BaseException:
            made.close()
            raise
        return made

    @property
    def handle(self) -> Any:
        """The library's handle, a `nertca_reconstruction *` of cffi."""
        return self._core.life.handle

    @property
    def context(self) -> Context:
        """Where it computes."""
        return self._core.context

    def close(self) -> None:
        """Ends training, waits for calls in other threads, and frees all memory; again does nothing.

        Raises BusyError from inside its own progress callback.
        """
        self._core.end()

    def __enter__(self) -> "Reconstruction":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # Frames

    def add_frame(
        self,
        pixels: Pixels,
        geometry: Geometry,
        *,
        phase: Optional[int] = None,
        time_s: Optional[float] = None,
        intensity: Intensity = Integral(),
        mask: "Union[npt.NDArray[np.bool_], npt.NDArray[np.uint8], None]" = None,
        split: Split = "train",
    ) -> int:
        """Adds a calibrated angiogram, which is copied, and returns its number, from 0.

        pixels: shape (rows, columns) of uint8, uint16, float32, or float64, which becomes float32; frames may differ in
            size.
        geometry: how it was taken.
        phase: cardiac phase, from 0; or `time_s`: its time in seconds, on the clock of the R-peaks.
        intensity: what pixel values mean; line integrals of attenuation unless stated.
        mask: vessels, True or non-zero, of the shape of the pixels.

        It may come at any time: training in the background takes it in by itself, other training when it next begins.
        Raises ArgumentError naming what is wrong; BusyError while training in the background in a deterministic context.
        """
        values = image("pixels", pixels, (np.uint8, np.uint16, np.float32, np.float64))
        if values.dtype == np.float64:
            values = values.astype(np.float32)
        rows, columns = values.shape
        frame = new("nertca_frame")
        frame.width, frame.height = columns, rows
        stated, matrix = as_struct(geometry)
        frame.geometry = stated[0]
        kept = [matrix, readable(values)]
        frame.pixels, frame.pixels_bytes = kept[1], values.nbytes
        frame.format = PIXEL_FORMATS[values.dtype]
        intensity.fill(frame)
        if (phase is None) == (time_s is None):
            raise wrong("phase", "either phase or time_s is needed, but not both")
        frame.phase = -1 if phase is None else whole("phase", phase, highest=2**31 - 1)
        frame.time_s = 0.0 if time_s is None else real("time_s", time_s)
        frame.split = constant("split", split, "NERTCA_SPLIT_")
        if mask is not None:
            marked = image("mask", mask, (np.bool_, np.uint8))
            if marked.shape != values.shape:
                raise wrong("mask", f"has shape {marked.shape}, but the pixels have shape {values.shape}")
            kept.append(readable(marked))
            frame.mask, frame.mask_bytes = ffi.cast("uint8_t *", kept[2]), marked.nbytes
        handle = self.handle
        with self._adding:
            check(lib.nertca_reconstruction_add_frame(handle, frame), handle)
            self._frames += 1
            return self._frames - 1

    def set_r_peaks(self, times_s: "Union[Sequence[float], npt.NDArray[np.float64]]") -> None:
        """Gives the times of the R-peaks, seconds, rising: frames with time stamps get their phase from them, and where one
        set of Gaussians moves they are fitted at their own time within it.

        Replaces those given earlier, so that a growing list can be given again and again; an empty list clears them. The phases 0
        to T - 1 are the middles of T equal parts of the beat, so a frame at an R-peak is at T - 0.5.
        """
        try:
            times = np.ascontiguousarray(times_s, dtype=np.float64)
        except (TypeError, ValueError):
            raise wrong("times_s", "are not numbers") from None
        if times.ndim != 1:
            raise wrong("times_s", f"an array of shape {times.shape}; a list of times is needed")
        handle = self.handle
        given = ffi.from_buffer("double[]", times) if len(times) else ffi.NULL
        check(lib.nertca_reconstruction_set_r_peaks(handle, given, len(times)), handle)

    def set_prior(self, points_mm: "npt.ArrayLike") -> None:
        """States vessels that are known before, for example from a CT: an array of shape (N, 3) of points along their centrelines,
        about a millimetre apart, in patient mm (left, posterior, superior) with the isocentre at the origin.

        They decide where vessels are sought first; the angiograms decide whether they are there. Replaces the points given
        earlier and acts on fits that begin later; an empty array clears them. Needs the preset `fast`.
        """
        try:
            points = np.ascontiguousarray(points_mm, dtype=np.float64)
        except (TypeError, ValueError):
            raise wrong("points_mm", "are not numbers") from None
        if points.size and (points.ndim != 2 or points.shape[1] != 3):
            raise wrong("points_mm", f"an array of shape {points.shape}; (N, 3) is needed")
        handle = self.handle
        given = ffi.from_buffer("double[]", points) if points.size else ffi.NULL
        check(lib.nertca_reconstruction_set_prior(handle, given, points.size // 3), handle)

    def correction(self, frame: int) -> Correction:
        """How the reconstruction sees a frame since training last took frames in: as stated, or as calibration corrected it.

        To draw the vessels over a frame, render with its `matrix`. What a checkpoint was corrected by is not known after
        loading it. Raises ArgumentError for a frame that was not added.
        """
        handle = self.handle
        found = new("nertca_correction")
        check(lib.nertca_reconstruction_correction(handle, whole("frame", frame), found), handle)
        left, posterior, superior = found.heart_shift_mm
        return Correction(
            kind=cast(CorrectionKind, constant_name(found.kind, "NERTCA_CORRECTION_")),
            primary_deg=found.primary_deg,
            secondary_deg=found.secondary_deg,
            table_mm=(found.table_mm[0], found.table_mm[1], found.table_mm[2]),
            heart_shift_mm=(left, posterior, superior),
            moved_px=found.moved_px,
            residual_before=found.residual_before,
            residual_after=found.residual_after,
            matrix=np.array([list(row) for row in found.matrix]),
        )

    def set_geometry(self, frame: int, geometry: Geometry) -> None:
        """States another geometry for a frame that was added; training in the background takes it in as it does a new frame,
        training that has ended when it is next started. A frame whose geometry no other frame shares is a view of its own, which
        may be left out: `frame_status` tells.

        Raises ArgumentError naming what is wrong; BusyError while training in the background in a deterministic context.
        """
        stated, kept = as_struct(geometry)
        handle = self.handle
        check(lib.nertca_reconstruction_set_geometry(handle, whole("frame", frame), stated), handle)
        del kept

    def set_view_geometry(self, frame: int, geometry: Geometry) -> None:
        """States another geometry for a frame and for all other frames of its view, as `set_geometry` does for one."""
        stated, kept = as_struct(geometry)
        handle = self.handle
        check(lib.nertca_reconstruction_set_view_geometry(handle, whole("frame", frame), stated), handle)
        del kept

    def remove_frame(self, frame: int) -> None:
        """Removes a frame; the others keep their numbers. Training takes that in as it does a new frame.

        Raises ArgumentError for a frame that was not added, or was removed before; BusyError while training in the background in
        a deterministic context.
        """
        handle = self.handle
        check(lib.nertca_reconstruction_remove_frame(handle, whole("frame", frame)), handle)

    def frame_status(self, frame: int) -> FrameStatus:
        """Phase, view and use of a frame. Raises ArgumentError for a frame that was not added or was removed."""
        handle = self.handle
        found = new("nertca_frame_status")
        check(lib.nertca_reconstruction_frame_status(handle, whole("frame", frame), found), handle)
        return FrameStatus(
            usage=cast(FrameUse, constant_name(found.usage, "NERTCA_USE_")),
            taken_in=found.taken_in == 1,
            view=found.view,
            phase=found.phase if found.phase >= 0 else None,
            after_phase=found.after_phase,
        )

    def beat_phase(self, time_s: float) -> float:
        """Phase of a time in seconds by the R-peaks, usually between two: a `phase` for `render`.

        Raises NotReadyError for a time that R-peaks do not cover.
        """
        handle = self.handle
        phase = ffi.new("double *")
        check(lib.nertca_reconstruction_beat_phase(handle, real("time_s", time_s), phase), handle)
        return float(phase[0])

    # Training

    def train(self, iterations: Optional[int] = None, *, progress: Optional[Observer] = None) -> int:
        """Trains in this thread up to `iterations` more, or to the end of the run, and returns how many were done.

        progress: told now and then how far training is, in this thread. A true result ends training; what it raises ends
        training and is raised here. Ctrl-C ends it likewise, after the iterations under way. All that was trained is kept,
        and another call goes on from there.

        Raises NotReadyError without frames enough; BusyError while it trains already; DivergedError, with the last good
        state kept.
        """
        handle = self.handle
        most = LARGEST_U32 if iterations is None else whole("iterations", iterations)
        done = ffi.new("uint32_t *")
        listener = Listener(progress)
        self._core.listeners.add(listener)
        try:
            status = lib.nertca_reconstruction_train(handle, most, ON_PROGRESS, listener.user, done)
        finally:
            self._core.listeners.discard(listener)
            listener.close()
        raised = listener.raised()
        if raised is not None:
            raise raised
        if status != lib.NERTCA_ERROR_CANCELLED:
            check(status, handle)
        return int(done[0])

    def start(self, *, progress: Optional[Observer] = None) -> None:
        """Trains in the background until the run is done, and waits for frames while there are too few.

        progress: told now and then how far training is, on the thread that trains. A true result ends training; so does what
        it raises, which `wait` and `stop` raise again.

        Raises BusyError while it does so already.
        """
        handle = self.handle
        listener = Listener(progress)
        try:
            check(lib.nertca_reconstruction_start(handle, ON_PROGRESS, listener.user), handle)
        except BaseException:
            listener.close()
            raise
        self._forget_background()
        self._core.listeners.add(listener)
        self._core.background = listener

    def pause(self) -> None:
        """Holds training in the background after the iterations under way."""
        handle = self.handle
        check(lib.nertca_reconstruction_pause(handle), handle)

    def resume(self) -> None:
        """Lets paused training go on."""
        handle = self.handle
        check(lib.nertca_reconstruction_resume(handle), handle)

    def stop(self) -> None:
        """Ends training in the background after the iterations under way and waits for that; it may be started again.

        Raises what the progress callback raised; BusyError from inside it.
        """
        handle = self.handle
        check(lib.nertca_reconstruction_stop(handle), handle)
        self._raise_from_background()

    def wait(self, limit_s: Optional[float] = None) -> bool:
        """Waits until training in the background has ended, at most so many seconds; whether it has.

        Ctrl-C ends the wait, not the training. Raises what ended training: an error of the library, or of the callback.
        """
        handle = self.handle
        ended = ffi.new("int32_t *")
        until = None if limit_s is None else time.monotonic() + real("limit_s", limit_s)
        while True:
            left_ms = SLICE_MS if until is None else (until - time.monotonic()) * 1000
            slice_ms = int(min(max(left_ms, 0), SLICE_MS))
            check(lib.nertca_reconstruction_wait(handle, slice_ms, ended), handle)
            if ended[0]:
                self._raise_from_background()
                return True
            if until is not None and time.monotonic() >= until:
                return False

    def progress(self) -> Progress:
        """State and progress, at any time."""
        handle = self.handle
        found = new("nertca_progress")
        check(lib.nertca_reconstruction_progress(handle, found), handle)
        return progress_of(found)

    def _forget_background(self) -> None:
        listener, self._core.background = self._core.background, None
        if listener is not None:
            listener.close()
            self._core.listeners.discard(listener)

    def _raise_from_background(self) -> None:
        listener = self._core.background
        self._forget_background()
        raised = listener.raised() if listener is not None else None
        if raised is not None:
            raise raised
        handle = self.handle
        failure = read_text(
            handle, lambda text, size, length: int(lib.nertca_reconstruction_failure(handle, text, size, length))
        )
        if failure and listener is not None:
            raise Error(failure)

    # What was reconstructed

    def render(
        self,
        geometry: Geometry,
        shape: tuple[int, int],
        phase: float = 0,
        *,
        component: Component = "total",
        projection: Projection = "drr",
        quality: Quality = "live",
        out: "Optional[npt.NDArray[np.float32]]" = None,
    ) -> "npt.NDArray[np.float32]":
        """Draws a view, also while training: line integrals, or 1/mm for a maximum projection; shape (rows, columns).

        phase: a float may lie between two phases, which live quality draws as line integrals of one set of moving Gaussians, and
            exact quality also for networks.
        out: an array of that shape to draw into instead of a new one, float32, rows following each other at once.

        Live pictures pass while other threads train, evaluate, or draw exact ones. Raises NotReadyError before anything was trained
        or loaded; CancelledError for an exact picture that `cancel` ended; ArgumentError naming what is wrong.
        """
        rows, columns = shape
        try:
            view, kept = _known_view(cast(Hashable, geometry), rows, columns, phase, component, projection, quality)
        except TypeError:  # an array, or a list among the geometry's fields: nothing to look up later
            view, kept = _as_view(geometry, rows, columns, phase, component, projection, quality)
        drawn = target("out", out, (view.height, view.width))
        picture = _ROOM.picture
        picture.pixels, picture.pixels_bytes = writable(drawn), drawn.nbytes
        handle = self.handle
        check(lib.nertca_reconstruction_render(handle, view, picture), handle)
        del kept
        return drawn

    def drawn(self) -> Drawn:
        """Which field the last live picture showed. Raises NotReadyError before the first one."""
        handle = self.handle
        found = new("nertca_drawn")
        check(lib.nertca_reconstruction_drawn(handle, found), handle)
        return Drawn(frames=found.frames, step=found.step)

    def cancel(self) -> None:
        """Ends `evaluate`, `tree`, `volume` and exact pictures that are under way in other threads, which raise CancelledError."""
        handle = self.handle
        check(lib.nertca_reconstruction_cancel(handle), handle)

    def volume(
        self,
        grid: Optional[Grid] = None,
        phase: int = 0,
        *,
        component: Component = "dynamic",
        out: "Optional[npt.NDArray[np.float32]]" = None,
    ) -> "npt.NDArray[np.float32]":
        """Attenuation per mm at the points of a grid, of shape (superior, posterior, left); zero outside what was
        reconstructed. Without a grid: a cube of 121 mm around the isocentre, a point per mm.

        out: an array of that shape to write into instead of a new one.
        """
        struct = _as_grid(Grid.around_isocentre() if grid is None else grid)
        left, posterior, superior = struct.points
        struct.component = constant("component", component, "NERTCA_COMPONENT_")
        struct.phase = whole("phase", phase)
        values = target("out", out, (superior, posterior, left))
        memory = ffi.cast("float *", writable(values))
        handle = self.handle
        check(lib.nertca_reconstruction_sample(handle, struct, memory, values.size), handle)
        return values

    def tree(self, *, threshold_per_mm: float = 0.0, least_branch_mm: float = 0.0) -> Tree:
        """Finds the vessels at all phases as trees of centrelines with radii. Takes seconds.

        threshold_per_mm: the threshold above which the dynamic field counts as vessel, 1/mm; 0 for the threshold that scores take.
        least_branch_mm: branches that end without reaching so far beyond the vessel they leave are left out; 0 for three
            times what the field resolves.

        Motion along a vessel is not observed in projections: what there is of it comes from smoothness alone. Raises
        NotReadyError before anything was trained or loaded; ArgumentError where there is no vessel above the threshold.
        """
        handle = self.handle
        struct = new("nertca_tree")
        struct.threshold_per_mm = real("threshold_per_mm", threshold_per_mm)
        struct.least_branch_mm = real("least_branch_mm", least_branch_mm)
        with self._finding_tree:
            check(lib.nertca_reconstruction_tree(handle, struct), handle)
            of_branches = {
                "branch_phase": np.empty(struct.branches, np.uint32),
                "branch_parent": np.empty(struct.branches, np.int32),
                "branch_first": np.empty(struct.branches, np.uint32),
                "branch_points": np.empty(struct.branches, np.uint32),
            }
            gap_mm = np.empty(struct.branches)
            points_mm = np.empty((struct.points, 3))
            radius_mm = np.empty(struct.points)
            of_doubt = {name: np.empty(struct.points) for name in ("doubt_mm", "doubt_with_motion_mm", "existence")}
            arrays: dict[str, npt.NDArray[Any]] = {
                **of_branches,
                "points_mm": points_mm,
                "radius_mm": radius_mm,
                "branch_gap_mm": gap_mm,
                **of_doubt,
            }
            kept = {name: writable(array) for name, array in arrays.items()}
            for name, memory in kept.items():
                setattr(struct, name, ffi.cast(ffi.typeof(getattr(struct, name)), memory))
            check(lib.nertca_reconstruction_tree(handle, struct), handle)
            lesions = self._lesions(handle)
        branches = [
            Branch(
                phase=int(phase),
                parent=int(parent) if parent >= 0 else None,
                points_mm=points_mm[first : first + count],
                radius_mm=radius_mm[first : first + count],
                gap_mm=float(gap),
                **{name: values[first : first + count] for name, values in of_doubt.items()},
            )
            for phase, parent, first, count, gap in zip(*of_branches.values(), gap_mm)
        ]
        return Tree(
            threshold_per_mm=struct.threshold_per_mm,
            followed=struct.followed == 1,
            branches=branches,
            lesions=lesions,
            radii_from_images=struct.radii_from_images == 1,
        )

    def _lesions(self, handle: Any) -> list[Lesion]:
        """The stenoses of the vessels that were found last."""
        count = ffi.new("size_t *")
        check(lib.nertca_reconstruction_lesion(handle, 0, ffi.NULL, count), handle)
        found = []
        for index in range(count[0]):
            lesion = new("nertca_lesion")
            check(lib.nertca_reconstruction_lesion(handle, index, lesion, ffi.NULL), handle)
            found.append(
                Lesion(
                    phase=lesion.phase,
                    branch=lesion.branch,
                    point=lesion.point,
                    from_root_mm=lesion.from_root_mm,
                    length_mm=lesion.length_mm,
                    min_diameter_mm=lesion.min_diameter_mm,
                    reference_diameter_mm=lesion.reference_diameter_mm,
                )
            )
        return found

    def set_true_vessels(
        self, inside: "Union[npt.NDArray[np.bool_], npt.NDArray[np.uint8], None]", grid: Grid, phase: int = 0
    ) -> None:
        """Says which points of a grid are vessel at a phase, in place of what was said of it: `evaluate` then scores in 3D.

        inside: True or non-zero inside vessels, of shape (superior, posterior, left); None forgets the phase.

        The true vessels are compared where they are said to be, whatever calibration did to the views. Raises ArgumentError
        naming what is wrong.
        """
        struct = _as_grid(grid)
        struct.phase = whole("phase", phase)
        handle = self.handle
        if inside is None:
            check(lib.nertca_reconstruction_set_true_vessels(handle, struct, ffi.NULL, 0), handle)
            return
        shape = tuple(struct.points)[::-1]
        given = np.asarray(inside)
        if given.dtype not in (np.bool_, np.uint8) or given.shape != shape:
            raise wrong("inside", f"{given.dtype} of shape {given.shape}; bool or uint8 of shape {shape} is needed")
        voxels = np.ascontiguousarray(given)
        memory = ffi.cast("uint8_t *", readable(voxels))
        check(lib.nertca_reconstruction_set_true_vessels(handle, struct, memory, voxels.nbytes), handle)

    def set_true_tree(self, tree: Optional[Tree]) -> None:
        """Says where the true centrelines are, and how wide the vessels: `evaluate` then finds a tree and scores it.

        tree: of one phase or more, of which 0 is one, with the same branches of as many points at each; point i of a branch is
        the same material point at every phase. None forgets it.

        Raises ArgumentError naming what is wrong.
        """
        branches = [] if tree is None else tree.branches
        struct = new("nertca_tree")
        counts = [len(branch.radius_mm) for branch in branches]
        words = {
            "branch_phase": [whole("phase", branch.phase) for branch in branches],
            "branch_first": np.cumsum([0, *counts])[:-1],
            "branch_points": counts,
        }
        for branch in branches:
            if np.shape(branch.points_mm) != (len(branch.radius_mm), 3):
                raise wrong("points_mm", f"of shape {np.shape(branch.points_mm)} with {len(branch.radius_mm)} radii")
        points_mm = np.array([point for branch in branches for point in branch.points_mm], np.float64)
        radius_mm = np.array([radius for branch in branches for radius in branch.radius_mm], np.float64)
        arrays = {name: np.array(values, np.uint32) for name, values in words.items()}
        all_arrays: dict[str, npt.NDArray[Any]] = {**arrays, "points_mm": points_mm, "radius_mm": radius_mm}
        kept = {name: readable(array) for name, array in all_arrays.items()}
        for name, memory in kept.items():
            setattr(struct, name, ffi.cast(ffi.typeof(getattr(struct, name)), memory))
        struct.branches, struct.points = len(branches), len(radius_mm)
        handle = self.handle
        check(lib.nertca_reconstruction_set_true_tree(handle, struct), handle)

    def evaluate(self, threshold_per_mm: float = 0.0) -> Scores:
        """Scores the frames that were added for validation, of which there must be one, and what was reconstructed against the
        true vessels, where `set_true_vessels` or `set_true_tree` said where they are.

        threshold_per_mm: attenuation above which the dynamic field counts as vessel; 0 for a fifth of
        `vessel_attenuation_per_mm`, or of the strongest attenuation of the field where that is unknown.

        Raises DataError without such frames; NotReadyError before anything was trained or loaded.
        """
        handle = self.handle
        found = new("nertca_scores")
        threshold = real("threshold_per_mm", threshold_per_mm)
        check(lib.nertca_reconstruction_evaluate(handle, threshold, found), handle)
        return Scores(**{name: getattr(found, name) for name in Scores.__dataclass_fields__})

    # Checkpoints

    def save(self, path: "Union[str, os.PathLike[str]]") -> None:
        """Writes everything needed to continue into a file, which appears whole or not at all; also while training.

        Raises NotReadyError before anything was trained or loaded; FileError.
        """
        handle = self.handle
        check(lib.nertca_reconstruction_save(handle, as_path(path)), handle)

    def save_bytes(self) -> bytes:
        """As `save`, into memory."""
        handle = self.handle
        length = ffi.new("size_t *")
        check(lib.nertca_reconstruction_save_memory(handle, ffi.NULL, 0, length), handle)
        while True:
            size = length[0] + ROOM_BYTES
            memory = bytearray(size)
            try:
                check(lib.nertca_reconstruction_save_memory(handle, ffi.from_buffer(memory), size, length), handle)
            except BufferTooSmallError:
                continue
            return bytes(memoryview(memory)[: length[0]])

    def load(self, path: "Union[str, os.PathLike[str]]") -> None:
        """Takes over a checkpoint file, of `save` or of `nertca-vk train`, with its settings and phases: it can be drawn at
        once, and trained further with the frames of this reconstruction.

        Raises BusyError while training in the background; DataError for a malformed file; FileError.
        """
        handle = self.handle
        check(lib.nertca_reconstruction_load(handle, as_path(path)), handle)

    def load_bytes(self, checkpoint: bytes) -> None:
        """As `load`, from memory."""
        handle = self.handle
        given = ffi.from_buffer(checkpoint)
        check(lib.nertca_reconstruction_load_memory(handle, given, len(given)), handle)
