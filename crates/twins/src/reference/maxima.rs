//! Maximum attenuation of Gaussians along rays, in f64, as used for scoring vessels.

use crate::gaussians::field::Gaussians;
use crate::gaussians::view::SplatView;
use crate::kernels::layout::GaussianSetup;
use crate::reference::gaussians::{AlongRay, Params, params, project};
use rayon::prelude::*;

/// Step along the ray, pixels at the isocentre.
const STEP: f64 = 0.25;
/// Range of a Gaussian along the ray, standard deviations.
const REACH: f64 = 3.2;

/// Maximum attenuation (per world unit) of the field of a phase along the ray of every pixel, rows first.
pub fn maxima(model: &Gaussians, view: &SplatView, width: usize, height: usize, phase: usize) -> Vec<f64> {
    let setup = GaussianSetup { width: width as u32, height: height as u32, ..model.setup };
    let all: Vec<Params> = model.at(phase).map(params).collect();
    let mut rows: Vec<Vec<(usize, u32)>> = vec![Vec::new(); height];
    for (index, p) in all.iter().enumerate() {
        let Some(seen) = project(p, view, &setup) else { continue };
        for (pixel, _) in seen.pixels(&setup) {
            rows[pixel / width].push((pixel % width, index as u32));
        }
    }
    rows.into_par_iter()
        .enumerate()
        .flat_map_iter(|(row, mut pairs)| {
            pairs.sort_unstable();
            let mut out = vec![0.0; width];
            for column in pairs.chunk_by(|a, b| a.0 == b.0) {
                let at = column[0].0;
                let gaussians = column.iter().map(|(_, index)| &all[*index as usize]);
                out[at] = along(gaussians, &setup, view, at as f64, row as f64) * model.units.attenuation();
            }
            out
        })
        .collect()
}

/// Maximum of the sum of Gaussians along the ray of a pixel.
fn along<'a>(
    gaussians: impl Iterator<Item = &'a Params>,
    setup: &GaussianSetup,
    view: &SplatView,
    column: f64,
    row: f64,
) -> f64 {
    let ray = view.ray(column, row);
    // Depths between which each Gaussian counts; a profile's depth is relative to that of its Gaussian.
    let mut parts: Vec<(f64, f64, f64, AlongRay)> = gaussians
        .map(|p| {
            let own = view.project(glam::DVec3::new(p[0], p[1], p[2])).0;
            let profile = AlongRay::new(p, setup, view, ray);
            let (at, deviation) = profile.peak();
            (own + at - REACH * deviation, own + at + REACH * deviation, own, profile)
        })
        .collect();
    parts.sort_by(|a, b| a.0.total_cmp(&b.0));
    let step = STEP / ray.length();
    let mut best = 0f64;
    let (mut first, mut t) = (0, f64::NEG_INFINITY);
    while first < parts.len() {
        t = (t + step).max(parts[first].0);
        let here = parts[first..].iter().take_while(|p| p.0 <= t).filter(|p| p.1 >= t);
        best = best.max(here.map(|p| p.3.at(t - p.2)).sum());
        while first < parts.len() && parts[first].1 < t + step {
            first += 1;
        }
    }
    best
}
