//! f64 reference implementations (twins) of the Gaussians' stages, as plain loops without the device, and the exact
//! cone-beam integral, which the affine one of the stages approximates.

use crate::gaussians::view::SplatView;
use crate::kernels::layout::{Gaussian, GaussianSchedule, GaussianSetup};
use crate::reference::adam::Adam;
use glam::{DMat2, DMat3, DVec2, DVec3};

/// Parameters of a Gaussian: position (3), log-density, log-scale (3), quaternion (4).
pub const N_PARAMS: usize = 11;

/// [`Gaussian`] in f64, in the order of [`N_PARAMS`].
pub type Params = [f64; N_PARAMS];

/// Returns the parameters of a Gaussian as numbers.
pub fn params(g: &Gaussian) -> Params {
    let mut out = [0.0; N_PARAMS];
    let all = g.position.iter().chain([&g.log_density]).chain(&g.log_scale).chain(&g.rotation);
    out.iter_mut().zip(all).for_each(|(p, v)| *p = f64::from(*v));
    out
}

fn position(p: &Params) -> DVec3 {
    DVec3::new(p[0], p[1], p[2])
}

/// Standard deviations along the axes.
fn scale(p: &Params, setup: &GaussianSetup) -> DVec3 {
    let bounds = (f64::from(setup.min_scale), f64::from(setup.max_scale));
    DVec3::new(p[4], p[5], p[6]).exp().clamp(DVec3::splat(bounds.0), DVec3::splat(bounds.1))
}

/// Axes as columns.
pub(crate) fn axes(p: &Params) -> DMat3 {
    let norm = (p[7] * p[7] + p[8] * p[8] + p[9] * p[9] + p[10] * p[10]).sqrt();
    let [w, x, y, z] = [7, 8, 9, 10].map(|k| p[k] / norm);
    DMat3::from_cols(
        DVec3::new(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
        DVec3::new(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
        DVec3::new(2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
}

/// Attenuation at a point.
pub fn density(p: &Params, setup: &GaussianSetup, x: DVec3) -> f64 {
    let c = (axes(p).transpose() * (x - position(p))) / scale(p, setup);
    (p[3] - 0.5 * c.length_squared()).exp()
}

/// Profile along a ray: attenuation is exp(log_density - (constant + 2 linear t + square t^2) / 2).
#[derive(Debug, Clone, Copy)]
pub struct AlongRay {
    /// Log of the attenuation at the centre.
    pub log_density: f64,
    /// Coefficient of t^0.
    pub constant: f64,
    /// Half the coefficient of t^1.
    pub linear: f64,
    /// Coefficient of t^2.
    pub square: f64,
}

impl AlongRay {
    /// Creates the profile; `t` is measured from the depth of the Gaussian's centre, in units of `ray`.
    pub fn new(p: &Params, setup: &GaussianSetup, view: &SplatView, ray: DVec3) -> AlongRay {
        let to_axes = axes(p).transpose();
        let depth = view.project(position(p)).0;
        // The origin is the ray's point at the centre's depth, so no large numbers are subtracted that f64 could not
        // handle.
        let a = to_axes * (view.source + ray * depth - position(p)) / scale(p, setup);
        let b = to_axes * ray / scale(p, setup);
        AlongRay { log_density: p[3], constant: a.length_squared(), linear: a.dot(b), square: b.length_squared() }
    }

    /// Attenuation at `t`.
    pub fn at(&self, t: f64) -> f64 {
        (self.log_density - 0.5 * (self.constant + t * (2.0 * self.linear + self.square * t))).exp()
    }

    /// Position of the Gaussian's maximum along the ray, and its standard deviation along the ray.
    pub fn peak(&self) -> (f64, f64) {
        (-self.linear / self.square, 1.0 / self.square.sqrt())
    }
}

/// Exact line integral along the ray of a pixel.
pub fn exact_integral(p: &Params, setup: &GaussianSetup, view: &SplatView, column: f64, row: f64) -> f64 {
    let ray = view.ray(column, row);
    let along = AlongRay::new(p, setup, view, ray);
    let (at, deviation) = along.peak();
    along.at(at) * std::f64::consts::TAU.sqrt() * deviation * ray.length()
}

/// Projection of a Gaussian into an image, with the intermediate values of its gradient.
#[derive(Debug, Clone)]
pub struct Projection {
    /// Column and row of the centre.
    pub mean: DVec2,
    /// Inverse variance in the image.
    pub conic: DMat2,
    /// Line integral at the centre.
    pub amplitude: f64,
    /// Half sides of the box of pixels it is limited to.
    pub half_box: DVec2,
    depth: f64,
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
    let slopes = [(1, column), (2, row)].map(|(k, mean)| (view.rows[k] - mean * view.rows[0]) / depth);
    let (axes, scale) = (axes(p), scale(p, setup));
    let [alpha, beta] = slopes.map(|slope| scale * (axes.transpose() * slope));
    let (uu, uv, vv) = (alpha.dot(alpha), alpha.dot(beta), beta.dot(beta));
    let det = alpha.cross(beta).length_squared();
    let ray = view.ray(column, row);
    let volume = scale.x * scale.y * scale.z;
    let amplitude = p[3].exp() * std::f64::consts::TAU.sqrt() * volume * ray.length() * view.inverse_det()
        / (depth * depth * det.sqrt());
    Some(Projection {
        mean: DVec2::new(column, row),
        conic: DMat2::from_cols(DVec2::new(vv, -uv), DVec2::new(-uv, uu)) * (1.0 / det),
        amplitude,
        half_box: f64::from(setup.cut) * DVec2::new(uu.sqrt(), vv.sqrt()),
        depth,
        ray,
        slopes,
        alpha,
        beta,
    })
}

impl Projection {
    /// Index and offset from the centre of every pixel of the box.
    pub fn pixels(&self, setup: &GaussianSetup) -> impl Iterator<Item = (usize, DVec2)> + use<> {
        let (width, mean) = (setup.width as usize, self.mean);
        let size = DVec2::new(f64::from(setup.width), f64::from(setup.height));
        let first = (mean - self.half_box).ceil().max(DVec2::ZERO);
        let last = (mean + self.half_box).floor().min(size - 1.0);
        let range = |first: f64, last: f64| first as i64..=if last < first { first as i64 - 1 } else { last as i64 };
        let columns = range(first.x, last.x);
        range(first.y, last.y).flat_map(move |y| {
            columns.clone().map(move |x| (y as usize * width + x as usize, DVec2::new(x as f64, y as f64) - mean))
        })
    }

    fn value(&self, d: DVec2) -> f64 {
        self.amplitude * (-0.5 * d.dot(self.conic * d)).exp()
    }

    /// Adds the Gaussian to an image.
    pub fn splat(&self, setup: &GaussianSetup, image: &mut [f64]) {
        for (pixel, d) in self.pixels(setup) {
            image[pixel] += self.value(d);
        }
    }

    /// Sums over the box of h = dL/dD times value: h (1, du, dv) and h (du^2, du dv, dv^2).
    pub fn moments(&self, setup: &GaussianSetup, gradient: &[f64]) -> [f64; 6] {
        let mut sums = [0.0; 6];
        for (pixel, d) in self.pixels(setup) {
            let h = gradient[pixel] * self.value(d);
            let terms = [1.0, d.x, d.y, d.x * d.x, d.x * d.y, d.y * d.y];
            sums.iter_mut().zip(terms).for_each(|(sum, term)| *sum += h * term);
        }
        sums
    }
}

/// Gradient of the parameters from the moments in one view.
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
    let mut d_mean = seen.conic * DVec2::new(hu, hv);
    let z = seen.depth;
    d_mean -= DVec2::new(view.rows[0].dot(d_slopes[0]), view.rows[0].dot(d_slopes[1])) / z;
    let mut d_depth = -(seen.slopes[0].dot(d_slopes[0]) + seen.slopes[1].dot(d_slopes[1])) / z;
    d_mean +=
        DVec2::new(seen.ray.dot(view.direction[1]), seen.ray.dot(view.direction[2])) * h / seen.ray.length_squared();
    d_depth -= 2.0 * h / z;
    let d_position = d_mean.x * seen.slopes[0] + d_mean.y * seen.slopes[1] + d_depth * view.rows[0];
    let free = DVec3::new(p[4], p[5], p[6]).exp();
    let inside = |k: usize| free[k] > f64::from(setup.min_scale) && free[k] < f64::from(setup.max_scale);
    let d_scale = |k: usize| if inside(k) { seen.alpha[k] * d_alpha[k] + seen.beta[k] * d_beta[k] + h } else { 0.0 };
    let column = |k: usize| scale[k] * (d_alpha[k] * seen.slopes[0] + d_beta[k] * seen.slopes[1]);
    let d_rotation = rotation_gradient(p, DMat3::from_cols(column(0), column(1), column(2)));
    let [x, y, z] = d_position.to_array();
    let [a, b, c, d] = d_rotation;
    [x, y, z, h, d_scale(0), d_scale(1), d_scale(2), a, b, c, d]
}

/// Gradient of the raw quaternion from that of the axes.
pub(crate) fn rotation_gradient(p: &Params, d: DMat3) -> [f64; 4] {
    let raw = [p[7], p[8], p[9], p[10]];
    let norm = raw.iter().map(|v| v * v).sum::<f64>().sqrt();
    let [w, x, y, z] = raw.map(|v| v / norm);
    let at = |row: usize, column: usize| d.col(column)[row];
    let skew = [at(2, 1) - at(1, 2), at(0, 2) - at(2, 0), at(1, 0) - at(0, 1)];
    let g = [
        x * skew[0] + y * skew[1] + z * skew[2],
        w * skew[0] - 2.0 * x * (at(1, 1) + at(2, 2)) + y * (at(0, 1) + at(1, 0)) + z * (at(0, 2) + at(2, 0)),
        w * skew[1] + x * (at(0, 1) + at(1, 0)) - 2.0 * y * (at(0, 0) + at(2, 2)) + z * (at(1, 2) + at(2, 1)),
        w * skew[2] + x * (at(0, 2) + at(2, 0)) + y * (at(1, 2) + at(2, 1)) - 2.0 * z * (at(0, 0) + at(1, 1)),
    ]
    .map(|v| 2.0 * v);
    let along = g[0] * w + g[1] * x + g[2] * y + g[3] * z;
    [(g[0], w), (g[1], x), (g[2], y), (g[3], z)].map(|(g, q)| (g - q * along) / norm)
}

/// Loss of an image, and its gradient: zero between the bounds of each pixel, Charbonnier loss outside.
pub fn residual(setup: &GaussianSetup, image: &[f64], low: &[f32], high: &[f32], weight: &[f32]) -> (f64, Vec<f64>) {
    let (bend, scale) = (f64::from(setup.bend), f64::from(setup.loss_weight));
    let mut loss = 0.0;
    let gradient = (0..image.len())
        .map(|p| {
            let [low, high, w] = [low[p], high[p], weight[p]].map(f64::from);
            let r = w * (image[p] - image[p].clamp(low, high));
            let root = (r * r + bend * bend).sqrt();
            loss += scale * (root - bend);
            scale * w * r / root
        })
        .collect();
    (loss, gradient)
}

/// Applies one Adam update by a row of the schedule to a Gaussian and its moments.
pub fn adam(
    setup: &GaussianSetup,
    row: &GaussianSchedule,
    g: &Params,
    p: &mut Params,
    moments: &mut [[f64; 2]; N_PARAMS],
) {
    let adam = Adam::new([setup.beta1, setup.beta2], setup.epsilon, [row.bias1, row.bias2]);
    for k in 0..N_PARAMS {
        let rate = match k {
            0..3 => setup.position_rate,
            3 => setup.density_rate,
            4..7 => setup.scale_rate,
            _ => setup.rotation_rate,
        };
        adam.update(f64::from(row.rate) * f64::from(rate), g[k], &mut p[k], &mut moments[k]);
    }
}
