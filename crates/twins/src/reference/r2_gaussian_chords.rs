//! f64 reference implementations (twins) of R2-Gaussian's stages with exact line integrals along pixels' own rays, as plain
//! loops without the device. Lengths are in half sides of the volume; along a Gaussian's axes they are in standard
//! deviations.

use crate::gaussians::view::SplatView;
use crate::kernels::layout::GaussianSetup;
use crate::methods::r2_gaussian::parameters::softplus;
use crate::reference::gaussians::{Params, axes};
use crate::reference::r2_gaussian_shape::{pixels_within, position, scale};
use glam::{DMat3, DVec2, DVec3};

/// A Gaussian in a view, and the box of pixels whose rays pass within the cut.
#[derive(Debug, Clone)]
pub struct Chords {
    /// Column and row of the centre.
    pub mean: DVec2,
    /// Half sides of the box around it, pixels.
    pub half_box: DVec2,
    density: f64,
    depth: f64,
    /// World directions: that of the ray through the centre, of unit depth, and its changes per column and row.
    rays: [DVec3; 3],
    /// Components of `rays` along the Gaussian's axes.
    along: [DVec3; 3],
}

/// A ray past a Gaussian, and the Gaussian's integral along it.
struct Chord {
    nearest: DVec3,
    direction: DVec3,
    integral: f64,
}

impl Chords {
    /// Projects a Gaussian into a view; `None` behind the source.
    pub fn of(p: &Params, view: &SplatView, setup: &GaussianSetup) -> Option<Chords> {
        let (depth, column, row) = view.project(position(p));
        if depth <= 0.0 {
            return None;
        }
        let (axes, scale) = (axes(p), scale(p, setup));
        let rays = [view.ray(column, row), view.direction[1], view.direction[2]];
        let mean = DVec2::new(column, row);
        Some(Chords {
            mean,
            half_box: half_box(mean, depth, view, (axes, scale), setup),
            density: softplus(p[3]),
            depth,
            rays,
            along: rays.map(|ray| axes.transpose() * ray / scale),
        })
    }

    fn at(&self, d: DVec2) -> Chord {
        let beside = d.x * self.along[1] + d.y * self.along[2];
        let (a, b) = (self.depth * beside, self.along[0] + beside);
        let nearest = a - a.dot(b) / b.length_squared() * b;
        let path = (self.rays[0] + d.x * self.rays[1] + d.y * self.rays[2]).length() / b.length();
        let falloff = (-0.5 * nearest.length_squared()).exp();
        let integral = self.density * std::f64::consts::TAU.sqrt() * path * falloff;
        Chord { nearest, direction: b.normalize(), integral }
    }

    /// Index and offset from the centre of every pixel of the box.
    pub fn pixels(&self, setup: &GaussianSetup) -> impl Iterator<Item = (usize, DVec2)> + use<> {
        pixels_within(self.mean, self.half_box, setup)
    }

    /// Adds the Gaussian to a picture.
    pub fn splat(&self, setup: &GaussianSetup, picture: &mut [f64]) {
        self.pixels(setup).for_each(|(pixel, d)| picture[pixel] += self.at(d).integral);
    }

    /// Sums over the box of h = dL/dx times the integral: h, h c, and h (c c^T + b b^T) as xx, yy, zz, xy, xz, yz, where c
    /// is the vector from the centre to the ray's nearest point and b the ray's direction.
    pub fn moments(&self, setup: &GaussianSetup, gradient: &[f64]) -> [f64; 10] {
        let mut sums = [0.0; 10];
        for (pixel, d) in self.pixels(setup) {
            let Chord { nearest: c, direction: b, integral } = self.at(d);
            let h = gradient[pixel] * integral;
            let square = |j: usize, k: usize| c[j] * c[k] + b[j] * b[k];
            let second = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)].map(|(j, k)| square(j, k));
            let terms = [1.0, c.x, c.y, c.z].into_iter().chain(second);
            sums.iter_mut().zip(terms).for_each(|(sum, term)| *sum += h * term);
        }
        sums
    }

    /// Length of the gradient by the centre in the image, in half images, as used by density control.
    pub fn pull(&self, setup: &GaussianSetup, moments: [f64; 10]) -> f64 {
        let linear = DVec3::new(moments[1], moments[2], moments[3]);
        let by_pixel = self.depth * DVec2::new(self.along[1].dot(linear), self.along[2].dot(linear));
        (0.5 * DVec2::new(setup.width.into(), setup.height.into()) * by_pixel).length()
    }
}

/// Half sides of the box around the centre's pixel that contains all rays within the cut: roots of the outline's equation
/// along columns and along rows. A Gaussian that reaches the source covers all pixels.
fn half_box(mean: DVec2, depth: f64, view: &SplatView, (axes, scale): (DMat3, DVec3), setup: &GaussianSetup) -> DVec2 {
    let cut = f64::from(setup.cut);
    let along = |row: DVec3| cut * scale * (axes.transpose() * row);
    let far = along(view.rows[0]);
    let behind = depth * depth - far.length_squared();
    if behind <= 0.0 {
        return mean.abs() + DVec2::new(setup.width.into(), setup.height.into());
    }
    let half = |k: usize, mean: f64| {
        let across = along(view.rows[k] - mean * view.rows[0]);
        let slant = far.dot(across).abs();
        (slant + (slant * slant + across.length_squared() * behind).sqrt()) / behind
    };
    DVec2::new(half(1, mean.x), half(2, mean.y))
}
