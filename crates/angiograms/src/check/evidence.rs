//! Evidence of each view about the agreement of the views, and what is missing of it.

use crate::calibrate::MIN_CHANGE;
use crate::calibrate::observed::Observed;
use crate::calibrate::profiles::{Pair, Views};
use crate::check::agreement::variation;
use crate::scan::dataset::Dataset;

/// Number of phases from which vessels can be told from wide structures that move, such as the heart.
const MIN_PHASES: usize = 4;
/// Noise, as a share of the strongest change, above which the change is noise.
const ONLY_NOISE: f64 = 0.5;

/// Share of the squares of a pair's profiles that must vary over the phases: approximations of the comparison leave less.
const MIN_VARIATION: f64 = 0.01;

/// Evidence of a view.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Evidence {
    /// Enough to judge whether it agrees with another view.
    Enough,
    /// Too few phases: what moves may be a heart or a diaphragm, which is removed from views with more phases.
    FewPhases,
    /// Nothing stands out of the noise.
    OnlyNoise,
    /// Nothing changes over the beat.
    Blank,
}

impl Evidence {
    /// Returns the evidence of each observed view.
    pub(super) fn of(observed: &Observed) -> Vec<Evidence> {
        let of_view = |slot: usize| match (observed.changes[slot], observed.noise[slot]) {
            (change, _) if change < MIN_CHANGE => Evidence::Blank,
            (_, noise) if noise > ONLY_NOISE => Evidence::OnlyNoise,
            _ if observed.phases_of(slot) < MIN_PHASES => Evidence::FewPhases,
            _ => Evidence::Enough,
        };
        (0..observed.views.len()).map(of_view).collect()
    }
}

/// The pairs of views by which the agreement is judged.
#[derive(Debug, Clone)]
pub(super) struct Judged {
    /// Evidence of each observed view.
    evidence: Vec<Evidence>,
    /// Pairs whose profiles hardly vary over the phases.
    still: Vec<[usize; 2]>,
}

impl Judged {
    pub(super) fn new(observed: &Observed) -> Judged {
        let hardly = |pair: &&Pair| variation(&observed.fine, **pair) < MIN_VARIATION;
        let still = observed.fine.pairs.iter().filter(hardly).map(|pair| pair.views).collect();
        Judged { evidence: Evidence::of(observed), still }
    }

    /// Tells whether a pair is judged: from both views the motion of wide structures is removed, or from neither.
    pub(super) fn takes(&self, pair: &Pair) -> bool {
        let [a, b] = pair.views.map(|view| self.evidence[view]);
        a == b && matches!(a, Evidence::Enough | Evidence::FewPhases) && !self.still.contains(&pair.views)
    }

    /// Returns views with the judged pairs only.
    pub(super) fn only(&self, mut views: Views) -> Views {
        views.pairs.retain(|pair| self.takes(pair));
        views
    }

    /// Indices into [`Dataset::views`] of the views in which nothing changes.
    pub(super) fn blank(&self, observed: &Observed) -> Vec<usize> {
        let slots = (0..self.evidence.len()).filter(|slot| self.evidence[*slot] == Evidence::Blank);
        slots.map(|slot| observed.views[slot]).collect()
    }

    /// Says of each view which evidence is missing.
    pub(super) fn missing(&self, dataset: &Dataset, observed: &Observed) -> Vec<String> {
        let pairs_of = |slot: usize| observed.fine.pairs.iter().filter(move |pair| pair.views.contains(&slot));
        let paired = |slot: usize| pairs_of(slot).next().is_some();
        let mixed = |slot: usize| {
            paired(slot)
                && !pairs_of(slot).any(|pair| pair.views.iter().all(|v| self.evidence[*v] == Evidence::FewPhases))
        };
        let of_view = |slot: usize| {
            let (view, phases, of) = (observed.views[slot], observed.phases_of(slot), observed.n_phases());
            match self.evidence[slot] {
                Evidence::Blank => {
                    Some(format!("view {view}: nothing changes over the beat: all its training images are alike"))
                }
                Evidence::OnlyNoise => Some(format!("view {view}: nothing that moves stands out of its noise")),
                Evidence::FewPhases if mixed(slot) => Some(format!(
                    "view {view}: {phases} of {of} phases are too few to tell its vessels from a moving heart or diaphragm, so \
                     a difference from other views is no evidence that it shows another object"
                )),
                _ if !paired(slot) => Some(format!(
                    "view {view}: it looks along the same line as every other view, so they have no planes in common that \
                     can be compared"
                )),
                _ => None,
            }
        };
        let mut missing: Vec<String> = (0..observed.views.len()).filter_map(of_view).collect();
        let alike = |pair: &&[usize; 2]| {
            let [a, b] = pair.map(|slot| self.evidence[slot]);
            a == b && matches!(a, Evidence::Enough | Evidence::FewPhases)
        };
        for pair in self.still.iter().filter(alike) {
            let [a, b] = pair.map(|slot| observed.views[slot]);
            missing.push(format!(
                "views {a} and {b}: what moves stays within the planes through both sources, so these two views cannot be compared"
            ));
        }
        let single: Vec<usize> =
            dataset.training_views().into_iter().filter(|view| !observed.views.contains(view)).collect();
        match single[..] {
            [] => (),
            [view] => {
                missing.push(format!("view {view}: it has a single phase, so nothing is known of what moves in it"))
            }
            _ => missing.push(format!(
                "{} views have a single phase each, so nothing is known of what moves in them (views {single:?})",
                single.len()
            )),
        }
        missing
    }
}
