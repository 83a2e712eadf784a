//! Pruning of components of a deformable set that are no vessels: in noise, a fit explains with short ones what several views show by
//! chance, and with broad ones what moves behind the vessels where a blade hides it from a view.

use crate::gaussians::field::scales;
use crate::kernels::layout::{Gaussian, GaussianSetup};
use crate::methods::dynamic_gaussians::deformable::linked::{extent, groups};
use crate::methods::dynamic_gaussians::groups::breadth;
use crate::methods::dynamic_gaussians::remainder::remainders;
use crate::methods::dynamic_gaussians::targets::Targets;
use crate::raster::percentile;
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
/// Percentile of the breadths in the largest component that is taken as the breadth of the widest vessel.
const WIDEST_PERCENTILE: f64 = 0.9;
/// Factor on that breadth above which the median breadth of another component is not that of a branch, which is not wider than the trunk.
const BROADER_COMPONENT: f32 = 1.5;
/// Factor on that breadth above which a single Gaussian is not part of a vessel.
const BROADER_GAUSSIAN: f32 = 3.0;
/// Maximum share of a component's squared image that blades hide from a view that shows it.
const HIDDEN: f64 = 0.3;
/// Deviation of a good fit without noise, as a share of the strongest change.
const FIT_DEVIATION: f64 = 0.02;

/// Returns a set's components that are short.
pub(super) fn short_parts<'a>(components: &'a [Vec<usize>], rows: &[Gaussian], factor: f64) -> Vec<&'a Vec<usize>> {
    let is_short = |members: &&Vec<usize>| extent(members.iter().map(|i| position(&rows[*i]))) <= SHORT * factor;
    components.iter().filter(is_short).collect()
}

/// Returns what is broader than vessels in a set's components, as lists of indices of Gaussians: components whose median breadth exceeds
/// that of the widest vessel, and single Gaussians of all other components. The largest component is the tree of the vessels.
pub(super) fn broad_parts(components: &[Vec<usize>], rows: &[Gaussian], setup: &GaussianSetup) -> Vec<Vec<usize>> {
    let breadths: Vec<f32> = rows.iter().map(|g| breadth(g, setup)).collect();
    let breadth_at = |component: &[usize], share: f64| {
        percentile(&component.iter().map(|i| breadths[*i]).collect::<Vec<_>>(), share)
    };
    let Some(tree) = components.iter().max_by_key(|component| component.len()) else { return Vec::new() };
    let widest = breadth_at(tree, WIDEST_PERCENTILE);
    let is_broad = |component: &&Vec<usize>| breadth_at(component, 0.5) > BROADER_COMPONENT * widest;
    let (broad, others): (Vec<_>, Vec<_>) = components.iter().partition(is_broad);
    let single = others.into_iter().flatten().filter(|i| breadths[**i] > BROADER_GAUSSIAN * widest);
    broad.into_iter().cloned().chain(single.map(|i| vec![*i])).collect()
}

fn position(g: &Gaussian) -> DVec3 {
    DVec3::from_array(g.position.map(f64::from))
}

/// Returns the components of a set, as indices of its Gaussians: those whose distances are below [`LINK_SCALES`] times their mean longest
/// scale, directly or through others.
pub(super) fn components(rows: &[Gaussian], setup: &GaussianSetup) -> Vec<Vec<usize>> {
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
        self.votes(of_component).into_iter().fold(f64::INFINITY, f64::min) > LEAST_GAIN
    }

    /// Tells whether all views whose background is known show a component, which images `of_component` are of: none has a blade or an edge
    /// before it.
    pub(super) fn is_shown_by_all(&self, of_component: &[f32]) -> bool {
        let traces = self.traces(of_component);
        let strongest = strongest(&traces);
        traces.iter().all(|trace| trace.votes(strongest) && trace.hidden <= HIDDEN * (trace.shown + trace.hidden))
    }

    /// Returns the gain in each view that shows a component.
    fn votes(&self, of_component: &[f32]) -> Vec<f64> {
        let traces = self.traces(of_component);
        let strongest = strongest(&traces);
        traces.iter().filter(|trace| trace.votes(strongest)).map(|trace| trace.gain).collect()
    }

    /// Returns the traces in the views whose background is known.
    fn traces(&self, of_component: &[f32]) -> Vec<Trace> {
        (0..self.targets.n_views).filter_map(|view| self.trace(of_component, view)).collect()
    }

    fn trace(&self, of_component: &[f32], view: usize) -> Option<Trace> {
        let targets = self.targets;
        let mut found = None;
        for image in targets.image_of.iter().skip(view).step_by(targets.n_views).flatten() {
            let Some(left) = &self.left[*image] else { continue };
            let trace = found.get_or_insert_with(Trace::default);
            let begin = image * targets.n_pixels();
            for (pixel, left) in left.iter().enumerate() {
                let at = begin + pixel;
                let e = f64::from(targets.contrast[*image] * of_component[at]);
                if e == 0.0 {
                    continue;
                }
                if targets.weight[at] == 0.0 {
                    trace.hidden += e * e;
                    continue;
                }
                let variance = FIT_DEVIATION.powi(2) + f64::from(targets.noise[at]).powi(2);
                trace.gain += (2.0 * f64::from(*left) * e + e * e) / variance;
                trace.shown += e * e;
            }
        }
        found
    }
}

/// Trace of a component in the images of a view.
#[derive(Default)]
struct Trace {
    /// Reduction of chi squared by the component.
    gain: f64,
    /// Sum of the squares of its images where the view shows the patient.
    shown: f64,
    /// Sum of the squares of its images behind blades.
    hidden: f64,
}

impl Trace {
    fn votes(&self, strongest: f64) -> bool {
        self.shown > 0.0 && self.shown >= VOTES * strongest
    }
}

/// Returns the largest sum of squares that a view shows.
fn strongest(traces: &[Trace]) -> f64 {
    traces.iter().fold(0.0, |max: f64, trace| max.max(trace.shown))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::methods::dynamic_gaussians::targets::test_targets::{PHASES, SIDE, targets};
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
    fn a_component_behind_a_blade_is_not_shown_by_all() {
        let field = spot(0.6);
        let shown = |targets: &Targets| Judge::new(targets, &field).is_shown_by_all(&field);
        assert!(shown(&seen([1.0; VIEWS])), "no blade");
        assert!(shown(&seen([1.0, 1.0, 0.0])), "whether a view supports a component is another question");
        let behind = |is_hidden: &dyn Fn(usize, usize) -> bool| {
            let mut covered = seen([1.0; VIEWS]);
            let in_view = |i: usize| i / PIXELS % VIEWS == 1 && is_hidden(i % SIDE, i / PIXELS / VIEWS);
            (0..field.len()).filter(|i| in_view(*i)).for_each(|i| covered.weight[i] = 0.0);
            covered
        };
        assert!(!shown(&behind(&|_, _| true)), "a blade before all of it in one view");
        assert!(!shown(&behind(&|column, _| column <= 20)), "a blade before more than half of it");
        assert!(!shown(&behind(&|_, phase| phase < PHASES / 2)), "hidden at half the phases");
        assert!(shown(&behind(&|column, _| column < 20)), "a blade before the smaller part of it");
        let targets = seen([1.0; VIEWS]);
        let mut judge = Judge::new(&targets, &field);
        (0..PHASES).for_each(|phase| judge.left[phase * VIEWS + 1] = None);
        assert!(judge.is_shown_by_all(&field), "a view without a known background hides nothing");
    }

    #[test]
    fn broad_components_are_no_branches() {
        let setup = GaussianSetup { min_scale: 0.4, max_scale: 6.0, ..GaussianSetup::default() };
        let of = |x: f32, y: f32, scales: [f32; 3]| Gaussian {
            position: [x, y, 0.0],
            log_scale: scales.map(f32::ln),
            ..Gaussian::default()
        };
        let thin = |x: f32, y: f32| of(x, y, [2.0, 0.5, 0.5]);
        let broad = |rows: &[Gaussian]| {
            let mut broad = broad_parts(&components(rows, &setup), rows, &setup);
            broad.iter_mut().for_each(|component| component.sort_unstable());
            broad.sort_unstable();
            broad
        };
        let tree: Vec<Gaussian> = (0..20).map(|i| thin(2.0 * i as f32, 0.0)).collect();
        let with = |others: &[Gaussian]| [&tree[..], others].concat();
        assert!(broad(&tree).is_empty());
        assert!(broad(&with(&[thin(0.0, 30.0), of(2.0, 30.0, [3.0, 0.7, 0.7])])).is_empty(), "a branch apart");
        let haze = [of(0.0, 30.0, [1.0; 3]), of(1.0, 30.0, [2.0, 1.0, 0.5])];
        assert_eq!(broad(&with(&haze)), [vec![20, 21]], "a haze apart");
        let disc = of(10.0, 1.0, [3.0, 2.5, 0.5]);
        assert_eq!(broad(&with(&[disc])), [vec![20]], "a disc at the tree");
        assert_eq!(broad(&with(&[thin(0.0, 30.0), thin(2.0, 30.0), of(3.0, 30.0, [3.0, 2.5, 0.5])])), [vec![22]]);
        assert!(broad(&with(&[of(10.0, 1.0, [1.4; 3])])).is_empty(), "a widening of the tree");
        let wide: Vec<Gaussian> = (0..20).map(|i| of(2.0 * i as f32, 0.0, [3.0; 3])).collect();
        assert!(broad(&wide).is_empty(), "a wide vessel");
        assert!(broad(&[]).is_empty());
    }

    #[test]
    fn long_components_are_vessels() {
        let setup = GaussianSetup { min_scale: 0.4, max_scale: 6.0, ..GaussianSetup::default() };
        let at = |x: f32, y: f32| Gaussian { position: [x, y, 0.0], ..Gaussian::default() };
        // Scales of 1: Gaussians are linked below a distance of 2.5.
        let mut rows: Vec<Gaussian> = (0..10).map(|i| at(2.0 * i as f32, 0.0)).collect();
        rows.extend([at(0.0, 9.0), at(2.0, 9.0), at(7.0, 9.0)]);
        let mut components = components(&rows, &setup);
        components.iter_mut().for_each(|component| component.sort_unstable());
        components.sort_unstable();
        assert_eq!(short_parts(&components, &rows, 1.0), [&vec![10, 11], &vec![12]]);
        assert_eq!(short_parts(&components, &rows, 3.0).len(), 3, "larger images");
    }
}
