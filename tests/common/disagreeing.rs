//! Phantoms whose views disagree by known errors, and the error of a correction against the truth.

use glam::DVec3;
use nertca_vk::calibrate::gauge::{FrameRays, RigidMotion, common_motion};
use nertca_vk::geometry::{CArm, Geometry, ViewRays, lps_mm_from_world, world_from_lps_mm};
use nertca_vk::gpu::device::Gpu;
use nertca_vk::random::{STREAM_PHOTON, normal, uniform01};
use nertca_vk::scan::dataset::{Dataset, Frame, Layout, Split, View};
use nertca_vk::scan::gating::contraction;
use nertca_vk_phantom::projector::{LoadedVolume, Projector};
use nertca_vk_phantom::tree::{Bounds, Heart, Tree};
use nertca_vk_phantom::views::{CArmOptions, PixelPitch, ViewAngles};
use nertca_vk_phantom::voxels::{self, Breath, Tissues};

pub const PHASES: u32 = 10;
const SCALE: f64 = 0.37;

/// A beating tree in a thorax, ready for projection.
pub struct Studio {
    projector: Projector,
    still: LoadedVolume,
    heart: Vec<LoadedVolume>,
    vessels: Vec<LoadedVolume>,
    trees: Vec<Tree>,
    pub size: usize,
}

/// Errors of the stated geometry: standard deviations or amplitudes.
#[derive(Debug, Clone, Copy, Default)]
pub struct Wrong {
    pub angle_deg: f64,
    pub shift_mm: f64,
    pub breathing_mm: f64,
    /// Noise as a share of the strongest vessel's line integral.
    pub noise: f64,
    pub seed: u32,
}

/// A dataset with stated geometry, and its true geometry.
#[derive(Clone)]
pub struct Shot {
    pub dataset: Dataset,
    /// True geometry of each view.
    pub truth: Vec<Geometry>,
    /// True displacement of the heart, `[view][phase]`, world units.
    pub heart: Vec<Vec<DVec3>>,
    pub breathes: bool,
    points: Vec<Vec<DVec3>>,
}

impl Studio {
    pub fn new(gpu: &Gpu, size: usize, seed: u32) -> Studio {
        let heart = Heart::new(DVec3::ZERO, SCALE);
        let bounds = Bounds::over_the_beat(PHASES, |fraction| Tree::procedural(&heart, SCALE, fraction, seed));
        let shift = -0.5 * (bounds.low_mm + bounds.high_mm);
        let heart = Heart::new(shift, SCALE);
        let fraction = |t: u32| f64::from(t) / f64::from(PHASES);
        let trees: Vec<Tree> = (0..PHASES).map(|t| Tree::procedural(&heart, SCALE, fraction(t), seed)).collect();
        let bounds = trees[1..].iter().map(Tree::bounds).fold(trees[0].bounds(), Bounds::joined);
        let still = voxels::thorax(Tissues::XCAT, shift, SCALE, DVec3::new(-25.0, 10.0, 25.0), DVec3::splat(64.0));
        let projector = Projector::new(gpu, size, size).unwrap();
        let load = |volume| projector.load(volume).unwrap();
        let beat = |t: u32| {
            let (squeeze, breath) = (contraction(fraction(t)), Breath::default());
            load(voxels::heart_and_diaphragm(Tissues::XCAT, &heart, squeeze, breath, shift, SCALE, &still))
        };
        let vessel = |tree: &Tree| load(voxels::vessels(tree, bounds, Tissues::XCAT.vessel, 0.4 * SCALE));
        let (hearts, vessels) = ((0..PHASES).map(beat).collect(), trees.iter().map(vessel).collect());
        let still = projector.load(still).unwrap();
        Studio { heart: hearts, vessels, still, trees, projector, size }
    }

    /// Projects the published training views, with errors that the stated geometry does not contain.
    pub fn shoot(&self, n_views: u32, wrong: Wrong) -> Shot {
        let mut views = ViewAngles::published(n_views).unwrap();
        views.validation.clear();
        let c_arms = CArmOptions {
            sod_mm: vec![450.0],
            sid_mm: vec![2500.0],
            pixel: PixelPitch::Detector([200.0 / self.size as f64; 2]),
            offset_mm: vec![[0.0; 2]],
        };
        let splits: Vec<Split> = views.all().map(|(_, split)| split).collect();
        let stated: Vec<CArm> = c_arms.c_arms(&views, self.size).unwrap();
        let draw = |v: usize, k: u32| normal(wrong.seed, STREAM_PHOTON, 1000 + v as u32, k);
        let mut shot = Shot {
            dataset: self.empty(&stated),
            truth: Vec::new(),
            heart: Vec::new(),
            breathes: wrong.breathing_mm > 0.0,
            points: self.points(),
        };
        for (v, (c_arm, split)) in stated.iter().zip(&splits).enumerate() {
            let error = |k: u32, size: f64| size * draw(v, k);
            let mut truth = c_arm.clone();
            truth.primary_deg += error(0, wrong.angle_deg);
            truth.secondary_deg += error(1, wrong.angle_deg);
            truth.table_mm = [2, 3, 4].map(|k| error(k, wrong.shift_mm));
            let truth = Geometry::CArm(truth);
            let rays = [truth.rays(self.size, self.size).unwrap()];
            let start = uniform01(wrong.seed, STREAM_PHOTON, 2000, v as u32);
            let still = &self.projector.project(&self.still, &rays, DVec3::ZERO).unwrap()[0];
            let mut breath = Vec::new();
            for t in 0..PHASES {
                // A quarter of a breath per beat.
                let course = (std::f64::consts::TAU * (start + 0.25 * f64::from(t) / f64::from(PHASES))).sin();
                let lps = course * wrong.breathing_mm * DVec3::new(0.0, 0.3, 1.0);
                let moving = [&self.heart[t as usize], &self.vessels[t as usize]];
                let moving = moving.map(|m| self.projector.project(m, &rays, lps).unwrap().swap_remove(0));
                let mut integrals: Vec<f32> = still.clone();
                moving.iter().for_each(|m| integrals.iter_mut().zip(m).for_each(|(i, m)| *i += m));
                let strongest = moving[1].iter().copied().fold(0f32, f32::max);
                for (p, value) in integrals.iter_mut().enumerate() {
                    let noise = normal(wrong.seed, STREAM_PHOTON, 3000 + (v as u32) * 100 + t, p as u32);
                    *value += strongest * (wrong.noise * noise) as f32;
                }
                let name = format!("view{v}-phase{t:02}");
                shot.dataset.frames.push(Frame {
                    name,
                    view: v,
                    phase: t,
                    split: *split,
                    integrals: integrals.into(),
                    mask: None,
                    after_phase: 0.0,
                    heart_shift_mm: [0.0; 3],
                    contrast: 1.0,
                });
                breath.push(world_from_lps_mm(lps));
            }
            shot.truth.push(truth);
            shot.heart.push(breath);
        }
        shot
    }

    fn empty(&self, stated: &[CArm]) -> Dataset {
        let view = |c_arm: &CArm| {
            let geometry = Geometry::CArm(c_arm.clone());
            View::new(geometry, [self.size; 2]).unwrap()
        };
        Dataset {
            path: "phantom".into(),
            layout: Layout::Native,
            views: stated.iter().map(view).collect(),
            frames: Vec::new(),
            width: self.size,
            height: self.size,
            n_phases: PHASES,
            depth_range: (-1.26, 1.26),
            hidden: Default::default(),
            vessel_attenuation: Some(Tissues::XCAT.vessel * 100.0),
            still: false,
            vessels_alone: false,
            views_adjusted: false,
            prior: None,
            notes: Vec::new(),
        }
    }

    fn points(&self) -> Vec<Vec<DVec3>> {
        let at = |t: usize| {
            let all = self.trees[t].branches.iter().flat_map(|b| b.points.iter().step_by(4));
            all.map(|p| world_from_lps_mm(*p)).collect()
        };
        (0..PHASES as usize).map(at).collect()
    }
}

impl Shot {
    /// Points of the vessels at a phase, patient mm (LPS).
    pub fn points_mm(&self, phase: usize) -> Vec<[f64; 3]> {
        self.points[phase].iter().map(|point| lps_mm_from_world(*point).to_array()).collect()
    }

    /// Rays of the training frames by their true geometry and by `corrected`, which maps (view, phase).
    pub fn frames(&self, corrected: &dyn Fn(usize, usize) -> ViewRays) -> Vec<FrameRays> {
        let size = self.dataset.width;
        let frame = |f: &Frame| {
            let phase = f.phase as usize;
            let truth = self.truth[f.view].rays(size, size).unwrap().moved(self.heart[f.view][phase]);
            FrameRays { phase, truth, corrected: corrected(f.view, phase) }
        };
        self.dataset.training().iter().map(frame).collect()
    }

    /// Root mean square image distance of vessel points after removal of the common motion, pixels.
    pub fn error_px(&self, corrected: &dyn Fn(usize, usize) -> ViewRays) -> f64 {
        let frames = self.frames(corrected);
        let some: Vec<DVec3> = self.points.iter().flatten().step_by(37).copied().collect();
        let motion = common_motion(&frames, &some, PHASES as usize, self.breathes);
        let squares: f64 = (0..PHASES as usize)
            .map(|t| {
                let here: Vec<FrameRays> = frames.iter().filter(|f| f.phase == t).cloned().collect();
                RigidMotion::remainder_px(&motion, &here, &self.points[t]).powi(2)
            })
            .sum();
        (squares / f64::from(PHASES)).sqrt()
    }
}
