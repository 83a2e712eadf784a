//! `report.html`: one self-contained page. Plots are SVG, pictures are embedded, and phases are selected by radio buttons, so
//! that the page needs no script, except for a vessel tree if there is one.

use crate::pages::calibration_table;
use crate::pages::plot::{Line, plot};
use crate::pages::tree_section::TreeSection;
use crate::pages::tree_table;
use crate::pages::volume_table;
use base64::Engine;
use maud::{DOCTYPE, Markup, PreEscaped, html};
use nertca_vk::calibrate::correction::Calibration;
use nertca_vk::error::{Error, Result};
use nertca_vk::files;
use nertca_vk::gaussians::field::Displacement;
use nertca_vk_runs::run::history::{History, Losses, Validated};
use nertca_vk_vessels::score::eval::Evaluation;
use plotters::style::RGBColor;
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Maximum number of embedded pictures.
const MAX_PICTURES: usize = 120;

/// Title of the plot of distances during training.
pub(crate) const DISTANCE_TITLE: &str = "Distance to the true vessels at the end of systole, mm";

/// Contents of a page.
pub struct Page<'a> {
    /// Name of the run.
    pub title: String,
    /// Facts about the run: name and value.
    pub facts: Vec<(String, String)>,
    /// Warnings about the run.
    pub warnings: Vec<String>,
    /// Lines of `metrics.jsonl`; empty when there are none.
    pub metrics: Vec<Value>,
    /// Losses and scores over time, from those lines.
    pub history: History,
    /// Scores, where there were views to score.
    pub evaluation: Option<&'a Evaluation>,
    /// Displacements of moving Gaussians at each phase; empty for other fields.
    pub motion: Vec<Displacement>,
    /// Comparison picture of each scored frame: view, phase, file.
    pub pictures: Vec<(usize, u32, PathBuf)>,
    /// Picture of the motion hull in front of each training view: view, file.
    pub hull: Vec<(usize, PathBuf)>,
    /// Corrections of the views, where they are known.
    pub calibration: Option<Calibration>,
    /// Picture of the vessels in each training view, before and after correction: view, file.
    pub silhouettes: Vec<(usize, PathBuf)>,
    /// Vessels as a tree, if it was requested.
    pub tree: Option<TreeSection>,
    /// Complete configuration.
    pub config: String,
}

/// Style sheet of the pages.
pub(crate) const STYLE: &str = "
:root{color-scheme:light dark;--ink:#1b1d21;--paper:#fcfcfb;--soft:#6c7078;--line:#d9dbdf;--mark:#b3261e}
@media(prefers-color-scheme:dark){:root{--ink:#e7e8ea;--paper:#17181b;--soft:#9a9ea7;--line:#3a3d44;--mark:#ff8a80}
.plot svg{filter:invert(.91) hue-rotate(180deg)}}
body{font:16px/1.5 system-ui,sans-serif;color:var(--ink);background:var(--paper);max-width:70rem;margin:2rem auto;padding:0 1rem}
h1{font-size:1.6rem;margin:0}h2{font-size:1.15rem;margin:2.2rem 0 .6rem}p.lead{color:var(--soft);margin:.2rem 0 1rem}
table{border-collapse:collapse;font-variant-numeric:tabular-nums}td,th{padding:.2rem .8rem .2rem 0;text-align:right;border-bottom:1px solid var(--line)}
th:first-child,td:first-child{text-align:left}.facts td{text-align:left}.facts td:first-child{color:var(--soft)}
.numbers{display:flex;flex-wrap:wrap;gap:2.5rem;margin:1rem 0}.numbers b{display:block;font-size:1.7rem;font-weight:600}
.warn{border-left:3px solid var(--mark);padding:.2rem .8rem;margin:.4rem 0}.plot svg{width:100%;height:auto;max-width:66rem}
fieldset{border:0;padding:0;margin:0 0 1.5rem}legend{padding:0;color:var(--soft)}input.p{position:absolute;opacity:0}
label.p{display:inline-block;min-width:1.6rem;text-align:center;padding:.1rem .4rem;border:1px solid var(--line);cursor:pointer}
input.p:focus-visible+label.p{outline:2px solid}.shot{display:none}.shot img{width:100%;image-rendering:pixelated}
.bars div{background:var(--soft);height:.7rem}pre{overflow:auto;border:1px solid var(--line);padding:.6rem;font-size:.85rem}
.by-view{display:flex;flex-wrap:wrap;gap:1rem}.by-view figure{margin:0;flex:1 1 24rem}.by-view img{width:100%;image-rendering:pixelated}
.scroll{overflow-x:auto;max-height:26rem}";

/// Returns a picture as a data URL.
pub(crate) fn embedded(path: &Path) -> Result<String> {
    let bytes = std::fs::read(path).map_err(Error::io("read", path))?;
    Ok(format!("data:image/png;base64,{}", base64::engine::general_purpose::STANDARD.encode(bytes)))
}

/// Shows pictures side by side, one per view.
fn by_view(what: &str, pictures: &[(usize, PathBuf)]) -> Result<Markup> {
    let pictures = pictures.iter().map(|(view, path)| Ok((view, embedded(path)?))).collect::<Result<Vec<_>>>()?;
    Ok(html! {
        div.by-view {
            @for (view, data) in &pictures {
                figure { img alt=(format!("{what} in view {view}")) src=(data); figcaption { "View " (view) } }
            }
        }
    })
}

impl Page<'_> {
    /// Plots losses, and scores of some unseen images, over the time of training.
    fn plots(&self) -> Result<Markup> {
        let (blue, orange, green) = (RGBColor(30, 100, 190), RGBColor(215, 120, 20), RGBColor(40, 130, 70));
        let History { losses, curve, .. } = &self.history;
        let loss = |name: &str, colour: RGBColor, pick: fn(&Losses) -> Option<f64>| Line {
            name: name.into(),
            colour,
            points: losses.iter().filter_map(|l| Some((l.elapsed_s, pick(l)?))).collect(),
            published: false,
        };
        let score = |name: &str, colour: RGBColor, pick: fn(&Validated) -> Option<f64>| Line {
            name: name.into(),
            colour,
            points: curve.iter().filter_map(|v| Some((v.train_s, pick(v)?))).collect(),
            published: false,
        };
        let plots = [
            plot("Loss", &[loss("data", blue, |l| l.data), loss("dynamic field", orange, |l| l.dynamic)], true)?,
            plot(
                "Some unseen images",
                &[
                    score("Dice, dynamic field", orange, |v| v.dice),
                    score("Dice, both", green, |v| v.dice_total),
                    score("SSIM", blue, |v| v.ssim),
                ],
                false,
            )?,
            plot(DISTANCE_TITLE, &[score("Chamfer, mm", orange, |v| v.chamfer_mm)], false)?,
        ];
        Ok(html! {
            @if plots.iter().any(|svg| !svg.is_empty()) { h2 { "Over time" } }
            @for svg in plots { @if !svg.is_empty() { div.plot { (PreEscaped(svg)) } } }
            @if curve.is_empty() && !losses.is_empty() && self.evaluation.is_some() {
                p.lead { "Scores over time need validation during training: --set train.validate_every=100." }
            }
        })
    }

    fn kernels(&self) -> Markup {
        let Some(passes) = self.metrics.iter().rev().find_map(|line| line["passes"].as_array()) else {
            return html! {};
        };
        let mut by_name: BTreeMap<&str, f64> = BTreeMap::new();
        for pass in passes {
            if let (Some(name), Some(ms)) = (pass["name"].as_str(), pass["ms"].as_f64()) {
                *by_name.entry(name).or_default() += ms;
            }
        }
        let total: f64 = by_name.values().sum();
        let mut rows: Vec<_> = by_name.into_iter().collect();
        rows.sort_by(|a, b| b.1.total_cmp(&a.1));
        html! {
            @if total > 0.0 {
                h2 { "Time of one iteration on the device: " (format!("{total:.2}")) " ms" }
                table.bars {
                    @for (name, ms) in rows.iter().take(14) {
                        tr { td { (name) } td { (format!("{ms:.3}")) " ms" } td { (format!("{:.1}", 100.0 * ms / total)) " %" }
                            td style="width:20rem" { div style=(format!("width:{:.1}%", 100.0 * ms / rows[0].1)) {} } }
                    }
                }
            }
        }
    }

    fn scores(&self) -> Markup {
        let Some(e) = self.evaluation else { return html! {} };
        let dice = |d: Option<f64>| d.map_or("-".into(), |d| format!("{d:.3}"));
        html! {
            div.numbers {
                div { b { (dice(e.dice.dynamic)) } "Dice, dynamic field" }
                div { b { (dice(e.dice.total)) } "Dice, both fields" }
                @if e.dice_otsu.is_some() { div { b { (dice(e.dice_otsu)) } "Dice, Otsu of each image" } }
                div { b { (format!("{:.1}", e.psnr)) } "PSNR, dB" }
                div { b { (format!("{:.3}", e.ssim)) } "SSIM" }
            }
            h2 { "Scores of " (e.images.len()) " unseen images" }
            p.lead { "A pixel is vessel where the attenuation exceeds \
                      " (format!("{:.3e}", e.threshold.dynamic_per_mm)) " per mm (" (e.threshold.rule) ")."
                @if let Some(best) = e.best_dice.dynamic {
                    " The best threshold gives the dynamic field a Dice of " (format!("{:.3}", best.dice)) " (at "
                    (format!("{:.3e}", best.threshold_per_mm)) " per mm, found with the masks)."
                }
            }
            div.scroll { table {
                tr { th { "image" } th { "primary" } th { "secondary" } th { "phase" } th { "Dice dynamic" } th { "Dice total" } th { "PSNR dB" } th { "SSIM" } }
                @for i in &e.images {
                    tr {
                        td { (i.name) }
                        td { (i.primary_deg.map_or("-".into(), |a| format!("{a:.1}°"))) }
                        td { (i.secondary_deg.map_or("-".into(), |a| format!("{a:.1}°"))) }
                        td { (i.phase) } td { (dice(i.dice_dynamic)) } td { (dice(i.dice_total)) }
                        td { (format!("{:.2}", i.psnr)) } td { (format!("{:.3}", i.ssim)) }
                    }
                }
            } }
        }
    }

    fn tables(&self) -> Markup {
        let Some(evaluation) = self.evaluation else { return html! {} };
        html! {
            @if let Some(volume) = &evaluation.volume { (volume_table::table(volume).markup()) }
            @if let Some(tree) = &evaluation.tree {
                (tree_table::table(tree).markup())
                @if let Some(text) = tree.lesions.as_ref().and_then(tree_table::lesions_in_words) { p { (text) } }
            }
        }
    }

    fn views(&self) -> Result<Markup> {
        let mut by_view: BTreeMap<usize, Vec<(u32, &PathBuf)>> = BTreeMap::new();
        // Too many pictures are thinned out evenly.
        let step = self.pictures.len().div_ceil(MAX_PICTURES).max(1);
        for (view, phase, path) in self.pictures.iter().step_by(step) {
            by_view.entry(*view).or_default().push((*phase, path));
        }
        let mut rules = String::new();
        let mut views = Vec::new();
        for (index, (view, mut frames)) in by_view.into_iter().enumerate() {
            frames.sort();
            let mut shots = Vec::new();
            for (slot, (phase, path)) in frames.into_iter().enumerate() {
                rules += &format!(
                    "#v{index}s{slot}:checked~.v{index}s{slot}{{display:block}}#v{index}s{slot}:checked+label{{background:var(--ink);color:var(--paper)}}"
                );
                shots.push((slot, phase, embedded(path)?));
            }
            views.push((index, view, shots));
        }
        Ok(html! {
            @if !views.is_empty() {
                h2 { "Unseen views" }
                p.lead { "Truth, prediction, static field, dynamic field, vessel overlap (green found, red missed, blue added); choose the phase."
                    @if step > 1 { " Every " (step) "th image is shown." } }
                style { (PreEscaped(rules)) }
                @for (index, view, shots) in &views {
                    fieldset {
                        legend { "View " (view) ", phase" }
                        @for (slot, phase, _) in shots {
                            @let id = format!("v{index}s{slot}");
                            @if *slot == 0 {
                                input.p type="radio" name=(format!("v{index}")) id=(id) checked;
                            } @else {
                                input.p type="radio" name=(format!("v{index}")) id=(id);
                            }
                            label.p for=(id) { (phase) }
                        }
                        @for (slot, phase, data) in shots {
                            div class=(format!("shot v{index}s{slot}")) {
                                img alt=(format!("view {view} at phase {phase}")) src=(data);
                            }
                        }
                    }
                }
            }
        })
    }

    fn hull(&self) -> Result<Markup> {
        let pictures = by_view("hull", &self.hull)?;
        Ok(html! {
            @if !self.hull.is_empty() {
                h2 { "Motion hull" }
                p.lead { "Training views at their first phase; the motion hull covers the orange regions. Vessels \
                          outside them cannot be reconstructed." }
                (pictures)
            }
        })
    }

    fn calibration(&self) -> Result<Markup> {
        let Some(calibration) = self.calibration.as_ref().filter(|c| !c.views.is_empty()) else { return Ok(html! {}) };
        let frames = calibration_table::frame_rows(calibration);
        Ok(html! {
            h2 { "Correction of the views" }
            p.lead { "These corrections are added to the geometry that the dataset states. \
                      " (calibration_table::legend(calibration)) }
            div.scroll { table {
                tr { @for column in &calibration_table::COLUMNS { th { (column.heading.join(" ").trim()) } } }
                @for cells in calibration_table::rows(calibration) { tr { @for cell in cells { td { (cell) } } } }
            } }
            @if let Some(adjustment) = &calibration.adjustment { p.lead { "Adjustment: " (adjustment.describe()) "." } }
            @if !frames.is_empty() {
                p.lead { "Corrections of the frames of each view: displacement of the heart by breathing, and contrast of the vessels \
                          as a multiple of the mean." }
                div.scroll { table {
                    tr { @for heading in calibration_table::FRAME_COLUMNS { th { (heading) } } }
                    @for cells in frames { tr { @for cell in cells { td { (cell) } } } }
                } }
            }
            @if !self.silhouettes.is_empty() {
                p.lead { "Vessel pixels of each training view with the stated (left) and the corrected geometry \
                          (right): green where all other views also show vessels on the ray, red where they do not." }
                (by_view("silhouettes", &self.silhouettes)?)
            }
        })
    }

    fn motion(&self) -> Markup {
        let largest = self.motion.iter().map(|d| d.largest_mm).fold(0.0, f64::max);
        html! {
            @if largest > 0.0 {
                h2 { "Motion of the Gaussians" }
                p.lead { "Distance from phase 0. Motion along a vessel is not observed in projections." }
                table.bars {
                    tr { th { "phase" } th { "mean, mm" } th { "maximum, mm" } th {} }
                    @for (phase, d) in self.motion.iter().enumerate() {
                        tr { td { (phase) } td { (format!("{:.2}", d.mean_mm)) } td { (format!("{:.2}", d.largest_mm)) }
                            td style="width:20rem" { div style=(format!("width:{:.1}%", 100.0 * d.mean_mm / largest)) {} } }
                    }
                }
            }
        }
    }

    /// Writes the page.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn write(&self, path: &Path) -> Result<()> {
        let page = html! {
            (DOCTYPE)
            html lang="en" {
                head {
                    meta charset="utf-8";
                    meta name="viewport" content="width=device-width";
                    title { (self.title) " - nertca-vk" }
                    style { (PreEscaped(STYLE)) }
                }
                body {
                    h1 { (self.title) }
                    p.lead { "4D reconstruction of the coronary arteries, nertca-vk " (env!("CARGO_PKG_VERSION")) }
                    @for warning in &self.warnings { p.warn { (warning) } }
                    (self.scores())
                    (self.tables())
                    (self.plots()?)
                    (self.views()?)
                    @if let Some(tree) = &self.tree { (tree.markup()) }
                    (self.calibration()?)
                    (self.hull()?)
                    (self.motion())
                    (self.kernels())
                    h2 { "Device and run" }
                    table.facts { @for (name, value) in &self.facts { tr { td { (name) } td { (value) } } } }
                    details { summary { "Configuration" } pre { (self.config) } }
                }
            }
        };
        Ok(files::write_atomic(path, page.into_string().as_bytes())?)
    }
}
