//! Pruning of components of a deformable set that the images do not support: in noise, a fit explains with them what several views
//! show by chance.

use crate::gaussians::field::scales;
use crate::kernels::layout::{Gaussian, GaussianSetup};
use crate::methods::dynamic_gaussians::linked::{extent, groups};
use crate::methods::dynamic_gaussians::remainder::remainders;
use crate::methods::dynamic_gaussians::targets::Targets;
use glam::DVec3;

/// Distance, in longest scales, within which two Gaussians belong to one component.
const LINK_SCALES: f64 = 2.5;
/// Maximum extent of a component that may be pruned, pixels of the settings: longer ones are vessels.
const SHORT: f64 = 8.0;
/// Least gain in chi squared, in the view that gains least, of a component that is kept. Noise alone gains less than 10, ends of vessels
/// hundreds.
const LEAST_GAIN: f64 = 20.0;
/// Minimum share of a view's squared image of the component in that of the view that shows it best; other views have no vote, such as
/// one where a blade covers the component.
const VOTES: f64 = 0.3;
/// Deviation of a good fit without noise, as a share of the strongest change.
const FIT_DEVIATION: f64 = 0.02;

/// Returns the short components of a set, as indices of its Gaussians.
pub(super) fn short_components(rows: &[Gaussian], setup: &GaussianSetup, factor: f64) -> Vec<Vec<usize>> {
    let short = |members: &Vec<usize>| extent(members.iter().map(|i| position(&rows[*i]))) <= SHORT * factor;
    components(rows, setup).into_iter().filter(short).collect()
}

fn position(g: &Gaussian) -> DVec3 {
    DVec3::from_array(g.position.map(f64::from))
}

/// Returns groups of Gaussians whose distances are below [`LINK_SCALES`] times their mean longest scale, directly or through others.
fn components(rows: &[Gaussian], setup: &GaussianSetup) -> Vec<Vec<usize>> {
    let longest: Vec<f64> = rows.iter().map(|g| scales(g, setup).max_element()).collect();
    let near = |i: usize, j: usize| {
        position(&rows[i]).distance(position(&rows[j])) < LINK_SCALES * 0.5 * (longest[i] + longest[j])
    };
    groups((0..rows.len()).collect(), near)
}

/// Evidence of the images for components: what the whole field leaves of them.
pub(super) struct Judge<'a> {
    targets: &'a Targets,
    /// `[image]`: remainder of the image behind the whole field, shares of the strongest change; none where the background is unknown.
    left: Vec<Option<Vec<f32>>>,
}

impl Judge<'_> {
    /// Collects the evidence from the images of the whole field, `[image][pixel]`.
    pub(super) fn new<'a>(targets: &'a Targets, images: &[f32]) -> Judge<'a> {
        Judge { targets, left: remainders(targets, images) }
    }

    /// Tells whether all views that show a component support it: without its images `of_component`, `[image][pixel]`, their chi squared
    /// would be larger.
    pub(super) fn supports(&self, of_component: &[f32]) -> bool {
        let views: Vec<[f64; 2]> =
            (0..self.targets.n_views).map(|view| self.gain_and_energy(of_component, view)).collect();
        let strongest = views.iter().fold(0.0, |max: f64, [_, energy]| max.max(*energy));
        let voters = views.iter().filter(|[_, energy]| *energy > 0.0 && *energy >= VOTES * strongest);
        voters.map(|[gain, _]| *gain).fold(f64::INFINITY, f64::min) > LEAST_GAIN
    }

    /// Returns the reduction of a view's chi squared by a component, and the sum of the squares of its images there.
    fn gain_and_energy(&self, of_component: &[f32], view: usize) -> [f64; 2] {
        let targets = self.targets;
        let (mut gain, mut energy) = (0.0, 0.0);
        for image in targets.image_of.iter().skip(view).step_by(targets.n_views).flatten() {
            let Some(left) = &self.left[*image] else { continue };
            let begin = image * targets.n_pixels();
            for (pixel, left) in left.iter().enumerate() {
                let at = begin + pixel;
                let e = f64::from(targets.contrast[*image] * of_component[at]);
                if e == 0.0 || targets.weight[at] == 0.0 {
                    continue;
                }
                let variance = FIT_DEVIATION.powi(2) + f64::from(targets.noise[at]).powi(2);
                gain += (2.0 * f64::from(*left) * e + e * e) / variance;
                energy += e * e;
            }
        }
        [gain, energy]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::methods::dynamic_gaussians::test_targets::{PHASES, SIDE, targets};
    use crate::random::normal;

    const VIEWS: usize = 3;
    const NOISE: f32 = 0.2;
    const PIXELS: usize = SIDE * SIDE;

    /// Images of a component in each view: a spot that moves down over the phases.
    fn spot(amplitude: f32) -> Vec<f32> {
        let value = |i: usize| {
            let (phase, p) = (i / (VIEWS * PIXELS), i % PIXELS);
            let (x, y) = ((p % SIDE) as f32 - 20.0, (p / SIDE) as f32 - 12.0 - 2.0 * phase as f32);
            amplitude * (-0.5 * (x * x + y * y) / 0.6).exp()
        };
        (0..PHASES * VIEWS * PIXELS).map(value).collect()
    }

    /// Targets of noisy images above a background of 2, to which `shown` of the spot is added in each view.
    fn seen(shown: [f32; VIEWS]) -> Targets {
        let spot = spot(0.6);
        let value = |i: usize| {
            let noise = normal(5, 1, (i / PIXELS) as u32, (i % PIXELS) as u32) as f32;
            2.0 + NOISE * noise + shown[i / PIXELS % VIEWS] * spot[i]
        };
        let mut targets = targets(&(0..spot.len()).map(value).collect::<Vec<_>>(), VIEWS);
        targets.noise.fill(NOISE);
        targets
    }

    #[test]
    fn a_component_is_supported_by_all_views_that_show_it() {
        let field = spot(0.6);
        let supported = |targets: &Targets| Judge::new(targets, &field).supports(&field);
        assert!(supported(&seen([1.0; VIEWS])), "an end of a vessel");
        assert!(!supported(&seen([1.0, 1.0, 0.0])), "two views show it, and the third does not");
        assert!(!supported(&seen([0.0; VIEWS])), "noise");
        let mut covered = seen([1.0, 1.0, 0.0]);
        let of_third = |i: usize| i / PIXELS % VIEWS == 2;
        (0..field.len()).filter(|i| of_third(*i)).for_each(|i| covered.weight[i] = 0.0);
        assert!(supported(&covered), "a blade covers it in the third view");
    }

    #[test]
    fn long_components_are_vessels() {
        let setup = GaussianSetup { min_scale: 0.4, max_scale: 6.0, ..GaussianSetup::default() };
        let at = |x: f32, y: f32| Gaussian { position: [x, y, 0.0], ..Gaussian::default() };
        // Scales of 1: Gaussians are linked below a distance of 2.5.
        let mut rows: Vec<Gaussian> = (0..10).map(|i| at(2.0 * i as f32, 0.0)).collect();
        rows.extend([at(0.0, 9.0), at(2.0, 9.0), at(7.0, 9.0)]);
        let mut short = short_components(&rows, &setup, 1.0);
        short.iter_mut().for_each(|component| component.sort_unstable());
        short.sort_unstable();
        assert_eq!(short, [vec![10, 11], vec![12]]);
        assert_eq!(short_components(&rows, &setup, 3.0).len(), 3, "larger images");
    }
}
