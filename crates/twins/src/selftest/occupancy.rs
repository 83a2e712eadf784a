//! Cells in which the dynamic field has been seen empty: the notes of an iteration, and their use by later ones.

use crate::config::Config;
use crate::error::{Error, Result};
use crate::fields::data::FieldData;
use crate::fitting::losses::StepLoss;
use crate::gpu::device::Gpu;
use crate::kernels::constants::{CELLS_PER_WORD, NEAR_SAMPLE, OCCUPANCY_EPOCH, OCCUPIED, SEEN};
use crate::kernels::layout::Ray;
use crate::kernels::push::{self, PushConstants};
use crate::kernels::tuning::Tuning;
use crate::plan::Plan;
use crate::reference::{march, occupancy};
use crate::scan::dataset::Dataset;
use crate::selftest::compare::Findings;
use crate::selftest::iteration::path_name;
use crate::selftest::problems::{FAST_NETWORK, small_config};
use crate::train::trainer::Trainer;
use glam::DVec3;

const NOTES: &[&str] = &[push::MarchLoss::SHADER, push::Report::SHADER];
const HEEDED: &[&str] = &["empty cells are left out"];

/// The iteration whose samples are compared with those that the notes let live; notes are heeded from iteration 100 on.
const HEEDING: u32 = 150;

/// A field that stays as it starts.
const SETTINGS: &[&str] =
    &["occupancy.start=100", "occupancy.cells=9", "dynamic.lr=0", "dynamic.lr_end=0", "train.iterations=200"];

/// Compares notes and their use with the twin's.
///
/// # Errors
/// Device errors.
pub fn compare(gpu: &Gpu, dataset: &Dataset, tuning: &Tuning, findings: &mut Findings) -> Result<()> {
    findings.begin(path_name(tuning.layers), "fast-mlp, a field that does not change");
    let mut plan = Plan::new(&small_config(FAST_NETWORK, SETTINGS)?, dataset)?;
    let limit = threshold(gpu, dataset, &plan.config, tuning)?;
    plan.data_mut::<FieldData>()?.setup.occupancy_threshold = limit;
    let mut trainer = Trainer::new(gpu, plan, dataset, tuning.clone())?;
    compare_notes(gpu, &mut trainer, findings)?;
    compare_use(gpu, &mut trainer, findings)
}

/// A threshold that nine tenths of the values are below, so that both kinds of cells occur.
fn threshold(gpu: &Gpu, dataset: &Dataset, config: &Config, tuning: &Tuning) -> Result<f32> {
    let mut trainer = Trainer::new(gpu, Plan::new(config, dataset)?, dataset, tuning.clone())?;
    let live = advance(&mut trainer, 1)?.live_samples as usize;
    let mut sigma: Vec<[f32; 2]> = gpu.download(&trainer.fields()?.forward().sample_sigma, 0, live)?;
    sigma.sort_by(|a, b| a[0].total_cmp(&b[0]));
    sigma.get(live * 9 / 10).map(|s| s[0]).ok_or_else(|| Error::Internal("no sample is live".into()))
}

fn advance(trainer: &mut Trainer, until: u32) -> Result<StepLoss> {
    let mut last = None;
    while trainer.step() < until {
        last = trainer.advance(until)?.last().copied().or(last);
    }
    last.ok_or_else(|| Error::Internal(format!("no iteration up to {until} has written a loss")))
}

fn notes(gpu: &Gpu, trainer: &Trainer) -> Result<Vec<u32>> {
    Ok(gpu.download(&trainer.fields()?.forward().occupancy, 0, 3 * trainer.fields()?.data().setup.occupancy_words())?)
}

/// Compares the notes of one iteration, the first of the second epoch. The epoch before is left alone.
fn compare_notes(gpu: &Gpu, trainer: &mut Trainer, findings: &mut Findings) -> Result<()> {
    advance(trainer, OCCUPANCY_EPOCH)?;
    let before = notes(gpu, trainer)?;
    let live = advance(trainer, OCCUPANCY_EPOCH + 1)?.live_samples as usize;
    let after = notes(gpu, trainer)?;
    let setup = trainer.fields()?.data().setup;
    let points: Vec<[f32; 4]> = gpu.download(&trainer.fields()?.forward().sample_points, 0, live)?;
    let rays: Vec<u32> = gpu.download(&trainer.fields()?.forward().sample_rays, 0, live)?;
    let sigma: Vec<[f32; 2]> = gpu.download(&trainer.fields()?.forward().sample_sigma, 0, live)?;
    let batch: Vec<Ray> = gpu.download(&trainer.fields()?.forward().rays, 0, setup.n_rays as usize)?;
    let words = setup.occupancy_words();
    let mut want = before[..2 * words].to_vec();
    let mut kinds = [0u32; 2];
    for ((point, ray), sigma) in points.iter().zip(&rays).zip(&sigma) {
        let x = DVec3::new(point[0].into(), point[1].into(), point[2].into());
        let Some(ray) = batch.get((ray & !NEAR_SAMPLE) as usize) else { continue };
        let full = sigma[0] > setup.occupancy_threshold;
        kinds[usize::from(full)] += 1;
        let bits = SEEN | if full { OCCUPIED } else { 0 };
        let tells = ray.beyond_share >= occupancy::LITTLE_SHOWN || full && ray.beyond_share > 0.0;
        for phase in [Some(ray.phase), tells.then_some(ray.beyond)].into_iter().flatten() {
            let entry = occupancy::entry(&setup, x, phase);
            want[words + (entry / CELLS_PER_WORD) as usize] |= bits << (2 * (entry % CELLS_PER_WORD));
        }
    }
    let wrong = after.iter().zip(&want).filter(|(after, want)| after != want).count();
    findings.add(NOTES, &format!("words that differ, of {}", want.len()), wrong as f64, 0.5);
    findings.require(NOTES, "cells of both kinds", kinds.iter().all(|n| *n > 10));
    Ok(())
}

/// Compares the samples of a later iteration with those that the twin lets live.
fn compare_use(gpu: &Gpu, trainer: &mut Trainer, findings: &mut Findings) -> Result<()> {
    advance(trainer, HEEDING)?;
    let noted = notes(gpu, trainer)?;
    let live = advance(trainer, HEEDING + 1)?.live_samples;
    let plan = trainer.fields()?.data();
    let s = &plan.setup;
    let (mut all, mut kept) = (0u64, 0u64);
    for ray in march::batch(plan, HEEDING) {
        for (t, _) in march::depths(s, s.n_dynamic_samples, s.dynamic_near, s.dynamic_far, HEEDING, &ray) {
            let x = ray.anchor + t * ray.direction;
            let noted = |phase: usize| occupancy::occupied(s, &noted, x, phase as u32, HEEDING);
            all += u64::from(march::searched(plan, x, &ray, |_| true));
            kept += u64::from(march::searched(plan, x, &ray, noted));
        }
    }
    // A sample on a cell face may fall either way in f32.
    let strays = 1.0 + (kept / 50) as f64;
    findings.add(HEEDED, "difference of the number of live samples", live.abs_diff(kept) as f64, strays);
    findings.require(HEEDED, "samples that are omitted", kept * 10 < all * 9);
    Ok(())
}
