//! f64 reference implementation (twin) of one training iteration: loss, gradient, Adam.

use crate::fields::data::FieldData;
use crate::reference::adam::Adam;
use crate::reference::field::Precision;
use crate::reference::losses::Losses;
use crate::reference::march::{self, NearPart, Ray};
use crate::reference::networks;

/// Tells whether a ray of the batch omits the static field (twin of `skips_static`).
pub fn skips_static(plan: &FieldData, r: usize) -> bool {
    let s = &plan.setup;
    s.temporal_target != 0 && (r as u32) < s.n_motion_rays && s.n_motion_rays < s.n_rays
}

/// Charbonnier's r^2, linear beyond `scale` (0: never), and half its derivative.
fn robust_square(scale: f64, r: f64) -> (f64, f64) {
    if scale == 0.0 {
        return (r * r, r);
    }
    let root = (1.0 + r * r / (scale * scale)).sqrt();
    (2.0 * scale * scale * (root - 1.0), r / root)
}

/// Contribution of one ray to the losses.
#[derive(Debug, Clone, Copy)]
pub struct RayLoss {
    /// Weighted data terms.
    pub data: f64,
    /// Weighted data term of the dynamic field alone.
    pub dynamic: f64,
    /// Derivatives of the data terms by the ray's integrals S and D.
    pub gradient: [f64; 2],
}

/// Losses of ray `r` of `n_rays` rays, whose integrals are S and D (twin of `march_loss`).
pub fn ray_loss(plan: &FieldData, r: usize, n_rays: usize, ray: &Ray, [s_integral, d]: [f64; 2]) -> RayLoss {
    let s = &plan.setup;
    let temporal = s.temporal_target != 0;
    let n_static = (0..n_rays).filter(|r| !skips_static(plan, *r)).count() as f64;
    let static_scale = if skips_static(plan, r) { 0.0 } else { f64::from(s.static_weight) / n_static };
    let dynamic_scale = f64::from(s.dynamic_weight) / n_rays as f64;
    let total = s_integral + d - ray.target;
    let dynamic_residual = if temporal { d - d.clamp(ray.temporal[0], ray.temporal[1]) } else { total };
    let (value, slope) = robust_square(s.robust_scale.into(), dynamic_residual);
    let dynamic = dynamic_scale * value;
    RayLoss {
        data: static_scale * total * total + if temporal { dynamic } else { 0.0 },
        dynamic,
        gradient: [2.0 * static_scale * total, 2.0 * dynamic_scale * slope],
    }
}

/// Loss and gradient of given rays at a step.
pub fn loss_and_gradient(
    plan: &FieldData,
    params: &[f64],
    step: u32,
    rays: &[Ray],
    precision: Precision,
) -> (Losses, Vec<f64>) {
    if plan.params.static_network.is_some() {
        return networks::loss_and_gradient(plan, params, step, rays, precision);
    }
    let s = &plan.setup;
    let mut gradient = vec![0.0; plan.params.len];
    let mut losses = Losses::default();
    let near_part = NearPart::of(plan, step, rays);
    for (r, ray) in rays.iter().enumerate() {
        let seen = march::fwd(plan, params, step, ray, near_part, !skips_static(plan, r), precision);
        let loss = ray_loss(plan, r, rays.len(), ray, [seen.static_integral, seen.dynamic_integral]);
        losses.data += loss.data;
        losses.dynamic += loss.dynamic;
        losses.occlusion += f64::from(s.occlusion_weight) * seen.occlusion;
        losses.live += seen.dynamics.len();
        march::bwd(plan, params, ray, &seen, loss.gradient, precision, &mut gradient);
    }
    losses.tv = total_variation(plan, params, &mut gradient);
    (losses, gradient)
}

/// Value of the total variation; adds its gradient (twin of `gradient_static`; method, section 4).
pub fn total_variation(plan: &FieldData, params: &[f64], gradient: &mut [f64]) -> f64 {
    let (s, p) = (&plan.setup, &plan.params);
    let (d, ranks) = (p.grid, p.ranks);
    let mut value = 0.0;
    let mut pair = |a: usize, b: usize, weight: f64| {
        let difference = params[b] - params[a];
        value += weight * difference * difference;
        gradient[b] += 2.0 * weight * difference;
        gradient[a] -= 2.0 * weight * difference;
    };
    let plane_weight = f64::from(s.tv_plane) * 2.0 / (ranks * d * (d - 1)) as f64;
    let line_weight = f64::from(s.tv_line) * 2.0 / (ranks * (d - 1)) as f64;
    for mode in 0..3 {
        for r in 0..ranks {
            for v in 0..d {
                for u in 0..d {
                    if u + 1 < d {
                        pair(p.plane(mode, r, v, u), p.plane(mode, r, v, u + 1), plane_weight);
                    }
                    if v + 1 < d {
                        pair(p.plane(mode, r, v, u), p.plane(mode, r, v + 1, u), plane_weight);
                    }
                }
                if v + 1 < d {
                    pair(p.line(mode, r, v), p.line(mode, r, v + 1), line_weight);
                }
            }
        }
    }
    value
}

/// One Adam update (twin of `adam`).
pub fn adam(plan: &FieldData, step: u32, gradient: &[f64], params: &mut [f64], moments: &mut [[f64; 2]]) {
    let (s, row) = (&plan.setup, plan.schedule[step as usize]);
    for (i, g) in gradient.iter().enumerate() {
        let is_static = i < plan.params.static_len;
        if !is_static && row.dynamic_active == 0 {
            continue;
        }
        let update = if is_static { row.static_update } else { row.dynamic_update };
        if update.restart != 0 {
            moments[i] = [0.0; 2];
        }
        let bias_corrections = [update.bias_correction1, update.bias_correction2];
        let adam = Adam::new([s.beta1, s.beta2], s.epsilon, bias_corrections);
        adam.update(f64::from(update.rate), *g, &mut params[i], &mut moments[i]);
    }
}
