//! Density control of R2-Gaussian: where the gradient of the images is large, small Gaussians are cloned and large ones split;
//! weak Gaussians and those that have left the volume are removed. Each set is treated by itself.

use crate::config::sections::R2;
use crate::kernels::layout::R2Gaussian;
use crate::methods::r2_gaussian::parameters::{ScaleBounds, softplus_inverse};
use crate::methods::r2_gaussian::state::R2State;
use crate::random::{STREAM_CHILD, normal};
use glam::DVec3;

/// Factor by which the two halves of a split Gaussian are narrower.
const NARROWER: f64 = 1.6;
const CHILDREN: u32 = 2;

/// Tells whether Gaussians are added and removed after iteration `step`, counted from 1.
pub fn densifies(settings: &R2, step: u32) -> bool {
    let R2 { densify_every: every, densify_from: from, densify_until: until, .. } = *settings;
    every > 0 && step > from && step < until && step.is_multiple_of(every)
}

/// Decision of density control on a Gaussian.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Fate {
    Stays,
    Cloned,
    Split,
}

/// The Gaussians after density control at `step`: survivors with their moments, clones, first children, second
/// children; statistics begin anew.
pub fn densified(before: &R2State, n_sets: usize, settings: &R2, seed: u32, step: u32) -> R2State {
    let bounds = ScaleBounds::of(settings);
    let fates = fates(before, n_sets, settings, bounds);
    let chosen = |fate: Fate| -> Vec<usize> { (0..fates.len()).filter(|i| fates[*i] == fate).collect() };
    let mut after = before.clone();
    for row in chosen(Fate::Cloned) {
        after.rows[row].density = shared(&before.rows[row]);
    }
    after.retain(&fates.iter().map(|fate| *fate != Fate::Split).collect::<Vec<_>>());
    let clones =
        chosen(Fate::Cloned).into_iter().map(|i| R2Gaussian { density: shared(&before.rows[i]), ..before.rows[i] });
    after.append(clones.collect());
    for child in 0..CHILDREN {
        let of = |i: usize| split(&before.rows[i], bounds, |axis| deviate(seed, step, i, 3 * child + axis));
        after.append(chosen(Fate::Split).into_iter().map(of).collect());
    }
    let stays =
        |g: &R2Gaussian| g.attenuation() >= settings.density_min_threshold && g.centre().abs().max_element() <= 1.0;
    after.retain(&after.rows.iter().map(stays).collect::<Vec<_>>());
    after.statistics = vec![[0.0; 2]; after.rows.len()];
    after
}

/// Decides on each Gaussian. Those with a large image gradient are cloned or split, as many as their set has room for.
fn fates(particles: &R2State, n_sets: usize, settings: &R2, bounds: ScaleBounds) -> Vec<Fate> {
    let mut counts = vec![0u32; n_sets];
    particles.rows.iter().for_each(|g| counts[g.set as usize] += 1);
    let pulled = |i: usize| {
        let [sum, seen] = particles.statistics[i].map(f64::from);
        seen > 0.0 && sum / seen >= settings.densify_gradient
    };
    let fate = |(i, g): (usize, &R2Gaussian)| {
        let count = &mut counts[g.set as usize];
        if !pulled(i) || *count >= settings.max_num_gaussians {
            return Fate::Stays;
        }
        *count += 1;
        if g.scales(bounds).max_element() > 2.0 * settings.size_limit { Fate::Split } else { Fate::Cloned }
    };
    particles.rows.iter().enumerate().map(fate).collect()
}

/// Stored form of half the density, which two Gaussians share.
fn shared(g: &R2Gaussian) -> f32 {
    softplus_inverse(0.5 * g.attenuation()) as f32
}

fn deviate(seed: u32, step: u32, row: usize, number: u32) -> f64 {
    normal(seed.wrapping_add(step), STREAM_CHILD, row as u32, number)
}

/// A narrower Gaussian at a place drawn from the one that is split; `deviate` gives a standard normal number for each
/// axis.
fn split(g: &R2Gaussian, bounds: ScaleBounds, deviate: impl Fn(u32) -> f64) -> R2Gaussian {
    let scales = g.scales(bounds);
    let away = g.axes() * (scales * DVec3::new(deviate(0), deviate(1), deviate(2)));
    R2Gaussian {
        position: (g.centre() + away).as_vec3().to_array(),
        density: shared(g),
        scale: scales.to_array().map(|scale| bounds.stored(scale / NARROWER) as f32),
        ..*g
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Config, Preset};
    use crate::methods::r2_gaussian::parameters::round;

    fn settings() -> R2 {
        Config::preset(Preset::R2Gaussian).of::<crate::config::sections::R2Settings>().unwrap().method.r2
    }

    /// A small and a large Gaussian in each of two sets, all with a large image gradient.
    fn four() -> R2State {
        let bounds = ScaleBounds::of(&settings());
        let row = |i: u32| {
            let scale = if i.is_multiple_of(2) { 0.05 } else { 0.3 };
            round(DVec3::new(0.1 * f64::from(i), -0.2, 0.3), 0.5, scale, bounds, i / 2)
        };
        let mut particles = R2State::fresh((0..4).map(row).collect());
        particles.statistics = vec![[3e-4, 3.0]; 4];
        particles.first[0][3] = 7.0;
        particles
    }

    #[test]
    fn density_control_has_its_iterations() {
        let all = |settings: &R2| (0..=30_000).filter(|step| densifies(settings, *step)).collect::<Vec<_>>();
        let usual = all(&settings());
        assert_eq!((usual.len(), usual[0], usual[usual.len() - 1]), (144, 600, 14_900));
        assert!(all(&R2 { densify_every: 0, ..settings() }).is_empty());
    }

    #[test]
    fn small_ones_are_cloned_and_large_ones_split() {
        let after = densified(&four(), 2, &settings(), 1, 600);
        // Two survivors, two clones, two pairs of children.
        assert_eq!(after.rows.iter().map(|g| g.set).collect::<Vec<_>>(), [0, 1, 0, 1, 0, 1, 0, 1]);
        assert!(after.rows.iter().all(|g| (g.attenuation() - 0.25).abs() < 1e-6), "{:?}", after.rows);
        assert_eq!(after.rows[0], after.rows[2]);
        let bounds = ScaleBounds::of(&settings());
        assert!((after.rows[4].scales(bounds).x - 0.3 / 1.6).abs() < 1e-6);
        assert_ne!(after.rows[4].position, after.rows[6].position);
        // Survivors keep moments, new ones have none; statistics begin anew.
        assert_eq!((after.first[0][3], after.first[2][3]), (7.0, 0.0));
        assert!(after.statistics.iter().all(|s| *s == [0.0; 2]));
        assert_eq!(densified(&four(), 2, &settings(), 1, 600), after);
        assert_ne!(densified(&four(), 2, &settings(), 1, 700).rows[4].position, after.rows[4].position);
    }

    #[test]
    fn children_are_spread_as_their_parent_was() {
        let bounds = ScaleBounds::of(&settings());
        let mut parent = round(DVec3::new(0.2, 0.0, -0.1), 0.5, 0.05, bounds, 0);
        parent.scale[1] = bounds.stored(0.2) as f32;
        // A quarter turn about z: its second axis lies along -x.
        parent.rotation = [0.5f32.sqrt(), 0.0, 0.0, 0.5f32.sqrt()];
        let n = 4000;
        let mut squares = DVec3::ZERO;
        for i in 0..n {
            let child = split(&parent, bounds, |axis| deviate(5, 600, i, axis));
            squares += (child.centre() - parent.centre()).powf(2.0);
        }
        let spread = (squares / n as f64).powf(0.5);
        assert!((spread - DVec3::new(0.2, 0.05, 0.05)).abs().max_element() < 0.01, "{spread}");
    }

    #[test]
    fn what_is_weak_or_outside_goes_and_nothing_is_pulled_in_vain() {
        let mut particles = four();
        particles.statistics = vec![[0.0, 0.0], [1e-4, 3.0], [0.0; 2], [0.0; 2]];
        particles.rows[2].density = softplus_inverse(0.9e-5) as f32;
        particles.rows[3].position[1] = -1.01;
        let after = densified(&particles, 2, &settings(), 1, 600);
        assert_eq!(after.rows, particles.rows[..2]);
        // A set that is full takes no more.
        let full = R2 { max_num_gaussians: 2, count: 1, ..settings() };
        assert_eq!(densified(&four(), 2, &full, 1, 600).rows, four().rows);
        let room_for_one = R2 { max_num_gaussians: 3, count: 1, ..settings() };
        assert_eq!(densified(&four(), 2, &room_for_one, 1, 600).rows.len(), 6);
    }
}
