//! Gauss-Newton steps on poses, displacements of the heart and contrasts, with the field fixed.

use crate::calibrate::estimate::{Freedom, Normal, TEMPER, Unknown, Unknowns};
use crate::calibrate::pose::{Poses, StatedView};
use crate::error::{Error, Result};
use crate::methods::dynamic_gaussians::adjust::poses::Stands;
use crate::methods::dynamic_gaussians::adjust::residual::{ActiveImage, active_images};
use crate::methods::dynamic_gaussians::deformable::DeformableTrainer;
use crate::methods::dynamic_gaussians::targets::Targets;
use glam::DMat3;
use rayon::prelude::*;

/// Step of central differences in positions, pixels at the isocentre.
const POSITION_STEP: f64 = 0.1;
/// Step of central differences in angles, degrees.
const ANGLE_STEP_DEG: f64 = 0.1;

/// Number of unknowns of a view.
const OF_VIEW: usize = 5;
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

    /// Axes of the stated C-arms.
    fn axes(&self) -> Vec<DMat3> {
        self.stands.stands.iter().map(StatedView::axes).collect()
    }

    /// Returns the derivatives of the field's images by the unknowns of their views ([`Unknown::of_view`]), `[unknown][image][pixel]`. They
    /// are central differences of images on the device.
    ///
    /// # Errors
    /// Device errors.
    pub fn columns(&self, poses: &Poses) -> Result<Vec<Vec<f32>>> {
        let (axes, length) = (self.axes(), POSITION_STEP * self.targets.units.pixel);
        let drawn_after = |unknown: usize, step: f64| {
            let mut poses = poses.clone();
            (0..axes.len()).for_each(|view| Unknown::of_view(view)[unknown].add(step, &axes, &mut poses));
            self.drawn(&poses)
        };
        let column = |unknown: usize| -> Result<Vec<f32>> {
            let is_angle = matches!(Unknown::of_view(0)[unknown], Unknown::Angle(..));
            let step = if is_angle { ANGLE_STEP_DEG } else { length };
            let (ahead, behind) = (drawn_after(unknown, step)?, drawn_after(unknown, -step)?);
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
        let mut frames = vec![Vec::new(); poses.views.len()];
        images.iter().for_each(|image| frames[image.slot].push(image.phase));
        let unknowns = Unknowns::new(self.axes(), Freedom::ALL, &frames);
        let mut normal = Normal::zeros(unknowns.all.len());
        for (image, sums) in images.iter().zip(&sums) {
            sums.add_to(&mut normal, &unknowns, &unknowns.of_frame(image.slot, image.phase));
        }
        normal.stepped(variance, &unknowns, poses).ok_or_else(|| {
            Error::Internal("the normal equations of the adjustment of poses are not positive definite".into())
        })
    }

    /// Takes the contrasts of poses as those of the images.
    pub fn set_contrasts(&mut self, poses: &Poses) {
        for (at, image) in self.targets.image_of.iter().enumerate() {
            let Some(image) = image else { continue };
            let (phase, slot) = (at / self.targets.n_views, at % self.targets.n_views);
            self.targets.contrast[*image] = (1.0 + poses.gains[slot][phase]) as f32;
        }
    }
}

/// Returns the derivative by an unknown, per standard deviation of its prior, as factors on the columns of its view. A displacement of the
/// heart changes an image as a translation of the view does.
fn factors(unknown: Unknown, axes: &[DMat3]) -> [f64; COLUMNS] {
    let mut factors = [0.0; COLUMNS];
    match unknown {
        Unknown::Angle(v, _) | Unknown::Shift(v, _) => {
            let of_view = Unknown::of_view(v);
            factors.iter_mut().zip(of_view).for_each(|(factor, u)| *factor = f64::from(u8::from(u == unknown)));
        }
        Unknown::Heart(v, _, axis) => {
            for (factor, u) in factors.iter_mut().zip(Unknown::of_view(v)) {
                let Unknown::Shift(_, along) = u else { continue };
                *factor = axes[v].col(along)[axis];
            }
        }
        Unknown::Gain(..) => factors[OF_VIEW] = 1.0,
    }
    factors.map(|factor| factor * unknown.deviation())
}

fn dot(a: &[f64; COLUMNS], b: &[f64; COLUMNS]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
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

    /// Adds the image to the equations of unknowns with these indices.
    fn add_to(&self, normal: &mut Normal, unknowns: &Unknowns, indices: &[usize]) {
        let rows: Vec<_> = indices.iter().map(|i| factors(unknowns.all[*i], &unknowns.axes)).collect();
        let product = |k: usize, l: usize| dot(&rows[k], &self.products.map(|products| dot(&products, &rows[l])));
        // The residual is the image minus the field's.
        normal.add(indices, product, |k| -dot(&rows[k], &self.right));
    }
}
