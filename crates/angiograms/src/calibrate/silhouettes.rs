//! Pixels that the other views explain, as a measure that is easy to inspect. Corrections are neither fitted nor validated
//! by it.

use crate::calibrate::observed::Observed;
use crate::calibrate::pose::Poses;
use crate::calibrate::sight::Others;
use rayon::prelude::*;

/// Tolerance of the vessels of other views, pixels.
const NEAR: usize = 1;

/// Displacements of a view's vessels, as shares of the image's sides, after which other views explain them by chance only.
const ASIDE: [[f64; 2]; 4] = [[0.15, 0.0], [-0.15, 0.0], [0.0, 0.15], [0.0, -0.15]];
/// Number of phases, at most, from which the share by chance is estimated.
const PHASES_BY_CHANCE: usize = 3;

/// Vessel pixels of a view at a phase for which all other views that see it show a vessel at one place on the ray, to
/// within a pixel; `None` where the view, or all others, have no image at the phase.
pub fn explained_pixels(observed: &Observed, poses: &Poses, view: usize, phase: usize) -> Option<Vec<bool>> {
    explained_aside(observed, poses, view, phase, [0.0; 2])
}

/// As [`explained_pixels`], with the rays of pixels that are displaced by `aside`, as shares of the image's sides.
fn explained_aside(
    observed: &Observed,
    poses: &Poses,
    view: usize,
    phase: usize,
    aside: [f64; 2],
) -> Option<Vec<bool>> {
    let shown = observed.shown[view][phase].as_ref()?;
    let rays = |v: usize| observed.stands[v].corrected_rays(&poses.views[v], poses.heart[v][phase]);
    let others = Others::of(observed, view, phase, NEAR, rays)?;
    let (rays, width) = (rays(view), others.size[0]);
    let [right, down] = [0, 1].map(|k| (aside[k] * observed.sizes[view][k] as f64).round());
    let explained = |p: usize| others.may_show(&rays, (p % width) as f64 + right, (p / width) as f64 + down);
    Some((0..shown.len()).into_par_iter().map(|p| shown[p] && explained(p)).collect())
}

/// Counts vessel pixels: those explained with a displacement, and all.
fn counted(observed: &Observed, poses: &Poses, phases: &[usize], aside: [f64; 2]) -> [usize; 2] {
    let (mut all, mut explained) = (0, 0);
    for (view, phase) in (0..observed.views.len()).flat_map(|view| phases.iter().map(move |phase| (view, *phase))) {
        let Some(pixels) = explained_aside(observed, poses, view, phase, aside) else { continue };
        explained += pixels.iter().filter(|p| **p).count();
        all += observed.shown[view][phase].iter().flatten().filter(|s| **s).count();
    }
    [explained, all]
}

fn share([explained, all]: [usize; 2]) -> f64 {
    explained as f64 / all.max(1) as f64
}

/// Share of the vessel pixels that the other views explain, over all views and phases.
pub fn explained(observed: &Observed, poses: &Poses) -> f64 {
    share(counted(observed, poses, &(0..observed.n_phases()).collect::<Vec<_>>(), [0.0; 2]))
}

/// Share of the vessel pixels that the other views explain when the vessels of each view in turn are displaced by a seventh of
/// the image: what vessels that cover so much of the images explain whatever they show.
pub fn explained_by_chance(observed: &Observed, poses: &Poses) -> f64 {
    let every = observed.n_phases().div_ceil(PHASES_BY_CHANCE).max(1);
    let phases: Vec<usize> = (0..observed.n_phases()).step_by(every).collect();
    let counts = ASIDE.map(|aside| counted(observed, poses, &phases, aside));
    share(counts.into_iter().fold([0, 0], |[a, b], [c, d]| [a + c, b + d]))
}
