//! Subjects of the images: a procedural thorax, a tree in a CT, or a user's volumes.

use crate::catheter;
use crate::error::{Error, Result};
use crate::formats::nrrd;
use crate::formats::volume::{Volume, VolumeHints};
use crate::formats::volume_files;
use crate::projector::{LoadedVolume, Projector};
use crate::scan::gating::contraction;
use crate::scan::truth::{TrueLesion, truth_file};
use crate::sight::{Seen, Sight, check_lengths, check_spacing};
use crate::stenosis::{Narrowing, Stenosis};
use crate::tree::{Bounds, Heart, Tree};
use crate::tree_file::TreeFile;
use crate::voxels::{self, Breath, Tissues};
use glam::DVec3;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Quantity of the volumes' values.
const QUANTITY: &str = "attenuation per mm";
/// Voxel spacing of vessels from a file, mm.
const VESSEL_VOXEL_MM: f64 = 0.5;

/// State of the subject while an image is taken.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Pose {
    /// Fraction of the beat, 0 to 1.
    pub(super) fraction: f64,
    pub(super) breath: Breath,
    pub(super) catheter: bool,
    /// Share of the vessels that is filled, see [`crate::runs::Shot`].
    pub(super) filled_to: f64,
}

impl Pose {
    /// Positions of the catheter's tip: the ostium of the tree at rest, which fixes the catheter's course, and the ostium at
    /// this pose.
    fn catheter_between(&self, rest: &Tree, now: &Tree) -> Option<[DVec3; 2]> {
        let tips = self.catheter.then(|| Some([rest.ostium_mm()?, now.ostium_mm()? + self.breath.heart_mm]));
        tips.flatten()
    }
}

/// A volume on the device with its displacement by breathing.
#[derive(Clone)]
pub(super) struct Placed {
    pub(super) volume: Arc<LoadedVolume>,
    pub(super) shift_mm: DVec3,
}

impl Placed {
    pub(super) fn at_rest(volume: LoadedVolume) -> Placed {
        Placed { volume: Arc::new(volume), shift_mm: DVec3::ZERO }
    }
}

/// Moving parts of a subject at a pose.
pub(super) struct Moving {
    pub(super) background: Option<Placed>,
    pub(super) vessels: Option<Placed>,
    pub(super) catheter: Option<Placed>,
}

/// Subject of angiograms.
pub(super) trait Subject {
    /// Static background, with the chest displaced by breathing.
    fn still(&self, projector: &Projector, chest_mm: DVec3) -> Result<Option<LoadedVolume>>;

    /// Beating parts at a pose.
    fn moving(&self, projector: &Projector, pose: &Pose) -> Result<Moving>;

    /// Nearest fraction of the beat that the subject can show.
    fn nearest_fraction(&self, fraction: f64) -> f64 {
        fraction
    }

    /// Vessels at a fraction of the beat, where they are known as a tree.
    fn vessel_tree(&self, _fraction: f64) -> Option<Tree> {
        None
    }

    /// Writes the volumes of a phase into a directory.
    fn write_volumes(&self, _directory: &Path, _phase: u32, _fraction: f64) -> Result<()> {
        Ok(())
    }
}

/// Tissues and extents of a procedural thorax.
#[derive(Debug, Clone, Copy)]
pub(super) struct Build {
    pub(super) tissues: Tissues,
    /// Size of the anatomy as a share of an adult's.
    pub(super) scale: f64,
    /// Centre of the volume with all tissue but the vessels, LPS mm.
    pub(super) centre_mm: DVec3,
    /// Half sides of this volume, mm.
    pub(super) half_mm: DVec3,
}

/// A procedural heart in a procedural thorax.
pub(super) struct Thorax {
    build: Build,
    seed: u32,
    heart_mm: DVec3,
    heart: Heart,
    bounds: Bounds,
    still: Volume,
    narrowing: Narrowing,
}

impl Thorax {
    /// Makes a thorax, with the middle of its tree at the isocentre, as on a real table. Returns its lesions as well.
    ///
    /// # Errors
    /// Errors of [`Narrowing::new`].
    pub(super) fn new(
        build: Build,
        seed: u32,
        phases: u32,
        stenoses: &[Stenosis],
    ) -> Result<(Thorax, Vec<TrueLesion>)> {
        let scale = build.scale;
        let heart = Heart::new(DVec3::ZERO, scale);
        let bounds = Bounds::over_the_beat(phases, |fraction| Tree::procedural(&heart, scale, fraction, seed));
        let heart_mm = -0.5 * (bounds.low_mm + bounds.high_mm);
        let heart = Heart::new(heart_mm, scale);
        let bounds = Bounds::over_the_beat(phases, |fraction| Tree::procedural(&heart, scale, fraction, seed));
        let still = voxels::thorax(build.tissues, heart_mm, scale, build.centre_mm, build.half_mm);
        let (narrowing, lesions) = Narrowing::new(&Tree::procedural(&heart, scale, 0.0, seed), stenoses)?;
        Ok((Thorax { build, seed, heart_mm, heart, bounds, still, narrowing }, lesions))
    }

    fn tree(&self, fraction: f64) -> Tree {
        self.narrowing.applied(Tree::procedural(&self.heart, self.build.scale, fraction, self.seed))
    }

    fn vessels(&self, tree: &Tree) -> Volume {
        voxels::vessels(tree, self.bounds.joined(tree.bounds()), self.build.tissues.vessel, self.vessel_voxel_mm())
    }

    fn catheter(&self, [rest, tip]: [DVec3; 2]) -> Volume {
        let Build { tissues, scale, .. } = self.build;
        catheter::volume(tip, rest, scale, tissues.vessel, self.vessel_voxel_mm())
    }

    fn vessel_voxel_mm(&self) -> f64 {
        0.4 * self.build.scale
    }

    fn background(&self, fraction: f64, breath: Breath) -> Volume {
        let squeeze = contraction(fraction);
        let Build { tissues, scale, .. } = self.build;
        voxels::heart_and_diaphragm(tissues, &self.heart, squeeze, breath, self.heart_mm, scale, &self.still)
    }
}

impl Subject for Thorax {
    fn still(&self, projector: &Projector, _chest_mm: DVec3) -> Result<Option<LoadedVolume>> {
        projector.load(self.still.clone()).map(Some)
    }

    fn moving(&self, projector: &Projector, pose: &Pose) -> Result<Moving> {
        let tree = self.tree(pose.fraction);
        let catheter = pose.catheter_between(&self.tree(0.0), &tree).map(|ends| self.catheter(ends));
        Ok(Moving {
            background: Some(Placed::at_rest(projector.load(self.background(pose.fraction, pose.breath))?)),
            vessels: Some(Placed {
                volume: Arc::new(projector.load(self.vessels(&tree.filled_to(pose.filled_to)))?),
                shift_mm: pose.breath.heart_mm,
            }),
            catheter: catheter.map(|volume| projector.load(volume)).transpose()?.map(Placed::at_rest),
        })
    }

    fn vessel_tree(&self, fraction: f64) -> Option<Tree> {
        Some(self.tree(fraction))
    }

    fn write_volumes(&self, directory: &Path, phase: u32, fraction: f64) -> Result<()> {
        write_vessels(directory, phase, &self.vessels(&self.tree(fraction)))?;
        let moving = self.background(fraction, Breath::default());
        let values = self.still.values.iter().zip(&moving.values).map(|(a, b)| a + b).collect();
        let sum = Volume { values, ..moving };
        Ok(nrrd::write(&directory.join(format!("background-{phase:02}.nrrd")), &sum, QUANTITY)?)
    }
}

fn write_vessels(directory: &Path, phase: u32, vessels: &Volume) -> Result<()> {
    Ok(nrrd::write(&truth_file(directory, phase), vessels, QUANTITY)?)
}

/// Files of a patient.
pub(super) struct PatientFiles<'a> {
    pub(super) tree: &'a Path,
    /// CT in Hounsfield units.
    pub(super) background: Option<&'a Path>,
    /// Whether the middle of the tree is put at the isocentre.
    pub(super) centre: bool,
    pub(super) vessel_per_mm: f64,
    pub(super) stenoses: &'a [Stenosis],
}

/// A tree from a file, with a CT as its background if there is one.
pub(super) struct Patient {
    tree: TreeFile,
    bounds: Bounds,
    vessel_per_mm: f64,
    still: Option<Volume>,
    narrowing: Narrowing,
    lesions: Vec<TrueLesion>,
}

impl Patient {
    /// Reads tree and CT. `centre` moves both so that the middle of the tree lies at the isocentre. Returns the warnings on what
    /// the views will not show as well.
    pub(super) fn read(files: &PatientFiles<'_>, phases: u32, sight: &Sight) -> Result<(Patient, Vec<String>)> {
        let mut tree = TreeFile::read(files.tree)?;
        check_lengths(files.tree, &tree, sight, VESSEL_VOXEL_MM)?;
        let within = tree.bounds();
        let shift_mm = if files.centre { -0.5 * (within.low_mm + within.high_mm) } else { DVec3::ZERO };
        if files.centre {
            tree = tree.moved(shift_mm);
        }
        let mut vessels = Seen::new(sight);
        vessels.add_tree(&tree);
        vessels.check(files.tree, "the vessels")?;
        let bounds = Bounds::over_the_beat(phases, |fraction| tree.at(fraction));
        let still = files.background.map(|path| Self::background(path, shift_mm, sight)).transpose()?;
        let (narrowing, lesions) = Narrowing::new(&tree.at(0.0), files.stenoses)?;
        let patient = Patient { tree, bounds, vessel_per_mm: files.vessel_per_mm, still, narrowing, lesions };
        Ok((patient, vessels.missing("the vessels").into_iter().collect()))
    }

    /// Reads a CT. It is usually wider than the field of view, so parts of it that are not shown are not worth a warning.
    fn background(path: &Path, shift_mm: DVec3, sight: &Sight) -> Result<Volume> {
        let mut volume = volume_files::read(path, &VolumeHints::default())?;
        volume.index_to_lps.translation += shift_mm;
        check_spacing(path, &volume, sight)?;
        voxels::attenuation_from_hounsfield(&mut volume);
        let mut seen = Seen::new(sight);
        seen.add_volume(&volume);
        seen.check(path, "the voxels of the CT")?;
        Ok(volume)
    }

    /// Returns the vessels at a fraction of the beat.
    fn tree(&self, fraction: f64) -> Tree {
        self.narrowing.applied(self.tree.at(fraction))
    }

    /// Returns the stenoses of the vessels.
    pub(super) fn lesions(&self) -> Vec<TrueLesion> {
        self.lesions.clone()
    }

    /// Largest axial distance of the CT's corners from the isocentre, mm; none without a CT.
    pub(super) fn axial_radius_mm(&self) -> Option<f64> {
        self.still.as_ref().map(Volume::axial_radius_mm)
    }

    fn vessels(&self, tree: &Tree) -> Volume {
        voxels::vessels(tree, self.bounds.joined(tree.bounds()), self.vessel_per_mm, VESSEL_VOXEL_MM)
    }
}

impl Subject for Patient {
    fn still(&self, projector: &Projector, chest_mm: DVec3) -> Result<Option<LoadedVolume>> {
        self.still.as_ref().map(|volume| projector.load(voxels::breathing_chest(volume, chest_mm))).transpose()
    }

    fn moving(&self, projector: &Projector, pose: &Pose) -> Result<Moving> {
        let tree = self.tree(pose.fraction);
        let catheter = pose
            .catheter_between(&self.tree(0.0), &tree)
            .map(|[rest, tip]| catheter::volume(tip, rest, 1.0, self.vessel_per_mm, VESSEL_VOXEL_MM));
        Ok(Moving {
            background: None,
            vessels: Some(Placed {
                volume: Arc::new(projector.load(self.vessels(&tree.filled_to(pose.filled_to)))?),
                shift_mm: pose.breath.heart_mm,
            }),
            catheter: catheter.map(|volume| projector.load(volume)).transpose()?.map(Placed::at_rest),
        })
    }

    fn vessel_tree(&self, fraction: f64) -> Option<Tree> {
        Some(self.tree(fraction))
    }

    fn write_volumes(&self, directory: &Path, phase: u32, fraction: f64) -> Result<()> {
        write_vessels(directory, phase, &self.vessels(&self.tree(fraction)))
    }
}

/// Options for reading a user's volumes.
pub(super) struct Reading<'a> {
    pub(super) paths: &'a [PathBuf],
    pub(super) hints: &'a VolumeHints,
    pub(super) hounsfield: bool,
    pub(super) scale: f32,
    /// Attenuation threshold above which a voxel belongs to a vessel, 1/mm.
    pub(super) vessel_per_mm: Option<f64>,
}

impl Reading<'_> {
    fn volume(&self, path: &Path) -> Result<Volume> {
        let mut volume = volume_files::read(path, self.hints)?;
        volume.values.iter_mut().for_each(|v| *v *= self.scale);
        if self.hounsfield {
            voxels::attenuation_from_hounsfield(&mut volume);
        }
        // Attenuation is positive; a chest in Hounsfield units is mostly air, which is negative.
        if volume.values.iter().map(|value| f64::from(*value)).sum::<f64>() < 0.0 {
            let [low, high] =
                volume.values.iter().fold([f32::MAX, f32::MIN], |[low, high], v| [low.min(*v), high.max(*v)]);
            let problem = format!(
                "are {low} to {high}, mostly negative, which is no attenuation per mm: --hounsfield converts Hounsfield units, --scale other \
                 units"
            );
            return Err(Error::data(path, "values", problem));
        }
        Ok(volume)
    }

    /// Static part of the volumes: the minimum attenuation of each voxel; none for a single volume.
    fn minimum(&self) -> Result<Option<Volume>> {
        let mut paths = self.paths.iter();
        let (Some(first), 2..) = (paths.next(), self.paths.len()) else {
            return Ok(None);
        };
        let mut min = self.volume(first)?;
        for path in paths {
            let volume = self.volume(path)?;
            if volume.size != min.size || volume.index_to_lps != min.index_to_lps {
                let problem = "differs from the grid of the first volume; breathing needs volumes on the same grid, to \
                               separate the heart from static tissue";
                return Err(Error::data(path, "grid", problem));
            }
            min.values.iter_mut().zip(&volume.values).for_each(|(a, b)| *a = a.min(*b));
        }
        Ok(Some(min))
    }
}

/// A user's own volumes, one per phase.
pub(super) struct Volumes {
    /// Common part of all volumes, where it is separated from the beating part.
    still: Option<Volume>,
    moving: Vec<(Arc<LoadedVolume>, Option<Arc<LoadedVolume>>)>,
    radius_mm: f64,
}

impl Volumes {
    /// Reads all volumes. If `breathing`, the static part is separated from the beating part. Returns the warnings on what the
    /// views will not show as well.
    pub(super) fn read(
        projector: &Projector,
        reading: &Reading<'_>,
        breathing: bool,
        sight: &Sight,
        mut progress: impl FnMut(u64),
    ) -> Result<(Volumes, Vec<String>)> {
        let still = if breathing { reading.minimum()? } else { None };
        let (mut moving, mut radius_mm) = (Vec::new(), 0f64);
        let (mut all, mut bright) = (Seen::new(sight), Seen::new(sight));
        for (index, path) in reading.paths.iter().enumerate() {
            progress(index as u64);
            let mut volume = reading.volume(path)?;
            check_spacing(path, &volume, sight)?;
            all.add_volume(&volume);
            radius_mm = radius_mm.max(volume.axial_radius_mm());
            let vessels = reading.vessel_per_mm.map(|threshold| Volume {
                values: volume.values.iter().map(|v| if f64::from(*v) >= threshold { *v } else { 0.0 }).collect(),
                ..volume.clone()
            });
            if let Some(vessels) = &vessels {
                bright.add_volume(vessels);
            }
            let vessels = vessels.map(|v| projector.load(v)).transpose()?.map(Arc::new);
            if let Some(still) = &still {
                volume.values.iter_mut().zip(&still.values).for_each(|(v, min)| *v -= min);
            }
            moving.push((Arc::new(projector.load(volume)?), vessels));
        }
        let first = &reading.paths[0];
        all.check(first, "the volumes")?;
        let missing = match reading.vessel_per_mm {
            Some(threshold) if bright.is_empty() => {
                Some(format!("no voxel reaches the attenuation of vessels that was given, {threshold} per mm"))
            }
            Some(_) => {
                bright.check(first, "the vessels")?;
                bright.missing("the vessels")
            }
            None => all.missing("the volumes"),
        };
        Ok((Volumes { still, moving, radius_mm }, missing.into_iter().collect()))
    }

    pub(super) fn axial_radius_mm(&self) -> f64 {
        self.radius_mm
    }

    fn index(&self, fraction: f64) -> usize {
        (fraction * self.moving.len() as f64).round() as usize % self.moving.len()
    }
}

impl Subject for Volumes {
    fn still(&self, projector: &Projector, chest_mm: DVec3) -> Result<Option<LoadedVolume>> {
        self.still.as_ref().map(|volume| projector.load(voxels::breathing_chest(volume, chest_mm))).transpose()
    }

    fn moving(&self, _projector: &Projector, pose: &Pose) -> Result<Moving> {
        let (volume, vessels) = &self.moving[self.index(pose.fraction)];
        let placed = |volume: &Arc<LoadedVolume>| Placed { volume: volume.clone(), shift_mm: pose.breath.heart_mm };
        Ok(Moving { background: Some(placed(volume)), vessels: vessels.as_ref().map(placed), catheter: None })
    }

    fn nearest_fraction(&self, fraction: f64) -> f64 {
        self.index(fraction) as f64 / self.moving.len() as f64
    }
}
