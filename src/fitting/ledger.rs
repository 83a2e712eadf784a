//! Minimum work of stages, for comparison with their measured times.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::ops::AddAssign;

/// Minimum work of a stage in an iteration.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct StageWork {
    /// Operations, a multiply-add counted as two, GFLOP.
    pub gflop: f64,
    /// Numbers that differ between samples or between parameters, each moved once between memory and the device, MB. Weights,
    /// which all samples share, are left out.
    pub megabytes: f64,
}

impl StageWork {
    /// Work of `items` samples or parameters that need `flop` operations and `bytes` bytes each.
    pub fn per_item(items: u64, flop: u64, bytes: u64) -> StageWork {
        StageWork { gflop: (items * flop) as f64 * 1e-9, megabytes: (items * bytes) as f64 * 1e-6 }
    }

    /// Minimum time of the work, milliseconds, for peak rates in TFLOP/s and GB/s.
    pub fn min_ms(&self, tflops: f64, gb_per_s: f64) -> f64 {
        (self.gflop / tflops).max(self.megabytes / gb_per_s)
    }
}

impl AddAssign for StageWork {
    fn add_assign(&mut self, other: StageWork) {
        self.gflop += other.gflop;
        self.megabytes += other.megabytes;
    }
}

/// Work by names of stages, without the suffixes of their variants.
pub type Ledger = BTreeMap<String, StageWork>;

/// Adds work to a stage.
pub fn add(ledger: &mut Ledger, stage: &str, work: StageWork) {
    *ledger.entry(stage.to_owned()).or_default() += work;
}

/// Returns the work of a pass, whose name is a stage's name, perhaps with the suffix of a variant.
pub fn of_pass(ledger: &Ledger, pass: &str) -> Option<StageWork> {
    let stages = ledger.iter().filter(|(stage, _)| pass.starts_with(stage.as_str()));
    stages.max_by_key(|(stage, _)| stage.len()).map(|(_, work)| *work)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn passes_find_the_stage_whose_variant_they_are() {
        let mut ledger = Ledger::new();
        add(&mut ledger, "mlp_out_bwd", StageWork::per_item(1_000_000, 2, 0));
        add(&mut ledger, "mlp_out_bwd_weight", StageWork::per_item(1_000_000, 3, 8));
        add(&mut ledger, "mlp_out_bwd_weight", StageWork::per_item(1_000_000, 0, 1));
        assert_eq!(of_pass(&ledger, "mlp_out_bwd_texel").unwrap().gflop, 2e-3);
        let weights = of_pass(&ledger, "mlp_out_bwd_weight_texel").unwrap();
        assert_eq!(weights, StageWork { gflop: 3e-3, megabytes: 9.0 });
        assert_eq!(of_pass(&ledger, "adam"), None);
        // The work needs 3 ms of arithmetic at 1 GFLOP/s, or 9 ms of memory at 1 GB/s.
        assert_eq!((weights.min_ms(1e-3, 1e9), weights.min_ms(1e3, 1.0)), (3.0, 9.0));
    }
}
