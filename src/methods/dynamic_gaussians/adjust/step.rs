//! Gauss-Newton steps on poses, displacements of the heart and contrasts, with the field fixed.

use crate::calibrate::pose::{Poses, ViewPose};
use crate::error::{Error, Result};
use crate::geometry::MM_PER_UNIT;
use crate::linear::Symmetric;
use crate::methods::dynamic_gaussians::adjust::poses::Stands;
use crate::methods::dynamic_gaussians::adjust::residual::{ActiveImage, active_images};
use crate::methods::dynamic_gaussians::deformable::DeformableTrainer;
use crate::methods::dynamic_gaussians::targets::Targets;
use glam::{DMat3, DVec3};
use rayon::prelude::*;

/// Expected standard deviation of errors of the angles, degrees.
const ANGLE_DEG: f64 = 0.3;
/// Expected standard deviation of errors of the patient's position across the view, mm.
const ACROSS_MM: f64 = 3.0;
/// Expected standard deviation of errors of the patient's position along the view, mm.
const DEPTH_MM: f64 = 1.0;
/// Expected standard deviation of the heart's displacement by breathing along (posterior, left, superior), mm.
const HEART_MM: [f64; 3] = [1.0, 0.6, 2.5];
/// Expected standard deviation of the contrast of a frame.
const CONTRAST: f64 = 0.2;
/// Minimum contrast of a frame: images are divided by it.
const MIN_CONTRAST: f64 = 0.3;
/// Standard deviation of the mean contrast of all frames: the field's density determines it.
const MEAN_CONTRAST: f64 = 1e-3;
/// Residuals of neighbouring pixels are errors of the model and correlated: this many count as one.
const TEMPER: f64 = 10.0;
/// Step of central differences in positions, pixels at the isocentre.
const POSITION_STEP: f64 = 0.1;
/// Step of central differences in angles, degrees.
const ANGLE_STEP_DEG: f64 = 0.1;

/// Unknowns of a view: two angles, three translations.
const OF_VIEW: usize = 5;
/// Unknowns of an image: three displacements of the heart, contrast.
const OF_IMAGE: usize = 4;
/// Columns of an image: derivatives by the unknowns of its view, and by its contrast.
const COLUMNS: usize = OF_VIEW + 1;

/// Field of a fit that stays as it is while poses move.
pub struct FieldInLoop<'a> {
    trainer: &'a DeformableTrainer,
    stands: &'a Stands<'a>,
    /// Images of the fit; their contrasts are those of the poses.
    pub targets: Targets,
}

impl<'a> FieldInLoop<'a> {
    /// Takes the field of a fit to views with this stated geometry.
    pub fn new(trainer: &'a DeformableTrainer, stands: &'a Stands<'a>) -> FieldInLoop<'a> {
        FieldInLoop { trainer, stands, targets: trainer.targets().clone() }
    }

    /// Returns the field's images at poses, `[image][pixel]`, shares of the strongest change.
    ///
    /// # Errors
    /// Device errors.
    pub fn drawn(&self, poses: &Poses) -> Result<Vec<f32>> {
        self.trainer.images_through(&self.stands.seen(&self.targets, poses))
    }

    /// Returns the derivatives of the field's images by the unknowns of their views, `[unknown][image][pixel]`: by the primary and the
    /// secondary angle, per degree, and by the position along each axis, per world unit. They are central differences of images on the
    /// device.
    ///
    /// # Errors
    /// Device errors.
    pub fn columns(&self, poses: &Poses) -> Result<Vec<Vec<f32>>> {
        let length = POSITION_STEP * self.targets.units.pixel;
        let drawn_after = |unknown: usize, step: f64| {
            let mut poses = poses.clone();
            poses.views.iter_mut().for_each(|pose| *pose = moved(*pose, unknown, step));
            self.drawn(&poses)
        };
        let column = |k: usize| -> Result<Vec<f32>> {
            let step = if k < 2 { ANGLE_STEP_DEG } else { length };
            let (ahead, behind) = (drawn_after(k, step)?, drawn_after(k, -step)?);
            let slope = (0.5 / step) as f32;
            Ok(ahead.iter().zip(&behind).map(|(a, b)| (a - b) * slope).collect())
        };
        (0..OF_VIEW).map(column).collect()
    }

    /// Makes Gauss-Newton steps with the derivatives at the first poses, which take most of the time, and returns the poses after them.
    ///
    /// # Errors
    /// Device errors; [`Error::Internal`] when the equations cannot be solved.
    pub fn stepped(&mut self, poses: &Poses, n_steps: usize) -> Result<Poses> {
        let columns = self.columns(poses)?;
        (0..n_steps).try_fold(poses.clone(), |poses, _| self.step(&poses, &columns))
    }

    /// Makes a step with such derivatives and returns the poses after it.
    fn step(&mut self, poses: &Poses, columns: &[Vec<f32>]) -> Result<Poses> {
        self.set_contrasts(poses);
        let drawn = self.drawn(poses)?;
        let images = active_images(&self.targets, &drawn);
        let sums: Vec<Sums> = images.par_iter().map(|image| Sums::of(image, &drawn, columns)).collect();
        let (squares, weights) = sums.iter().fold((0.0, 0.0), |(s, n), of| (s + of.squares, n + of.n_pixels));
        let variance = TEMPER * squares / f64::max(weights, 1.0);
        if variance <= 0.0 {
            return Ok(poses.clone());
        }
        let unknowns = Unknowns { n_views: poses.views.len(), n_images: images.len() };
        let mut normal = Normal::new(unknowns.count());
        for (k, (image, sums)) in images.iter().zip(&sums).enumerate() {
            normal.add_image(&unknowns.of_columns(image.slot, k), sums, 1.0 / variance);
        }
        self.add_priors(&mut normal, &unknowns, &images, poses);
        let step = normal.matrix.solve(&normal.right).ok_or_else(|| {
            Error::Internal("the normal equations of the adjustment of poses are not positive definite".into())
        })?;
        let mut next = poses.clone();
        for (slot, pose) in next.views.iter_mut().enumerate() {
            (0..OF_VIEW).for_each(|k| *pose = moved(*pose, k, step[slot * OF_VIEW + k]));
        }
        for (k, image) in images.iter().enumerate() {
            let of = &step[unknowns.image(k)..][..OF_IMAGE];
            next.heart[image.slot][image.phase] += DVec3::from_slice(&of[..3]);
            let gain = &mut next.gains[image.slot][image.phase];
            *gain = (*gain + of[3]).max(MIN_CONTRAST - 1.0);
        }
        Ok(next)
    }

    /// Takes the contrasts of poses as those of the images.
    pub fn set_contrasts(&mut self, poses: &Poses) {
        for (at, image) in self.targets.image_of.iter().enumerate() {
            let Some(image) = image else { continue };
            let (phase, slot) = (at / self.targets.n_views, at % self.targets.n_views);
            self.targets.contrast[*image] = (1.0 + poses.gains[slot][phase]) as f32;
        }
    }

    /// Adds the expected deviations of all corrections from the stated geometry.
    fn add_priors(&self, normal: &mut Normal, unknowns: &Unknowns, images: &[ActiveImage], poses: &Poses) {
        for (slot, pose) in poses.views.iter().enumerate() {
            let first = slot * OF_VIEW;
            (0..2).for_each(|k| normal.add_prior(first + k, pose.angles_deg[k], ANGLE_DEG));
            let axes = self.stands.stands[slot].corrected_axes(pose);
            let precision = DVec3::new(ACROSS_MM, ACROSS_MM, DEPTH_MM).map(|mm| (MM_PER_UNIT / mm).powi(2));
            let precision = axes * DMat3::from_diagonal(precision) * axes.transpose();
            let pull = precision * pose.shift;
            for i in 0..3 {
                (0..=i).for_each(|j| normal.matrix.add(first + 2 + i, first + 2 + j, precision.col(j)[i]));
                normal.right[first + 2 + i] -= pull[i];
            }
        }
        let mut excess = 0.0;
        for (k, image) in images.iter().enumerate() {
            let (first, heart) = (unknowns.image(k), poses.heart[image.slot][image.phase]);
            (0..3).for_each(|axis| normal.add_prior(first + axis, heart[axis], HEART_MM[axis] / MM_PER_UNIT));
            let gain = poses.gains[image.slot][image.phase];
            normal.add_prior(first + 3, gain, CONTRAST);
            excess += gain;
        }
        // One row for the mean of all contrasts.
        let share = 1.0 / images.len().max(1) as f64;
        let weight = (share / MEAN_CONTRAST).powi(2);
        for k in 0..images.len() {
            (0..=k).for_each(|l| normal.matrix.add(unknowns.image(k) + 3, unknowns.image(l) + 3, weight));
            normal.right[unknowns.image(k) + 3] -= weight * excess;
        }
    }
}

/// Returns a view's pose after a step of one unknown.
fn moved(mut pose: ViewPose, unknown: usize, step: f64) -> ViewPose {
    match unknown.checked_sub(2) {
        None => pose.angles_deg[unknown] += step,
        Some(axis) => pose.shift[axis] += step,
    }
    pose
}

/// Order of the unknowns: those of all views, then those of all images.
struct Unknowns {
    n_views: usize,
    n_images: usize,
}

impl Unknowns {
    fn count(&self) -> usize {
        OF_VIEW * self.n_views + OF_IMAGE * self.n_images
    }

    /// First unknown of an image.
    fn image(&self, image: usize) -> usize {
        OF_VIEW * self.n_views + OF_IMAGE * image
    }

    /// Returns pairs of an unknown and the column of its derivatives. A translation of the view and a displacement of the heart have
    /// the same derivatives.
    fn of_columns(&self, slot: usize, image: usize) -> Vec<(usize, usize)> {
        let view = (0..OF_VIEW).map(|k| (slot * OF_VIEW + k, k));
        let heart = (0..3).map(|axis| (self.image(image) + axis, 2 + axis));
        view.chain(heart).chain([(self.image(image) + 3, OF_VIEW)]).collect()
    }
}

/// Sums over the pixels of an image.
struct Sums {
    /// Weighted products of columns.
    products: [[f64; COLUMNS]; COLUMNS],
    /// Weighted products of columns and residuals.
    right: [f64; COLUMNS],
    /// Weighted squares of residuals.
    squares: f64,
    n_pixels: f64,
}

impl Sums {
    fn of(image: &ActiveImage, drawn: &[f32], columns: &[Vec<f32>]) -> Sums {
        let mut sums = Sums {
            products: [[0.0; COLUMNS]; COLUMNS],
            right: [0.0; COLUMNS],
            squares: 0.0,
            n_pixels: image.pixels.len() as f64,
        };
        for pixel in &image.pixels {
            let mut row = [f64::from(drawn[pixel.at]); COLUMNS];
            row.iter_mut().zip(columns).for_each(|(row, column)| *row = image.contrast * f64::from(column[pixel.at]));
            for (i, a) in row.iter().enumerate() {
                row.iter().enumerate().for_each(|(j, b)| sums.products[i][j] += pixel.weight * a * b);
                sums.right[i] += pixel.weight * a * pixel.left;
            }
            sums.squares += pixel.weight * pixel.left.powi(2);
        }
        sums
    }
}

/// Normal equations.
struct Normal {
    matrix: Symmetric,
    right: Vec<f64>,
}

impl Normal {
    fn new(n: usize) -> Normal {
        Normal { matrix: Symmetric::zeros(n), right: vec![0.0; n] }
    }

    fn add_image(&mut self, unknowns: &[(usize, usize)], sums: &Sums, factor: f64) {
        for (a, (i, column_i)) in unknowns.iter().enumerate() {
            for (j, column_j) in &unknowns[..=a] {
                self.matrix.add(*i, *j, factor * sums.products[*column_i][*column_j]);
            }
            self.right[*i] += factor * sums.right[*column_i];
        }
    }

    /// Adds the expectation that a value is zero to within a standard deviation.
    fn add_prior(&mut self, unknown: usize, value: f64, deviation: f64) {
        let precision = 1.0 / deviation.powi(2);
        self.matrix.add(unknown, unknown, precision);
        self.right[unknown] -= precision * value;
    }
}
