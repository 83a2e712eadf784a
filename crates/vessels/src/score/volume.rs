//! Scores in 3D, where a dataset has its vessels as volumes (see `docs/formats.md`).

use crate::calibrate::gauge::RigidMotion;
use crate::error::{Error, Result};
use crate::formats::volume::{Volume, VolumeHints};
use crate::formats::volume_files;
use crate::geometry::MM_PER_UNIT;
use crate::model::scene::Scene;
use crate::render::grid::PatientGrid;
use crate::render::renderer::Renderer;
use crate::scan::dataset::Dataset;
use crate::scan::truth::{VOLUMES, truth_file};
use crate::score::metrics::dice;
use crate::score::shapes::{Agreement, WITHIN_MM, compare};
use crate::vessels::distances::DistanceMap;
use crate::vessels::field::{CoarseField, Corners, VesselField};
use crate::vessels::mask::Mask;
use glam::{DMat3, DVec3};
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Share of the vessel attenuation above which a voxel of the truth is vessel, and one of the field is lumen.
const LUMEN_SHARE: f64 = 0.5;
/// Distance from a vessel beyond which attenuation is far from it, pixels.
const FAR_PIXELS: f64 = 2.0;
/// Distance from a vessel beyond which attenuation is far from it, mm.
const FAR_MM: f64 = 2.0;
/// Side of the minimum cube that counts as a component, pixels.
const COMPONENT_PIXELS: f64 = 1.0;
/// Maximum number of voxels that are compared.
pub const MAX_VOXELS: u64 = 1 << 26;

/// Scores of one phase, or their means.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Scores {
    /// Agreement of the reconstructed vessels with the true ones.
    #[serde(flatten)]
    pub agreement: Agreement,
    /// Dice of the lumen: voxels at which the dynamic field exceeds half of the stated vessel attenuation, the rule for voxels of the
    /// truth. `None` where no vessel attenuation is stated.
    pub lumen_dice: Option<f64>,
    /// Share of the dynamic field's attenuation farther than 2 pixels at the isocentre from the nearest true vessel voxel.
    pub mass_beyond_2_pixels: Option<f64>,
    /// Share of the dynamic field's attenuation that lies more than 2 mm from a true vessel.
    pub mass_beyond_2_mm: Option<f64>,
}

/// Scores of one phase.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PhaseScores {
    /// Cardiac phase, from 0.
    pub phase: u32,
    /// Scores of the phase.
    #[serde(flatten)]
    pub scores: Scores,
}

/// Scores of all phases with a known truth.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct VolumeScores {
    /// Threshold above which the dynamic field is vessel, per mm.
    pub threshold_per_mm: f64,
    /// Pixel at the isocentre, mm.
    pub pixel_mm: f64,
    /// Maximum distance at which centrelines count as one vessel, mm.
    pub within_mm: f64,
    /// Minimum volume of a counted component, mm³.
    pub smallest_component_mm3: f64,
    /// Means over the phases; `None` where a phase has no value.
    pub mean: Scores,
    /// Means without the motion of the reconstruction, where that motion was applied to the truth.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mean_as_stated: Option<Scores>,
    /// One row per phase.
    pub phases: Vec<PhaseScores>,
}

/// Scores the dynamic field where it exceeds `threshold_per_mm` at every phase whose truth is in the dataset's directory;
/// `None` where there is no truth. Where the reconstruction is `carried` against it, the motion is applied to the truth,
/// and the means without it are reported as well. `proceed` is called before every phase; its error ends the work.
///
/// # Errors
/// [`Error::Io`] and [`Error::Data`] for a truth that cannot be read, that does not follow the patient's axes, or that has
/// too many voxels; device errors; errors of `proceed`.
pub fn score(
    renderer: &Renderer,
    scene: &Scene,
    dataset: &Dataset,
    threshold_per_mm: f64,
    carried: Option<&RigidMotion>,
    mut proceed: impl FnMut() -> Result<()>,
) -> Result<Option<VolumeScores>> {
    let pixel_mm = pixel_mm(dataset);
    let lumen_per_mm = lumen_per_mm(dataset);
    let least_mm3 = smallest_component_mm3(pixel_mm);
    let volumes = dataset.path.join(VOLUMES);
    let (mut phases, mut as_stated) = (Vec::new(), Vec::new());
    for phase in 0..dataset.n_phases {
        let file = truth_file(&volumes, phase);
        if !file.is_file() {
            continue;
        }
        let volume = read(&file)?;
        let field = VesselField { renderer, scene, phase, pixel_mm, threshold_per_mm };
        let coarse = field.coarse()?;
        let mut against = |volume: &Volume| -> Result<PhaseScores> {
            proceed()?;
            let truth = TrueVessels::new(volume, dataset);
            Ok(PhaseScores { phase, scores: scores(&field, &coarse, &truth, &file, (least_mm3, lumen_per_mm))? })
        };
        match carried {
            None => phases.push(against(&volume)?),
            Some(motion) => {
                phases.push(against(&volume.carried(&motion.patient_mm(phase as usize)))?);
                as_stated.push(against(&volume)?);
            }
        }
    }
    Ok((!phases.is_empty()).then(|| VolumeScores {
        mean_as_stated: (!as_stated.is_empty()).then(|| mean(&as_stated)),
        ..VolumeScores::of(phases, threshold_per_mm, pixel_mm)
    }))
}

/// Scores the dynamic field where it exceeds `threshold_per_mm` at the phases whose true vessels are known; `None` if none
/// are. `dataset` states the size of a pixel at the isocentre and the attenuation of vessels.
///
/// # Errors
/// [`Error::Data`] for a truth that has too many voxels; device errors.
pub fn score_known(
    renderer: &Renderer,
    scene: &Scene,
    known: &BTreeMap<u32, TrueVessels>,
    threshold_per_mm: f64,
    dataset: &Dataset,
) -> Result<Option<VolumeScores>> {
    let (pixel_mm, lumen_per_mm) = (pixel_mm(dataset), lumen_per_mm(dataset));
    let of_phase = |(phase, truth): (&u32, &TrueVessels)| -> Result<PhaseScores> {
        let field = VesselField { renderer, scene, phase: *phase, pixel_mm, threshold_per_mm };
        let of = PathBuf::from(format!("true vessels of phase {phase}"));
        let least_mm3 = smallest_component_mm3(pixel_mm);
        let scores = scores(&field, &field.coarse()?, truth, &of, (least_mm3, lumen_per_mm))?;
        Ok(PhaseScores { phase: *phase, scores })
    };
    let phases = known.iter().map(of_phase).collect::<Result<Vec<_>>>()?;
    Ok((!phases.is_empty()).then(|| VolumeScores::of(phases, threshold_per_mm, pixel_mm)))
}

/// Attenuation above which the dynamic field is lumen, per mm.
fn lumen_per_mm(dataset: &Dataset) -> Option<f64> {
    dataset.vessel_attenuation.map(|attenuation| LUMEN_SHARE * attenuation / MM_PER_UNIT)
}

/// Minimum volume of a counted component, for a pixel size at the isocentre.
fn smallest_component_mm3(pixel_mm: f64) -> f64 {
    (COMPONENT_PIXELS * pixel_mm).powi(3)
}

impl VolumeScores {
    fn of(phases: Vec<PhaseScores>, threshold_per_mm: f64, pixel_mm: f64) -> VolumeScores {
        VolumeScores {
            threshold_per_mm,
            pixel_mm,
            within_mm: WITHIN_MM,
            smallest_component_mm3: smallest_component_mm3(pixel_mm),
            mean: mean(&phases),
            mean_as_stated: None,
            phases,
        }
    }
}

/// Means over phases; `None` where a phase has no value.
fn mean(phases: &[PhaseScores]) -> Scores {
    let mean = |pick: &dyn Fn(&Scores) -> Option<f64>| {
        phases.iter().map(|p| pick(&p.scores)).sum::<Option<f64>>().map(|sum| sum / phases.len() as f64)
    };
    let of_all = |pick: fn(&Agreement) -> f64| mean(&|s| Some(pick(&s.agreement))).unwrap_or(f64::NAN);
    Scores {
        agreement: Agreement {
            dice: of_all(|a| a.dice),
            chamfer_mm: mean(&|s| s.agreement.chamfer_mm),
            hausdorff95_mm: mean(&|s| s.agreement.hausdorff95_mm),
            true_centreline_found: mean(&|s| s.agreement.true_centreline_found),
            our_centreline_true: mean(&|s| s.agreement.our_centreline_true),
            cl_dice: mean(&|s| s.agreement.cl_dice),
            components: of_all(|a| a.components),
            true_components: of_all(|a| a.true_components),
        },
        lumen_dice: mean(&|s| s.lumen_dice),
        mass_beyond_2_pixels: mean(&|s| s.mass_beyond_2_pixels),
        mass_beyond_2_mm: mean(&|s| s.mass_beyond_2_mm),
    }
}

/// Pixel size at the isocentre, mm.
pub(crate) fn pixel_mm(dataset: &Dataset) -> f64 {
    let c_arm = dataset.reference_c_arm();
    c_arm.pixel_mm[0] * c_arm.sod_mm / c_arm.sid_mm
}

/// True vessels of a phase.
#[derive(Debug, Clone, PartialEq)]
pub struct TrueVessels {
    /// Grid of the voxels.
    pub grid: PatientGrid,
    /// Whether each voxel is vessel, left fastest.
    pub inside: Vec<bool>,
}

/// Reads the true attenuation per mm on a grid along the patient's axes.
pub(super) fn read(file: &Path) -> Result<Volume> {
    let volume = volume_files::read(file, &VolumeHints::default())?;
    let spacing_mm = spacing_mm(&volume);
    if volume.index_to_lps.matrix3 != DMat3::from_diagonal(spacing_mm) || spacing_mm.min_element() <= 0.0 {
        return Err(Error::data(file, "space directions", "are not left, posterior and superior, in this order"));
    }
    Ok(volume)
}

/// Distances between voxels along the patient's axes.
fn spacing_mm(volume: &Volume) -> DVec3 {
    let axes = volume.index_to_lps.matrix3;
    DVec3::new(axes.x_axis.x, axes.y_axis.y, axes.z_axis.z)
}

impl TrueVessels {
    /// Creates the mask: a voxel is vessel if it reaches a share of the vessels' attenuation, or of the maximum value if
    /// that is not stated.
    pub(super) fn new(volume: &Volume, dataset: &Dataset) -> TrueVessels {
        let largest = || f64::from(volume.values.iter().copied().fold(0.0, f32::max));
        let vessel_per_mm = dataset.vessel_attenuation.map(|v| v / MM_PER_UNIT);
        let threshold = LUMEN_SHARE * vessel_per_mm.unwrap_or_else(largest);
        TrueVessels {
            grid: PatientGrid {
                origin_mm: volume.index_to_lps.translation,
                spacing_mm: spacing_mm(volume),
                size: volume.size.map(|n| n as u32),
            },
            inside: volume.values.iter().map(|v| f64::from(*v) > threshold).collect(),
        }
    }

    /// Returns the vessels on a grid that extends at least from one corner to another.
    fn reaching(&self, corners: Corners, file: &Path) -> Result<(PatientGrid, Mask)> {
        let PatientGrid { origin_mm, spacing_mm, size } = self.grid;
        let own = Corners::of(&self.grid);
        let before = ((own.low_mm - corners.low_mm) / spacing_mm).ceil().max(DVec3::ZERO);
        let after = ((corners.high_mm - own.high_mm) / spacing_mm).ceil().max(DVec3::ZERO);
        let grown = DVec3::from_array(size.map(f64::from)) + before + after;
        if grown.element_product() > MAX_VOXELS as f64 {
            let [x, y, z] = grown.to_array();
            let problem = format!(
                "these vessels and the dynamic field together cover {x} x {y} x {z} voxels of this size, but at most \
                 {MAX_VOXELS} are compared"
            );
            return Err(Error::data(file, "sizes", problem));
        }
        let [bx, by, bz] = before.as_usizevec3().to_array();
        let ([nx, ny, _], [gx, gy, gz]) = (size.map(|n| n as usize), grown.as_usizevec3().to_array());
        let mut inside = vec![false; gx * gy * gz];
        for (row, values) in self.inside.chunks(nx).enumerate() {
            let (y, z) = (row % ny + by, row / ny + bz);
            inside[(z * gy + y) * gx + bx..][..nx].copy_from_slice(values);
        }
        let grid =
            PatientGrid { origin_mm: origin_mm - before * spacing_mm, spacing_mm, size: grown.as_uvec3().to_array() };
        Ok((grid, Mask { size: [gx, gy, gz], spacing_mm, inside }))
    }
}

/// Attenuation summed over volumes, mm² (per mm, times mm³).
#[derive(Clone, Copy, Default)]
struct Mass {
    all: f64,
    far_pixels: f64,
    far_mm: f64,
}

impl Mass {
    /// Sums a field by its distance to the truth, which is known on a grid; all attenuation beyond that grid is far.
    fn of(coarse: &CoarseField, grid: &PatientGrid, to_truth: &DistanceMap, pixel_mm: f64) -> Mass {
        let [nx, ny, _] = grid.size.map(|n| n as usize);
        let end = DVec3::from_array(grid.size.map(f64::from));
        let mut mass = Mass::default();
        for (point_mm, value) in coarse.points() {
            let voxel = ((point_mm - grid.origin_mm) / grid.spacing_mm).round();
            let away_mm = if voxel.cmpge(DVec3::ZERO).all() && voxel.cmplt(end).all() {
                let [x, y, z] = voxel.as_usizevec3().to_array();
                f64::from(to_truth.at_mm((z * ny + y) * nx + x))
            } else {
                f64::INFINITY
            };
            let here = value * coarse.grid.spacing_mm.element_product();
            mass.all += here;
            mass.far_pixels += if away_mm > FAR_PIXELS * pixel_mm { here } else { 0.0 };
            mass.far_mm += if away_mm > FAR_MM { here } else { 0.0 };
        }
        mass
    }

    /// Returns a part as a share of the total; `None` if the total is zero.
    fn share(&self, part: f64) -> Option<f64> {
        (self.all > 0.0).then(|| part / self.all)
    }
}

/// True vessels, and those of a field, on a grid with the truth's voxels that contains both.
pub(super) fn on_one_grid(
    field: &VesselField<'_>,
    coarse: &CoarseField,
    truth: &TrueVessels,
    file: &Path,
) -> Result<(PatientGrid, [Mask; 2])> {
    let own = Corners::of(&truth.grid).grown(FAR_MM.max(FAR_PIXELS * field.pixel_mm));
    let reach = coarse.reach(field.threshold_per_mm).map_or(own, |reach| own.joined(reach));
    let (grid, true_vessels) = truth.reaching(reach, file)?;
    let size = grid.size.map(|n| n as usize);
    let ours = Mask { size, spacing_mm: grid.spacing_mm, inside: field.vessels(coarse, &grid)? };
    Ok((grid, [true_vessels, ours]))
}

/// Scores of a field against the truth. Components count from the first of the two limits on, in mm³; the field is lumen above the
/// second, per mm.
fn scores(
    field: &VesselField<'_>,
    coarse: &CoarseField,
    truth: &TrueVessels,
    file: &Path,
    (smallest_component_mm3, lumen_per_mm): (f64, Option<f64>),
) -> Result<Scores> {
    let (grid, [true_vessels, ours]) = on_one_grid(field, coarse, truth, file)?;
    let mass = DistanceMap::to(&true_vessels).map(|to_truth| Mass::of(coarse, &grid, &to_truth, field.pixel_mm));
    let dice_above = |threshold_per_mm: f64| -> Result<f64> {
        let lumen = VesselField { threshold_per_mm, ..*field }.vessels(coarse, &grid)?;
        Ok(dice(&true_vessels.inside, &lumen))
    };
    Ok(Scores {
        agreement: compare(&true_vessels, &ours, smallest_component_mm3)?,
        lumen_dice: lumen_per_mm.map(dice_above).transpose()?,
        mass_beyond_2_pixels: mass.and_then(|m| m.share(m.far_pixels)),
        mass_beyond_2_mm: mass.and_then(|m| m.share(m.far_mm)),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::vessels::mask::tests::drawn;

    #[test]
    fn what_floats_is_its_share_of_the_mass() {
        let (size, spacing_mm) = ([60, 20, 20], DVec3::new(0.25, 0.5, 0.5));
        let box_at = |x: f64| move |p: DVec3| (x..=x + 1.0).contains(&p.x) && (4.0..=6.0).contains(&p.y) && p.z == 5.0;
        let truth = drawn(size, spacing_mm, box_at(2.0));
        let (near, far) = (drawn(size, spacing_mm, box_at(4.0)), drawn(size, spacing_mm, box_at(6.0)));
        // Weights are three where the vessel is, two at 1 to 2 mm from it, one at 3 to 4 mm.
        let weight = |i: usize| 3 * u8::from(truth.inside[i]) + 2 * u8::from(near.inside[i]) + u8::from(far.inside[i]);
        let grid = PatientGrid { origin_mm: DVec3::splat(-5.0), spacing_mm, size: size.map(|n| n as u32) };
        let field = CoarseField { grid, values: (0..truth.inside.len()).map(|i| f32::from(weight(i))).collect() };
        let to_truth = DistanceMap::to(&truth).unwrap();
        let shares = |pixel_mm: f64| {
            let mass = Mass::of(&field, &grid, &to_truth, pixel_mm);
            let expected = 6.0 * truth.voxels().count() as f64 * 0.0625;
            assert!((mass.all - expected).abs() < 1e-9, "{} mm² for {expected}", mass.all);
            [mass.share(mass.far_pixels).unwrap(), mass.share(mass.far_mm).unwrap()]
        };
        let close = |[a, b]: [f64; 2], [c, d]: [f64; 2]| (a - c).abs() < 1e-9 && (b - d).abs() < 1e-9;
        assert!(close(shares(0.4), [0.5, 1.0 / 6.0]), "{:?}", shares(0.4));
        assert!(close(shares(1.4), [1.0 / 6.0, 1.0 / 6.0]), "{:?}", shares(1.4));
        assert!(close(shares(3.0), [0.0, 1.0 / 6.0]), "{:?}", shares(3.0));
        assert_eq!(Mass::default().share(0.0), None);
    }

    #[test]
    fn the_grid_grows_by_whole_voxels() {
        let (origin_mm, spacing_mm) = (DVec3::new(1.0, 2.0, 3.0), DVec3::new(0.5, 1.0, 2.0));
        let grid = PatientGrid { origin_mm, spacing_mm, size: [2, 3, 2] };
        let truth = TrueVessels { grid, inside: (0..12).map(|i| i % 5 == 0).collect() };
        let file = Path::new("vessels-00.nrrd");
        let same = truth.reaching(Corners { low_mm: DVec3::splat(3.5), high_mm: DVec3::ZERO }, file).unwrap();
        assert_eq!((same.0, &same.1.inside), (grid, &truth.inside));
        let corners = Corners { low_mm: DVec3::new(0.3, 2.0, -1.5), high_mm: DVec3::new(1.0, 4.1, 5.0) };
        let (larger, mask) = truth.reaching(corners, file).unwrap();
        assert_eq!((larger.origin_mm, larger.size, mask.size), (DVec3::new(0.0, 2.0, -3.0), [4, 4, 5], [4, 4, 5]));
        // Voxels keep their positions.
        let places = |grid: &PatientGrid, inside: &[bool]| {
            let [nx, ny, _] = grid.size.map(|n| n as usize);
            let at = |i: usize| DVec3::new((i % nx) as f64, (i / nx % ny) as f64, (i / (nx * ny)) as f64);
            let place = |i: usize| (grid.origin_mm + at(i) * grid.spacing_mm).to_array();
            (0..inside.len()).filter(|i| inside[*i]).map(place).collect::<Vec<_>>()
        };
        assert_eq!(places(&larger, &mask.inside), places(&grid, &truth.inside));
        let endless = Corners { low_mm: DVec3::splat(-1e4), high_mm: DVec3::splat(1e4) };
        assert!(truth.reaching(endless, file).unwrap_err().to_string().contains("vessels-00.nrrd"));
    }

    #[test]
    fn what_lies_beyond_the_grid_is_far_from_everything_in_it() {
        let coarse = PatientGrid { origin_mm: DVec3::splat(-2.0), spacing_mm: DVec3::splat(2.0), size: [3, 3, 3] };
        let mut coarse = CoarseField { grid: coarse, values: vec![0.0; 27] };
        (coarse.values[0], coarse.values[13], coarse.values[14]) = (2.0, 5.0, 3.0);
        let grid = PatientGrid { origin_mm: DVec3::ZERO, spacing_mm: DVec3::splat(0.25), size: [20, 70, 20] };
        let truth = Mask { size: [20, 70, 20], spacing_mm: grid.spacing_mm, inside: vec![true; 20 * 70 * 20] };
        let mass = Mass::of(&coarse, &grid, &DistanceMap::to(&truth).unwrap(), 0.3);
        assert_eq!((mass.all, mass.far_pixels, mass.far_mm), (80.0, 16.0, 16.0));
    }
}
