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
        let progress = (f64::from(step) / f64::from(self.train.iterations) / self.adam.decay_share).min(1.0);
        let weights = self.network_weights(step);
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
            ..weights
        }
    }

    /// Weights of the losses that two networks have.
    fn network_weights(&self, step: u32) -> layout::Schedule {
        let n = &self.networks;
        if !self.two_networks() {
            return layout::Schedule::default();
        }
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
    #[test]
    fn nerf_ca_schedule_is_that_of_its_code() {
        let config = Config::preset(Preset::NerfCa);
        let close = |got: f32, want: f64| assert!((f64::from(got) - want).abs() <= 1e-6 * want, "{got} {want}");
        let [start, delayed, half, late] = [0, 40_000, 90_000, 160_000].map(|step| config.schedule(step));
        assert_eq!((start.window, start.dynamic_active, start.reset), (1.0, 1, 1));
        assert_eq!((start.favour_static, start.near_integral), (0.0, 0.0));
        close(start.static_lr, 1e-3);
        close(start.ray_entropy, 1e-10);
        close(start.static_size, 1e-8);
        close(delayed.favour_static, 1e-12);
        close(delayed.near_integral, 1e-8);
        // Half of both ramps, counted from their own beginnings.
        close(config.schedule(50_000).ray_entropy, 0.5 * (1e-10 + 1e-8));
        close(half.favour_static, 0.5 * (1e-12 + 1e-10));
        close(half.near_integral, 0.5 * (1e-8 + 1e-4));
        // p = 1 + 12 it / 150,000.
        close(half.window, 8.2);
        close(config.schedule(75_000).dynamic_lr, 0.5 * (1e-3 + 1e-5));
        assert_eq!(late.window, 12.0);
        for (got, want) in [
            (late.dynamic_lr, 1e-5),
            (late.ray_entropy, 1e-8),
            (late.favour_static, 1e-10),
            (late.near_integral, 1e-4),
            (late.static_size, 1e-15),
        ] {
            close(got, want);
        }
    }
}
