//! f64 reference implementations (twins) of the stages of X-Gaussian, as plain loops without the device.

use crate::gaussians::view::SplatView;
use crate::kernels::layout::{BlendGaussian, BlendSetup, GaussianSetup, Splat, XSchedule};
use crate::reference::adam::Adam;
use crate::reference::gaussians;
use glam::{DMat2, DMat3, DVec2, DVec3};

/// Number of parameters of a Gaussian: position, opacity before the sigmoid, logarithms of scales, intensity, quaternion.
pub const N_PARAMS: usize = 12;
/// Parameters of a Gaussian.
pub type Params = [f64; N_PARAMS];
/// Sums of a Gaussian over pixels: h, h (du, dv), h (du^2, du dv, dv^2), and the gradient by its intensity.
pub type Sums = [f64; 7];

/// Distance from the image's centre at which slopes stop following the Gaussian's centre, in half images.
const SLOPES_END: f64 = 1.3;
/// Minimum squared difference of variances in the computation of a radius, pixels^4.
const MIN_SPREAD: f64 = 0.1;
/// Variance added to each splat, pixels^2.
const LOW_PASS: f64 = 0.3;
/// Extent of a splat in standard deviations along its longest axis.
const REACH: f64 = 3.0;
const TILE: usize = 16;
const MAX_OPAQUE: f64 = 0.99;
const MIN_ALPHA: f64 = 1.0 / 255.0;
const MIN_LIGHT: f64 = 1e-4;

/// Returns the stored parameters of a Gaussian.
pub fn params(g: &BlendGaussian) -> Params {
    let mut out = [0.0; N_PARAMS];
    let all = g.position.iter().chain([&g.opacity]).chain(&g.log_scale).chain([&g.intensity]).chain(&g.rotation);
    out.iter_mut().zip(all).for_each(|(p, v)| *p = f64::from(*v));
    out
}

/// Returns the parameters that other Gaussians share, in their order: position, scale and quaternion.
fn shape(p: &Params) -> gaussians::Params {
    [p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[8], p[9], p[10], p[11]]
}

fn scale(p: &Params) -> DVec3 {
    DVec3::new(p[4], p[5], p[6]).exp()
}

fn sigmoid(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

/// Values of a Gaussian that a pixel needs.
#[derive(Debug, Clone, Copy)]
pub struct Blot {
    /// Column and row of the centre.
    pub mean: DVec2,
    /// Inverse variance in the image.
    pub conic: DMat2,
    /// Opacity at the centre.
    pub opacity: f64,
    /// Intensity that it contributes.
    pub intensity: f64,
}

impl Blot {
    /// Creates the values from the device's splat.
    pub fn of(splat: &Splat, intensity: f32) -> Blot {
        let [a, b, c] = splat.conic.map(f64::from);
        Blot {
            mean: DVec2::from_array(splat.mean.map(f64::from)),
            conic: DMat2::from_cols(DVec2::new(a, b), DVec2::new(b, c)),
            opacity: splat.amplitude.into(),
            intensity: f64::from(intensity).max(0.0),
        }
    }

    /// Opacity at a pixel, and whether it depends on the parameters; `None` where it is too faint.
    fn alpha(&self, d: DVec2) -> Option<(f64, bool)> {
        let alpha = self.opacity * (-0.5 * d.dot(self.conic * d)).exp();
        let follows = alpha <= MAX_OPAQUE;
        (alpha >= MIN_ALPHA).then_some((alpha.min(MAX_OPAQUE), follows))
    }
}

/// Projection of a Gaussian into an image, with the intermediate values of its gradient.
#[derive(Debug, Clone)]
pub struct Projection {
    /// Values that pixels need.
    pub blot: Blot,
    /// Half side of the square of pixels it is limited to.
    pub radius: f64,
    /// Depth along the view's axis.
    pub depth: f64,
    follows: DVec2,
    slopes: [DVec3; 2],
    alpha: DVec3,
    beta: DVec3,
}

/// Projects a Gaussian into a view; `None` at the source and behind it.
pub fn project(p: &Params, view: &SplatView, setup: &GaussianSetup, x: &BlendSetup) -> Option<Projection> {
    let (depth, column, row) = view.project(DVec3::new(p[0], p[1], p[2]));
    if depth <= f64::from(x.nearest) {
        return None;
    }
    let mean = DVec2::new(column, row);
    let size = DVec2::new(setup.width.into(), setup.height.into());
    let (middle, reach) = (0.5 * (size - 1.0), 0.5 * SLOPES_END * size);
    let held = mean.clamp(middle - reach, middle + reach);
    let follows = DVec2::new(f64::from(u8::from(held.x == mean.x)), f64::from(u8::from(held.y == mean.y)));
    let slopes = [(1, held.x), (2, held.y)].map(|(k, held)| (view.rows[k] - held * view.rows[0]) / depth);
    let axes = gaussians::axes(&shape(p));
    let [alpha, beta] = slopes.map(|slope| scale(p) * (axes.transpose() * slope));
    let (uu, uv, vv) = (alpha.dot(alpha) + LOW_PASS, alpha.dot(beta), beta.dot(beta) + LOW_PASS);
    let det = uu * vv - uv * uv;
    let half_sum = 0.5 * (uu + vv);
    let largest = half_sum + (half_sum * half_sum - det).max(MIN_SPREAD).sqrt();
    let conic = DMat2::from_cols(DVec2::new(vv, -uv), DVec2::new(-uv, uu)) * (1.0 / det);
    Some(Projection {
        blot: Blot { mean, conic, opacity: sigmoid(p[3]), intensity: p[7].max(0.0) },
        radius: (REACH * largest.sqrt()).ceil(),
        depth,
        follows,
        slopes,
        alpha,
        beta,
    })
}

/// First tile (column, row) of a splat's square, and one after the last.
pub fn tiles_of(mean: DVec2, radius: f64, x: &BlendSetup) -> [u32; 4] {
    let along = |v: f64, n: u32| (v / TILE as f64).trunc().clamp(0.0, n.into()) as u32;
    let last = TILE as f64 - 1.0;
    let all = [
        along(mean.x - radius, x.tile_columns),
        along(mean.y - radius, x.tile_rows),
        along(mean.x + radius + last, x.tile_columns),
        along(mean.y + radius + last, x.tile_rows),
    ];
    if all[2] > all[0] && all[3] > all[1] { all } else { [0; 4] }
}

/// Pixels of a tile inside the image: index in the image, column and row.
fn pixels_of(tile: usize, setup: &GaussianSetup, x: &BlendSetup) -> Vec<(usize, DVec2)> {
    let (width, height) = (setup.width as usize, setup.height as usize);
    let corner = [tile % x.tile_columns as usize * TILE, tile / x.tile_columns as usize * TILE];
    let rows = corner[1]..(corner[1] + TILE).min(height);
    let columns = corner[0]..(corner[0] + TILE).min(width);
    rows.flat_map(|y| columns.clone().map(move |x| (y * width + x, DVec2::new(x as f64, y as f64)))).collect()
}

/// Value of a pixel from Gaussians, the nearest first, the remaining transmittance, and one more than the index of the last
/// visible Gaussian.
fn shown(list: &[Blot], at: DVec2) -> (f64, f64, usize) {
    let (mut sum, mut light, mut last) = (0.0, 1.0, 0);
    for (place, blot) in list.iter().enumerate() {
        let Some((alpha, _)) = blot.alpha(at - blot.mean) else { continue };
        let left = light * (1.0 - alpha);
        if left < MIN_LIGHT {
            break;
        }
        sum += blot.intensity * alpha * light;
        (light, last) = (left, place + 1);
    }
    (sum, light, last)
}

/// Blends an image from lists of Gaussians, one per tile, and returns the transmittance of each pixel as well.
pub fn blend(lists: &[Vec<Blot>], setup: &GaussianSetup, x: &BlendSetup) -> (Vec<f64>, Vec<f64>) {
    let n = (setup.width * setup.height) as usize;
    let (mut picture, mut left) = (vec![0.0; n], vec![1.0; n]);
    for (tile, list) in lists.iter().enumerate() {
        for (pixel, at) in pixels_of(tile, setup, x) {
            (picture[pixel], left[pixel], _) = shown(list, at);
        }
    }
    (picture, left)
}

/// Sums of each Gaussian of a tile's list over the tile's pixels, with gradients given for the whole image. They are
/// computed front to back: the contribution behind a Gaussian is the pixel's value minus that of the Gaussians up to it.
pub fn blend_back(tile: usize, list: &[Blot], setup: &GaussianSetup, x: &BlendSetup, gradient: &[f64]) -> Vec<Sums> {
    let mut sums = vec![[0.0; 7]; list.len()];
    for (pixel, at) in pixels_of(tile, setup, x) {
        let g = f64::from(x.absolute_weight) * gradient[pixel];
        let (all, _, last) = shown(list, at);
        let (mut so_far, mut light) = (0.0, 1.0);
        for (blot, sums) in list[..last].iter().zip(&mut sums) {
            let d = at - blot.mean;
            let Some((alpha, follows)) = blot.alpha(d) else { continue };
            so_far += blot.intensity * alpha * light;
            let behind = (all - so_far) / (light * (1.0 - alpha));
            sums[6] += g * light * alpha;
            if follows {
                let h = g * light * (blot.intensity - behind) * alpha;
                let terms = [1.0, d.x, d.y, d.x * d.x, d.x * d.y, d.y * d.y];
                sums.iter_mut().zip(terms).for_each(|(sum, term)| *sum += h * term);
            }
            light *= 1.0 - alpha;
        }
    }
    sums
}

/// Length of the gradient by the centre in the image, in half images, as used by density control.
pub fn pull(seen: &Projection, setup: &GaussianSetup, sums: &Sums) -> f64 {
    let by_pixel = seen.blot.conic * DVec2::new(sums[1], sums[2]);
    (0.5 * DVec2::new(setup.width.into(), setup.height.into()) * by_pixel).length()
}

/// Gradient of the stored parameters from the sums over all tiles.
pub fn gradient(p: &Params, seen: &Projection, view: &SplatView, sums: &Sums) -> Params {
    let [h, hu, hv, huu, huv, hvv, by_intensity] = *sums;
    let conic = seen.blot.conic;
    let second = DMat2::from_cols(DVec2::new(huu, huv), DVec2::new(huv, hvv));
    let variance = conic * second * conic * 0.5;
    let (c, s) = (variance.x_axis, variance.y_axis);
    let d_alpha = 2.0 * (c.x * seen.alpha + c.y * seen.beta);
    let d_beta = 2.0 * (s.x * seen.alpha + s.y * seen.beta);
    let (axes, scale, z) = (gaussians::axes(&shape(p)), scale(p), seen.depth);
    let d_slopes = [axes * (scale * d_alpha), axes * (scale * d_beta)];
    let d_held = -DVec2::new(view.rows[0].dot(d_slopes[0]), view.rows[0].dot(d_slopes[1])) / z;
    let d_mean = conic * DVec2::new(hu, hv) + seen.follows * d_held;
    let d_depth = -(seen.slopes[0].dot(d_slopes[0]) + seen.slopes[1].dot(d_slopes[1])) / z;
    let by_position = |k: usize, mean: f64| (view.rows[k] - mean * view.rows[0]) / z;
    let mean = seen.blot.mean;
    let position = d_mean.x * by_position(1, mean.x) + d_mean.y * by_position(2, mean.y) + d_depth * view.rows[0];
    let d_scale = seen.alpha * d_alpha + seen.beta * d_beta;
    let column = |k: usize| scale[k] * (d_alpha[k] * seen.slopes[0] + d_beta[k] * seen.slopes[1]);
    let rotation = gaussians::rotation_gradient(&shape(p), DMat3::from_cols(column(0), column(1), column(2)));
    let opacity = h * (1.0 - seen.blot.opacity);
    let intensity = if p[7] > 0.0 { by_intensity } else { 0.0 };
    let mut out = [0.0; N_PARAMS];
    let place = position.to_array().into_iter().chain([opacity]);
    let all = place.chain(d_scale.to_array()).chain([intensity]).chain(rotation);
    out.iter_mut().zip(all).for_each(|(slot, value)| *slot = value);
    out
}

/// Lists of Gaussians of one image, one per tile, as indices, nearest first.
pub fn tile_lists(seen: &[Option<Projection>], x: &BlendSetup) -> Vec<Vec<usize>> {
    let mut order: Vec<(usize, &Projection)> =
        seen.iter().enumerate().filter_map(|(i, seen)| Some((i, seen.as_ref()?))).collect();
    order.sort_by(|a, b| a.1.depth.total_cmp(&b.1.depth));
    let mut lists = vec![Vec::new(); (x.tile_columns * x.tile_rows) as usize];
    for (i, seen) in order {
        let [first_column, first_row, end_column, end_row] = tiles_of(seen.blot.mean, seen.radius, x);
        for row in first_row..end_row {
            (first_column..end_column).for_each(|column| lists[(row * x.tile_columns + column) as usize].push(i));
        }
    }
    lists
}

/// Applies one Adam update by a row of the schedule to a Gaussian and its moments.
pub fn adam(setup: &GaussianSetup, row: &XSchedule, g: &Params, p: &mut Params, moments: &mut [[f64; 2]; N_PARAMS]) {
    if row.updates == 0 {
        return;
    }
    let adam = Adam::new([setup.beta1, setup.beta2], setup.epsilon, [row.bias1, row.bias2]);
    for k in 0..N_PARAMS {
        let rate = match k {
            0..3 => row.position_rate,
            3 => row.opacity_rate,
            4..7 => row.scale_rate,
            7 => row.intensity_rate,
            _ => row.rotation_rate,
        };
        adam.update(f64::from(rate), g[k], &mut p[k], &mut moments[k]);
    }
}
