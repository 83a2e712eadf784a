//! f64 reference implementations (twins) of the stages of R2-Gaussian, as plain loops without the device. Lengths are in
//! half sides of the volume.

use crate::gaussians::view::SplatView;
use crate::kernels::layout::{GaussianSetup, R2Gaussian, R2Schedule, R2Setup};
use crate::methods::r2_gaussian::parameters::{ScaleBounds, softplus};
use crate::reference::adam::Adam;
use crate::reference::gaussians::{N_PARAMS, Params, axes, rotation_gradient};
use crate::reference::r2_gaussian_chords::Chords;
use crate::reference::r2_gaussian_shape::{bounds, pixels_within, position, scale};
use glam::{DMat2, DMat3, DVec2, DVec3};

/// Distance from the image's centre at which slopes stop following the Gaussian's centre, in half images.
const SLOPES_END: f64 = 1.3;
/// Minimum squared difference of variances in the computation of a radius, pixels^4.
const MIN_SPREAD: f64 = 0.1;
/// Standard deviations along its longest axis at which a Gaussian is cut off among voxels.
const VOXEL_CUT: f64 = 3.0;

/// Returns the stored parameters of a Gaussian: position, density, scale, quaternion.
pub fn params(g: &R2Gaussian) -> Params {
    let mut out = [0.0; N_PARAMS];
    let all = g.position.iter().chain([&g.density]).chain(&g.scale).chain(&g.rotation);
    out.iter_mut().zip(all).for_each(|(p, v)| *p = f64::from(*v));
    out
}

fn sigmoid(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

/// Converts gradients by the logarithms of density and scales to gradients by the stored parameters.
pub fn to_stored(p: &Params, setup: &GaussianSetup, by_logarithms: &Params) -> Params {
    let mut out = *by_logarithms;
    out[3] *= sigmoid(p[3]) / softplus(p[3]);
    let ScaleBounds { min, max } = bounds(setup);
    for k in 4..7 {
        let share = sigmoid(p[k]);
        out[k] *= (max - min) * share * (1.0 - share) / bounds(setup).scale(p[k]);
    }
    out
}

/// Projection of a Gaussian into an image, with the intermediate values of its gradient.
#[derive(Debug, Clone)]
pub struct Projection {
    /// Column and row of the centre.
    pub mean: DVec2,
    /// Inverse variance in the image.
    pub conic: DMat2,
    /// Line integral through the centre, along the ray of its slopes.
    pub amplitude: f64,
    /// Half side of the square of pixels it is limited to.
    pub radius: f64,
    depth: f64,
    follows: DVec2,
    ray: DVec3,
    slopes: [DVec3; 2],
    alpha: DVec3,
    beta: DVec3,
}

/// Projects a Gaussian into a view; `None` behind the source.
pub fn project(p: &Params, view: &SplatView, setup: &GaussianSetup) -> Option<Projection> {
    let (depth, column, row) = view.project(position(p));
    if depth <= 0.0 {
        return None;
    }
    let mean = DVec2::new(column, row);
    let size = DVec2::new(setup.width.into(), setup.height.into());
    let (middle, reach) = (0.5 * (size - 1.0), 0.5 * SLOPES_END * size);
    let held = mean.clamp(middle - reach, middle + reach);
    let follows = DVec2::new(f64::from(u8::from(held.x == mean.x)), f64::from(u8::from(held.y == mean.y)));
    let slopes = [(1, held.x), (2, held.y)].map(|(k, held)| (view.rows[k] - held * view.rows[0]) / depth);
    let (axes, scale) = (axes(p), scale(p, setup));
    let [alpha, beta] = slopes.map(|slope| scale * (axes.transpose() * slope));
    let (uu, uv, vv) = (alpha.dot(alpha), alpha.dot(beta), beta.dot(beta));
    let det = alpha.cross(beta).length_squared();
    let ray = view.ray(held.x, held.y);
    let amplitude =
        softplus(p[3]) * std::f64::consts::TAU.sqrt() * scale.element_product() * ray.length() * view.inverse_det()
            / (depth * depth * det.sqrt());
    let half_sum = 0.5 * (uu + vv);
    let largest = half_sum + (half_sum * half_sum - det).max(MIN_SPREAD).sqrt();
    Some(Projection {
        mean,
        conic: DMat2::from_cols(DVec2::new(vv, -uv), DVec2::new(-uv, uu)) * (1.0 / det),
        amplitude,
        radius: (f64::from(setup.cut) * largest.sqrt()).ceil(),
        depth,
        follows,
        ray,
        slopes,
        alpha,
        beta,
    })
}

impl Projection {
    /// Index and offset from the centre of every pixel of the square.
    pub fn pixels(&self, setup: &GaussianSetup) -> impl Iterator<Item = (usize, DVec2)> + use<> {
        pixels_within(self.mean, DVec2::splat(self.radius), setup)
    }

    fn value(&self, d: DVec2) -> f64 {
        self.amplitude * (-0.5 * d.dot(self.conic * d)).exp()
    }

    /// Adds the Gaussian to a picture.
    pub fn splat(&self, setup: &GaussianSetup, picture: &mut [f64]) {
        self.pixels(setup).for_each(|(pixel, d)| picture[pixel] += self.value(d));
    }

    /// Sums over the square of h = dL/dx times value: h (1, du, dv) and h (du^2, du dv, dv^2).
    pub fn moments(&self, setup: &GaussianSetup, gradient: &[f64]) -> [f64; 6] {
        let mut sums = [0.0; 6];
        for (pixel, d) in self.pixels(setup) {
            let h = gradient[pixel] * self.value(d);
            let terms = [1.0, d.x, d.y, d.x * d.x, d.x * d.y, d.y * d.y];
            sums.iter_mut().zip(terms).for_each(|(sum, term)| *sum += h * term);
        }
        sums
    }

    /// Length of the gradient by the centre in the image, in half images, as used by density control.
    pub fn pull(&self, setup: &GaussianSetup, moments: [f64; 6]) -> f64 {
        let by_pixel = self.conic * DVec2::new(moments[1], moments[2]);
        (0.5 * DVec2::new(setup.width.into(), setup.height.into()) * by_pixel).length()
    }
}

/// Gradient by position, the logarithms of density and scales, and the quaternion, from the moments in a view.
pub fn gradient(p: &Params, view: &SplatView, setup: &GaussianSetup, moments: [f64; 6]) -> Params {
    let Some(seen) = project(p, view, setup) else { return [0.0; N_PARAMS] };
    let [h, hu, hv, huu, huv, hvv] = moments;
    let second = DMat2::from_cols(DVec2::new(huu, huv), DVec2::new(huv, hvv));
    let variance = (seen.conic * second * seen.conic - seen.conic * h) * 0.5;
    let (c, s) = (variance.x_axis, variance.y_axis);
    let d_alpha = 2.0 * (c.x * seen.alpha + c.y * seen.beta);
    let d_beta = 2.0 * (s.x * seen.alpha + s.y * seen.beta);
    let (axes, scale) = (axes(p), scale(p, setup));
    let d_slopes = [axes * (scale * d_alpha), axes * (scale * d_beta)];
    let z = seen.depth;
    let d_held = -DVec2::new(view.rows[0].dot(d_slopes[0]), view.rows[0].dot(d_slopes[1])) / z
        + DVec2::new(seen.ray.dot(view.direction[1]), seen.ray.dot(view.direction[2])) * h / seen.ray.length_squared();
    let d_mean = seen.conic * DVec2::new(hu, hv) + seen.follows * d_held;
    let d_depth = -(seen.slopes[0].dot(d_slopes[0]) + seen.slopes[1].dot(d_slopes[1]) + 2.0 * h) / z;
    let by_position = |k: usize, mean: f64| (view.rows[k] - mean * view.rows[0]) / z;
    let d_position =
        d_mean.x * by_position(1, seen.mean.x) + d_mean.y * by_position(2, seen.mean.y) + d_depth * view.rows[0];
    let d_scale = seen.alpha * d_alpha + seen.beta * d_beta + h;
    let column = |k: usize| scale[k] * (d_alpha[k] * seen.slopes[0] + d_beta[k] * seen.slopes[1]);
    let d_rotation = rotation_gradient(p, DMat3::from_cols(column(0), column(1), column(2)));
    together(d_position, h, d_scale, d_rotation)
}

fn together(position: DVec3, density: f64, scale: DVec3, rotation: [f64; 4]) -> Params {
    let mut out = [0.0; N_PARAMS];
    let all = position.to_array().into_iter().chain([density]).chain(scale.to_array()).chain(rotation);
    out.iter_mut().zip(all).for_each(|(slot, value)| *slot = value);
    out
}

/// A box of voxels.
#[derive(Debug, Clone, Copy)]
pub struct VoxelBox<'a> {
    /// Centre of the first voxel.
    pub corner: DVec3,
    /// Voxel size, voxels along the box, and the weight of the total variation.
    pub r2: &'a R2Setup,
    /// Setup with the bounds of scales.
    pub setup: &'a GaussianSetup,
}

impl VoxelBox<'_> {
    /// Voxels of the box.
    pub fn len(&self) -> usize {
        (self.r2.box_side as usize).pow(3)
    }

    /// Tells whether the box has no voxels.
    pub fn is_empty(&self) -> bool {
        self.r2.box_side == 0
    }

    /// Index of each voxel near a Gaussian, and the voxel's offset from the centre in standard deviations along the axes.
    fn near(&self, p: &Params) -> Vec<(usize, DVec3)> {
        let (side, voxel) = (i64::from(self.r2.box_side), f64::from(self.r2.voxel));
        let (scale, to_axes) = (scale(p, self.setup), axes(p).transpose());
        let reach = VOXEL_CUT * scale.max_element();
        let first = ((position(p) - reach - self.corner) / voxel).ceil();
        let last = ((position(p) + reach - self.corner) / voxel).floor();
        let along = |k: usize| first[k].max(0.0) as i64..(last[k].max(-1.0) as i64 + 1).min(side);
        let mut near = Vec::new();
        for (z, y) in along(2).flat_map(|z| along(1).map(move |y| (z, y))) {
            for x in along(0) {
                let at = self.corner + voxel * DVec3::new(x as f64, y as f64, z as f64);
                near.push((((z * side + y) * side + x) as usize, to_axes * (at - position(p)) / scale));
            }
        }
        near
    }

    /// Adds a Gaussian to the voxels.
    pub fn splat(&self, p: &Params, voxels: &mut [f64]) {
        self.near(p).into_iter().for_each(|(at, c)| voxels[at] += softplus(p[3]) * (-0.5 * c.length_squared()).exp());
    }

    /// Weighted total variation, and its gradient by each voxel.
    pub fn variation(&self, voxels: &[f64]) -> (f64, Vec<f64>) {
        let side = self.r2.box_side as usize;
        let weight = f64::from(self.r2.tv_weight) / (3 * (side - 1) * side * side) as f64;
        let (mut sum, mut gradient) = (0.0, vec![0.0; voxels.len()]);
        for (axis, stride) in [1, side, side * side].into_iter().enumerate() {
            for at in (0..voxels.len()).filter(|at| at / side.pow(axis as u32) % side + 1 < side) {
                let step = voxels[at + stride] - voxels[at];
                sum += weight * step.abs();
                if step != 0.0 {
                    gradient[at + stride] += weight * step.signum();
                    gradient[at] -= weight * step.signum();
                }
            }
        }
        (sum, gradient)
    }

    /// Sums over the voxels near a Gaussian of h = dL/d(attenuation) times value: h, h c, and h c c^T as xx, yy, zz,
    /// xy, xz, yz.
    pub fn moments(&self, p: &Params, gradient: &[f64]) -> [f64; 10] {
        let mut sums = [0.0; 10];
        for (at, c) in self.near(p) {
            let h = gradient[at] * softplus(p[3]) * (-0.5 * c.length_squared()).exp();
            let terms = [1.0, c.x, c.y, c.z, c.x * c.x, c.y * c.y, c.z * c.z, c.x * c.y, c.x * c.z, c.y * c.z];
            sums.iter_mut().zip(terms).for_each(|(sum, term)| *sum += h * term);
        }
        sums
    }

    /// Gradient by position, the logarithms of density and scales, and the quaternion, from these moments. Centres do not
    /// move unless the setup says otherwise.
    pub fn gradient(&self, p: &Params, moments: [f64; 10]) -> Params {
        let mut sum = along_axes_gradient(p, self.setup, moments);
        if self.r2.tv_moves_centres == 0 {
            sum[..3].fill(0.0);
        }
        sum
    }
}

/// Gradient by position, the logarithms of density and scales, and the quaternion, from sums of h, of h times an offset
/// along the axes, and of h times products of these offsets.
fn along_axes_gradient(p: &Params, setup: &GaussianSetup, [h, x, y, z, xx, yy, zz, xy, xz, yz]: [f64; 10]) -> Params {
    let (axes, scale) = (axes(p), scale(p, setup));
    let d_position = axes * (DVec3::new(x, y, z) / scale);
    let second = [DVec3::new(xx, xy, xz), DVec3::new(xy, yy, yz), DVec3::new(xz, yz, zz)];
    let column = |k: usize| -(axes * (scale * second[k])) / scale[k];
    let d_rotation = rotation_gradient(p, DMat3::from_cols(column(0), column(1), column(2)));
    together(d_position, h, DVec3::new(xx, yy, zz), d_rotation)
}

/// Projection of a Gaussian into a view, by either kind of line integral.
#[derive(Debug, Clone)]
pub enum ViewProjection {
    /// Affine projection.
    Affine(Projection),
    /// Exact integrals along the pixels' own rays.
    Exact(Chords),
}

impl ViewProjection {
    /// Projects a Gaussian into a view; `None` behind the source.
    pub fn of(p: &Params, view: &SplatView, setup: &GaussianSetup, r2: &R2Setup) -> Option<ViewProjection> {
        match r2.exact {
            0 => project(p, view, setup).map(ViewProjection::Affine),
            _ => Chords::of(p, view, setup).map(ViewProjection::Exact),
        }
    }

    /// Index and offset from the centre of every pixel of its box.
    pub fn pixels(&self, setup: &GaussianSetup) -> Box<dyn Iterator<Item = (usize, DVec2)>> {
        match self {
            ViewProjection::Affine(seen) => Box::new(seen.pixels(setup)),
            ViewProjection::Exact(seen) => Box::new(seen.pixels(setup)),
        }
    }

    /// Adds the Gaussian to a picture.
    pub fn splat(&self, setup: &GaussianSetup, picture: &mut [f64]) {
        match self {
            ViewProjection::Affine(seen) => seen.splat(setup, picture),
            ViewProjection::Exact(seen) => seen.splat(setup, picture),
        }
    }

    /// [`Projection::moments`] and four zeros, or [`Chords::moments`].
    pub fn moments(&self, setup: &GaussianSetup, gradient: &[f64]) -> [f64; 10] {
        match self {
            ViewProjection::Affine(seen) => {
                let [h, u, v, uu, uv, vv] = seen.moments(setup, gradient);
                [h, u, v, uu, uv, vv, 0.0, 0.0, 0.0, 0.0]
            }
            ViewProjection::Exact(seen) => seen.moments(setup, gradient),
        }
    }

    /// Gradient by position, the logarithms of density and scales, and the quaternion, from these moments.
    pub fn gradient(&self, p: &Params, view: &SplatView, setup: &GaussianSetup, moments: [f64; 10]) -> Params {
        match self {
            ViewProjection::Affine(_) => gradient(p, view, setup, plane(moments)),
            ViewProjection::Exact(_) => along_axes_gradient(p, setup, moments),
        }
    }

    /// Length of the gradient by the centre in the image, in half images.
    pub fn pull(&self, setup: &GaussianSetup, moments: [f64; 10]) -> f64 {
        match self {
            ViewProjection::Affine(seen) => seen.pull(setup, plane(moments)),
            ViewProjection::Exact(seen) => seen.pull(setup, moments),
        }
    }
}

/// Moments of an affine projection.
fn plane([h, u, v, uu, uv, vv, ..]: [f64; 10]) -> [f64; 6] {
    [h, u, v, uu, uv, vv]
}

/// Applies one Adam update by a row of the schedule to a Gaussian and its moments.
pub fn adam(setup: &GaussianSetup, row: &R2Schedule, g: &Params, p: &mut Params, moments: &mut [[f64; 2]; N_PARAMS]) {
    if row.updates == 0 {
        return;
    }
    let adam = Adam::new([setup.beta1, setup.beta2], setup.epsilon, [row.bias1, row.bias2]);
    for k in 0..N_PARAMS {
        let rate = match k {
            0..3 => row.position_rate,
            3 => row.density_rate,
            4..7 => row.scale_rate,
            _ => row.rotation_rate,
        };
        adam.update(f64::from(rate), g[k], &mut p[k], &mut moments[k]);
    }
}
