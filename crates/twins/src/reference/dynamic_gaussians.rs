//! f64 reference implementation (twin) of the deformable set of Gaussians: their positions, the loss with its penalties, and its
//! gradient.

use crate::gaussians::field::{basis, shares};
use crate::gaussians::view::SplatView;
use crate::kernels::layout::{GaussianSetup, MotionGridSetup};
use crate::methods::dynamic_gaussians::targets::Targets;
use crate::reference::gaussians::{self, N_PARAMS, Params};
use crate::scan::gating::BeatTime;
use glam::DVec3;

/// All fitted parameters, or their gradient.
#[derive(Debug, Clone, PartialEq)]
pub struct DeformableParams {
    /// Gaussians at rest.
    pub rows: Vec<Params>,
    /// Own motion, `[Gaussian][basis function]`.
    pub own: Vec<DVec3>,
    /// Displacements of the grid's nodes, `[phase][node]`; those of the phase of rest stay fixed.
    pub grid: Vec<DVec3>,
    /// Filling, `[Gaussian][phase]`, constant at the rest phase; empty where vessels are full all the time.
    pub filling: Vec<f64>,
}

impl DeformableParams {
    /// Returns zeros of equal sizes.
    pub fn zeros(&self) -> DeformableParams {
        DeformableParams {
            rows: vec![[0.0; N_PARAMS]; self.rows.len()],
            own: vec![DVec3::ZERO; self.own.len()],
            grid: vec![DVec3::ZERO; self.grid.len()],
            filling: vec![0.0; self.filling.len()],
        }
    }
}

/// Place of the log-density in [`Params`].
const LOG_DENSITY: usize = 3;

/// Nodes and basis functions that determine a Gaussian's position at a phase.
struct Motion {
    nodes: [(usize, f64); 8],
    basis: Vec<f64>,
}

fn motion(deformable: &MotionGridSetup, rest: &Params, phase: usize, n_phases: usize) -> Motion {
    let nodes = shares(deformable, DVec3::new(rest[0], rest[1], rest[2]))
        .map(|(n, share)| (phase * deformable.nodes() + n, share));
    let since_rest = (phase as f64 - f64::from(deformable.rest_phase)) / n_phases as f64;
    Motion { nodes, basis: basis(deformable.n_basis as usize, since_rest) }
}

fn displaced(p: &DeformableParams, i: usize, motion: &Motion) -> Params {
    let grid: DVec3 = motion.nodes.iter().map(|(node, share)| *share * p.grid[*node]).sum();
    let n_basis = motion.basis.len();
    let own: DVec3 = motion.basis.iter().zip(&p.own[i * n_basis..]).map(|(b, a)| *b * *a).sum();
    let mut out = p.rows[i];
    (grid + own).to_array().iter().zip(&mut out).for_each(|(d, x)| *x += d);
    out
}

/// Phases that an image shows, and their shares.
pub fn phases_shown(phase: usize, view: &SplatView, n_phases: usize) -> [(usize, f64); 2] {
    BeatTime { phase: phase as u32, after_phase: view.after_phase }.shown(n_phases as u32)
}

/// Returns the filling of a Gaussian in an image of a phase: linearly interpolated between two phases.
fn filling_shown(p: &DeformableParams, i: usize, phase: usize, view: &SplatView, n_phases: usize) -> f64 {
    if p.filling.is_empty() {
        return 1.0;
    }
    phases_shown(phase, view, n_phases).iter().map(|(at, share)| share * p.filling[i * n_phases + at]).sum()
}

/// Returns a Gaussian as in an image of a phase: linearly interpolated between two phases.
pub fn shown(
    deformable: &MotionGridSetup,
    p: &DeformableParams,
    i: usize,
    phase: usize,
    view: &SplatView,
    n_phases: usize,
) -> Params {
    let at = |phase: usize| displaced(p, i, &motion(deformable, &p.rows[i], phase, n_phases));
    let [(here, _), (beyond, share)] = phases_shown(phase, view, n_phases);
    let (mut out, there) = (at(here), at(beyond));
    (0..3).for_each(|k| out[k] += share * (there[k] - out[k]));
    out[LOG_DENSITY] += filling_shown(p, i, phase, view, n_phases).ln();
    out
}

/// Loss without and with penalties, and the gradient of the latter. The interpolation weights of nodes are treated as
/// constants.
pub fn loss_and_gradient(
    targets: &Targets,
    setup: &GaussianSetup,
    deformable: &MotionGridSetup,
    p: &DeformableParams,
) -> (f64, f64, DeformableParams) {
    let n = targets.n_pixels();
    let mut images = vec![0.0; targets.n_images * n];
    let everywhere: Vec<(usize, usize)> =
        (0..targets.n_phases).flat_map(|phase| (0..p.rows.len()).map(move |i| (phase, i))).collect();
    let place = |phase: usize, i: usize| motion(deformable, &p.rows[i], phase, targets.n_phases);
    let shown = |phase: usize, i: usize, view: &SplatView| shown(deformable, p, i, phase, view, targets.n_phases);
    for &(phase, i) in &everywhere {
        for (image, view) in targets.views_at(phase) {
            let moved = shown(phase, i, view);
            if let Some(seen) = gaussians::project(&moved, view, setup) {
                seen.splat(setup, &mut images[image * n..][..n]);
            }
        }
    }
    let (mut loss, mut residuals) = (0.0, Vec::new());
    for (image, seen) in images.chunks(n).enumerate() {
        let range = image * n..(image + 1) * n;
        let [low, high] = [&targets.low, &targets.high].map(|v| &v[range.clone()]);
        let (value, residual) = gaussians::residual(setup, seen, low, high, targets.weight.image(image));
        loss += value;
        residuals.push(residual);
    }
    let mut gradient = p.zeros();
    for &(phase, i) in &everywhere {
        for (image, view) in targets.views_at(phase) {
            let moved = shown(phase, i, view);
            let Some(seen) = gaussians::project(&moved, view, setup) else { continue };
            let g = gaussians::gradient(&moved, view, setup, seen.moments(setup, &residuals[image]));
            gradient.rows[i].iter_mut().zip(g).for_each(|(sum, g)| *sum += g);
            let x = DVec3::new(g[0], g[1], g[2]);
            let filled = filling_shown(p, i, phase, view, targets.n_phases);
            for (phase, share) in phases_shown(phase, view, targets.n_phases) {
                if !p.filling.is_empty() {
                    gradient.filling[i * targets.n_phases + phase] += share * g[LOG_DENSITY] / filled;
                }
                add_place(&mut gradient, i, phase == deformable.rest_phase as usize, &place(phase, i), share * x);
            }
        }
    }
    let penalty = add_penalties(deformable, p, targets.n_phases, &mut gradient);
    (loss, loss + penalty, gradient)
}

/// Adds the gradient of a Gaussian's position at a phase to that of its motion; at the phase of rest the grid is excluded.
fn add_place(gradient: &mut DeformableParams, i: usize, at_rest: bool, motion: &Motion, x: DVec3) {
    for (k, b) in motion.basis.iter().enumerate() {
        gradient.own[i * motion.basis.len() + k] += *b * x;
    }
    for (node, share) in motion.nodes.iter().filter(|_| !at_rest) {
        gradient.grid[*node] += *share * x;
    }
}

/// Adds the gradient of the penalties, and returns their value: squared own motion, and squared differences of neighbouring
/// nodes.
fn add_penalties(
    deformable: &MotionGridSetup,
    p: &DeformableParams,
    n_phases: usize,
    gradient: &mut DeformableParams,
) -> f64 {
    let (own, smooth) = (f64::from(deformable.own_penalty), f64::from(deformable.smoothness));
    let mut penalty = 0.0;
    for (g, a) in gradient.own.iter_mut().zip(&p.own) {
        *g += 2.0 * own * *a;
        penalty += own * a.length_squared();
    }
    let n = deformable.n_nodes as usize;
    for phase in (0..n_phases).filter(|phase| *phase != deformable.rest_phase as usize) {
        for node in 0..deformable.nodes() {
            for stride in [1, n, n * n] {
                if node / stride % n + 1 == n {
                    continue;
                }
                let (a, b) = (phase * deformable.nodes() + node, phase * deformable.nodes() + node + stride);
                let step = p.grid[b] - p.grid[a];
                penalty += smooth * step.length_squared();
                gradient.grid[b] += 2.0 * smooth * step;
                gradient.grid[a] -= 2.0 * smooth * step;
            }
        }
    }
    penalty
}
