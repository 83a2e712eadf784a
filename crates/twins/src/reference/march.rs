//! f64 reference implementations (twins) of ray drawing, depths and the march.

use crate::fields::data::FieldData;
use crate::kernels::layout::Setup;
use crate::model::params::ParamMap;
use crate::random::{STREAM_DEPTH, STREAM_MOTION_RAY, STREAM_RAY, permute, uniform01};
use crate::reference::field::{self, NetworkTrace, Precision, ShownPhases};
use glam::DVec3;

/// One ray; see `Ray` in the shaders.
#[derive(Debug, Clone)]
pub struct Ray {
    /// Point at the isocentre plane.
    pub anchor: DVec3,
    /// Direction of unit depth.
    pub direction: DVec3,
    /// Phases that it shows.
    pub shown: ShownPhases,
    /// Measured line integral.
    pub target: f64,
    /// Bounds of the integral above the pixel's static background.
    pub temporal: [f64; 2],
    /// frame * pixels + pixel.
    pub id: u32,
    /// Change of its pixel over the beat; 0 except for two networks.
    pub change: f64,
}

/// Draws the rays of iteration `step` (twin of `batch`).
pub fn batch(plan: &FieldData, step: u32) -> Vec<Ray> {
    let s = &plan.setup;
    let draw = |slot: u32, per_step: u32, n: u32, stream: u32| {
        let counter = step * per_step + slot;
        permute(counter % n, n, s.seed, counter / n, stream)
    };
    (0..s.n_rays)
        .map(|r| {
            let id = if r < s.n_motion_rays {
                plan.listed_rays[draw(r, s.n_motion_rays, s.n_motion_list, STREAM_MOTION_RAY) as usize]
            } else {
                let drawn = |n: u32| draw(r - s.n_motion_rays, s.n_rays - s.n_motion_rays, n, STREAM_RAY);
                match s.n_shown_list {
                    0 => drawn(s.n_all_rays),
                    n => plan.listed_rays[(s.n_motion_list + drawn(n)) as usize],
                }
            };
            ray(plan, id)
        })
        .collect()
}

/// Returns a training ray by its id.
pub fn ray(plan: &FieldData, id: u32) -> Ray {
    let s = &plan.setup;
    let index = (id / s.n_pixels) as usize;
    let frame = plan.frames[index];
    let view = plan.views[frame.view as usize];
    let pixel = id % s.n_pixels;
    let (i, j) = (f64::from(pixel % s.image_width), f64::from(pixel / s.image_width));
    let target = f64::from(plan.images[index][pixel as usize]);
    let beyond_share = f64::from(frame.beyond_share);
    let [low, high] = plan.backgrounds[(frame.background_offset + pixel) as usize];
    let v = |a: [f32; 4]| DVec3::new(a[0].into(), a[1].into(), a[2].into());
    Ray {
        anchor: v(view.anchor00) + i * v(view.anchor_du) + j * v(view.anchor_dv),
        direction: v(view.direction00) + i * v(view.direction_du) + j * v(view.direction_dv),
        shown: [(frame.phase as usize, 1.0 - beyond_share), (frame.beyond as usize, beyond_share)],
        target,
        temporal: [high, low].map(|background| target - f64::from(background)),
        id,
        change: plan.pixel_changes.get((frame.background_offset + pixel) as usize).copied().unwrap_or(0.0).into(),
    }
}

/// Depths of a ray, and the path lengths they represent.
pub fn depths(s: &Setup, n: u32, near: f32, far: f32, step: u32, ray: &Ray) -> Vec<(f64, f64)> {
    let (near, far) = (f64::from(near), f64::from(far));
    let grid = |k: u32| near + (far - near) * f64::from(k) / f64::from(n - 1);
    let stream = if s.per_ray_depths != 0 { ray.id + 1 } else { 0 };
    let at: Vec<f64> = (0..n)
        .map(|k| {
            if s.jitter == 0 {
                return grid(k);
            }
            let lower = if k == 0 { grid(0) } else { 0.5 * (grid(k - 1) + grid(k)) };
            let upper = if k == n - 1 { grid(k) } else { 0.5 * (grid(k) + grid(k + 1)) };
            lower + (upper - lower) * uniform01(s.seed, STREAM_DEPTH.wrapping_add(stream << 4), step, k)
        })
        .collect();
    let norm = if s.along_axis != 0 { 1.0 } else { ray.direction.length() };
    (0..n as usize).map(|k| (at[k], if k + 1 < n as usize { at[k + 1] - at[k] } else { 1e-10 } * norm)).collect()
}

/// Near part of rays, whose samples are subject to occlusion minimisation.
#[derive(Debug, Clone, Copy)]
pub enum NearPart {
    /// Samples at depths below this, world units.
    Depth(f64),
    /// Samples that end below this path length from the first depth, world units.
    Path(f64),
}

impl NearPart {
    /// Returns the near part of the rays of a batch at iteration `step`.
    pub fn of(plan: &FieldData, step: u32, batch: &[Ray]) -> NearPart {
        let s = &plan.setup;
        let share = f64::from(s.occlusion_share);
        match batch.last().filter(|_| share > 0.0) {
            None => NearPart::Depth(s.occlusion_depth.into()),
            Some(last) => {
                let at = depths(s, s.n_dynamic_samples, s.dynamic_near, s.dynamic_far, step, last);
                NearPart::Path(share * at.iter().map(|(_, dl)| dl).sum::<f64>())
            }
        }
    }

    /// Tells which of a ray's samples are near, given their depths and path lengths.
    fn marks(self, samples: &[(f64, f64)]) -> Vec<bool> {
        let mut path = 0.0;
        let mark = |(t, dl): &(f64, f64)| {
            path += dl;
            match self {
                NearPart::Depth(limit) => *t < limit,
                NearPart::Path(limit) => path < limit,
            }
        };
        samples.iter().map(mark).collect()
    }
}

/// Tells whether the dynamic field may exist at a point at a phase, by its box and, if used, the hull.
pub fn dynamic_inside(plan: &FieldData, x: DVec3, phase: usize) -> bool {
    let s = &plan.setup;
    let (low, high) = (field::point(s.dynamic_min), field::point(s.dynamic_max));
    x.cmpge(low).all() && x.cmple(high).all() && plan.hull.as_ref().is_none_or(|h| h.contains_point(x, phase))
}

/// Tells whether the dynamic field is evaluated at a point of a ray (twin of `searched`); `occupied` decides for a phase.
pub fn searched(plan: &FieldData, x: DVec3, ray: &Ray, occupied: impl Fn(usize) -> bool) -> bool {
    let shows = |(phase, share): &(usize, f64)| *share > 0.0 && dynamic_inside(plan, x, *phase) && occupied(*phase);
    ray.shown.iter().any(shows)
}

/// A static sample: position, path length, feature.
pub struct StaticSample {
    /// Position.
    pub x: DVec3,
    /// Path length.
    pub dl: f64,
    /// Feature before the activation.
    pub feature: f64,
}

/// A live dynamic sample.
pub struct DynamicSample {
    /// Position.
    pub x: DVec3,
    /// Path length.
    pub dl: f64,
    /// Whether it is subject to occlusion minimisation.
    pub near: bool,
    /// Network values at the sample.
    pub trace: NetworkTrace,
}

/// Integrals of a ray, with all values for its backward pass.
pub struct March {
    /// Samples in the static box.
    pub statics: Vec<StaticSample>,
    /// Live dynamic samples.
    pub dynamics: Vec<DynamicSample>,
    /// Line integral of the static field.
    pub static_integral: f64,
    /// Line integral of the dynamic field.
    pub dynamic_integral: f64,
    /// Integral over the penalised near part.
    pub occlusion: f64,
}

/// Marches one ray through the static field only, or through no field.
pub fn statics(plan: &FieldData, params: &[f64], step: u32, ray: &Ray, with_static: bool) -> March {
    let (s, p): (&Setup, &ParamMap) = (&plan.setup, &plan.params);
    let mut out = March {
        statics: Vec::new(),
        dynamics: Vec::new(),
        static_integral: 0.0,
        dynamic_integral: 0.0,
        occlusion: 0.0,
    };
    if with_static {
        for (t, dl) in depths(s, s.n_static_samples, s.static_near, s.static_far, step, ray) {
            let x = ray.anchor + t * ray.direction;
            if field::static_inside(s, x) {
                let feature = field::vm_feature(s, p, params, x);
                out.static_integral +=
                    dl * f64::from(s.static_gain) * field::softplus(feature + f64::from(s.static_shift));
                out.statics.push(StaticSample { x, dl, feature });
            }
        }
    }
    out
}

/// Marches one ray (twin of `march_count`..`march_emit`, `march_fwd` and `march_loss`).
pub fn fwd(
    plan: &FieldData,
    params: &[f64],
    step: u32,
    ray: &Ray,
    near_part: NearPart,
    with_static: bool,
    precision: Precision,
) -> March {
    let (s, p): (&Setup, &ParamMap) = (&plan.setup, &plan.params);
    let row = plan.schedule[step as usize];
    let mut out = statics(plan, params, step, ray, with_static);
    let Some(network) = p.dynamic_network.as_ref().filter(|_| row.dynamic_active != 0) else { return out };
    let samples = depths(s, s.n_dynamic_samples, s.dynamic_near, s.dynamic_far, step, ray);
    for ((t, dl), near) in samples.iter().copied().zip(near_part.marks(&samples)) {
        let x = ray.anchor + t * ray.direction;
        if !searched(plan, x, ray, |_| true) {
            continue;
        }
        let trace = field::network_fwd(network, params, &field::encode(s, row.window.into(), x), ray.shown, precision);
        let sigma = f64::from(s.dynamic_gain) * field::softplus(trace.feature + f64::from(s.dynamic_shift));
        out.dynamic_integral += sigma * dl;
        out.occlusion += if near { sigma * dl } else { 0.0 };
        out.dynamics.push(DynamicSample { x, dl, near, trace });
    }
    out
}

/// Adds the gradient of a ray, given dL/dS and dL/dD of its integrals (twin of `march_loss`, `mlp_*_bwd`).
pub fn bwd(
    plan: &FieldData,
    params: &[f64],
    ray: &Ray,
    march: &March,
    [dl_ds, dl_dd]: [f64; 2],
    precision: Precision,
    gradient: &mut [f64],
) {
    let (s, p) = (&plan.setup, &plan.params);
    if dl_ds != 0.0 {
        for sample in &march.statics {
            let slope = f64::from(s.static_gain) * field::sigmoid(sample.feature + f64::from(s.static_shift));
            field::vm_feature_bwd(s, p, params, sample.x, dl_ds * sample.dl * slope, gradient);
        }
    }
    for sample in &march.dynamics {
        sample_bwd(plan, params, ray.shown, sample, dl_dd, precision, gradient);
    }
}

/// Adds the gradient of a live sample, given dL/dD of its ray (twin of `mlp_*_bwd`).
pub fn sample_bwd(
    plan: &FieldData,
    params: &[f64],
    shown: ShownPhases,
    sample: &DynamicSample,
    dl_dd: f64,
    precision: Precision,
    gradient: &mut [f64],
) {
    let Some(network) = &plan.params.dynamic_network else { return };
    let s = &plan.setup;
    let slope = f64::from(s.dynamic_gain) * field::sigmoid(sample.trace.feature + f64::from(s.dynamic_shift));
    let per_integral = dl_dd + if sample.near { f64::from(s.occlusion_weight) } else { 0.0 };
    let slope = if per_integral < 0.0 { slope.max(s.min_slope.into()) } else { slope };
    field::network_bwd(network, params, &sample.trace, shown, per_integral * sample.dl * slope, precision, gradient);
}
