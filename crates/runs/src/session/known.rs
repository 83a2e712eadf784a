//! True vessels as a caller states them.

use crate::error::{Error, Result};
use crate::scan::gating::BeatTime;
use crate::score::trees::TrueLine;
use crate::score::volume::TrueVessels;
use std::collections::BTreeMap;

/// True vessels, by phase.
#[derive(Default)]
pub(super) struct TrueShapes {
    pub(super) volumes: BTreeMap<u32, TrueVessels>,
    pub(super) trees: BTreeMap<u32, Vec<TrueLine>>,
}

/// The lines at a time: those of the nearest phase, on the straight way to the next where that is known; none where neither is.
pub(super) fn between(known: &BTreeMap<u32, Vec<TrueLine>>, time: BeatTime, n_phases: u32) -> Vec<TrueLine> {
    let Some(mut lines) = known.get(&time.phase).cloned() else { return Vec::new() };
    let [_, (beyond, share)] = time.shown(n_phases);
    for (line, next) in lines.iter_mut().zip(known.get(&(beyond as u32)).into_iter().flatten()) {
        line.points_mm.iter_mut().zip(&next.points_mm).for_each(|(a, b)| *a = a.lerp(*b, share));
        line.radius_mm.iter_mut().zip(&next.radius_mm).for_each(|(a, b)| *a += share * (b - *a));
    }
    lines
}

/// Refuses what is no tree over a beat.
pub(super) fn check_lines(trees: &BTreeMap<u32, Vec<TrueLine>>) -> Result<()> {
    let bad = |phase: u32, problem: &str| Err(Error::config("true tree", format!("phase {phase}"), problem));
    let lengths = |lines: &[TrueLine]| lines.iter().map(|line| line.points_mm.len()).collect::<Vec<_>>();
    let Some((first, rest)) = trees.first_key_value() else { return Ok(()) };
    if *first != 0 {
        return bad(0, "has no line, but the other phases are compared with phase 0");
    }
    for (phase, lines) in trees {
        if lengths(lines) != lengths(rest) {
            return bad(*phase, "has another number of lines, or of points on a line, than phase 0");
        }
        for line in lines {
            let numbers = line.points_mm.iter().flat_map(|p| p.to_array()).chain(line.radius_mm.iter().copied());
            if line.points_mm.len() < 2 || line.radius_mm.len() != line.points_mm.len() {
                return bad(*phase, "has a line of fewer than two points, or not exactly one radius per point");
            }
            if !numbers.into_iter().all(f64::is_finite) || line.radius_mm.iter().any(|r| *r < 0.0) {
                return bad(*phase, "has a point or a radius that is not finite, or a negative radius");
            }
        }
    }
    Ok(())
}
