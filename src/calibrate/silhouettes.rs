//! Which pixels the other views explain: what a person sees at a look. Corrections are not found or judged by it.

use crate::calibrate::observed::Observed;
use crate::calibrate::pose::Poses;
use crate::geometry::ViewRays;
use crate::raster::{Image, dilate};
use glam::{DMat3, DVec3};
use rayon::prelude::*;

/// Vessels of other views may be so many pixels off.
const NEAR: usize = 1;
/// Depths looked at along a ray, of a pixel each at the isocentre.
const DEPTHS_PER_SIDE: f64 = 0.5;

/// What another view shows at a phase.
struct Other {
    source: DVec3,
    inverse: DMat3,
    width: i64,
    height: i64,
    shown: Vec<bool>,
}

impl Other {
    fn new(rays: &ViewRays, [width, height]: [usize; 2], shown: &[bool]) -> Other {
        let basis = DMat3::from_cols(rays.direction[1], rays.direction[2], rays.direction[0]);
        let values = shown.iter().map(|s| f32::from(u8::from(*s))).collect();
        let near = dilate(&Image { width, height, values }, NEAR);
        Other {
            source: rays.source(),
            inverse: basis.inverse(),
            width: width as i64,
            height: height as i64,
            shown: near.values.iter().map(|v| *v > 0.0).collect(),
        }
    }

    fn shows(&self, point: DVec3) -> bool {
        let h = self.inverse * (point - self.source);
        let (i, j) = ((h.x / h.z).round() as i64, (h.y / h.z).round() as i64);
        let inside = h.z > 0.0 && i >= 0 && j >= 0 && i < self.width && j < self.height;
        inside && self.shown[(j * self.width + i) as usize]
    }
}

/// Of the pixels of a view that show vessels at a phase, those for which all other views show some on the ray, to a pixel;
/// none where the view, or all others, have no image then.
pub fn explained_pixels(observed: &Observed, poses: &Poses, view: usize, phase: usize) -> Option<Vec<bool>> {
    let shown = observed.shown[view][phase].as_ref()?;
    let size = observed.fine.views[view].size;
    let rays = |v: usize| observed.stands[v].corrected_rays(&poses.views[v], poses.heart[v][phase]);
    let other = |v: usize| Some(Other::new(&rays(v), size, observed.shown[v][phase].as_ref()?));
    let others: Vec<Other> = (0..observed.views.len()).filter(|v| *v != view).filter_map(other).collect();
    if others.is_empty() {
        return None;
    }
    let rays = rays(view);
    let pixel = 0.5 * (rays.anchor[1].length() + rays.anchor[2].length());
    let half = (DEPTHS_PER_SIDE * size[0].max(size[1]) as f64) as i64;
    let explained = |p: usize| {
        let (anchor, direction) = rays.pixel((p % size[0]) as f64, (p / size[0]) as f64);
        (-half..=half).any(|k| {
            let point = anchor + direction * (k as f64 * pixel);
            others.iter().all(|other| other.shows(point))
        })
    };
    Some((0..shown.len()).into_par_iter().map(|p| shown[p] && explained(p)).collect())
}

/// Share of the pixels that show vessels which the other views explain, over all views and phases.
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
