//! The loop of a run: iterations go to the device, losses come back as progress. `run` drives it towards a run
//! directory, `session` in memory.

use crate::error::Result;
use crate::fitting::losses::StepLoss;
use crate::train::trainer::Trainer;
use std::time::Instant;

/// Weight of the newest squared error, by its logarithm, in the smoothed one.
const SMOOTHING: f64 = 0.05;

/// Losses of an iteration, and how fast iterations go.
#[derive(Debug, Clone, Copy)]
pub struct Progress {
    /// Losses of the iteration.
    pub loss: StepLoss,
    /// PSNR of the iteration's rays, dB; not a number while Gaussians are fitted, which have no rays.
    pub psnr_db: f64,
    /// PSNR of the training rays, smoothed over iterations, dB.
    pub smoothed_psnr_db: f64,
    /// Iterations per second since the clock was started.
    pub iterations_per_s: f64,
    /// Seconds since the clock was started.
    pub elapsed_s: f64,
}

/// A run in training.
pub struct Training {
    trainer: Trainer,
    /// Span of the line integrals of the training images.
    image_range: f64,
    /// Smoothed logarithm of the squared error: through the logarithm, a short peak is forgotten as soon as any other value.
    smoothed_log_mse: Option<f64>,
    clock: Clock,
    train_s: f64,
}

struct Clock {
    begin: Instant,
    first_step: u32,
}

impl Training {
    /// Takes over a trainer and starts the clock.
    pub fn new(trainer: Trainer) -> Training {
        let [low, high] = trainer.plan().image_range;
        let clock = Clock { begin: Instant::now(), first_step: trainer.step() };
        let image_range = if high > low { f64::from(high - low) } else { 1.0 };
        Training { trainer, image_range, smoothed_log_mse: None, clock, train_s: 0.0 }
    }

    /// The trainer.
    pub fn trainer(&self) -> &Trainer {
        &self.trainer
    }

    /// The trainer, for snapshots and checkpoints.
    pub fn trainer_mut(&mut self) -> &mut Trainer {
        &mut self.trainer
    }

    /// Counts time and iterations from now on, as after a pause.
    pub fn start_clock(&mut self) {
        self.clock = Clock { begin: Instant::now(), first_step: self.trainer.step() };
    }

    /// Seconds spent in the loop, without what its driver does in between.
    pub fn train_s(&self) -> f64 {
        self.train_s
    }

    /// Seconds since the clock was started.
    pub fn elapsed_s(&self) -> f64 {
        self.clock.begin.elapsed().as_secs_f64()
    }

    /// Keeps the device busy towards iteration `until` and returns the progress that became known, oldest first; see
    /// [`Trainer::advance`].
    ///
    /// # Errors
    /// As [`Trainer::advance`].
    pub fn advance(&mut self, until: u32) -> Result<Vec<Progress>> {
        let started = Instant::now();
        let losses = self.trainer.advance(until)?;
        self.train_s += started.elapsed().as_secs_f64();
        Ok(losses.into_iter().map(|loss| self.progress(loss)).collect())
    }

    /// Lets the iterations under way finish.
    ///
    /// # Errors
    /// As [`Trainer::advance`].
    pub fn drain(&mut self) -> Result<Vec<Progress>> {
        let mut progress = Vec::new();
        while self.trainer.step() < self.trainer.submitted() {
            progress.extend(self.advance(self.trainer.submitted())?);
        }
        Ok(progress)
    }

    fn progress(&mut self, loss: StepLoss) -> Progress {
        let newest = loss.squared_error;
        let log = newest.max(f64::MIN_POSITIVE).ln();
        let smoothed = self.smoothed_log_mse.map_or(log, |before| (1.0 - SMOOTHING) * before + SMOOTHING * log);
        // Gaussians have no such error.
        let smoothed = if newest.is_nan() { f64::NAN } else { smoothed };
        self.smoothed_log_mse = Some(smoothed).filter(|log| log.is_finite());
        let elapsed_s = self.elapsed_s();
        Progress {
            loss,
            psnr_db: self.psnr_db(newest),
            smoothed_psnr_db: self.psnr_db(smoothed.exp()),
            iterations_per_s: f64::from(loss.step - self.clock.first_step) / elapsed_s.max(1e-9),
            elapsed_s,
        }
    }

    fn psnr_db(&self, squared_error: f64) -> f64 {
        if squared_error.is_nan() {
            return f64::NAN;
        }
        -10.0 * (squared_error / (self.image_range * self.image_range)).max(1e-20).log10()
    }
}
