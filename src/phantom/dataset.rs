//! Phantom datasets: volumes and motion -> projections, exact masks, noise -> a dataset on disk.

use crate::choice::Choice;
use crate::error::{Error, Result};
use crate::formats::nrrd;
use crate::formats::volume::{Volume, VolumeHints};
use crate::geometry::{CArm, Geometry, ViewRays};
use crate::gpu::device::Gpu;
use crate::phantom::projector::{LoadedVolume, Projector};
use crate::phantom::tree::{Heart, Tree, contraction};
use crate::phantom::views::{CArmOptions, PixelPitch, ViewAngles};
use crate::phantom::voxels::{self, Tissues};
use crate::random::{STREAM_PHOTON, normal, uniform01};
use crate::scan::dataset::{Layout, MANIFEST, Split};
use crate::scan::nerfca;
use crate::scan::writer::{About, Writer};
use glam::DVec3;
use serde::Serialize;
use std::path::{Path, PathBuf};

/// What the values of volumes are.
const QUANTITY: &str = "attenuation per mm";
/// A vessel-only line integral above this share of a 1 mm vessel's marks a vessel pixel.
const MASK_SHARE: f64 = 0.05;

/// A published set-up of C-arm and volume.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub enum Setting {
    /// The authors' XCAT set-up: DSD 2500, DSO 450, 0.25 mm voxels.
    Xcat,
    /// The authors' MAGIX set-up: DSD 2000, DSO 600, 0.9 mm voxels.
    Magix,
}

impl Choice for Setting {
    const ALL: &'static [Setting] = &[Setting::Xcat, Setting::Magix];

    fn name(self) -> &'static str {
        match self {
            Setting::Xcat => "xcat",
            Setting::Magix => "magix",
        }
    }
}

/// What to make.
#[derive(Debug, Clone)]
pub struct PhantomOptions {
    /// C-arm and volume when the anatomy is procedural.
    pub setting: Setting,
    /// Columns and rows of the images.
    pub size: usize,
    /// Cardiac phases.
    pub phases: u32,
    /// Views.
    pub views: ViewAngles,
    /// Seed of shape and noise.
    pub seed: u32,
    /// Photons per unattenuated pixel; `None` = no noise.
    pub photons: Option<f64>,
    /// Amplitude of breathing along the body, mm; 0 = held breath.
    pub respiration_mm: f64,
    /// Layout to write.
    pub layout: Layout,
    /// Real anatomy instead of the procedural one.
    pub anatomy: Option<Anatomy>,
    /// Also write the voxel volumes.
    pub volumes: bool,
}

/// A tree and a CT from files.
#[derive(Debug, Clone)]
pub struct Anatomy {
    /// Tree as JSON.
    pub tree: PathBuf,
    /// CT in Hounsfield units.
    pub background: Option<PathBuf>,
    /// C-arms.
    pub c_arms: CArmOptions,
    /// Vessel attenuation, 1/mm.
    pub iodine_per_mm: f64,
}

/// A user's own volumes.
#[derive(Debug, Clone)]
pub struct VolumeOptions {
    /// One file per phase, in order.
    pub volumes: Vec<PathBuf>,
    /// What the files cannot say of themselves.
    pub hints: VolumeHints,
    /// Values are Hounsfield units.
    pub hounsfield: bool,
    /// Factor on the values.
    pub scale: f32,
    /// Attenuation from which a voxel is vessel, 1/mm.
    pub vessel_per_mm: Option<f64>,
    /// C-arms.
    pub c_arms: CArmOptions,
    /// Columns and rows of the images.
    pub size: usize,
    /// Views.
    pub views: ViewAngles,
    /// Layout to write.
    pub layout: Layout,
}

/// What a phantom dataset is shot from.
pub(super) struct Stage {
    pub(super) description: String,
    /// One per view.
    pub(super) c_arms: Vec<CArm>,
    pub(super) depth_half_extent_mm: f64,
    pub(super) vessel_attenuation: Option<f64>,
    pub(super) still: Option<LoadedVolume>,
    /// Per phase: what moves besides the vessels, and the vessels (for image and mask).
    pub(super) moving: Vec<(Option<LoadedVolume>, Option<LoadedVolume>)>,
}

/// How a stage is shot.
struct Shooting<'a> {
    size: usize,
    views: &'a ViewAngles,
    seed: u32,
    photons: Option<f64>,
    respiration_mm: f64,
    layout: Layout,
    /// The vessels are part of the moving volume already; project them for the mask alone.
    vessels_in_background: bool,
}

/// Makes a phantom dataset in `out`.
///
/// # Errors
/// [`Error::Config`] for impossible options, [`Error::Data`] for unreadable anatomy, device errors.
pub fn make(gpu: &Gpu, options: &PhantomOptions, out: &Path, mut progress: impl FnMut(&str, u64, u64)) -> Result<()> {
    if !(1..=200).contains(&options.phases) {
        return Err(Error::config("phases", options.phases, "1 to 200 is accepted"));
    }
    if let Some(photons) = options.photons.filter(|n| !(n.is_finite() && *n >= 1.0)) {
        return Err(Error::config("photons", photons, "at least 1 is needed"));
    }
    if !(options.respiration_mm.is_finite() && options.respiration_mm.abs() <= 100.0) {
        return Err(Error::config("respiration_mm", options.respiration_mm, "at most 100 mm is accepted"));
    }
    let shooting = Shooting {
        size: options.size,
        views: &options.views,
        seed: options.seed,
        photons: options.photons,
        respiration_mm: options.respiration_mm,
        layout: options.layout,
        vessels_in_background: false,
    };
    check_output(&shooting, out)?;
    let projector = Projector::new(gpu, options.size, options.size)?;
    progress("volumes", 0, 1);
    let stage = match &options.anatomy {
        None => procedural(&projector, options, out)?,
        Some(anatomy) => from_files(&projector, options, anatomy, out)?,
    };
    shoot(&projector, &stage, &shooting, out, progress)
}

/// Projects a user's volumes, one per phase, into a dataset in `out`.
///
/// # Errors
/// As [`make`].
pub fn project_volumes(
    gpu: &Gpu,
    options: &VolumeOptions,
    out: &Path,
    mut progress: impl FnMut(&str, u64, u64),
) -> Result<()> {
    let shooting = Shooting {
        size: options.size,
        views: &options.views,
        seed: 0,
        photons: None,
        respiration_mm: 0.0,
        layout: options.layout,
        vessels_in_background: true,
    };
    check_output(&shooting, out)?;
    if options.vessel_per_mm.is_some_and(|v| !(v.is_finite() && v > 0.0)) {
        return Err(Error::config("vessel_per_mm", options.vessel_per_mm.unwrap_or_default(), "must be positive"));
    }
    let c_arms = options.c_arms.c_arms(&options.views, options.size)?;
    let projector = Projector::new(gpu, options.size, options.size)?;
    let total = options.volumes.len() as u64;
    let (mut moving, mut radius) = (Vec::new(), 0f64);
    for (index, path) in options.volumes.iter().enumerate() {
        progress("volumes", index as u64, total);
        let mut volume = Volume::read(path, &options.hints)?;
        volume.values.iter_mut().for_each(|v| *v *= options.scale);
        if options.hounsfield {
            voxels::attenuation_from_hounsfield(&mut volume);
        }
        radius = radius.max(volume.axial_radius_mm());
        let vessels = options.vessel_per_mm.map(|threshold| Volume {
            values: volume.values.iter().map(|v| if f64::from(*v) >= threshold { *v } else { 0.0 }).collect(),
            ..volume.clone()
        });
        let vessels = vessels.map(|v| projector.load(v)).transpose()?;
        moving.push((Some(projector.load(volume)?), vessels));
    }
    let stage = Stage {
        description: format!("projected from {} volumes", options.volumes.len()),
        depth_half_extent_mm: radius.min(largest_depth_mm(&c_arms)),
        c_arms,
        vessel_attenuation: options.vessel_per_mm,
        still: None,
        moving,
    };
    shoot(&projector, &stage, &shooting, out, progress)
}

/// How far from the isocentre attenuation may lie: short of the nearest source.
fn largest_depth_mm(c_arms: &[CArm]) -> f64 {
    0.9 * c_arms.iter().map(|c_arm| c_arm.sod_mm).fold(f64::INFINITY, f64::min)
}

/// The widest field of view at the isocentre.
fn widest_field_mm(c_arms: &[CArm], size: usize) -> f64 {
    let fields = c_arms.iter().map(|c_arm| c_arm.pixel_mm[0] * size as f64 * c_arm.sod_mm / c_arm.sid_mm);
    fields.fold(0.0, f64::max)
}

/// Refuses impossible images and directories that already hold a dataset, before any work is done.
fn check_output(shooting: &Shooting<'_>, out: &Path) -> Result<()> {
    if !(16..=2048).contains(&shooting.size) {
        return Err(Error::config("size", shooting.size, "16 to 2048 is accepted"));
    }
    for name in [MANIFEST, nerfca::GENERAL] {
        if out.join(name).exists() {
            return Err(Error::config("OUT", out.display(), "already holds a dataset; choose another directory"));
        }
    }
    Ok(())
}

/// Projects every view and phase of a stage and writes the dataset.
fn shoot(
    projector: &Projector,
    stage: &Stage,
    shooting: &Shooting<'_>,
    out: &Path,
    mut progress: impl FnMut(&str, u64, u64),
) -> Result<()> {
    let size = shooting.size;
    let splits: Vec<Split> = shooting.views.all().map(|(_, split)| split).collect();
    let geometries: Vec<Geometry> = stage.c_arms.iter().cloned().map(Geometry::CArm).collect();
    let rays = geometries
        .iter()
        .map(|g| g.rays(size, size).map_err(|(field, problem)| Error::config(field, "", problem)))
        .collect::<Result<Vec<ViewRays>>>()?;
    let about = About {
        description: stage.description.clone(),
        phases: stage.moving.len() as u32,
        depth_half_extent_mm: stage.depth_half_extent_mm,
        vessel_attenuation_per_mm: stage.vessel_attenuation,
        size: [size, size],
        c_arm: stage.c_arms[0].clone(),
    };
    let mut writer = Writer::new(out, shooting.layout, about)?;
    let still = match &stage.still {
        Some(volume) => projector.project(volume, &rays, DVec3::ZERO)?,
        None => vec![vec![0.0; size * size]; rays.len()],
    };
    let mask_threshold = |c_arm: &CArm| {
        let pixel_at_isocentre = c_arm.pixel_mm[0] * c_arm.sod_mm / c_arm.sid_mm;
        (MASK_SHARE * stage.vessel_attenuation.unwrap_or(0.0) * pixel_at_isocentre) as f32
    };
    let total = stage.moving.len() as u64;
    for (phase, (background, vessels)) in stage.moving.iter().enumerate() {
        progress("projections", phase as u64, total);
        let phase = phase as u32;
        for (view, geometry) in geometries.iter().enumerate() {
            // Breathing differs between runs, so each view has its own course of displacement.
            let shift = DVec3::Z * breath(shooting, view, phase, splits[view], total);
            let project = |volume: &LoadedVolume| -> Result<Vec<f32>> {
                Ok(projector.project(volume, std::slice::from_ref(&rays[view]), shift)?.swap_remove(0))
            };
            let mut image = still[view].clone();
            if let Some(volume) = background {
                add(&mut image, &project(volume)?);
            }
            let mut mask = None;
            if let Some(volume) = vessels {
                let vessel_image = project(volume)?;
                if !shooting.vessels_in_background {
                    add(&mut image, &vessel_image);
                }
                let threshold = mask_threshold(&stage.c_arms[view]);
                mask = Some(vessel_image.iter().map(|v| *v > threshold).collect::<Vec<_>>());
            }
            if let Some(photons) = shooting.photons {
                add_noise(&mut image, photons, shooting.seed, (view as u32) << 16 | phase);
            }
            writer.frame(geometry, splits[view], view, phase, &image, mask.as_deref())?;
        }
    }
    progress("projections", total, total);
    writer.finish()
}

fn breath(options: &Shooting<'_>, view: usize, phase: u32, split: Split, phases: u64) -> f64 {
    if split == Split::Validation {
        return 0.0;
    }
    let start = uniform01(options.seed, STREAM_PHOTON, u32::MAX, view as u32);
    let course = start + 0.25 * f64::from(phase) / phases as f64;
    0.5 * options.respiration_mm * (std::f64::consts::TAU * course).sin()
}

fn add(image: &mut [f32], other: &[f32]) {
    for (a, b) in image.iter_mut().zip(other) {
        *a += b;
    }
}

/// Counts are Poisson; beyond a few hundred photons a normal is indistinguishable from it.
fn add_noise(image: &mut [f32], photons: f64, seed: u32, stream: u32) {
    for (pixel, value) in image.iter_mut().enumerate() {
        let expected = photons * (-f64::from(*value)).exp();
        let counts = if expected > 200.0 {
            (expected + expected.sqrt() * normal(seed, STREAM_PHOTON, stream, pixel as u32)).round()
        } else {
            poisson(expected, seed, stream, pixel as u32)
        };
        *value = -(counts.max(0.5) / photons).ln() as f32;
    }
}

/// Knuth's product method; `expected` is at most 200.
fn poisson(expected: f64, seed: u32, stream: u32, pixel: u32) -> f64 {
    let mut log_product = 0.0;
    let mut count = 0u32;
    loop {
        log_product += uniform01(seed ^ count.wrapping_mul(0x9e37_79b9), STREAM_PHOTON, stream, pixel).max(1e-9).ln();
        if log_product < -expected {
            return f64::from(count);
        }
        count += 1;
    }
}

fn procedural(projector: &Projector, options: &PhantomOptions, out: &Path) -> Result<Stage> {
    let scale_pixels = 200.0 / options.size as f64;
    // Volume offsets are in the world's axes (posterior, left, superior); LPS swaps the first two.
    let (tissues, sid_mm, sod_mm, anatomy_scale, centre_mm, half_mm) = match options.setting {
        Setting::Xcat => (Tissues::XCAT, 2500.0, 450.0, 0.37, DVec3::new(-25.0, 10.0, 25.0), 64.0),
        Setting::Magix => (Tissues::MAGIX, 2000.0, 600.0, 0.62, DVec3::ZERO, 230.0),
    };
    let heart = Heart::new(DVec3::ZERO, anatomy_scale);
    let tree = Tree::procedural(&heart, anatomy_scale, options.phases, options.seed);
    let (low, high) = tree.bounds_mm();
    // The tree's middle is the isocentre, as on a real table.
    let shift = -0.5 * (low + high);
    let heart = Heart::new(shift, anatomy_scale);
    let tree = Tree::procedural(&heart, anatomy_scale, options.phases, options.seed);
    let still = voxels::thorax(tissues, shift, anatomy_scale, centre_mm, half_mm);
    let spacing = 0.4 * anatomy_scale;
    let mut moving = Vec::new();
    for phase in 0..options.phases {
        let squeeze = contraction(f64::from(phase) / f64::from(options.phases));
        let background = voxels::heart_and_diaphragm(tissues, &heart, squeeze, shift, anatomy_scale, &still);
        let vessels = voxels::vessels(&tree, phase as usize, tissues.vessel, spacing);
        if options.volumes {
            write_volumes(out, phase, &vessels, Some((&still, &background)))?;
        }
        moving.push((Some(projector.load(background)?), Some(projector.load(vessels)?)));
    }
    let radius = half_mm + centre_mm.x.abs().max(centre_mm.y.abs());
    let c_arms = CArmOptions {
        sod_mm: vec![sod_mm],
        sid_mm: vec![sid_mm],
        pixel: PixelPitch::Detector([scale_pixels; 2]),
        offset_mm: vec![[0.0; 2]],
    }
    .c_arms(&options.views, options.size)?;
    Ok(Stage {
        description: format!("procedural phantom, {:?} set-up, seed {}", options.setting, options.seed),
        depth_half_extent_mm: (radius * std::f64::consts::SQRT_2).min(largest_depth_mm(&c_arms)),
        c_arms,
        vessel_attenuation: Some(tissues.vessel),
        still: Some(projector.load(still)?),
        moving,
    })
}

fn from_files(projector: &Projector, options: &PhantomOptions, anatomy: &Anatomy, out: &Path) -> Result<Stage> {
    if !(anatomy.iodine_per_mm.is_finite() && anatomy.iodine_per_mm > 0.0) {
        return Err(Error::config("iodine_per_mm", anatomy.iodine_per_mm, "must be positive"));
    }
    let tree = Tree::read(&anatomy.tree, options.phases)?;
    let still = match &anatomy.background {
        None => None,
        Some(path) => {
            let mut volume = Volume::read(path, &VolumeHints::default())?;
            voxels::attenuation_from_hounsfield(&mut volume);
            Some(volume)
        }
    };
    let mut moving = Vec::new();
    for phase in 0..options.phases {
        let vessels = voxels::vessels(&tree, phase as usize, anatomy.iodine_per_mm, 0.5);
        if options.volumes {
            write_volumes(out, phase, &vessels, None)?;
        }
        moving.push((None, Some(projector.load(vessels)?)));
    }
    let c_arms = anatomy.c_arms.c_arms(&options.views, options.size)?;
    let radius = still.as_ref().map_or_else(|| widest_field_mm(&c_arms, options.size), Volume::axial_radius_mm);
    Ok(Stage {
        description: format!("anatomy from {}", anatomy.tree.file_name().unwrap_or_default().to_string_lossy()),
        depth_half_extent_mm: radius.min(largest_depth_mm(&c_arms)),
        c_arms,
        vessel_attenuation: Some(anatomy.iodine_per_mm),
        still: still.map(|v| projector.load(v)).transpose()?,
        moving,
    })
}

fn write_volumes(out: &Path, phase: u32, vessels: &Volume, background: Option<(&Volume, &Volume)>) -> Result<()> {
    let directory = out.join("volumes");
    nrrd::write(&directory.join(format!("vessels-{phase:02}.nrrd")), vessels, QUANTITY)?;
    if let Some((still, moving)) = background {
        let sum =
            Volume { values: still.values.iter().zip(&moving.values).map(|(a, b)| a + b).collect(), ..still.clone() };
        nrrd::write(&directory.join(format!("background-{phase:02}.nrrd")), &sum, QUANTITY)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_has_the_variance_of_its_counts() {
        for (photons, integral) in [(1e6f64, 2.0f32), (500.0, 3.0)] {
            let mut image = vec![integral; 20_000];
            add_noise(&mut image, photons, 1, 0);
            let mean = image.iter().map(|v| f64::from(*v)).sum::<f64>() / 20_000.0;
            let var = image.iter().map(|v| (f64::from(*v) - mean).powi(2)).sum::<f64>() / 20_000.0;
            let expected = photons * f64::from(-integral).exp();
            let relative = var * expected;
            assert!((0.9..1.25).contains(&relative), "{photons}: {relative}");
        }
    }
}
