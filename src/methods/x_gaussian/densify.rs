//! Density control of X-Gaussian: where the gradient of the images is large, small Gaussians are cloned and large ones split;
//! faint and huge ones are removed; and now and then all become faint. Each set is treated by itself.

use crate::config::sections::X;
use crate::kernels::layout::{BlendGaussian, XStatistics};
use crate::methods::x_gaussian::state::XState;
use crate::random::{STREAM_CHILD, normal};
use glam::DVec3;

/// Factor by which the two halves of a split Gaussian are narrower.
const NARROWER: f64 = 1.6;
const CHILDREN: u32 = 2;

/// Tells whether Gaussians are added and removed after iteration `step`, counted from 1.
pub fn densifies(settings: &X, step: u32) -> bool {
    let X { densify_every: every, densify_from: from, densify_until: until, .. } = *settings;
    every > 0 && step > from && step < until && step.is_multiple_of(every)
}

/// Tells whether opacities are reset after iteration `step`, counted from 1.
pub fn resets(settings: &X, step: u32) -> bool {
    settings.reset_every > 0 && step > 0 && step < settings.densify_until && step.is_multiple_of(settings.reset_every)
}

/// Decision of density control on a Gaussian.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Fate {
    Stays,
    Cloned,
    Split,
}

/// The Gaussians after density control at `step` in a scene of `extent_mm`: survivors with their moments, clones, first
/// children, second children; statistics begin anew.
pub fn densified(before: &XState, n_sets: usize, settings: &X, extent_mm: f64, (seed, step): (u32, u32)) -> XState {
    let fates = fates(before, n_sets, settings, extent_mm);
    let chosen = |fate: Fate| -> Vec<usize> { (0..fates.len()).filter(|i| fates[*i] == fate).collect() };
    let sets = |rows: &[usize]| rows.iter().map(|i| before.sets[*i]).collect::<Vec<_>>();
    let mut after = before.clone();
    after.retain(&fates.iter().map(|fate| *fate != Fate::Split).collect::<Vec<_>>());
    let (cloned, split_ones) = (chosen(Fate::Cloned), chosen(Fate::Split));
    after.append(cloned.iter().map(|i| before.rows[*i]).collect(), sets(&cloned));
    for child in 0..CHILDREN {
        let of = |i: &usize| split(&before.rows[*i], |axis| deviate(seed, step, *i, 3 * child + axis));
        after.append(split_ones.iter().map(of).collect(), sets(&split_ones));
    }
    let large_ones_go = settings.reset_every > 0 && step > settings.reset_every;
    let stays = |g: &BlendGaussian| {
        let too_wide = g.scales().max_element() > settings.max_scale * extent_mm;
        g.shown_opacity() >= settings.min_opacity && !(large_ones_go && too_wide)
    };
    after.retain(&after.rows.iter().map(stays).collect::<Vec<_>>());
    after.statistics = vec![XStatistics::default(); after.rows.len()];
    after
}

/// Decides on each Gaussian. Those with a large image gradient are cloned or split, as many as their set has room for.
fn fates(state: &XState, n_sets: usize, settings: &X, extent_mm: f64) -> Vec<Fate> {
    let mut counts = state.counts(n_sets);
    let fate = |i: usize| {
        let (count, of) = (&mut counts[state.sets[i] as usize], state.statistics[i]);
        let pulled = of.seen > 0.0 && f64::from(of.pull) / f64::from(of.seen) >= settings.densify_gradient;
        if !pulled || *count >= settings.max_gaussians {
            return Fate::Stays;
        }
        *count += 1;
        let is_large = state.rows[i].scales().max_element() > settings.size_limit * extent_mm;
        if is_large { Fate::Split } else { Fate::Cloned }
    };
    (0..state.rows.len()).map(fate).collect()
}

fn deviate(seed: u32, step: u32, row: usize, number: u32) -> f64 {
    normal(seed.wrapping_add(step), STREAM_CHILD, row as u32, number)
}

/// A narrower Gaussian at a place drawn from the one that is split; `deviate` gives a standard normal number for each
/// axis.
fn split(g: &BlendGaussian, deviate: impl Fn(u32) -> f64) -> BlendGaussian {
    let away = g.axes() * (g.scales() * DVec3::new(deviate(0), deviate(1), deviate(2)));
    BlendGaussian {
        position: (g.centre() + away).as_vec3().to_array(),
        log_scale: g.log_scale.map(|log| (f64::from(log) - NARROWER.ln()) as f32),
        ..*g
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Config, Preset};
    use crate::gaussians::blending::opacity::stored_opacity;

    const EXTENT_MM: f64 = 400.0;
    const AT: (u32, u32) = (1, 600);

    fn settings() -> X {
        Config::preset(Preset::XGaussian).of::<crate::config::sections::XSettings>().unwrap().method.x
    }

    fn row(x: f32, scale_mm: f32, opacity: f64) -> BlendGaussian {
        BlendGaussian {
            position: [x, -2.0, 3.0],
            opacity: stored_opacity(opacity.ln()) as f32,
            log_scale: [scale_mm.ln(); 3],
            intensity: 0.4,
            rotation: [1.0, 0.0, 0.0, 0.0],
        }
    }

    /// A small and a large Gaussian in each of two sets, all with a large image gradient.
    fn four() -> XState {
        let rows = (0..4).map(|i| row(i as f32, if i % 2 == 0 { 2.0 } else { 9.0 }, 0.5));
        let mut state = XState::fresh(rows.collect(), vec![0, 0, 1, 1]);
        state.statistics = vec![XStatistics { pull: 3e-4, seen: 3.0, radius: 30.0 }; 4];
        state.first[0][3] = 7.0;
        state
    }

    #[test]
    fn density_control_and_resets_have_their_iterations() {
        let settings = settings();
        let usual: Vec<u32> = (0..=20_000).filter(|step| densifies(&settings, *step)).collect();
        assert_eq!((usual.len(), usual[0], usual[usual.len() - 1]), (37, 600, 7800));
        assert_eq!((0..=20_000).filter(|step| resets(&settings, *step)).collect::<Vec<_>>(), [4000]);
        assert!(!(0..=99).any(|step| resets(&X { reset_every: 0, ..settings.clone() }, step)));
    }

    #[test]
    fn small_ones_are_cloned_and_large_ones_split() {
        let after = densified(&four(), 2, &settings(), EXTENT_MM, AT);
        // Two survivors, two clones, two pairs of children.
        assert_eq!(after.sets, [0, 1, 0, 1, 0, 1, 0, 1]);
        assert_eq!(after.rows[0], after.rows[2]);
        assert!((after.rows[4].scales().x - 9.0 / 1.6).abs() < 1e-5);
        assert_ne!(after.rows[4].position, after.rows[6].position);
        assert!(after.rows.iter().all(|g| (g.shown_opacity() - 0.5).abs() < 1e-6 && g.intensity == 0.4));
        // Survivors keep moments, new ones have none; statistics begin anew.
        assert_eq!((after.first[0][3], after.first[2][3]), (7.0, 0.0));
        assert!(after.statistics.iter().all(|s| *s == XStatistics::default()));
        assert_eq!(densified(&four(), 2, &settings(), EXTENT_MM, AT), after);
        assert_ne!(densified(&four(), 2, &settings(), EXTENT_MM, (1, 800)).rows[4].position, after.rows[4].position);
    }

    #[test]
    fn faint_and_huge_ones_go_and_a_full_set_takes_no_more() {
        let state = |rows: Vec<BlendGaussian>| {
            let n = rows.len();
            let mut state = XState::fresh(rows, vec![0; n]);
            state.statistics.iter_mut().for_each(|s| s.radius = 30.0);
            state
        };
        let all = state(vec![row(0.0, 2.0, 0.5), row(1.0, 2.0, 0.004), row(2.0, 50.0, 0.5)]);
        let left = |settings: &X, step: u32| {
            let after = densified(&all, 1, settings, EXTENT_MM, (1, step));
            after.rows.iter().map(|g| g.position[0]).collect::<Vec<_>>()
        };
        assert_eq!(left(&settings(), 600), [0.0, 2.0]);
        assert_eq!(left(&settings(), 4200), [0.0]);
        assert_eq!(left(&X { reset_every: 0, ..settings() }, 4200), [0.0, 2.0], "nothing is ever reset");
        let full = X { max_gaussians: 2, ..settings() };
        assert_eq!(densified(&four(), 2, &full, EXTENT_MM, AT).rows, four().rows);
        let room_for_one = X { max_gaussians: 3, ..settings() };
        assert_eq!(densified(&four(), 2, &room_for_one, EXTENT_MM, AT).rows.len(), 6);
    }

    #[test]
    fn children_are_spread_as_their_parent_was() {
        let mut parent = row(2.0, 0.5, 0.5);
        parent.log_scale[1] = 2f32.ln();
        // A quarter turn about z: its second axis lies along -x.
        parent.rotation = [0.5f32.sqrt(), 0.0, 0.0, 0.5f32.sqrt()];
        let n = 4000;
        let squares: DVec3 = (0..n)
            .map(|i| (split(&parent, |axis| deviate(5, 600, i, axis)).centre() - parent.centre()).powf(2.0))
            .sum();
        let spread = (squares / n as f64).powf(0.5);
        assert!((spread - DVec3::new(2.0, 0.5, 0.5)).abs().max_element() < 0.1, "{spread}");
    }
}
