//! Runs of another length: schedules that keep their shares of the run, and the iterations at which they change something.

use crate::config::method::Scaled;
use crate::config::{Config, GaussianForm};
use crate::error::Result;

/// Iterations of a dry run: enough for every event of the presets to have iterations before and after it.
pub(super) const DRY_RUN: u32 = 20;
/// Iterations of a dry run with density control, which happens at most every ten iterations.
pub(super) const DRY_RUN_WITH_DENSIFYING: u32 = 60;
/// Minimum number of iterations of a dry run after its last event.
const AFTER_THE_LAST: u32 = 4;

impl Config {
    /// Returns the settings, with their keys, that keep the schedule's shares of a run of so many iterations.
    pub fn schedule_of_length(&self, iterations: u32) -> Vec<(&'static str, u32)> {
        let scaled = Scaled(f64::from(iterations) / f64::from(self.train.iterations));
        let mut schedule = vec![
            ("dynamic.delay", scaled.count(self.dynamic.delay)),
            ("dynamic.window_iterations", scaled.count(self.dynamic.window_iterations)),
            ("occupancy.start", scaled.count(self.occupancy.start)),
        ];
        schedule.extend(self.method().settings().schedule(self, &scaled));
        schedule
    }

    /// Returns this configuration for a run of so many iterations, with a schedule that keeps its shares.
    ///
    /// # Errors
    /// [`crate::error::Error::Config`] when a run of that length is refused.
    pub fn of_length(&self, iterations: u32) -> Result<Config> {
        let mut config = self.clone();
        config.train.iterations = iterations;
        let schedule = self.schedule_of_length(iterations);
        let settings: Vec<String> = schedule.iter().map(|(key, count)| format!("{key}={count}")).collect();
        config.with_constants(&settings)
    }

    /// Returns the configuration of a dry run (`train::dry_run`): its schedule keeps its order, and its batches their sizes.
    ///
    /// # Errors
    /// [`crate::error::Error::Config`] when so short a run is refused.
    pub fn of_dry_run(&self) -> Result<Config> {
        let method = self.method().settings();
        let iterations = method.dry_run_length();
        if self.train.iterations <= iterations {
            return Ok(self.clone());
        }
        let mut short = self.of_length(iterations)?;
        if short.follows_breath() {
            // A fit of Gaussians has its own number of iterations, which does not scale with the run.
            short.train.iterations = short.gaussians.iterations.saturating_add(iterations).min(self.train.iterations);
        }
        method.shorten(&mut short, iterations);
        let last = short.schedule_events().last().copied().unwrap_or(0);
        short.train.iterations = short.train.iterations.max(last.saturating_add(AFTER_THE_LAST));
        Ok(short)
    }

    /// Returns the iterations, in ascending order, at which the schedule changes something.
    pub fn schedule_events(&self) -> Vec<u32> {
        let mut events = Vec::new();
        if self.method().has_network() {
            events.extend(self.restart().map(|restart| restart - 1));
            events.extend(self.restart());
            events.push(self.dynamic.delay.saturating_add(self.dynamic.window_iterations));
        }
        events.extend(self.method().settings().events(self));
        if self.occupancy.enabled {
            events.push(self.dynamic.delay.saturating_add(self.occupancy.start));
        }
        // The fit of the static field begins where that of the Gaussians ends.
        if self.gaussians.form != GaussianForm::None {
            events.push(self.gaussian_iterations());
        }
        events.retain(|event| (1..self.train.iterations).contains(event));
        events.sort_unstable();
        events.dedup();
        events
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Preset;

    #[test]
    fn a_run_of_another_length_keeps_its_events_in_their_order() {
        for (preset, length, events) in [
            (Preset::Paper, 30_000, vec![1500, 1501, 16_500]),
            (Preset::Paper, 20, vec![1, 2, 11]),
            (Preset::PublicCode, 3000, vec![150, 151, 1650]),
            (Preset::NerfCa, 200, vec![40, 138, 140, 150]),
            (Preset::FastMlp, 120, vec![26, 60]),
            (Preset::R2Gaussian, 600, vec![10, 300]),
            (Preset::XGaussian, 400, vec![10, 20, 80, 160]),
            (Preset::SaxNerf, 9006, vec![9000]),
        ] {
            let config = Config::preset(preset).of_length(length).unwrap();
            assert_eq!((config.train.iterations, config.schedule_events()), (length, events), "{preset:?}");
        }
        assert_eq!(Config::preset(Preset::Fast).schedule_events(), [120]);
    }
}
