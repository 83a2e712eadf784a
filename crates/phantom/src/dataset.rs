//! Phantom datasets: projects moving volumes, makes exact masks, applies degradations and writes the dataset.

use crate::acquisition::Acquisition;
use crate::camera::{Camera, Exposure, Shooting, Stage};
use crate::choice::Choice;
use crate::degradations::Degradations;
use crate::error::{Error, Result};
use crate::formats::volume::VolumeHints;
use crate::geometry::{CArm, Geometry};
use crate::gpu::device::Gpu;
use crate::noise::add_noise;
use crate::projector::Projector;
use crate::raster::Image;
use crate::runs::{Shot, shots};
use crate::scan::dataset::{Layout, Split};
use crate::scan::truth::{TrueFrame, Truth, VOLUMES};
use crate::scan::writer::{About, Writer, authors_angles};
use crate::sight::Sight;
use crate::stenosis::Stenosis;
use crate::subjects::{Build, Patient, PatientFiles, Reading, Thorax, Volumes};
use crate::tree::Tree;
use crate::tree_file::{TREE, TreeFile};
use crate::views::{CArmOptions, PixelPitch, ViewAngles};
use crate::voxels::Tissues;
use glam::DVec3;
use serde::{Deserialize, Serialize};
use std::num::NonZeroU32;
use std::path::{Path, PathBuf};
use strum::{IntoStaticStr, VariantArray};

/// Procedural anatomy with its C-arm.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, IntoStaticStr, VariantArray)]
#[serde(rename_all = "kebab-case")]
#[strum(serialize_all = "kebab-case")]
pub enum Setting {
    /// XCAT set-up of the authors: DSD 2500, DSO 450, a body that is half as large as an adult's, cut to their volume of
    /// 128 x 128 x 100 mm.
    Xcat,
    /// The C-arm and attenuations of [`Setting::Xcat`] with a smaller body, 0.37 of an adult's, in a cube of 128 mm.
    SmallXcat,
    /// MAGIX set-up of the authors: DSD 2000, DSO 600, 0.9 mm voxels.
    Magix,
}

/// Options of a phantom dataset.
#[derive(Debug, Clone)]
pub struct PhantomOptions {
    /// C-arm and volume for procedural anatomy.
    pub setting: Setting,
    /// Columns and rows of the images.
    pub size: usize,
    /// Number of cardiac phases.
    pub phases: u32,
    /// Views.
    pub views: ViewAngles,
    /// Seed of shape, noise and degradations.
    pub seed: u32,
    /// Degradations of the images.
    pub degradations: Degradations,
    /// Stenoses of the vessels.
    pub stenoses: Vec<Stenosis>,
    /// Layout to write.
    pub layout: Layout,
    /// Real anatomy instead of the procedural one.
    pub anatomy: Option<Anatomy>,
    /// Interval of the phases whose voxel volumes are also written: the first of every so many. Without it, no volumes are
    /// written.
    pub volumes_every: Option<NonZeroU32>,
}

/// Anatomy from files: a tree and a CT.
#[derive(Debug, Clone)]
pub struct Anatomy {
    /// File with the tree, as read by [`TreeFile::read`].
    pub tree: PathBuf,
    /// CT in Hounsfield units.
    pub background: Option<PathBuf>,
    /// Whether the middle of the tree is put at the isocentre, and the CT moved along.
    pub centre: bool,
    /// C-arms.
    pub c_arms: CArmOptions,
    /// Vessel attenuation, 1/mm.
    pub iodine_per_mm: f64,
}

/// Options of a dataset that is projected from a user's own volumes.
#[derive(Debug, Clone)]
pub struct VolumeOptions {
    /// One file per phase, in order.
    pub volumes: Vec<PathBuf>,
    /// Properties that the files may not state.
    pub hints: VolumeHints,
    /// Whether values are Hounsfield units.
    pub hounsfield: bool,
    /// Factor on the values.
    pub scale: f32,
    /// Attenuation threshold above which a voxel belongs to a vessel, 1/mm.
    pub vessel_per_mm: Option<f64>,
    /// Whether the object is at rest: one volume, and a dataset that says so.
    pub still: bool,
    /// C-arms.
    pub c_arms: CArmOptions,
    /// Columns and rows of the images.
    pub size: usize,
    /// Views.
    pub views: ViewAngles,
    /// Seed of noise and degradations.
    pub seed: u32,
    /// Degradations of the images.
    pub degradations: Degradations,
    /// Layout to write.
    pub layout: Layout,
}

/// Makes a phantom dataset in the directory `out`. Returns warnings on what the views do not show.
///
/// # Errors
/// [`Error::Config`] for impossible options, [`Error::Data`] for anatomy that is unreadable or outside every training view, device
/// errors.
pub fn make(
    gpu: &Gpu,
    options: &PhantomOptions,
    out: &Path,
    progress: impl FnMut(&str, u64, u64),
) -> Result<Vec<String>> {
    make_with_runs(gpu, options, None, out, progress)
}

/// Makes a phantom dataset as [`make`] does, and runs of its training views where they are asked for. The degradations then act on the runs,
/// and the dataset is what is true: it has no degradations but noise.
///
/// # Errors
/// Errors of [`make`]; [`Error::Config`] for impossible runs.
pub fn make_with_runs(
    gpu: &Gpu,
    options: &PhantomOptions,
    runs: Option<&Acquisition>,
    out: &Path,
    mut progress: impl FnMut(&str, u64, u64),
) -> Result<Vec<String>> {
    if !(1..=200).contains(&options.phases) {
        return Err(Error::config("phases", options.phases, "is not in the accepted range, 1 to 200"));
    }
    options.degradations.check(options.views.training.len(), options.layout)?;
    let exact = Degradations { photons: options.degradations.photons, ..Degradations::default() };
    let shooting = Shooting {
        size: options.size,
        views: &options.views,
        seed: options.seed,
        degradations: if runs.is_some() { &exact } else { &options.degradations },
        layout: options.layout,
        volumes_every: options.volumes_every,
    };
    shooting.check(out)?;
    if let Some(runs) = runs {
        runs.check(&options.degradations)?;
    }
    let projector = Projector::new(gpu, options.size, options.size)?;
    progress("volumes", 0, 1);
    let (stage, warnings) = match &options.anatomy {
        None => (procedural(options)?, Vec::new()),
        Some(anatomy) => from_files(options, anatomy)?,
    };
    shoot(&projector, &stage, &shooting, out, &mut progress)?;
    if let Some(runs) = runs {
        let taken = Shooting { degradations: &options.degradations, ..shooting };
        runs.take(&projector, &stage, &taken, progress)?;
    }
    Ok(warnings)
}

/// Projects a user's volumes, one per phase, into a dataset in the directory `out`. At times between phases the nearest volume
/// is used. If the patient breathes, the part that all volumes have in common is treated as static background. Returns warnings
/// on what the views do not show.
///
/// # Errors
/// Errors of [`make`]; [`Error::Config`] also for degradations that need vessels where no vessel threshold is given.
pub fn project_volumes(
    gpu: &Gpu,
    options: &VolumeOptions,
    out: &Path,
    mut progress: impl FnMut(&str, u64, u64),
) -> Result<Vec<String>> {
    let shooting = Shooting {
        size: options.size,
        views: &options.views,
        seed: options.seed,
        degradations: &options.degradations,
        layout: options.layout,
        volumes_every: None,
    };
    shooting.check(out)?;
    if options.vessel_per_mm.is_some_and(|v| !(v.is_finite() && v > 0.0)) {
        return Err(Error::config("vessel_per_mm", options.vessel_per_mm.unwrap_or_default(), "is not positive"));
    }
    check_vessels(&options.degradations, options.vessel_per_mm)?;
    if options.still && options.volumes.len() != 1 {
        let problem = "volumes are given, but an object at rest has one";
        return Err(Error::config("still", options.volumes.len(), problem));
    }
    if options.still && options.layout == Layout::Nerfca {
        return Err(Error::config("layout", "nerfca", "cannot state that the object is at rest"));
    }
    if options.volumes.is_empty() {
        return Err(Error::config("volumes", 0, "at least one volume, for one phase, is needed"));
    }
    let c_arms = options.c_arms.c_arms(&options.views, options.size)?;
    let projector = Projector::new(gpu, options.size, options.size)?;
    let total = options.volumes.len() as u64;
    let reading = Reading {
        paths: &options.volumes,
        hints: &options.hints,
        hounsfield: options.hounsfield,
        scale: options.scale,
        vessel_per_mm: options.vessel_per_mm,
    };
    let breathing = options.degradations.breathing.is_some();
    let sight = Sight::new(&c_arms[..options.views.training.len()], options.size)?;
    let (volumes, warnings) =
        Volumes::read(&projector, &reading, breathing, &sight, |done| progress("volumes", done, total))?;
    let stage = Stage {
        description: format!("projections of {} volumes", options.volumes.len()),
        depth_half_extent_mm: volumes.axial_radius_mm().min(largest_depth_mm(&c_arms)),
        c_arms,
        vessel_attenuation: options.vessel_per_mm,
        phases: total as u32,
        still: options.still,
        subject: Box::new(volumes),
        lesions: Vec::new(),
        vessels_in_background: true,
    };
    shoot(&projector, &stage, &shooting, out, progress)?;
    Ok(warnings)
}

/// Rejects degradations that need properties the volumes do not have.
fn check_vessels(degradations: &Degradations, vessel_per_mm: Option<f64>) -> Result<()> {
    const WITHOUT_OSTIUM: &str = "is not supported with volumes, in which the position of the ostium is unknown; use a \
                                  phantom";
    if degradations.catheter {
        return Err(Error::config("catheter", true, WITHOUT_OSTIUM));
    }
    if degradations.inflow_s > 0.0 {
        return Err(Error::config("inflow_s", degradations.inflow_s, WITHOUT_OSTIUM));
    }
    let of_vessels =
        [("contrast_variation", degradations.contrast_variation), ("collimated_share", degradations.collimated_share)];
    match of_vessels.into_iter().find(|(_, value)| *value > 0.0 && vessel_per_mm.is_none()) {
        Some((field, value)) => {
            Err(Error::config(field, value, "needs vessel_per_mm, the attenuation threshold of vessels"))
        }
        None => Ok(()),
    }
}

/// Largest accepted depth of attenuation from the isocentre, mm; it ends before the nearest source.
fn largest_depth_mm(c_arms: &[CArm]) -> f64 {
    0.9 * c_arms.iter().map(|c_arm| c_arm.sod_mm).fold(f64::INFINITY, f64::min)
}

/// Largest field of view at the isocentre, mm.
fn widest_field_mm(c_arms: &[CArm], size: usize) -> f64 {
    let fields = c_arms.iter().map(|c_arm| c_arm.pixel_mm[0] * size as f64 * c_arm.sod_mm / c_arm.sid_mm);
    fields.fold(0.0, f64::max)
}

/// Takes the images of every view and writes the dataset.
fn shoot(
    projector: &Projector,
    stage: &Stage,
    shooting: &Shooting<'_>,
    out: &Path,
    mut progress: impl FnMut(&str, u64, u64),
) -> Result<()> {
    let (size, degradations) = (shooting.size, shooting.degradations);
    let splits: Vec<Split> = shooting.views.all().map(|(_, split)| split).collect();
    let about = About {
        description: stage.description.clone(),
        phases: stage.phases,
        depth_half_extent_mm: stage.depth_half_extent_mm,
        vessel_attenuation_per_mm: stage.vessel_attenuation,
        still: stage.still,
        vessels_alone: false,
        size: [size, size],
        c_arm: stage.c_arms[0].clone(),
    };
    if shooting.layout == Layout::Nerfca {
        let geometry = |c_arm: &CArm| Geometry::CArm(c_arm.clone());
        stage.c_arms.iter().try_for_each(|c_arm| authors_angles(&about.c_arm, &geometry(c_arm)).map(drop))?;
    }
    let mut writer = Writer::new(out, shooting.layout, about)?;
    let mut truth = Truth::new(shooting.seed, stage.phases);
    truth.lesions.clone_from(&stage.lesions);
    let mut camera = Camera::new(projector, stage, size)?;
    let mut plan = Vec::new();
    for (view, split) in splits.iter().enumerate() {
        let mut shots = shots(degradations, shooting.seed, view, *split, stage.phases);
        for shot in shots.iter_mut().flatten() {
            shot.fraction = stage.subject.nearest_fraction(shot.fraction);
        }
        let collimated = *split == Split::Train && degradations.collimated_share > 0.0;
        let blade = if collimated { Some(camera.blade(view, &shots, shooting)?) } else { None };
        plan.push((shots, blade));
    }
    for phase in 0..stage.phases {
        progress("projections", u64::from(phase), u64::from(stage.phases));
        if shooting.volumes_every.is_some_and(|every| phase % every == 0) {
            let fraction = Shot::at_phase(phase, stage.phases).fraction;
            stage.subject.write_volumes(&out.join(VOLUMES), phase, fraction)?;
        }
        for (view, (shots, blade)) in plan.iter().enumerate() {
            let Some(shot) = &shots[phase as usize] else { continue };
            let (split, c_arm) = (splits[view], &stage.c_arms[view]);
            let Exposure { mut image, vessels } =
                camera.expose(view, shot, degradations.catheter && split == Split::Train)?;
            let mut mask = vessels.map(|vessels| camera.mask(view, &vessels));
            if let Some(photons) = degradations.photons {
                add_noise(&mut image, photons, shooting.seed, (view as u32) << 16 | phase);
            }
            if let Some(blade) = blade {
                blade.close(&mut image, mask.as_mut(), size);
            }
            let stated = Geometry::CArm(shooting.stated(c_arm, view, split));
            let image = Image { width: size, height: size, values: image };
            let file = writer.frame(&stated, split, view, shot.stated, &image, mask.as_deref())?;
            let DVec3 { x: left, y: posterior, z: superior } = shot.breath.heart_mm;
            truth.frames.push(TrueFrame {
                image: file,
                view,
                split,
                phase,
                geometry: c_arm.clone(),
                heart_shift_mm: [posterior, left, superior],
                beat_phase: shot.fraction * f64::from(stage.phases),
                time_s: shot.time_s,
                contrast_gain: shot.contrast_gain,
                filled_to: shot.filled_to,
                cut_share: blade.as_ref().map_or(0.0, |blade| blade.cut_share),
            });
        }
    }
    progress("projections", u64::from(stage.phases), u64::from(stage.phases));
    truth.write(out)?;
    if shooting.volumes_every.is_some() {
        let at = |phase| stage.subject.vessel_tree(Shot::at_phase(phase, stage.phases).fraction);
        let trees: Vec<Tree> = (0..stage.phases).filter_map(at).collect();
        if let Some(file) = TreeFile::of(&trees) {
            file.write(&out.join(VOLUMES).join(TREE))?;
        }
    }
    writer.finish()
}

fn procedural(options: &PhantomOptions) -> Result<Stage> {
    let scale_pixels = 200.0 / options.size as f64;
    // Volume offsets are given in the world's axes (posterior, left, superior); LPS exchanges the first two.
    let small_xcat = Build {
        tissues: Tissues::XCAT,
        scale: 0.37,
        centre_mm: DVec3::new(-25.0, 10.0, 25.0),
        half_mm: DVec3::splat(64.0),
    };
    let (build, sid_mm, sod_mm) = match options.setting {
        // The authors state voxels of 0.5 mm and project them as voxels of 0.25 mm, so the body is half as large as an adult's.
        Setting::Xcat => (Build { scale: 0.5, half_mm: DVec3::new(64.0, 64.0, 50.0), ..small_xcat }, 2500.0, 450.0),
        Setting::SmallXcat => (small_xcat, 2500.0, 450.0),
        Setting::Magix => {
            let half_mm = DVec3::splat(230.0);
            (Build { tissues: Tissues::MAGIX, scale: 0.62, centre_mm: DVec3::ZERO, half_mm }, 2000.0, 600.0)
        }
    };
    let (thorax, lesions) = Thorax::new(build, options.seed, options.phases, &options.stenoses)?;
    let radius = build.half_mm.max_element() + build.centre_mm.x.abs().max(build.centre_mm.y.abs());
    let c_arms = CArmOptions {
        sod_mm: vec![sod_mm],
        sid_mm: vec![sid_mm],
        pixel: PixelPitch::Detector([scale_pixels; 2]),
        offset_mm: vec![[0.0; 2]],
    }
    .c_arms(&options.views, options.size)?;
    Ok(Stage {
        description: format!("procedural phantom, {} set-up, seed {}", options.setting.name(), options.seed),
        depth_half_extent_mm: (radius * std::f64::consts::SQRT_2).min(largest_depth_mm(&c_arms)),
        c_arms,
        vessel_attenuation: Some(build.tissues.vessel),
        phases: options.phases,
        still: false,
        subject: Box::new(thorax),
        lesions,
        vessels_in_background: false,
    })
}

fn from_files(options: &PhantomOptions, anatomy: &Anatomy) -> Result<(Stage, Vec<String>)> {
    let vessel_per_mm = anatomy.iodine_per_mm;
    if !(vessel_per_mm.is_finite() && vessel_per_mm > 0.0) {
        return Err(Error::config("iodine_per_mm", vessel_per_mm, "is not positive"));
    }
    let c_arms = anatomy.c_arms.c_arms(&options.views, options.size)?;
    let sight = Sight::new(&c_arms[..options.views.training.len()], options.size)?;
    let files = PatientFiles {
        tree: &anatomy.tree,
        background: anatomy.background.as_deref(),
        centre: anatomy.centre,
        vessel_per_mm,
        stenoses: &options.stenoses,
    };
    let (patient, warnings) = Patient::read(&files, options.phases, &sight)?;
    let radius = patient.axial_radius_mm().unwrap_or_else(|| widest_field_mm(&c_arms, options.size));
    let stage = Stage {
        description: format!("anatomy from {}", anatomy.tree.file_name().unwrap_or_default().to_string_lossy()),
        depth_half_extent_mm: radius.min(largest_depth_mm(&c_arms)),
        c_arms,
        vessel_attenuation: Some(vessel_per_mm),
        phases: options.phases,
        still: false,
        lesions: patient.lesions(),
        subject: Box::new(patient),
        vessels_in_background: false,
    };
    Ok((stage, warnings))
}
