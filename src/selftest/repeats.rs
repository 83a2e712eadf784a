//! Runs that must come to the same bits when they are done again, however many iterations go into a submit.

use crate::config::Preset;
use crate::error::Result;
use crate::gaussians::particles::Particles;
use crate::gpu::device::Gpu;
use crate::kernels::layout::Gaussian;
use crate::kernels::tuning::Tuning;
use crate::methods::dynamic_gaussians::deformable::DeformableTrainer;
use crate::methods::dynamic_gaussians::per_phase::GaussianTrainer;
use crate::methods::dynamic_gaussians::rules::{GaussianRules, Rules};
use crate::methods::dynamic_gaussians::targets::Targets;
use crate::plan::Plan;
use crate::scan::dataset::Dataset;
use crate::selftest::compare::Findings;
use crate::selftest::iteration::path_name;
use crate::selftest::problems::{default_rules, deformable_case, hard_case, small_config};
use crate::train::trainer::Trainer;

const REPEATS: &[&str] = &["equal runs have equal bits"];

/// Iterations of each run.
const ITERATIONS: u32 = 24;
/// Where the second run stops on its way, so that its submits differ from the first one's.
const STOPS: [&[u32]; 2] = [&[ITERATIONS], &[5, 6, ITERATIONS]];

/// Records how many numbers of two equal runs differ. Losses come first.
fn compare_runs(run: impl Fn(&[u32]) -> Result<Vec<u64>>, findings: &mut Findings) -> Result<()> {
    let [whole, parts] = [run(STOPS[0])?, run(STOPS[1])?];
    findings.require(REPEATS, "losses that differ", whole.first() != whole.get(1));
    let differ = whole.iter().zip(&parts).filter(|(a, b)| a != b).count() + whole.len().abs_diff(parts.len());
    findings.add(REPEATS, &format!("numbers that differ, of {}", whole.len()), differ as f64, 0.5);
    Ok(())
}

/// Compares runs of both fields, with empty cells learned on the way.
///
/// # Errors
/// Device errors.
pub fn compare_network(gpu: &Gpu, dataset: &Dataset, tuning: &Tuning, findings: &mut Findings) -> Result<()> {
    findings.begin(path_name(tuning.layers), "24 iterations, losses and parameters");
    let config = small_config(Preset::FastMlp, &["dynamic.lr=3e-3", "train.rays=64", "occupancy.start=2"])?;
    let run = |stops: &[u32]| -> Result<Vec<u64>> {
        let mut trainer = Trainer::new(gpu, Plan::new(&config, dataset)?, dataset, tuning.clone())?;
        let totals = |stop| Ok(trainer.advance(stop)?.iter().map(|loss| loss.total()).collect());
        let mut bits = losses(stops, totals)?;
        bits.extend(trainer.model()?.params.iter().map(|v| u64::from(v.to_bits())));
        Ok(bits)
    };
    compare_runs(run, findings)
}

fn bits_of(rows: &[Gaussian]) -> Vec<u64> {
    let words: &[u32] = bytemuck::cast_slice(rows);
    words.iter().map(|word| u64::from(*word)).collect()
}

/// Bits of the losses of a run with these stops on the way; `advance` goes towards a stop, and returns nothing once there.
fn losses(stops: &[u32], mut advance: impl FnMut(u32) -> Result<Vec<f64>>) -> Result<Vec<u64>> {
    let mut bits = Vec::new();
    for stop in stops {
        loop {
            let losses = advance(*stop)?;
            if losses.is_empty() {
                break;
            }
            bits.extend(losses.iter().map(|loss| loss.to_bits()));
        }
    }
    Ok(bits)
}

/// Compares runs of Gaussians, a set per phase and one set that moves.
///
/// # Errors
/// Device errors.
pub fn compare_gaussians(gpu: &Gpu, findings: &mut Findings) -> Result<()> {
    findings.begin("phase", "24 iterations, losses and Gaussians");
    let short = |rules: Rules| {
        let gaussians = GaussianRules { iterations: ITERATIONS, grow_at: 0, ..rules.gaussians };
        Rules { gaussians, ..rules }
    };
    let config = short(default_rules()?);
    let (targets, rows) = hard_case()?;
    let run = |stops: &[u32]| -> Result<Vec<u64>> {
        let mut trainer = GaussianTrainer::with(gpu, targets.clone(), &config, &Particles::fresh(rows.clone()))?;
        let mut bits = losses(stops, |stop| trainer.advance(stop))?;
        bits.extend(bits_of(&trainer.model()?.rows));
        Ok(bits)
    };
    compare_runs(run, findings)?;
    let (targets, rows, config) = deformable_case()?;
    let config = short(config);
    findings.begin("deformable", "24 iterations, losses, Gaussians and their motion");
    compare_deformable(gpu, &targets, &rows, &config, findings)?;
    findings.begin("deformable", "the same with contrast that comes and goes, and fillings");
    compare_deformable(gpu, &Targets { contrast_comes_and_goes: true, ..targets }, &rows, &config, findings)
}

/// Compares runs of one set that moves.
fn compare_deformable(
    gpu: &Gpu,
    targets: &Targets,
    rows: &[Gaussian],
    config: &Rules,
    findings: &mut Findings,
) -> Result<()> {
    let run = |stops: &[u32]| -> Result<Vec<u64>> {
        let mut trainer = DeformableTrainer::with(gpu, targets.clone(), config, &Particles::fresh(rows.to_vec()))?;
        let mut bits = losses(stops, |stop| trainer.advance(stop))?;
        let deformable = trainer.deformable()?;
        bits.extend(bits_of(&deformable.rest.rows));
        let motion = deformable.grid.iter().chain(&deformable.own).flatten();
        bits.extend(motion.chain(deformable.filling.iter().flatten()).map(|v| u64::from(v.to_bits())));
        Ok(bits)
    };
    compare_runs(run, findings)
}
