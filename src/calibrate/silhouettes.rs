//! Pixels that the other views explain, as a measure that is easy to inspect. Corrections are neither fitted nor validated
//! by it.

use crate::calibrate::observed::Observed;
use crate::calibrate::pose::Poses;
use crate::calibrate::sight::Others;
use rayon::prelude::*;

/// Tolerance of the vessels of other views, pixels.
const NEAR: usize = 1;

/// Vessel pixels of a view at a phase for which all other views that see it show a vessel at one place on the ray, to
/// within a pixel; `None` where the view, or all others, have no image at the phase.
pub fn explained_pixels(observed: &Observed, poses: &Poses, view: usize, phase: usize) -> Option<Vec<bool>> {
    let shown = observed.shown[view][phase].as_ref()?;
    let rays = |v: usize| observed.stands[v].corrected_rays(&poses.views[v], poses.heart[v][phase]);
    let others = Others::of(observed, view, phase, NEAR, rays)?;
    let (rays, width) = (rays(view), others.size[0]);
    let explained = |p: usize| others.may_show(&rays, (p % width) as f64, (p / width) as f64);
    Some((0..shown.len()).into_par_iter().map(|p| shown[p] && explained(p)).collect())
}

/// Share of the vessel pixels that the other views explain, over all views and phases.
pub fn explained(observed: &Observed, poses: &Poses) -> f64 {
    let (mut all, mut explained) = (0, 0);
    for view in 0..observed.views.len() {
        for phase in 0..observed.n_phases() {
            let Some(pixels) = explained_pixels(observed, poses, view, phase) else { continue };
            explained += pixels.iter().filter(|p| **p).count();
            all += observed.shown[view][phase].iter().flatten().filter(|s| **s).count();
        }
    }
    f64::from(explained as u32) / f64::from((all as u32).max(1))
}
