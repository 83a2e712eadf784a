//! Report of a finished run: scores on every unseen image, pictures of them, and a page.

use crate::pages::page::Page;
use crate::pages::tree_section::TreeSection;
use nertca_vk::calibrate::correction::Calibration;
use nertca_vk::check::Verdict;
use nertca_vk::choice::Choice;
use nertca_vk::error::Result;
use nertca_vk::gaussians::field::GaussianField;
use nertca_vk::gpu::device::Gpu;
use nertca_vk::kernels::tuning::Tuning;
use nertca_vk::model::Model;
use nertca_vk::scan::canvas::in_words;
use nertca_vk::scan::dataset::Dataset;
use nertca_vk_runs::run::history::History;
use nertca_vk_runs::run::{hull_pictures, silhouette_pictures};
use nertca_vk_vessels::score::eval::Evaluation;
use nertca_vk_vessels::trees::tree::BeatTree;
use serde_json::Value;
use std::path::{Path, PathBuf};

/// Inputs of `report.html`.
pub struct Report<'a> {
    /// Device the model was scored on.
    pub gpu: &'a Gpu,
    /// Computation paths of the kernels.
    pub tuning: &'a Tuning,
    /// Trained fields.
    pub model: &'a Model,
    /// Dataset that they were scored with.
    pub dataset: &'a Dataset,
    /// Scores, where there are any.
    pub evaluation: Option<&'a Evaluation>,
    /// Warnings that reduce the value of the fields or of the scores.
    pub warnings: &'a [String],
    /// Run directory, whose log and calibration describe how the model was made, if they exist.
    pub run: &'a Path,
    /// Vessels as a tree, if it was requested.
    pub tree: Option<&'a BeatTree>,
    /// Directory of the comparison pictures.
    pub pictures: &'a Path,
}

impl Report<'_> {
    /// Writes the page.
    ///
    /// # Errors
    /// [`nertca_vk::error::Error::Io`]; [`nertca_vk::error::Error::Data`] for a run's calibration that cannot be read.
    pub fn write(&self, path: &Path) -> Result<()> {
        let Report { gpu, tuning, model, dataset, evaluation, run, pictures, .. } = *self;
        let log = std::fs::read_to_string(run.join("metrics.jsonl")).unwrap_or_default();
        let metrics: Vec<Value> = log.lines().filter_map(|line| serde_json::from_str(line).ok()).collect();
        let latest = |event: &str| metrics.iter().rev().find(|line| line["event"] == event);
        let mut facts = vec![
            ("dataset".to_owned(), dataset.path.display().to_string()),
            ("images".to_owned(), images_of(dataset)),
            ("iterations".to_owned(), format!("{} of {}", model.step, model.config.train.iterations)),
            ("parameters".to_owned(), model.param_map.len.to_string()),
            ("preset".to_owned(), model.config.preset.name().to_owned()),
            ("scored on".to_owned(), gpu.info().name.clone()),
            ("commit".to_owned(), nertca_vk_study::COMMIT.to_owned()),
        ];
        if let Some(hull) = &model.hull {
            facts.push(("hull".into(), format!("{:.3} % of the box", 100.0 * hull.share())));
        }
        if let Some(field) = &model.gaussians {
            facts.push(("Gaussians".into(), gaussians_of(field)));
        }
        facts.extend(model.field.as_ref().map(|field| field.fact()));
        let checked = latest("checked");
        facts.extend(
            checked.and_then(|line| line["conclusion"].as_str()).map(|text| ("views".to_owned(), text.to_owned())),
        );
        facts.extend(checked.and_then(numbers_of));
        facts.extend(strings(checked, "missing").map(|text| ("missing evidence".to_owned(), text)));
        if let Some(started) = latest("started") {
            facts.push(("trained on".into(), started["device"].as_str().unwrap_or_default().to_owned()));
            let notes = started["notes"].as_array().into_iter().flatten().filter_map(|n| n.as_str());
            facts.extend(notes.map(|note| ("note".to_owned(), note.to_owned())));
        } else {
            facts.extend(tuning.reasons.iter().map(|reason| ("note".to_owned(), reason.clone())));
        }
        let found = latest("found").and_then(|line| line["note"].as_str());
        facts.extend(found.map(|note| ("found".to_owned(), note.to_owned())));
        if let Some(s) = latest("finished").and_then(|line| line["train_s"].as_f64()) {
            facts.push(("training".into(), format!("{s:.1} s; the paper: 2220 s on an RTX A5000")));
        }
        let frames = dataset.validation().iter();
        let tree = model.gaussians.as_ref().and_then(GaussianField::moving);
        let of_views = |file: fn(&Path, usize) -> PathBuf| {
            let files = dataset.training_views().into_iter().map(|view| (view, file(&run.join("report"), view)));
            files.filter(|(_, file)| file.is_file()).collect()
        };
        let warnings = self.all_warnings(checked);
        let page = Page {
            title: run.file_name().map_or("run".into(), |name| name.to_string_lossy().into_owned()),
            facts,
            warnings,
            metrics,
            history: History::read(run),
            evaluation,
            motion: tree.map_or(Vec::new(), |t| (0..t.rest.n_phases).map(|p| t.displacement(p as f64)).collect()),
            pictures: frames
                .map(|f| (f.view, f.phase, pictures.join(format!("{}.png", f.name))))
                .filter(|(_, _, file)| file.is_file())
                .collect(),
            hull: of_views(hull_pictures::file),
            calibration: Calibration::read(run)?,
            silhouettes: of_views(silhouette_pictures::file),
            tree: self.tree.map(|tree| TreeSection::new(tree, dataset)).transpose()?,
            config: model.config.to_toml()?,
        };
        page.write(path)
    }

    fn all_warnings(&self, checked: Option<&Value>) -> Vec<String> {
        let (model, dataset) = (self.model, self.dataset);
        let mut warnings: Vec<String> = strings(checked, "warnings").collect();
        if let Some(conclusion) = checked.filter(|line| is_faulty(line)).and_then(|line| line["conclusion"].as_str()) {
            warnings.insert(0, format!("Check the data (`nertca-vk check`): {conclusion}."));
        }
        if model.step < model.config.train.iterations {
            warnings.push(format!(
                "The run is not finished: {} of {} iterations.",
                model.step, model.config.train.iterations
            ));
        }
        if model.config.fields().is_some_and(|settings| settings.has_hull)
            && model.hull.is_none()
            && model.gaussians.is_none()
        {
            warnings.push(
                "No motion hull was used: the views may disagree, or there is motion in too much of the images."
                    .to_owned(),
            );
        }
        if let Some(hull) = model.hull.as_ref().filter(|h| h.share() < 5e-5) {
            warnings.push(format!(
                "The motion hull keeps only {:.4} % of the box, so the views hardly agree. Check geometry and phases \
                 (`nertca-vk check`).",
                100.0 * hull.share()
            ));
        }
        if self.evaluation.is_none() {
            warnings.push(match dataset.validation().is_empty() {
                true => "The dataset has no validation frames, so nothing was scored.".to_owned(),
                false => "The run is not scored yet: use `nertca-vk eval`.".to_owned(),
            });
        }
        if !dataset.validation().is_empty() && dataset.validation().iter().all(|f| f.mask.is_none()) {
            warnings.push("The validation frames have no vessel masks, so there is no Dice.".to_owned());
        }
        warnings.extend(self.warnings.iter().cloned());
        warnings
    }
}

/// Texts in a list of a line of the log.
fn strings(line: Option<&Value>, key: &str) -> impl Iterator<Item = String> {
    let list = line.and_then(|line| line[key].as_array()).into_iter().flatten();
    list.filter_map(|text| text.as_str().map(str::to_owned)).collect::<Vec<_>>().into_iter()
}

/// Tells whether the comparison of the views found a fault.
fn is_faulty(checked: &Value) -> bool {
    let sound = [Verdict::Agree, Verdict::Unknown].map(|verdict| serde_json::to_value(verdict).unwrap_or_default());
    !sound.contains(&checked["verdict"])
}

/// Says how much the views agree, and how much they would by chance.
fn numbers_of(checked: &Value) -> Option<(String, String)> {
    let percent = |value: &Value| value.as_f64().map(|share| format!("{:.0} %", 100.0 * share));
    let differs = percent(&checked["agreement"]["coarse"])?;
    let [explained, by_chance] = [percent(&checked["explained"][0])?, percent(&checked["explained"][1])?];
    let text = format!(
        "{differs} of the moving contrast differs between two views (unrelated images: 100 %); all other views show a vessel for \
         {explained} of a view's vessel pixels, and for {by_chance} by chance, with the vessels of the view displaced"
    );
    Some(("agreement".into(), text))
}

fn gaussians_of(field: &GaussianField) -> String {
    let form = match field {
        GaussianField::PerPhase(_) => "one set per phase",
        GaussianField::Moving(_) => "one deformable set",
    };
    let kib = field.bytes() as f64 / 1024.0;
    let agreement = field.rows().agreement.as_ref().map_or(String::new(), |fits| {
        let percent = 100.0 * fits.overall;
        format!(", the mean of several fits; {percent:.0} % of the vessels of one fit lie in those of another")
    });
    let (n, name) = (field.rows().rows.len(), field.form());
    format!("{n}, {form} (form \"{name}\"), {kib:.0} KiB{agreement}")
}

fn images_of(dataset: &Dataset) -> String {
    format!(
        "{}; {} for training from {} views, {} for validation, {} phases",
        in_words(&dataset.sizes()),
        dataset.training().len(),
        dataset.training_views().len(),
        dataset.validation().len(),
        dataset.n_phases
    )
}
