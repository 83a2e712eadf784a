//! The schedules of a run as pure functions of the step.

use crate::config::{Config, Decay};
use crate::kernels::layout;

impl Config {
    /// Rows for every step and one more, so that the state after the last step has a row as well.
    pub fn schedule_table(&self) -> Vec<layout::Schedule> {
        (0..=self.train.iterations).map(|step| self.schedule(step)).collect()
    }

    /// The schedule's row for `step` (from 0).
    pub fn schedule(&self, step: u32) -> layout::Schedule {
        let d = &self.dynamic;
        let progress = f64::from(step) / f64::from(self.train.iterations);
        let active = step >= d.delay && !self.gaussians_move();
        let since_delay = step.saturating_sub(d.delay);
        let restarted = active && d.delay > 0;
        // The still field begins where Gaussians end.
        let since_begin = step.saturating_sub(self.gaussian_iterations());
        let updates = if restarted { since_delay } else { since_begin } + 1;
        let opened = f64::from(since_delay) / f64::from(d.window_iterations.max(1));
        let bands = f64::from(d.bands);
        layout::Schedule {
            static_lr: rate(self.static_field.lr, self.static_field.lr_end, self.static_field.decay, progress) as f32,
            dynamic_lr: rate(d.lr, d.lr_end, d.decay, progress) as f32,
            window: (d.window_start + (bands - d.window_start) * opened).min(bands) as f32,
            dynamic_active: u32::from(active),
            reset: u32::from(updates == 1),
            bias_correction1: (1.0 - self.adam.beta1.powi(updates as i32)) as f32,
            bias_correction2: (1.0 - self.adam.beta2.powi(updates as i32)) as f32,
        }
    }
}

fn rate(start: f64, end: f64, decay: Decay, progress: f64) -> f64 {
    match decay {
        Decay::Linear => start + (end - start) * progress,
        Decay::Exponential if start > 0.0 && end > 0.0 => start * (end / start).powf(progress),
        Decay::Exponential => start,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Preset;

    #[test]
    fn paper_schedule_has_its_delay_window_and_reset() {
        let config = Config::preset(Preset::Paper);
        assert_eq!(config.schedule(0).reset, 1);
        assert_eq!(config.schedule(1499).dynamic_active, 0);
        let start = config.schedule(1500);
        assert_eq!((start.dynamic_active, start.reset, start.window), (1, 1, 0.0));
        assert!((start.bias_correction1 - 0.1).abs() < 1e-7);
        assert_eq!(config.schedule(1501).reset, 0);
        assert!((config.schedule(1500 + 7500).window - 5.0).abs() < 1e-6);
        assert_eq!(config.schedule(29_999).window, 10.0);
        assert!((config.schedule(15_000).static_lr - 0.0055).abs() < 1e-9);
    }
}
