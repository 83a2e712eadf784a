//! The schedules of a run as pure functions of the step.

use crate::config::fields::{FieldSettings, Rates};
use crate::config::{Config, Decay};
use crate::kernels::layout;

impl Config {
    /// Returns the schedule's row for iteration `step` (from 0); an empty one without fields that rays are marched through.
    pub fn schedule(&self, step: u32) -> layout::Schedule {
        self.fields().map_or_else(layout::Schedule::default, |settings| settings.schedule(step))
    }
}

impl FieldSettings {
    /// Returns a row for every step and one more, so that the state after the last step has a row as well.
    pub fn schedule_table(&self) -> Vec<layout::Schedule> {
        (0..=self.train.iterations).map(|step| self.schedule(step)).collect()
    }

    /// Returns the schedule's row for iteration `step` (from 0).
    pub fn schedule(&self, step: u32) -> layout::Schedule {
        let d = &self.dynamic;
        let (bands, iterations) =
            self.network.as_ref().map_or((0, 0), |network| (network.bands, network.window_iterations));
        let opened = f64::from(step.saturating_sub(d.delay)) / f64::from(iterations.max(1));
        let bands = f64::from(bands);
        layout::Schedule {
            static_update: self.static_update(step),
            dynamic_update: self.dynamic_update(step),
            window: (d.window_start + (bands - d.window_start) * opened).min(bands) as f32,
            dynamic_active: u32::from(step >= d.delay && self.network.is_some()),
            ..self.network_weights(step)
        }
    }

    /// Returns the first iteration after which moments and learning rates of both fields have started again; none where the dynamic
    /// field is there from the start. The authors' code makes its optimiser anew at the end of the first iteration with the dynamic
    /// field (`run_hybrid.py`, where `n_iter == model_delay`), not before it.
    pub(crate) fn restart(&self) -> Option<u32> {
        (self.dynamic.delay > 0 && self.network.is_some()).then(|| self.dynamic.delay.saturating_add(1))
    }

    /// Returns Adam's update of the static field.
    fn static_update(&self, step: u32) -> layout::FieldUpdate {
        // With Gaussians, the fit of the static field begins where that of the Gaussians ends.
        let begin = match self.restart() {
            Some(restart) if step >= restart => restart,
            _ => self.begin,
        };
        let rates = self.static_field.rates();
        self.update(rates.at(self.progress(rates.decay, step)), step.saturating_sub(begin) + 1)
    }

    /// Returns Adam's update of the dynamic field. The update at the delay uses the optimiser that the static field has used so
    /// far, so that the next update is a first one again.
    fn dynamic_update(&self, step: u32) -> layout::FieldUpdate {
        let Some(network) = &self.network else { return layout::FieldUpdate::default() };
        let (begin, progress) = match self.restart() {
            Some(restart) if step < restart => (restart - 1, 0.0),
            Some(restart) => (restart, self.progress(network.decay, step)),
            None => (0, self.progress(network.decay, step)),
        };
        let rates = Rates { start: network.lr, end: network.lr_end, decay: network.decay };
        self.update(rates.at(progress), step.saturating_sub(begin) + 1)
    }

    /// Returns Adam's update number `updates` (from 1) since its moments were zero.
    fn update(&self, rate: f64, updates: u32) -> layout::FieldUpdate {
        let correction = |beta: f64| (1.0 - beta.powi(updates as i32)) as f32;
        layout::FieldUpdate {
            rate: rate as f32,
            restart: u32::from(updates == 1),
            bias_correction1: correction(self.adam.beta1),
            bias_correction2: correction(self.adam.beta2),
        }
    }

    /// Returns the progress of learning rates from start (0) to end (1). After the restart, a linear decay ends with the run,
    /// as the paper states, and an exponential decay keeps its factor per iteration, as in the authors' code.
    fn progress(&self, decay: Decay, step: u32) -> f64 {
        let whole = f64::from(self.train.iterations) * self.adam.decay_share;
        let Some(restart) = self.restart().filter(|restart| step >= *restart) else {
            return (f64::from(step) / whole).min(1.0);
        };
        let length = match decay {
            Decay::Linear => (whole - f64::from(restart)).max(1.0),
            Decay::Exponential => whole,
        };
        (f64::from(step - restart) / length).min(1.0)
    }

    /// Returns the weights of the losses of two networks.
    fn network_weights(&self, step: u32) -> layout::Schedule {
        let Some(n) = &self.networks else { return layout::Schedule::default() };
        let after = |delay: u32, start: f64, end: f64| {
            if step < delay {
                return 0.0;
            }
            let share = (f64::from(step - delay) / f64::from(n.ramp)).min(1.0);
            (start + (end - start) * share) as f32
        };
        layout::Schedule {
            favour_static: after(n.delay, n.favour_static, n.favour_static_end),
            ray_entropy: after(0, n.ray_entropy, n.ray_entropy_end),
            near_integral: after(n.delay, n.near_integral, n.near_integral_end),
            static_size: after(0, n.static_size, n.static_size_end),
            ..layout::Schedule::default()
        }
    }
}

impl Rates {
    /// Returns the rate at a progress from 0 to 1.
    fn at(self, progress: f64) -> f64 {
        let Rates { start, end, decay } = self;
        match decay {
            Decay::Linear => start + (end - start) * progress,
            Decay::Exponential if start > 0.0 && end > 0.0 => start * (end / start).powf(progress),
            Decay::Exponential => start,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Preset;

    fn fields(preset: Preset) -> FieldSettings {
        Config::preset(preset).fields().unwrap()
    }

    fn close(got: f32, want: f64) {
        assert!((f64::from(got) - want).abs() <= 1e-6 * want, "{got} {want}");
    }

    /// Expected values follow `run_hybrid.py` of the authors: update number of each field, and its rate as a power of the
    /// factor per iteration.
    #[test]
    fn the_delay_of_the_public_code_is_that_of_its_authors() {
        let config = fields(Preset::PublicCode);
        let factor = 0.1f64.powf(1.0 / 30_000.0);
        let correction = |updates: i32| 1.0 - 0.99f64.powi(updates);
        for (step, restarts, static_powers, static_updates, dynamic_powers, dynamic_updates) in [
            (0, [1, 0], 0, 1, 0, 1),
            (1499, [0, 0], 1499, 1500, 0, 1),
            // One step of the dynamic field with the old optimiser, then both optimisers restart.
            (1500, [0, 1], 1500, 1501, 0, 1),
            (1501, [1, 1], 0, 1, 0, 1),
            (1502, [0, 0], 1, 2, 1, 2),
            (29_999, [0, 0], 28_498, 28_499, 28_498, 28_499),
        ] {
            let row = config.schedule(step);
            assert_eq!(row.dynamic_active, u32::from(step >= 1500));
            close(row.static_update.rate, 0.02 * factor.powi(static_powers));
            close(row.static_update.bias_correction2, correction(static_updates));
            assert_eq!(row.static_update.restart, restarts[0], "{step}");
            if row.dynamic_active != 0 {
                close(row.dynamic_update.rate, 0.1 * factor.powi(dynamic_powers));
                close(row.dynamic_update.bias_correction2, correction(dynamic_updates));
                assert_eq!(row.dynamic_update.restart, restarts[1], "{step}");
            }
        }
    }

    #[test]
    fn paper_schedule_has_its_delay_window_and_restart_and_ends_where_the_paper_says() {
        let config = fields(Preset::Paper);
        let (before, start, restart) = (config.schedule(1499), config.schedule(1500), config.schedule(1501));
        assert_eq!((before.dynamic_active, start.dynamic_active, start.window), (0, 1, 0.0));
        close(before.static_update.rate, 0.01 - 0.009 * 1499.0 / 30_000.0);
        close(start.dynamic_update.rate, 0.1);
        close(restart.static_update.rate, 0.01);
        close(restart.dynamic_update.rate, 0.1);
        close(restart.dynamic_update.bias_correction1, 0.1);
        close(config.schedule(1500 + 7500).window, 5.0);
        assert_eq!(config.schedule(29_999).window, 10.0);
        let end = config.schedule(30_000);
        close(end.static_update.rate, 1e-3);
        close(end.dynamic_update.rate, 1e-2);
    }

    #[test]
    fn nerf_ca_schedule_is_that_of_its_code() {
        let config = fields(Preset::NerfCa);
        let [start, delayed, half, late] = [0, 40_000, 90_000, 160_000].map(|step| config.schedule(step));
        assert_eq!((start.window, start.dynamic_active, start.dynamic_update.restart), (1.0, 1, 1));
        assert_eq!((start.favour_static, start.near_integral), (0.0, 0.0));
        close(start.static_update.rate, 1e-3);
        close(start.ray_entropy, 1e-10);
        close(start.static_size, 1e-8);
        close(delayed.favour_static, 1e-12);
        close(delayed.near_integral, 1e-8);
        // Half of both ramps, each counted from its own beginning.
        close(config.schedule(50_000).ray_entropy, 0.5 * (1e-10 + 1e-8));
        close(half.favour_static, 0.5 * (1e-12 + 1e-10));
        close(half.near_integral, 0.5 * (1e-8 + 1e-4));
        // p = 1 + 12 it / 150,000.
        close(half.window, 8.2);
        close(config.schedule(75_000).dynamic_update.rate, 0.5 * (1e-3 + 1e-5));
        assert_eq!(late.window, 12.0);
        for (got, want) in [
            (late.dynamic_update.rate, 1e-5),
            (late.ray_entropy, 1e-8),
            (late.favour_static, 1e-10),
            (late.near_integral, 1e-4),
            (late.static_size, 1e-15),
        ] {
            close(got, want);
        }
    }
}
