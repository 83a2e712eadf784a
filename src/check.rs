//! Checks a dataset before training: whether its views show one object, and if not, which of the usual mistakes explains
//! it.
//!
//! Views are compared by their changes over the beat ([`mod@agreement`]), which needs neither labels nor a reconstruction.
//! When they disagree, each of the usual [`mistakes`] is undone in turn, and those after whose correction the views agree
//! are named. No set of views can distinguish a patient from the mirrored patient.

pub mod agreement;
pub mod mistakes;

use crate::calibrate::observed::Observed;
use crate::calibrate::profiles::Views;
use crate::error::{Error, Result};
use crate::evidence::background::Background;
use crate::evidence::series::Series;
use crate::scan::dataset::Dataset;
use agreement::{Agreement, Comparison, Sharpness, agreement};
use mistakes::{MISTAKES, Mistake, PhaseMistake, exchanged};
use serde::Serialize;

/// Maximum disagreement of the views without the mistake, as a share of the disagreement with it.
const CLEARLY_BETTER: f64 = 0.6;
/// Maximum disagreement without the mistake: half the disagreement of unrelated views.
const AGREES: f64 = 0.3;
/// Explanations whose residual is at most this many times that of the best are named, too.
const AS_GOOD: f64 = 1.25;
/// Views whose disagreement at the coarse look exceeds this show different objects.
const DISAGREES: f64 = 0.3;
/// Share of a view's changes next to its edges above which vessels are likely to be cut off.
const CUT_OFF: f64 = 0.05;
/// Noise, as a share of the strongest change, above which thin vessels are lost.
const NOISY: f64 = 0.2;

/// Result for one view.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CheckedView {
    /// Index into [`Dataset::views`].
    pub view: usize,
    /// Primary and secondary angle, degrees, where stated.
    pub angles_deg: Option<(f64, f64)>,
    /// Number of its phases.
    pub phases: usize,
    /// Noise of a pixel, as a share of the strongest change.
    pub noise: f64,
    /// Root mean square, over the phases, of the wide motion other than that of vessels, as a share of the strongest change
    /// of narrow structures; `None` where there is none.
    pub wide_motion: Option<f64>,
    /// Share of all change that is next to the edges of the image.
    pub at_edges: f64,
}

/// Result for a dataset.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Check {
    /// Training views with at least two phases.
    pub views: Vec<CheckedView>,
    /// Agreement of the views; `None` where no two of them can be compared.
    pub agreement: Option<Agreement>,
    /// Advice on the mistakes that explain a disagreement, likeliest first: one of them was made. Empty when the data are
    /// sound, or wrong in a way that is not among the usual ones.
    pub mistakes: Vec<String>,
    /// Further points to look at.
    pub warnings: Vec<String>,
}

impl Check {
    /// Tells whether the views agree and no mistake was found.
    pub fn sound(&self) -> bool {
        self.mistakes.is_empty() && self.agreement.as_ref().is_some_and(|a| a.coarse <= DISAGREES)
    }
}

/// A mistake, and the views without it.
struct Explanation {
    advice: String,
    views: Views,
    /// Residual of the fine look.
    fine: f64,
}

/// Checks a dataset.
///
/// # Errors
/// [`Error::Config`] when fewer than two training views have two phases, since motion is then unknown.
pub fn check(dataset: &Dataset) -> Result<Check> {
    let observed = Observed::new(dataset);
    if observed.views.len() < 2 {
        let problem = format!(
            "{} of its training views show two phases: at least two such views are needed to compare the motion in \
             them",
            observed.views.len()
        );
        return Err(Error::config("dataset", dataset.path.display(), problem));
    }
    let (series, stated) = (Series::of(dataset), agreement(&observed.fine));
    let views: Vec<CheckedView> =
        (0..observed.views.len()).map(|v| checked_view(dataset, &observed, v, &series[v])).collect();
    let mistakes = stated.as_ref().map_or(Vec::new(), |stated| {
        let inverted = darkens(&observed.fine) < 0.0;
        named(stated, &explanations(dataset, &observed, inverted), inverted)
    });
    let mut warnings = view_warnings(&views);
    match &stated {
        None => warnings
            .push("no two views can be compared: all views look from the same side or from opposite sides".into()),
        Some(stated) if mistakes.is_empty() && stated.coarse > DISAGREES => warnings.push(format!(
            "the views disagree ({:.0} % of the moving contrast differs between two views), and none of the usual \
             mistakes explains it: compare geometry, phases and order of the images with their source",
            100.0 * stated.coarse
        )),
        _ => (),
    }
    Ok(Check { views, agreement: stated, mistakes, warnings })
}

fn checked_view(dataset: &Dataset, observed: &Observed, v: usize, series: &Series) -> CheckedView {
    let background = Background::new(series);
    CheckedView {
        view: observed.views[v],
        angles_deg: dataset.views[observed.views[v]].geometry.angles_deg(),
        phases: series.seen().count(),
        noise: median(&background.noise.values) / f64::from(background.strongest).max(f64::MIN_POSITIVE),
        wide_motion: background.drift.size().map(f64::from),
        at_edges: observed.at_border[v],
    }
}

fn median(values: &[f32]) -> f64 {
    f64::from(crate::raster::percentile(values, 0.5))
}

fn view_warnings(views: &[CheckedView]) -> Vec<String> {
    let mut warnings = Vec::new();
    for v in views {
        if v.at_edges > CUT_OFF {
            let share = 100.0 * v.at_edges;
            warnings.push(format!(
                "view {}: {share:.0} % of the moving pixels are at the edge of the image, so vessels are cut off",
                v.view
            ));
        }
        if v.noise > NOISY {
            let share = 100.0 * v.noise;
            warnings.push(format!(
                "view {}: the noise is {share:.0} % of the strongest vessel, so thin vessels will be lost",
                v.view
            ));
        }
    }
    let (min, max) = (views.iter().map(|v| v.phases).min(), views.iter().map(|v| v.phases).max());
    if min != max {
        warnings.push(
            "the views have different numbers of phases, so some phases are reconstructed from fewer views".into(),
        );
    }
    warnings
}

/// Third moment of the changes over time. It is positive, since vessels darken few pixels strongly at a time.
fn darkens(views: &Views) -> f64 {
    let mut moment = 0.0;
    for view in &views.views {
        let seen: Vec<&Vec<f32>> = view.phases.iter().flatten().collect();
        for pixel in 0..view.pixels.len() {
            let mean = seen.iter().map(|p| f64::from(p[pixel])).sum::<f64>() / seen.len() as f64;
            moment += seen.iter().map(|p| (f64::from(p[pixel]) - mean).powi(3)).sum::<f64>();
        }
    }
    moment
}

/// Mistakes that make vessels brighten instead of darken.
const INVERTING: [Mistake; 2] = [Mistake::LogTwice, Mistake::LogMissing];

fn explanations(dataset: &Dataset, observed: &Observed, inverted: bool) -> Vec<Explanation> {
    let mut all = Vec::new();
    let mut consider = |advice: String, views: Views| {
        if !views.pairs.is_empty() {
            let fine = Comparison::of(&views, Sharpness::Fine).residual();
            all.push(Explanation { advice, views, fine });
        }
    };
    for mistake in MISTAKES.into_iter().filter(|m| inverted == INVERTING.contains(m)) {
        if let Some(undone) = mistake.undone(dataset) {
            consider(mistake.advice().into(), Observed::new(&undone).fine);
        }
    }
    if inverted {
        return all;
    }
    for b in 0..observed.views.len() {
        for pair in (0..b).map(|a| [observed.views[a], observed.views[b]]) {
            let advice =
                format!("views {} and {} are exchanged: each view has the images of the other", pair[0], pair[1]);
            if let Some(undone) = exchanged(dataset, pair) {
                consider(advice, Observed::new(&undone).fine);
            }
        }
    }
    let stated = Comparison::of(&observed.fine, Sharpness::Fine);
    all.extend(PhaseMistake::all(observed.views.len(), observed.fine.n_phases).map(|mistake| {
        let views = mistake.undone(&observed.fine);
        let fine = stated.after_change(&views, mistake.view).residual();
        Explanation { advice: advice_on_phases(mistake, observed.views[mistake.view]), views, fine }
    }));
    all
}

fn advice_on_phases(mistake: PhaseMistake, view: usize) -> String {
    if mistake.reversed {
        return format!("the phases of view {view} are in reverse order");
    }
    format!("view {view} is late by {} phases: subtract this number from its phases, cyclically", mistake.late)
}

/// Advice on the explanations of a disagreement, best first, by the coarse look where the fine one finds none. Where
/// vessels brighten, the best explanation is named even if the views agree as stated.
fn named(stated: &Agreement, explanations: &[Explanation], inverted: bool) -> Vec<String> {
    let fine: Vec<f64> = explanations.iter().map(|e| e.fine).collect();
    let by_fine = best_of(explanations, &fine, if inverted { f64::INFINITY } else { stated.fine });
    if !by_fine.is_empty() || stated.coarse <= DISAGREES {
        return by_fine;
    }
    let coarse: Vec<f64> =
        explanations.iter().map(|e| Comparison::of(&e.views, Sharpness::Coarse).residual()).collect();
    best_of(explanations, &coarse, stated.coarse)
}

/// Advice on the explanations with the minimum residuals, if these are clearly smaller than the stated one.
fn best_of(explanations: &[Explanation], residuals: &[f64], stated: f64) -> Vec<String> {
    let mut order: Vec<usize> = (0..residuals.len()).collect();
    order.sort_by(|a, b| residuals[*a].total_cmp(&residuals[*b]));
    let Some(best) = order.first().map(|i| residuals[*i]) else { return Vec::new() };
    if best >= CLEARLY_BETTER * stated || best >= AGREES {
        return Vec::new();
    }
    let as_good = order.into_iter().take_while(|i| residuals[*i] <= AS_GOOD * best);
    as_good.map(|i| explanations[i].advice.clone()).collect()
}
