//! Checks a dataset before training: whether its views show one object, and if not, which of the usual mistakes explains
//! it.
//!
//! Views are compared by their changes over the beat ([`mod@agreement`]), which needs neither labels nor a reconstruction.
//! When they disagree, each of the usual [`mistakes`] is undone in turn, and those after whose correction the views agree
//! are named. No set of views can distinguish a patient from the mirrored patient. A view accuses others only where its images
//! say enough; what they cannot say is reported as missing evidence (`check/evidence.rs`).

pub mod agreement;
mod evidence;
pub mod mistakes;
mod polarity;

use crate::calibrate::choose::{Correction, Tags, fit};
use crate::calibrate::observed::Observed;
use crate::calibrate::pose::Poses;
use crate::calibrate::profiles::{Planes, Views};
use crate::calibrate::silhouettes;
use crate::error::{Error, Result};
use crate::evidence::noise::NOISY;
use crate::scan::dataset::Dataset;
use agreement::{Agreement, Comparison, Sharpness, agreement};
use evidence::Judged;
use mistakes::{MISTAKES, Mistake, PhaseMistake, exchanged};
use serde::Serialize;

// The first four numbers: with them, ten data sets with small errors and noise raise no alarm, and thirteen planted mistakes are named.
/// Maximum disagreement of the views without the mistake, as a share of the disagreement with it.
const CLEARLY_BETTER: f64 = 0.6;
/// Maximum disagreement of views that show the same object, as stated at the coarse look, and without a mistake.
const AGREES: f64 = 0.3;
/// Explanations whose residual is at most this many times that of the best are named, too.
const AS_GOOD: f64 = 1.25;
/// Minimum share of a view's vessel pixels that the other views explain where all are said to show the same object: exact views without
/// noise explain .97 to .99.
const SAME_OBJECT: f64 = 0.9;
/// Maximum number of views for which that share is expected: all others must explain a pixel, and 18 exact ones explain .85.
const FEW_VIEWS: usize = 4;
/// Minimum number of views among which two exchanged ones are looked for: two views alone agree about as well when they are exchanged.
const MIN_VIEWS_OF_EXCHANGE: usize = 3;
/// Share of a view's changes next to its edges above which vessels are likely to be cut off.
const CUT_OFF: f64 = 0.05;
/// Angle between two views, degrees, below which their common depth is hardly determined.
const NARROW_DEG: f64 = 30.0;

/// Outcome of a check.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Verdict {
    /// The views show the same object.
    Agree,
    /// The views would agree, or show vessels as they should, without one of the usual mistakes.
    Mistake,
    /// The views do not show the same object, and none of the usual mistakes explains it.
    Disagree,
    /// Nothing changes over the beat in at least one view.
    Blank,
    /// The evidence is too little to tell whether the views show the same object.
    Unknown,
}

/// Result for one view.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CheckedView {
    /// Index into [`Dataset::views`].
    pub view: usize,
    /// Primary and secondary angle, degrees, where stated.
    pub angles_deg: Option<(f64, f64)>,
    /// Number of its phases.
    pub phases: usize,
    /// Noise of a pixel, as a share of the strongest change; `None` where nothing changes over the beat.
    pub noise: Option<f64>,
    /// Root mean square, over the phases, of the wide motion other than that of vessels, as a share of the strongest change
    /// of narrow structures; `None` where there is none.
    pub wide_motion: Option<f64>,
    /// Share of all change that is next to the edges of the image.
    pub at_edges: f64,
}

/// Result for a dataset.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Check {
    /// Outcome.
    pub verdict: Verdict,
    /// Training views with at least two phases.
    pub views: Vec<CheckedView>,
    /// Agreement of the views; `None` where no two of them can be compared.
    pub agreement: Option<Agreement>,
    /// Share of the vessel pixels of a view for which all other views show a vessel on the ray, and the share by chance, with the
    /// vessels of the view displaced by a seventh of the image.
    pub explained: [f64; 2],
    /// Advice on the mistakes that explain a disagreement, likeliest first: one of them was made. Empty when the data are
    /// sound, or wrong in a way that is not among the usual ones.
    pub mistakes: Vec<String>,
    /// Evidence that is missing, by view.
    pub missing: Vec<String>,
    /// Further points to look at.
    pub warnings: Vec<String>,
}

impl Check {
    /// Tells whether the views agree and no mistake was found.
    pub fn sound(&self) -> bool {
        self.verdict == Verdict::Agree
    }

    /// Tells whether something is wrong with the data; missing evidence is no fault.
    pub fn faulty(&self) -> bool {
        !matches!(self.verdict, Verdict::Agree | Verdict::Unknown)
    }

    /// Describes the outcome in a sentence without a capital letter and a full stop.
    pub fn conclusion(&self) -> String {
        match (self.verdict, self.mistakes.first()) {
            (Verdict::Mistake, Some(mistake)) => {
                format!("the views agree once one mistake is corrected: {mistake}")
            }
            (Verdict::Agree, _) if self.explained[0] < SAME_OBJECT && self.views.len() <= FEW_VIEWS => format!(
                "the views agree on what moves, but all other views show a vessel for only {:.0} % of a view's vessel pixels ({:.0} % of \
                 them are expected): geometry or phases may be off, or there may be little to see",
                100.0 * self.explained[0],
                100.0 * SAME_OBJECT
            ),
            (Verdict::Agree, _) => "the views show the same object".into(),
            (Verdict::Blank, _) => "nothing changes over the beat in a view".into(),
            (Verdict::Unknown, _) => "the evidence is too little to tell whether the views show the same object".into(),
            (Verdict::Disagree | Verdict::Mistake, _) => "the views do not show the same object".into(),
        }
    }

    /// Describes how much the views agree, and how much they would by chance; `None` where they cannot be compared.
    pub fn in_numbers(&self) -> Option<String> {
        let agreement = self.agreement.as_ref()?;
        let [explained, by_chance] = self.explained.map(|share| 100.0 * share);
        Some(format!(
            "{:.0} % of the moving contrast differs between two views (0 for the same object, 100 for unrelated images); all \
             other views show a vessel for {explained:.0} % of a view's vessel pixels, and for {by_chance:.0} % by chance, with \
             the vessels of the view displaced",
            100.0 * agreement.coarse
        ))
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
    Ok(checked(dataset, &observed, true))
}

/// Compares the views of a dataset without looking for the mistakes that explain a disagreement, which takes much longer; only
/// whether the logarithm is missing or was taken twice is looked for. Returns `None` when fewer than two training views have two
/// phases.
pub fn compare(dataset: &Dataset) -> Option<Check> {
    let observed = Observed::new(dataset);
    (observed.views.len() >= 2).then(|| checked(dataset, &observed, false))
}

fn checked(dataset: &Dataset, observed: &Observed, thoroughly: bool) -> Check {
    let judged = Judged::new(observed);
    let stated = agreement(&observed.fine, |pair| judged.takes(pair));
    let inverted = polarity::is_inverted(dataset);
    let mistakes = match &stated {
        Some(stated) if thoroughly || inverted => {
            named(stated, &explanations(dataset, observed, &judged, inverted), inverted, || {
                // Other positions of the views explain small differences as well as a mistake does.
                let poses = fit(observed, Correction::Static, Tags::Wrong, Planes::All);
                Comparison::at(&judged.only(observed.fine.clone()), &poses, Sharpness::Fine).residual()
            })
        }
        _ => Vec::new(),
    };
    let views: Vec<CheckedView> = (0..observed.views.len()).map(|slot| checked_view(dataset, observed, slot)).collect();
    let mut warnings = view_warnings(&views);
    warnings.extend(two_views(dataset, observed));
    let differ = stated.as_ref().is_some_and(|stated| stated.coarse > AGREES);
    let verdict = match &stated {
        _ if !judged.blank(observed).is_empty() => Verdict::Blank,
        _ if !mistakes.is_empty() => Verdict::Mistake,
        None => Verdict::Unknown,
        Some(_) if !differ => Verdict::Agree,
        Some(_) => Verdict::Disagree,
    };
    match &stated {
        None if observed.fine.pairs.is_empty() => warnings
            .push("no two views can be compared: all views look from the same side or from opposite sides".into()),
        Some(stated) if verdict == Verdict::Disagree => warnings.push(format!(
            "the views disagree ({:.0} % of the moving contrast differs between two views){}: compare geometry, phases and order \
             of the images with their source",
            100.0 * stated.coarse,
            if thoroughly { ", and none of the usual mistakes explains it" } else { "" }
        )),
        _ => (),
    }
    let poses = Poses::stated(observed.views.len(), observed.n_phases());
    let explained = [silhouettes::explained, silhouettes::explained_by_chance].map(|share| share(observed, &poses));
    let missing = judged.missing(dataset, observed);
    Check { verdict, views, agreement: stated, explained, mistakes, missing, warnings }
}

fn checked_view(dataset: &Dataset, observed: &Observed, slot: usize) -> CheckedView {
    CheckedView {
        view: observed.views[slot],
        angles_deg: dataset.views[observed.views[slot]].geometry.angles_deg(),
        phases: observed.phases_of(slot),
        noise: Some(observed.noise[slot]).filter(|noise| noise.is_finite()),
        wide_motion: observed.wide_motion[slot],
        at_edges: observed.at_border[slot],
    }
}

/// Returns a warning where only two views show what moves, with the angle between them.
fn two_views(dataset: &Dataset, observed: &Observed) -> Option<String> {
    let [a, b] = observed.views[..] else { return None };
    let between = dataset.views[a].rays.axis().angle_between(dataset.views[b].rays.axis()).to_degrees();
    let apart = between.min(180.0 - between);
    let narrow = if apart < NARROW_DEG {
        "At so small an angle, depth is hardly determined at all; two views should be 60 to 90 degrees apart"
    } else {
        "A third view resolves most of it"
    };
    Some(format!(
        "only two views show what moves, {a} and {b}, {apart:.0} degrees apart. Depth is ambiguous: wherever vessels of both views \
         lie in one plane through both sources, each may belong to each, so branches that do not exist and gaps in those that do \
         are to be expected, which fit both views as well as the truth. {narrow}"
    ))
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
        if let Some(noise) = v.noise.filter(|noise| *noise >= f64::from(NOISY)) {
            let share = 100.0 * noise;
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

/// Mistakes that make vessels brighten instead of darken.
const INVERTING: [Mistake; 2] = [Mistake::LogTwice, Mistake::LogMissing];

fn explanations(dataset: &Dataset, observed: &Observed, judged: &Judged, inverted: bool) -> Vec<Explanation> {
    let mut all = Vec::new();
    let mut consider = |advice: String, views: Views| {
        let views = judged.only(views);
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
    let judged = judged.only(observed.fine.clone());
    let stated = Comparison::of(&judged, Sharpness::Fine);
    let suspects = stated.suspects(&judged, AGREES);
    let is_determined = observed.views.len() >= MIN_VIEWS_OF_EXCHANGE;
    let pairs = suspects.iter().enumerate().flat_map(|(k, b)| suspects[..k].iter().map(|a| [*a, *b]));
    all.extend(pairs.filter(|_| is_determined).filter_map(|pair| {
        let views = exchanged(dataset, observed, &judged, pair)?;
        let [a, b] = pair.map(|slot| observed.views[slot]);
        let fine = stated.after_change(&views, &pair).residual();
        let advice = format!("views {a} and {b} are exchanged: each view has the images of the other");
        Some(Explanation { advice, views, fine })
    }));
    all.extend(PhaseMistake::all(observed.views.len(), observed.fine.n_phases).map(|mistake| {
        let views = mistake.undone(&judged);
        let fine = stated.after_change(&views, &[mistake.view]).residual();
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
/// vessels brighten, the best explanation is named even if the views agree as stated. `elsewhere` returns the residual with the views at
/// other positions.
fn named(stated: &Agreement, explanations: &[Explanation], inverted: bool, elsewhere: impl Fn() -> f64) -> Vec<String> {
    let fine: Vec<f64> = explanations.iter().map(|e| e.fine).collect();
    let mut by_fine = best_of(explanations, &fine, if inverted { f64::INFINITY } else { stated.fine });
    if !by_fine.is_empty() && !inverted {
        by_fine = best_of(explanations, &fine, stated.fine.min(elsewhere()));
    }
    if !by_fine.is_empty() || stated.coarse <= AGREES {
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
