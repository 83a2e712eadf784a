//! Probability that a place of the hull holds vessel, by which the first places of Gaussians are drawn.

use crate::config::sections::Rule;
use crate::gaussians::view::SplatView;
use crate::methods::dynamic_gaussians::targets::{PossibleVessel, Targets};
use glam::DVec3;

/// Evidence of four views (natural logarithm) at which half of the cells hold vessel, and the width over which that share rises. Chosen
/// on a procedural phantom and one real anatomy.
const LIKELY_EVIDENCE: f64 = 14.0;
const EVIDENCE_WIDTH: f64 = 1.5;
/// Natural log-odds against a place far from the vessels of a prior.
const FAR_LOG_ODDS: f64 = 8.0;

/// Coefficients of a logistic regression for places that two views see: log-odds per unit of evidence, per unit of the natural logarithm of
/// the least line integral, per unit of the share that the pixel in the middle has of it, and the constant. They were fitted to phases 0, 3
/// and 5 of two procedural trees, each in two pairs of views; places within 2 mm of a true centreline hold vessel.
const PER_EVIDENCE: f64 = 0.22;
const PER_LOG_INTEGRAL: f64 = 1.25;
const PER_CENTRALITY: f64 = 2.95;
const CONSTANT: f64 = -3.01;
/// Line integral below which a pixel shows no vessel, as a share of the strongest change.
const LEAST_INTEGRAL: f64 = 0.02;

/// Returns the probability that each place of a phase holds vessel.
///
/// With three views or more, it follows from the evidence alone. Two views have as much evidence for each crossing of their rays through
/// vessels, of which most are false. True places are more often those that both views show strongly and in the middle of a vessel: a
/// strong vessel hides false partners among its own, and two vessels that miss each other rarely meet in their middles.
pub(super) fn likelihoods(targets: &Targets, phase: usize) -> Vec<f64> {
    let views: Vec<(usize, &SplatView)> = targets.views_at(phase).collect();
    let of = |place: &PossibleVessel| {
        let log_odds = match views.len() {
            2 if targets.left_out.keeps(Rule::LikelihoodOfTwoViews) => log_odds_of_two(targets, &views, place),
            n => log_odds(place.evidence, n),
        };
        sigmoid(log_odds - FAR_LOG_ODDS * place.far_from_prior)
    };
    targets.places[phase].iter().map(of).collect()
}

/// Log-odds of a place by its evidence, as measured on phantoms.
fn log_odds(evidence: f64, n_views: usize) -> f64 {
    let likely = LIKELY_EVIDENCE / 4.0 * n_views.max(4) as f64;
    (evidence - likely) / EVIDENCE_WIDTH
}

/// Log-odds of a place that two views see.
fn log_odds_of_two(targets: &Targets, views: &[(usize, &SplatView)], place: &PossibleVessel) -> f64 {
    let seen = views.iter().map(|(image, view)| line_integral(targets, *image, view, place.position));
    let (integral, centrality) =
        seen.fold((f64::INFINITY, f64::INFINITY), |(a, b), (integral, share)| (a.min(integral), b.min(share)));
    PER_EVIDENCE * place.evidence + PER_LOG_INTEGRAL * integral.ln() + PER_CENTRALITY * centrality + CONSTANT
}

/// Returns the largest line integral of the pixels around a position, 3 x 3 of them in the size of the settings, as a share of the strongest
/// change, and the share that the pixel in the middle has of it.
fn line_integral(targets: &Targets, image: usize, view: &SplatView, position: DVec3) -> (f64, f64) {
    let (_, u, v) = view.project(position);
    let pixels = &targets.low[image * targets.n_pixels()..][..targets.n_pixels()];
    let at = |du: i64, dv: i64| {
        let (column, row) = (u.round() as i64 + du, v.round() as i64 + dv);
        let inside = (0..targets.width as i64).contains(&column) && (0..targets.height as i64).contains(&row);
        if inside { f64::from(pixels[row as usize * targets.width + column as usize]) } else { 0.0 }
    };
    let reach = targets.lengths.factor.round().max(1.0) as i64;
    let around = (-reach..=reach).flat_map(|dv| (-reach..=reach).map(move |du| (du, dv)));
    let largest = around.map(|(du, dv)| at(du, dv)).fold(LEAST_INTEGRAL, f64::max);
    (largest, (at(0, 0) / largest).clamp(0.0, 1.0))
}

fn sigmoid(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::methods::dynamic_gaussians::targets::test_targets::{PHASES, SIDE, targets};

    /// Targets whose views each show a bright and a faint vertical vessel, at columns 10 and 25.
    fn two_vessels(n_views: usize) -> Targets {
        let value = |i: usize| match i % SIDE {
            9..=11 if i % SIDE != 10 => 0.4,
            10 => 0.8,
            24..=26 if i % SIDE != 25 => 0.1,
            25 => 0.2,
            _ => 0.0,
        };
        let images: Vec<f32> = (0..n_views * PHASES * SIDE * SIDE).map(value).collect();
        let mut targets = targets(&images, n_views);
        targets.low = images;
        targets
    }

    /// Position on the ray of a column of the first view, in the plane of the isocentre.
    fn on_column(targets: &Targets, column: f64) -> DVec3 {
        let (_, view) = targets.views_at(0).next().unwrap();
        let (depth, ..) = view.project(DVec3::ZERO);
        view.source + view.ray(column, 20.0) * depth
    }

    fn with_places(mut targets: Targets, places: &[(f64, f64)]) -> Targets {
        let place = |(column, far_from_prior): &(f64, f64)| PossibleVessel {
            position: on_column(&targets, *column),
            evidence: 9.0,
            far_from_prior: *far_from_prior,
        };
        targets.places = vec![places.iter().map(place).collect(); PHASES];
        targets
    }

    #[test]
    fn line_integrals_are_those_of_the_vessel_around_a_pixel() {
        let targets = two_vessels(2);
        let views: Vec<_> = targets.views_at(0).collect();
        let at = |column| line_integral(&targets, views[0].0, views[0].1, on_column(&targets, column));
        for (column, expected) in
            [(10.0, (0.8, 1.0)), (11.0, (0.8, 0.5)), (25.0, (0.2, 1.0)), (2.0, (LEAST_INTEGRAL, 0.0))]
        {
            let got = at(column);
            assert!((got.0 - expected.0).abs() < 1e-6 && (got.1 - expected.1).abs() < 1e-6, "{column}: {got:?}");
        }
    }

    #[test]
    fn strong_middles_are_likelier_than_edges_and_faint_vessels() {
        let targets = with_places(two_vessels(2), &[(10.0, 0.0), (11.0, 0.0), (25.0, 0.0), (10.0, 1.0)]);
        let [middle, edge, faint, far] = likelihoods(&targets, 0)[..] else { panic!("four places") };
        assert!(middle > edge && middle > faint, "{middle} {edge} {faint}");
        assert!(far < 0.01 * middle, "far from the prior: {far}");
    }

    #[test]
    fn the_view_that_shows_a_place_less_counts() {
        let places = [(10.0, 0.0), (25.0, 0.0)];
        let alike = likelihoods(&with_places(two_vessels(2), &places), 0);
        let mut fainter = with_places(two_vessels(2), &places);
        let n = fainter.n_pixels();
        // The second view shows the bright vessel as the faint one.
        fainter
            .low
            .iter_mut()
            .enumerate()
            .filter(|(i, _)| i / n % 2 == 1 && (9..=11).contains(&(i % SIDE)))
            .for_each(|(_, v)| *v *= 0.25);
        let one_less = likelihoods(&fainter, 0);
        assert!((one_less[0] - alike[1]).abs() < 1e-6 && one_less[1] == alike[1], "{alike:?} {one_less:?}");
    }

    #[test]
    fn with_more_views_the_evidence_counts_alone() {
        let targets = with_places(two_vessels(3), &[(10.0, 0.0), (11.0, 0.0), (25.0, 0.0)]);
        let all = likelihoods(&targets, 0);
        assert!(all.iter().all(|p| *p == all[0]), "{all:?}");
        assert!((sigmoid(log_odds(LIKELY_EVIDENCE, 3)) - 0.5).abs() < 1e-12);
    }
}
