"""What the library answers."""

from dataclasses import dataclass, field
from typing import Literal, Optional

import numpy as np
import numpy.typing as npt

State = Literal["idle", "running", "paused", "waiting", "finished", "cancelled", "failed"]
CorrectionKind = Literal["stated", "static", "breathing"]
FrameUse = Literal["training", "validation", "no_phase", "one_phase"]


@dataclass(frozen=True)
class Progress:
    """How far training is."""

    state: State
    step: int
    """Iterations done."""
    iterations: int
    """Length of the run."""
    frames: int
    """Frames trained on."""
    loss: float
    """Loss of the last iteration."""
    psnr_db: float
    """PSNR of the last iteration's rays, dB; NaN while Gaussians are fitted, which have no rays."""
    iterations_per_s: float
    """Iterations per second since training was last begun."""


@dataclass(frozen=True)
class Correction:
    """How calibration sees a frame."""

    kind: CorrectionKind
    primary_deg: float
    """Added to the stated primary angle, degrees."""
    secondary_deg: float
    """Added to the stated secondary angle, degrees."""
    table_mm: tuple[float, float, float]
    """How much further than stated the table has carried the patient (LPS), mm."""
    heart_shift_mm: tuple[float, float, float]
    """Where breathing has carried the heart in this frame (LPS), mm."""
    moved_px: float
    """Root mean square of how far the correction moves the heart's image in this view, pixels."""
    residual_before: float
    """What does not agree with the other views, as a share of what moves, before."""
    residual_after: float
    """And after."""
    matrix: npt.NDArray[np.float64]
    """All of it, as a projection of shape (3, 4): a geometry to draw the vessels over the frame with."""


@dataclass(frozen=True)
class FrameStatus:
    """Phase, view and use of a frame."""

    usage: FrameUse
    """"training"; "validation"; "no_phase" while R-peaks do not cover its time; "one_phase" where training frames show its view
    at one phase only, so that nothing in it is known to move."""
    taken_in: bool
    """Whether training used it, as it is now, when it last took frames in."""
    view: int
    """Number of its view: frames of one size whose geometries agree within a tenth of a pixel have the same."""
    phase: Optional[int]
    """Phase nearest to its time, from 0; None while it is not known."""
    after_phase: float
    """Time after that phase, counted in phases, from -0.5 to 0.5; -0.5 after phase 0 for a frame at an R-peak."""


@dataclass(frozen=True)
class Drawn:
    """Field that a live picture showed."""

    frames: int
    """Frames that it was fitted to; 0 for a checkpoint that was loaded."""
    step: int
    """Iterations after which the oldest part of the picture was read."""


@dataclass(frozen=True)
class Scores:
    """Scores on the frames added for validation, and in 3D where the true vessels are known."""

    step: int
    """Iterations of the model."""
    images: int
    """Images scored."""
    dice_dynamic: float
    """Mean Dice of the moving vessels; NaN without masks."""
    dice_total: float
    """Mean Dice of both fields; NaN without masks."""
    psnr_db: float
    """Mean PSNR, dB."""
    ssim: float
    """Mean structural similarity."""
    threshold_per_mm: float
    """Attenuation above which the dynamic field counts as vessel, 1/mm."""
    volume_phases: int
    """Phases whose true vessels are known as voxels (`set_true_vessels`); what follows are means over them, NaN without."""
    tree_phases: int
    """Phases whose true vessels are known as a tree (`set_true_tree`)."""
    volume_dice: float
    """Dice of the voxels that are vessel."""
    chamfer_mm: float
    """Mean distance of a voxel of one set to the nearest of the other, both directions weighing the same, mm."""
    hausdorff95_mm: float
    """The larger of both directions' 95th percentiles of these distances, mm."""
    true_centreline_found: float
    """Share of the true centreline's voxels with one of ours within 1 mm."""
    our_centreline_true: float
    """Share of our centreline's voxels with a true one within 1 mm."""
    cl_dice: float
    """Centreline Dice: the harmonic mean of the shares of each centreline inside the other set."""
    components: float
    """Connected components of ours that are a pixel at the isocentre wide or more."""
    true_components: float
    """Connected components of the truth."""
    tree_true_centreline_found: float
    """Share of the true tree's length with ours within 1 mm."""
    tree_our_centreline_true: float
    """Share of our tree's length with a true one within 1 mm."""
    tree_ours_to_true_mm: float
    """Mean distance of our centreline to the true one, mm."""
    tree_components: float
    """Connected trees of ours."""
    radius_error_mm: float
    """Mean of our radius less the true one, where our centreline is true, mm."""
    radius_rmse_mm: float
    """Root of the mean square of the same, mm."""
    motion_error_mm: float
    """Mean distance between where our points have come since the phase that is followed and where the true points beside them have, mm."""


@dataclass(frozen=True)
class Grid:
    """A regular grid of points in patient coordinates (left, posterior, superior)."""

    origin_mm: tuple[float, float, float]
    """First point, mm."""
    spacing_mm: tuple[float, float, float]
    """Distance between neighbours along each axis, mm."""
    points: tuple[int, int, int]
    """Points along each axis, 1 to 4096."""

    @staticmethod
    def around_isocentre(half_extent_mm: float = 60.0, spacing_mm: float = 1.0) -> "Grid":
        """A cube around the isocentre, with a point on it."""
        beside = int(half_extent_mm / spacing_mm)
        first = -beside * spacing_mm
        return Grid((first, first, first), (spacing_mm, spacing_mm, spacing_mm), (2 * beside + 1,) * 3)


@dataclass(frozen=True)
class Branch:
    """A vessel's centreline between two bifurcations, at one cardiac phase."""

    phase: int
    """Cardiac phase, from 0."""
    parent: Optional[int]
    """The branch that it leaves, by its place among the branches; None for one that begins at a root."""
    points_mm: npt.NDArray[np.float64]
    """Points (LPS), mm, of shape (points, 3); the first is the last of its parent."""
    radius_mm: npt.NDArray[np.float64]
    """Radius of the vessel at each point, mm, of shape (points,)."""
    doubt_mm: Optional[npt.NDArray[np.float64]] = None
    """Half width of the interval that contains the true centreline with a probability of 68 %, along the least certain direction across the
    vessel, for each point, mm; NaN where there are no frames to compare with, as after a checkpoint was loaded, and with two views, whose
    vessels may have exchanged their depths where they cross. None for a branch of a user's own."""
    doubt_with_motion_mm: Optional[npt.NDArray[np.float64]] = None
    """Half width for the material point, mm, which also holds its motion along the vessel; NaN where points are not followed."""
    existence: Optional[npt.NDArray[np.float64]] = None
    """Probability that a true vessel is within 3 mm of each point, 0 to 1."""
    gap_mm: float = 0.0
    """Length of the gaps in the branch, mm: the field shows no vessel there, and two vessels are linked because one points at the other."""


@dataclass(frozen=True)
class Lesion:
    """A stenosis: a place where a vessel is narrower than its course elsewhere lets expect."""

    phase: int
    """Cardiac phase, from 0."""
    branch: int
    """Branch with the least diameter, by its place among the branches of the tree."""
    point: int
    """Point of the branch with the least diameter."""
    from_root_mm: float
    """Position of the least diameter along the vessels, mm from the root."""
    length_mm: float
    """Length of the part that is narrowed by a tenth of the reference or more, mm."""
    min_diameter_mm: float
    """Least diameter, mm."""
    reference_diameter_mm: float
    """Reference diameter there, mm."""

    @property
    def stenosis_percent(self) -> float:
        """Narrowing in percent of the reference diameter."""
        return 100.0 * (1.0 - self.min_diameter_mm / self.reference_diameter_mm)


@dataclass(frozen=True)
class Tree:
    """Vessels at all phases as trees of centrelines with radii."""

    threshold_per_mm: float
    """Threshold above which the dynamic field counted as vessel, 1/mm."""
    followed: bool
    """Whether all phases have the same branches, and point i of each is the same material point at every phase."""
    branches: list[Branch]
    """Phase by phase, each behind its parent."""
    lesions: list[Lesion] = field(default_factory=list)
    """Stenoses of 30 % or more, phase by phase."""
    radii_from_images: bool = False
    """Whether radii are those that the frames show; otherwise they are those of the field, which shows thin vessels blurred."""

    def at(self, phase: int) -> list[Branch]:
        """The branches of one cardiac phase."""
        return [branch for branch in self.branches if branch.phase == phase]


@dataclass(frozen=True)
class Device:
    """A Vulkan device."""

    index: int
    name: str
    uuid: str
    kind: str
    """discrete, integrated, virtual, cpu or other."""
    driver: str
    unusable: Optional[str]
    """Why it cannot be used; None where it can."""
