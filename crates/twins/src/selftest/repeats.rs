//! Runs that must come to the same bits when they are done again, however many iterations go into a submit.

use crate::error::Result;
use crate::gpu::device::Gpu;
use crate::kernels::layout::Gaussian;
use crate::kernels::tuning::Tuning;
use crate::plan::Plan;
use crate::scan::dataset::Dataset;
use crate::selftest::compare::Findings;
use crate::selftest::iteration::path_name;
use crate::selftest::problems::{FAST_NETWORK, small_config};
use crate::train::trainer::Trainer;

const REPEATS: &[&str] = &["equal runs have equal bits"];

/// Iterations of each run.
pub(crate) const ITERATIONS: u32 = 24;
/// Where the second run stops on its way, so that its submits differ from the first one's.
const STOPS: [&[u32]; 2] = [&[ITERATIONS], &[5, 6, ITERATIONS]];

/// Records how many numbers of two equal runs differ. Losses come first.
pub(crate) fn compare_runs(run: impl Fn(&[u32]) -> Result<Vec<u64>>, findings: &mut Findings) -> Result<()> {
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
    let config = small_config(FAST_NETWORK, &["dynamic.lr=3e-3", "train.rays=64", "occupancy.start=2"])?;
    let run = |stops: &[u32]| -> Result<Vec<u64>> {
        let mut trainer = Trainer::new(gpu, Plan::new(&config, dataset)?, dataset, tuning.clone())?;
        let totals = |stop| Ok(trainer.advance(stop)?.iter().map(|loss| loss.total()).collect());
        let mut bits = losses(stops, totals)?;
        bits.extend(trainer.model()?.params.iter().map(|v| u64::from(v.to_bits())));
        Ok(bits)
    };
    compare_runs(run, findings)
}

/// Returns the bits of Gaussians.
pub(crate) fn bits_of(rows: &[Gaussian]) -> Vec<u64> {
    let words: &[u32] = bytemuck::cast_slice(rows);
    words.iter().map(|word| u64::from(*word)).collect()
}

/// Bits of the losses of a run with these stops on the way; `advance` goes towards a stop, and returns nothing once there.
pub(crate) fn losses(stops: &[u32], mut advance: impl FnMut(u32) -> Result<Vec<f64>>) -> Result<Vec<u64>> {
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
