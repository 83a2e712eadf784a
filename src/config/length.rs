//! Runs of another length: schedules that keep their shares of the run, and the iterations at which they change something.

use crate::config::Config;
use crate::config::method::Scaled;

/// Iterations of a dry run: enough for every event of the presets to have iterations before and after it.
pub(super) const DRY_RUN: u32 = 20;
/// Iterations of a dry run with density control, which happens at most every ten iterations.
pub(super) const DRY_RUN_WITH_DENSIFYING: u32 = 60;
/// Minimum number of iterations of a dry run after its last event.
const AFTER_THE_LAST: u32 = 4;

impl Config {
    /// Returns this configuration for a run of so many iterations, with a schedule that keeps its shares; [`Config::check`] tells
    /// whether it can be run.
    pub fn of_length(&self, iterations: u32) -> Config {
        let mut config = self.clone();
        let scaled = Scaled(f64::from(iterations) / f64::from(self.train.iterations));
        config.method.settings_mut().scale(&scaled);
        config.train.iterations = iterations;
        config
    }

    /// Returns the configuration of a dry run (`train::dry_run`): its schedule keeps its order, and its batches their sizes.
    pub fn of_dry_run(&self) -> Config {
        let iterations = self.method.settings().dry_run_length();
        if self.train.iterations <= iterations {
            return self.clone();
        }
        let mut short = self.of_length(iterations);
        short.method.settings_mut().shorten(&mut short.train, iterations, self.train.iterations);
        let last = short.schedule_events().last().copied().unwrap_or(0);
        short.train.iterations = short.train.iterations.max(last.saturating_add(AFTER_THE_LAST));
        short
    }

    /// Returns the iterations, in ascending order, at which the schedule changes something.
    pub fn schedule_events(&self) -> Vec<u32> {
        let mut events = self.method.settings().events();
        if let Some(fields) = self.fields() {
            if let Some(network) = &fields.network {
                events.extend(fields.restart().map(|restart| restart - 1));
                events.extend(fields.restart());
                events.push(fields.dynamic.delay.saturating_add(network.window_iterations));
            }
            if fields.occupancy.enabled {
                events.push(fields.dynamic.delay.saturating_add(fields.occupancy.start));
            }
        }
        // The fit of the static field begins where that of the Gaussians ends.
        events.push(self.gaussian_iterations());
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
    use crate::config::sections::{R2Settings, XSettings};

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
            let config = Config::preset(preset).of_length(length);
            assert_eq!((config.train.iterations, config.schedule_events()), (length, events), "{preset:?}");
        }
        assert_eq!(Config::preset(Preset::Fast).schedule_events(), [120]);
    }

    #[test]
    fn shortened_runs_keep_the_shares_of_density_control_but_not_every_iteration() {
        let r2 = |length| Config::preset(Preset::R2Gaussian).of_length(length).of::<R2Settings>().unwrap().r2.clone();
        assert_eq!((r2(6000).densify_every, r2(6000).densify_from), (20, 100));
        assert_eq!((r2(1000).densify_every, r2(1000).densify_from), (10, 17));
        let x = Config::preset(Preset::XGaussian).of_length(2000).of::<XSettings>().unwrap().x.clone();
        assert_eq!((x.densify_every, x.densify_from, x.densify_until), (20, 50, 800));
        assert_eq!((x.reset_every, x.degree_every), (400, 100));
    }
}
