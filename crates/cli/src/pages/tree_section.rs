//! The vessel tree on a run's page: lines over the angiograms it was reconstructed from, with lengths and diameters of its
//! branches. It is the only part of the page that needs a script, which is embedded.

use crate::pages::lesion_section;
use crate::viewer::view_server::TREES_SCRIPT;
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use maud::{Markup, PreEscaped, html};
use nertca_vk::error::{Error, Result};
use nertca_vk::formats::png;
use nertca_vk::scan::dataset::{Dataset, Frame};
use nertca_vk::scan::gating::SYSTOLE_SHARE;
use nertca_vk_vessels::score::pictures::Window;
use nertca_vk_vessels::trees::files::{note, to_json};
use nertca_vk_vessels::trees::tree::{
    BeatTree, CONFIDENCE, DOUBTFUL, EXISTS_WITHIN_MM, PhaseTree, RadiiFrom, TreeView,
};
use serde_json::{Value, json};

const SCRIPT: &str = include_str!("report_trees.js");
/// Maximum number of embedded angiograms.
const MAX_PICTURES: usize = 120;
const STYLE: &str = "
#tree-views svg{width:100%;display:block}#tree-views image{image-rendering:pixelated}
#tree-views polyline{fill:none;stroke-width:2px;vector-effect:non-scaling-stroke;stroke-linejoin:round;cursor:pointer}
#tree-views .chosen{stroke-width:5px}#tree-views .mark{fill:#fff;stroke:#000;vector-effect:non-scaling-stroke}
#tree-views .interval{fill:none;stroke:#fff;stroke-opacity:.7;stroke-width:1px;pointer-events:none}
#tree-views .lesion{fill:none;stroke:#ff0;stroke-width:2px;pointer-events:none}
#tree-views .level{fill:none;stroke-width:3px;pointer-events:none}
tr.chosen td{font-weight:600}td i{display:inline-block;width:.8rem;height:.8rem;margin-right:.4rem}";

/// Contents of the section about a tree.
pub struct TreeSection {
    /// Tree and angiograms, as JSON.
    data: String,
    note: &'static str,
    /// Names of the phases with tables, and their trees.
    tables: Vec<(&'static str, PhaseTree)>,
    /// Tree with the training views.
    beat: BeatTree,
}

impl TreeSection {
    /// Makes the section of a tree of all phases over the training views of a dataset, from which it was reconstructed.
    ///
    /// # Errors
    /// [`Error::Internal`] for values that JSON or a picture cannot represent.
    pub fn new(beat: &BeatTree, dataset: &Dataset) -> Result<TreeSection> {
        // Too many angiograms are thinned out evenly.
        let step = dataset.training().len().div_ceil(MAX_PICTURES).max(1);
        let views = dataset.training_views().into_iter().map(|view| view_data(dataset, view, step));
        let views = json!(views.collect::<Result<Vec<_>>>()?).to_string();
        let systole = (SYSTOLE_SHARE * f64::from(dataset.n_phases)).round() as u32;
        let names = [("End of diastole", 0), ("End of systole", systole)];
        let named = |(name, phase): (&'static str, u32)| {
            beat.phases.iter().find(|tree| tree.phase == phase).map(|tree| (name, tree.clone()))
        };
        let beat = BeatTree { views: TreeView::of(dataset), ..beat.clone() };
        Ok(TreeSection {
            data: format!(r#"{{"tree":{},"views":{views}}}"#, to_json(&beat)?),
            note: note(&beat),
            tables: names.into_iter().filter_map(named).collect(),
            beat,
        })
    }

    /// Returns the section for the page.
    pub fn markup(&self) -> Markup {
        html! {
            h2 { "Vessels as a tree" }
            p.lead { "Centrelines over the angiograms of the training views; " (self.note) ". " (radii_source(self.beat.radii_from)) }
            style { (PreEscaped(STYLE)) }
            noscript { p.warn { "A script of this page draws the lines, but scripts are switched off in this \
                                 browser." } }
            p {
                label for="tree-phase" { "Phase " span #tree-phase-text {} " " }
                input #tree-phase type="range" min="0" value="0" step="1";
                " " label { input #tree-lines type="checkbox" checked; " centrelines" }
                @if self.beat.phases.iter().flat_map(|tree| &tree.branches).all(|branch| !branch.doubt.is_empty()) {
                    " " label { input #tree-doubt type="checkbox"; " doubt" } " " span #tree-legend hidden {}
                }
            }
            p #tree-told role="status" {}
            div.by-view #tree-views {}
            div.by-view { @for (name, tree) in &self.tables { (table(&self.beat, name, tree)) } }
            // The data contain only numbers, angles and base64 images, so that nothing in them can close the element.
            script #tree-data type="application/json" { (PreEscaped(&self.data)) }
            script { (PreEscaped(TREES_SCRIPT)) (PreEscaped(SCRIPT)) }
        }
    }
}

/// Returns the data of a training view: its angiograms, and the projection of patient points in each.
fn view_data(dataset: &Dataset, view: usize, step: usize) -> Result<Value> {
    let mut frames: Vec<&Frame> = dataset.training().iter().filter(|frame| frame.view == view).collect();
    // Phases are rounded to a thousandth, so that captions are short.
    let phases = |frame: &Frame| (1e3 * frame.beat_time().phases(dataset.n_phases)).round() / 1e3;
    frames.sort_by(|a, b| phases(a).total_cmp(&phases(b)));
    let [width, height] = dataset.views[view].size;
    let own = |frame: &Frame| dataset.own(view, &frame.integrals).into_owned();
    let window = Window::of(&frames.iter().flat_map(|frame| own(frame)).collect::<Vec<_>>());
    let frame = |frame: &Frame| -> Result<Value> {
        let png = png::grey8(width, height, &window.codes(&own(frame)))?;
        Ok(json!({
            "phase": phases(frame),
            "projection": dataset.heart_rays(frame).projection(),
            "picture": format!("data:image/png;base64,{}", STANDARD.encode(png)),
        }))
    };
    let frames = frames.into_iter().step_by(step).map(frame).collect::<Result<Vec<_>>>()?;
    if frames.is_empty() {
        return Err(Error::Internal(format!("view {view} has no training frame")));
    }
    let angle = |value: f64, plus: &str, minus: &str| {
        format!("{} {:.0}°", if value >= 0.0 { plus } else { minus }, value.abs())
    };
    let angles = dataset.views[view].geometry.angles_deg().map_or(String::new(), |(primary, secondary)| {
        format!(", {} {}", angle(primary, "LAO", "RAO"), angle(secondary, "CRA", "CAU"))
    });
    Ok(json!({
        "title": format!("View {view}{angles}"),
        "width": width,
        "height": height,
        "frames": frames,
    }))
}

/// Returns the sentence about the source of the radii.
fn radii_source(radii_from: RadiiFrom) -> &'static str {
    match radii_from {
        RadiiFrom::Images => "Diameters are those that the angiograms show.",
        RadiiFrom::Field => {
            "Diameters are those of the dynamic field, which shows thin vessels and short stenoses blurred."
        }
    }
}

fn table(beat: &BeatTree, name: &str, tree: &PhaseTree) -> Markup {
    let is_mean = tree.doubtful_mm().is_some();
    let has_doubt = tree.branches.iter().all(|branch| !branch.doubt.is_empty());
    let has_gaps = tree.branches.iter().any(|branch| branch.gap_mm > 0.0);
    html! {
        div {
            h3 { (name) " (phase " (tree.phase) ")" }
            table {
                tr { th { "branch" } th { "parent" } th { "length, mm" } th { "mean diameter, mm" } th { "minimum, \
                                                                                                          mm" }
                    @if has_doubt { th { "known to, mm" } th { "exists, %" } }
                    @if is_mean { th { "other fits, %" } }
                    @if has_gaps { th { "gap, mm" } } }
                @for (index, branch) in tree.branches.iter().enumerate() {
                    tr data-branch=(index) data-phase=(tree.phase) {
                        td { i data-colour=(index) {} (index) }
                        td { @match branch.parent { Some(parent) => (parent), None => "-" } }
                        td { (format!("{:.1}", branch.length_mm())) }
                        td { (format!("{:.2}", branch.mean_diameter_mm())) }
                        td { (format!("{:.2}", branch.min_diameter_mm())) }
                        @if has_doubt {
                            td { (branch.median_doubt_mm().map_or("-".into(), |mm| format!("{mm:.2}"))) }
                            td { (branch.existence().map_or("-".into(), |share| format!("{:.0}", 100.0 * share))) }
                        }
                        @if is_mean { td { (branch.mean_agreement().map_or("-".into(), |share| format!("{:.0}", 100.0 * share))) } }
                        @if has_gaps { td { (if branch.gap_mm > 0.0 { format!("{:.1}", branch.gap_mm) } else { "-".into() }) } }
                    }
                }
                tr { td { "all" } td {} td { (format!("{:.1}", tree.length_mm())) } td {} td {} @if has_doubt { td {} td {} } @if is_mean { td {} } @if has_gaps { td {} } }
            }
            @if has_gaps {
                p { "\"Gap\" is the length of a branch over which the field shows no vessel: two vessels were linked there because one points at "
                    "the other, as on both sides of a severe stenosis." }
            }
            @if has_doubt {
                p { "\"Known to\" is the median, along the branch, of the half width of the interval that contains the true centreline with a "
                    "probability of " (format!("{:.0}", 100.0 * CONFIDENCE)) " %, in its least certain direction. \"Exists\" is the mean "
                    "probability that a true vessel is within " (EXISTS_WITHIN_MM) " mm." }
            }
            @if beat.views.len() == 2 {
                p { "How far points are known is not stated: two views are explained as well by vessels that exchange their depths where they "
                    "cross." }
            }
            (lesion_section::section(beat, tree))
            @if let Some(mm) = tree.doubtful_mm().filter(|mm| *mm > 0.0) {
                p { "The field is the mean of several fits. \"Other fits\" is the share of them that have a vessel there. Less than "
                    (format!("{:.0}", 100.0 * DOUBTFUL)) " % of them have " (format!("{mm:.1}")) " mm of this tree, which may be false." }
            }
        }
    }
}
