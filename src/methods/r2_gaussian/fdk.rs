//! Filtered back-projection of cone beams (Feldkamp, Davis and Kress) as TIGRE computes it for R2-Gaussian's start: the
//! cosine of each ray, the ramp of Ram and Lak along rows, and at each voxel the squared share of the way from the
//! source to the isocentre. Views are few and truncated here, and rows of a tilted C-arm share no plane: a crude start,
//! and mostly streaks.

use crate::gaussians::view::SplatView;
use crate::methods::r2_gaussian::data::R2Data;
use glam::{DVec2, DVec3};
use rayon::prelude::*;

/// A view's filtered image.
struct Filtered<'a> {
    view: &'a SplatView,
    /// From the source to the isocentre along the axis, half sides of the volume.
    distance: f64,
    width: usize,
    height: usize,
    values: Vec<f64>,
}

/// Ramp filter at a distance of `apart` pixels, for pixels of side 1.
fn ramp(apart: usize) -> f64 {
    match apart {
        0 => 0.25,
        odd if odd % 2 == 1 => -1.0 / (std::f64::consts::PI * odd as f64).powi(2),
        _ => 0.0,
    }
}

impl<'a> Filtered<'a> {
    /// Filters one of `n_views` images.
    fn new(view: &'a SplatView, image: &[f32], (width, height): (usize, usize), n_views: usize) -> Filtered<'a> {
        let distance = view.project(DVec3::ZERO).0;
        let pitch = view.direction[1].length() * distance;
        let factor = std::f64::consts::TAU / n_views as f64 / (2.0 * pitch);
        let window: Vec<f64> = (0..width).map(|apart| factor * ramp(apart)).collect();
        let row_of = |row: usize| -> Vec<f64> {
            let cosine = |column: usize| 1.0 / view.ray(column as f64, row as f64).length();
            let weighted: Vec<f64> =
                (0..width).map(|column| cosine(column) * f64::from(image[row * width + column])).collect();
            let at = |column: usize| weighted.iter().enumerate().map(|(k, v)| v * window[column.abs_diff(k)]).sum();
            (0..width).map(at).collect()
        };
        let values = (0..height).into_par_iter().flat_map_iter(row_of).collect();
        Filtered { view, distance, width, height, values }
    }

    /// Returns the view's contribution at a point: linear between pixels, 0 beyond the image.
    fn at(&self, x: DVec3) -> f64 {
        let (depth, column, row) = self.view.project(x);
        let place = DVec2::new(column, row);
        let corner = place.floor();
        let part = place - corner;
        let mut sum = 0.0;
        for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
            let (i, j) = (corner.x as i64 + dx, corner.y as i64 + dy);
            if (0..self.width as i64).contains(&i) && (0..self.height as i64).contains(&j) {
                let share = |d: i64, part: f64| if d == 1 { part } else { 1.0 - part };
                sum += share(dx, part.x) * share(dy, part.y) * self.values[j as usize * self.width + i as usize];
            }
        }
        sum * (self.distance / depth).powi(2)
    }
}

/// Back-projects the images of a set onto `side`^3 voxels of the volume, x fastest.
pub fn back_projection(data: &R2Data, set: usize, side: usize) -> Vec<f32> {
    let images = data.sets.images(set);
    let filtered: Vec<Filtered<'_>> = images
        .iter()
        .map(|image| {
            let values = &data.images[image * data.n_pixels()..][..data.n_pixels()];
            Filtered::new(&data.views[*image], values, (data.width, data.height), images.len())
        })
        .collect();
    let centre = |k: usize| (2.0 * k as f64 + 1.0) / side as f64 - 1.0;
    let slice = |z: usize| {
        let places = (0..side * side).map(move |k| DVec3::new(centre(k % side), centre(k / side), centre(z)));
        places.map(|x| filtered.iter().map(|view| view.at(x)).sum::<f64>() as f32).collect::<Vec<f32>>()
    };
    (0..side).into_par_iter().flat_map_iter(slice).collect()
}
