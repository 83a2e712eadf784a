//! Images of a stage: its subject, seen by its C-arms, as a dataset or a run takes them.

use crate::blades::Blade;
use crate::degradations::{Chance, Degradations};
use crate::error::{Error, Result};
use crate::geometry::{CArm, Geometry, ViewRays};
use crate::projector::Projector;
use crate::runs::Shot;
use crate::scan::dataset::{Layout, MANIFEST, Split};
use crate::scan::nerfca;
use crate::scan::truth::TrueLesion;
use crate::subjects::{Moving, Placed, Pose, Subject};
use crate::views::ViewAngles;
use glam::DVec3;
use std::num::NonZeroU32;
use std::path::Path;

/// Threshold of a vessel pixel: its line integral through vessels alone exceeds this share of that of one pixel width of
/// vessel.
const MASK_SHARE: f64 = 0.05;
/// Attenuation of a blade as a multiple of the largest line integral of its view.
const BLADE_DENSITY: f32 = 2.0;

/// Subject and geometry that a phantom dataset is made from.
pub(super) struct Stage {
    pub(super) description: String,
    /// C-arm of each view.
    pub(super) c_arms: Vec<CArm>,
    pub(super) depth_half_extent_mm: f64,
    pub(super) vessel_attenuation: Option<f64>,
    pub(super) phases: u32,
    pub(super) still: bool,
    pub(super) subject: Box<dyn Subject>,
    /// Stenoses of the vessels.
    pub(super) lesions: Vec<TrueLesion>,
    /// Whether the moving background already contains the vessels.
    pub(super) vessels_in_background: bool,
}

/// Options of the images that are taken of a stage.
pub(super) struct Shooting<'a> {
    pub(super) size: usize,
    pub(super) views: &'a ViewAngles,
    pub(super) seed: u32,
    pub(super) degradations: &'a Degradations,
    pub(super) layout: Layout,
    /// Interval of the phases whose voxel volumes are also written: the first of every so many.
    pub(super) volumes_every: Option<NonZeroU32>,
}

impl Shooting<'_> {
    /// Rejects impossible images, and directories that already hold a dataset, before any work is done.
    pub(super) fn check(&self, out: &Path) -> Result<()> {
        if !(16..=2048).contains(&self.size) {
            return Err(Error::config("size", self.size, "is not in the accepted range, 16 to 2048"));
        }
        for name in [MANIFEST, nerfca::GENERAL] {
            if out.join(name).exists() {
                return Err(Error::config(
                    "OUT",
                    out.display(),
                    "already contains a dataset; choose another directory",
                ));
            }
        }
        self.degradations.check(self.views.training.len(), self.layout)
    }

    pub(super) fn chance(&self, view: usize) -> Chance {
        Chance { seed: self.seed, view: view as u32 }
    }

    /// C-arm as the dataset states it.
    pub(super) fn stated(&self, c_arm: &CArm, view: usize, split: Split) -> CArm {
        match self.degradations.geometry_error {
            Some(error) if split == Split::Train => error.stated(c_arm, self.chance(view)),
            _ => c_arm.clone(),
        }
    }
}

/// Takes images of a stage.
pub(super) struct Camera<'a> {
    projector: &'a Projector,
    stage: &'a Stage,
    rays: Vec<ViewRays>,
    /// Line integrals of the static background, per view.
    still: Vec<Vec<f32>>,
    /// Moving parts at the pose that was drawn last.
    drawn: Option<(Pose, Moving)>,
}

/// Line integrals of an image and of its vessels alone.
pub(super) struct Exposure {
    pub(super) image: Vec<f32>,
    pub(super) vessels: Option<Vec<f32>>,
}

impl<'a> Camera<'a> {
    pub(super) fn new(projector: &'a Projector, stage: &'a Stage, size: usize) -> Result<Camera<'a>> {
        let rays = |c_arm: &CArm| {
            let rays = Geometry::CArm(c_arm.clone()).rays(size, size);
            rays.map_err(|(field, problem)| Error::config(field, "", problem))
        };
        let rays = stage.c_arms.iter().map(rays).collect::<Result<Vec<ViewRays>>>()?;
        let still = match stage.subject.still(projector, DVec3::ZERO)? {
            Some(volume) => projector.project(&volume, &rays, DVec3::ZERO)?,
            None => vec![vec![0.0; size * size]; rays.len()],
        };
        Ok(Camera { projector, stage, rays, still, drawn: None })
    }

    pub(super) fn expose(&mut self, view: usize, shot: &Shot, catheter: bool) -> Result<Exposure> {
        let rays = self.rays[view].clone();
        let still = self.still[view].clone();
        self.expose_through(&rays, still, shot, catheter)
    }

    /// Takes an image through some rays, over the static background that these show without breathing.
    pub(super) fn expose_through(
        &mut self,
        rays: &ViewRays,
        still: Vec<f32>,
        shot: &Shot,
        catheter: bool,
    ) -> Result<Exposure> {
        let pose = Pose { fraction: shot.fraction, breath: shot.breath, catheter, filled_to: shot.filled_to };
        let moving = match self.drawn.take() {
            Some((drawn, moving)) if drawn == pose => moving,
            _ => self.stage.subject.moving(self.projector, &pose)?,
        };
        let mut image = match shot.breath.chest_mm {
            DVec3::ZERO => still,
            chest_mm => match self.stage.subject.still(self.projector, chest_mm)? {
                Some(volume) => self.project(rays, &Placed::at_rest(volume))?,
                None => still,
            },
        };
        for placed in moving.background.iter().chain(&moving.catheter) {
            add(&mut image, &self.project(rays, placed)?, 1.0);
        }
        let vessels = moving.vessels.as_ref().map(|placed| self.project(rays, placed)).transpose()?;
        if let Some(vessels) = &vessels {
            let there = if self.stage.vessels_in_background { 1.0 } else { 0.0 };
            add(&mut image, vessels, shot.contrast_gain as f32 - there);
        }
        self.drawn = Some((pose, moving));
        Ok(Exposure { image, vessels })
    }

    fn project(&self, rays: &ViewRays, placed: &Placed) -> Result<Vec<f32>> {
        Ok(self.projector.project(&placed.volume, std::slice::from_ref(rays), placed.shift_mm)?.swap_remove(0))
    }

    /// Static background through some rays.
    pub(super) fn still_through(&self, still: Option<&Placed>, rays: &ViewRays) -> Result<Vec<f32>> {
        still.map_or_else(|| Ok(vec![0.0; self.still[0].len()]), |placed| self.project(rays, placed))
    }

    /// Mask of vessel pixels, from the line integrals of vessels alone.
    pub(super) fn mask(&self, view: usize, vessels: &[f32]) -> Vec<bool> {
        let c_arm = &self.stage.c_arms[view];
        let pixel_at_isocentre = c_arm.pixel_mm[0] * c_arm.sod_mm / c_arm.sid_mm;
        let threshold = (MASK_SHARE * self.stage.vessel_attenuation.unwrap_or(0.0) * pixel_at_isocentre) as f32;
        vessels.iter().map(|v| *v > threshold).collect()
    }

    /// Makes a blade that hides a share of the moving part of a view's vessels.
    pub(super) fn blade(&mut self, view: usize, shots: &[Option<Shot>], shooting: &Shooting<'_>) -> Result<Blade> {
        let pixels = shooting.size * shooting.size;
        let (mut sum, mut min, mut densest, mut images) = (vec![0f64; pixels], vec![f32::MAX; pixels], 0f32, 0);
        for shot in shots.iter().flatten() {
            let exposure = self.expose(view, shot, shooting.degradations.catheter)?;
            densest = exposure.image.iter().copied().fold(densest, f32::max);
            for (pixel, value) in exposure.vessels.iter().flatten().enumerate() {
                sum[pixel] += f64::from(*value);
                min[pixel] = min[pixel].min(*value);
            }
            images += 1;
        }
        // In a single image all vessels count as moving, because there is no other image to compare with.
        let still = |pixel: usize| if images > 1 { f64::from(images) * f64::from(min[pixel]) } else { 0.0 };
        let moving: Vec<f64> = sum.iter().enumerate().map(|(pixel, sum)| sum - still(pixel)).collect();
        let share = shooting.degradations.collimated_share;
        Ok(Blade::hiding(share, &moving, shooting.size, BLADE_DENSITY * densest, shooting.chance(view)))
    }
}

fn add(image: &mut [f32], other: &[f32], factor: f32) {
    for (a, b) in image.iter_mut().zip(other) {
        *a += factor * b;
    }
}
