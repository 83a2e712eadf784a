//! A study as it is written: a TOML file. What cannot be run is refused before anything is, with the line it stands on.

use crate::data::{DataSet, PhantomSection, Source, phantoms};
use crate::layout::{Dimension, TableLayout};
use crate::plan::{Method, Study};
use crate::published::Published;
use crate::scores::Score;
use crate::text::{Places, Text};
use nertca_vk::choice::Choice;
use nertca_vk::config::{Config, Preset};
use nertca_vk::error::{Error, Result};
use nertca_vk::files;
use serde::Deserialize;
use std::collections::{BTreeMap, HashSet};
use std::path::{Path, PathBuf};
use toml::Spanned;

/// Larger files are no studies.
const MAX_BYTES: u64 = 1 << 20;
/// Runs of one study.
const MAX_RUNS: usize = 100_000;
/// Settings that a study makes itself, and where.
const OWNED: [(&str, &str); 2] = [("seed", "`seeds`"), ("preset", "the method's `preset`")];

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct StudyFile {
    title: String,
    seeds: Spanned<Vec<u32>>,
    published: Option<Spanned<PathBuf>>,
    #[serde(default)]
    phantom: PhantomSection,
    #[serde(default)]
    data: Vec<DataSection>,
    #[serde(default)]
    method: Vec<MethodSection>,
    #[serde(default)]
    table: TableSection,
}

#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct TableSection {
    columns: Option<Spanned<Vec<Dimension>>>,
    scores: Option<Spanned<Vec<Score>>>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct DataSection {
    name: Spanned<String>,
    label: Option<String>,
    phantom: Option<Spanned<PhantomSection>>,
    directory: Option<Spanned<PathBuf>>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct MethodSection {
    name: Spanned<String>,
    label: Option<String>,
    preset: Preset,
    iterations: Option<Spanned<u32>>,
    #[serde(default)]
    set: Vec<Spanned<String>>,
    /// Further settings on data sets, by their names.
    #[serde(default)]
    on: BTreeMap<Spanned<String>, Vec<Spanned<String>>>,
    published: Option<Spanned<String>>,
}

/// Reads a study and all it refers to. Relative paths are those of files in `data_directory`, or beside the study.
///
/// # Errors
/// [`Error::Data`] with the line of what cannot be run; [`Error::Io`].
pub fn read(file: &Path, data_directory: Option<&Path>) -> Result<Study> {
    let text = files::read_text(file, MAX_BYTES)?;
    let beside = match file.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    };
    let places = Places::new(data_directory.into_iter().chain([beside]));
    let text = Text { file, text: &text };
    let read: StudyFile = text.parse()?;
    seeds(&text, &read.seeds)?;
    let mut names = HashSet::new();
    let mut data: Vec<DataSet> = Vec::new();
    for section in &read.data {
        check_name(&text, &section.name, &mut names, "data set")?;
        let sets = data_sets(&text, &places, section, &read.phantom)?;
        if let Some(set) = sets.iter().find(|set| data.iter().any(|other| other.id == set.id)) {
            return Err(
                text.fault(&section.name.span(), format!("the runs of another data set are also called `{}`", set.id))
            );
        }
        data.extend(sets);
    }
    names.clear();
    let mut methods = Vec::new();
    for section in &read.method {
        check_name(&text, &section.name, &mut names, "method")?;
        methods.push(method(&text, section, &read.data)?);
    }
    let published = read.published.as_ref().map(|path| published(&text, &places, path, &read.method)).transpose()?;
    for (what, none) in [("[[data]]", data.is_empty()), ("[[method]]", methods.is_empty())] {
        if none {
            return Err(Error::data(file, what, "is missing: at least one is needed"));
        }
    }
    let runs = data.len() * methods.len() * read.seeds.get_ref().len();
    if runs > MAX_RUNS {
        return Err(Error::data(file, "runs", format!("{runs} exceeds the maximum, {MAX_RUNS}")));
    }
    let table = layout(&text, read.table)?;
    Ok(Study { title: read.title, seeds: read.seeds.into_inner(), data, methods, table, published })
}

fn layout(text: &Text<'_>, section: TableSection) -> Result<TableLayout> {
    let usual = TableLayout::default();
    let columns = match section.columns {
        None => usual.columns,
        Some(columns) => {
            let at = columns.span();
            let columns = columns.into_inner();
            if (1..columns.len()).any(|i| columns[..i].contains(&columns[i])) || columns.len() > 2 {
                let problem = "columns: at most two of data, views and method are accepted, each once; the others are \
                               rows";
                return Err(text.fault(&at, problem));
            }
            columns
        }
    };
    let scores = match section.scores {
        None => usual.scores,
        Some(scores) if scores.get_ref().is_empty() => {
            return Err(text.fault(&scores.span(), format!("scores: at least one of {} is needed", Score::names())));
        }
        Some(scores) => scores.into_inner(),
    };
    Ok(TableLayout { columns, scores })
}

fn seeds(text: &Text<'_>, seeds: &Spanned<Vec<u32>>) -> Result<()> {
    let list = seeds.get_ref();
    if list.is_empty() {
        return Err(text.fault(&seeds.span(), "seeds: at least one is needed"));
    }
    match (1..list.len()).find(|i| list[..*i].contains(&list[*i])) {
        Some(i) => Err(text.fault(&seeds.span(), format!("seeds: {} is given twice", list[i]))),
        None => Ok(()),
    }
}

/// Names are parts of paths, and `.` stands between them.
fn check_name(text: &Text<'_>, name: &Spanned<String>, seen: &mut HashSet<String>, what: &str) -> Result<()> {
    let plain = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_';
    if name.get_ref().is_empty() || !name.get_ref().chars().all(plain) {
        let problem = format!("name `{}`: only ASCII letters, digits, `-` and `_` are accepted", name.get_ref());
        return Err(text.fault(&name.span(), problem));
    }
    if !seen.insert(name.get_ref().clone()) {
        return Err(text.fault(&name.span(), format!("name `{}`: another {what} has the same name", name.get_ref())));
    }
    Ok(())
}

fn data_sets(
    text: &Text<'_>,
    places: &Places<'_>,
    section: &DataSection,
    common: &PhantomSection,
) -> Result<Vec<DataSet>> {
    let name = section.name.get_ref();
    let label = section.label.as_ref().unwrap_or(name);
    match (&section.directory, &section.phantom) {
        (Some(_), Some(phantom)) => Err(text
            .fault(&phantom.span(), format!("data set `{name}`: `phantom` and `directory` cannot be used together"))),
        (Some(path), None) => {
            let at = path.span();
            let found = places.find(path.get_ref()).map_err(|e| text.fault(&at, format!("data set `{name}`: {e}")))?;
            let source = Source::directory(&found)?;
            Ok(vec![DataSet { id: name.clone(), name: name.clone(), label: label.clone(), views: None, source }])
        }
        (None, own) => {
            let at = own.as_ref().map_or_else(|| section.name.span(), Spanned::span);
            let options = own.as_ref().map_or_else(PhantomSection::default, |own| own.get_ref().clone()).over(common);
            phantoms(name, label, &options, places).map_err(|e| text.fault(&at, format!("data set `{name}`: {e}")))
        }
    }
}

fn method(text: &Text<'_>, section: &MethodSection, data: &[DataSection]) -> Result<Method> {
    let name = section.name.get_ref();
    let preset = Config::preset(section.preset);
    let mut config_on = BTreeMap::new();
    for (set, settings) in &section.on {
        if !data.iter().any(|data| data.name.get_ref() == set.get_ref()) {
            let problem = format!("method `{name}`: `on.{}`: the study has no such data set", set.get_ref());
            return Err(text.fault(&set.span(), problem));
        }
        config_on.insert(set.get_ref().clone(), configuration(text, section, &preset, settings)?);
    }
    Ok(Method {
        name: name.clone(),
        label: section.label.clone().unwrap_or_else(|| name.clone()),
        preset_iterations: preset.train.iterations,
        config: configuration(text, section, &preset, &[])?,
        config_on,
        published: section.published.as_ref().map(|published| published.get_ref().clone()),
    })
}

/// A method's configuration with `further` settings beside its own.
fn configuration(
    text: &Text<'_>,
    section: &MethodSection,
    preset: &Config,
    further: &[Spanned<String>],
) -> Result<Config> {
    let name = section.name.get_ref();
    let mut given: Vec<String> = Vec::new();
    for setting in section.set.iter().chain(further) {
        let fault = |problem: String| text.fault(&setting.span(), format!("method `{name}`: {problem}"));
        let key = setting.get_ref().split('=').next().unwrap_or_default().trim().to_owned();
        if let Some((_, owner)) = OWNED.iter().find(|(owned, _)| *owned == key) {
            return Err(fault(format!("`{key}` is set by {owner}")));
        }
        if key == ITERATIONS && section.iterations.is_some() {
            return Err(fault(format!("`{key}` contradicts the method's `iterations`")));
        }
        if given.contains(&key) {
            return Err(fault(format!("`{key}` is set twice")));
        }
        given.push(key);
    }
    let own = || section.set.iter().chain(further);
    let settings: Vec<String> = own().map(|setting| setting.get_ref().clone()).collect();
    // The schedule of a run of another length keeps its shares, but for what the study sets.
    let base = section.iterations.as_ref().map_or(preset.clone(), |iterations| preset.of_length(*iterations.get_ref()));
    base.with(&settings).map_err(|e| {
        let alone = |setting: &&Spanned<String>| {
            Config::load(Some(section.preset), None, std::slice::from_ref(setting.get_ref())).is_err()
        };
        let to_blame = own().find(alone).map(Spanned::span);
        let length = || section.iterations.as_ref().map(Spanned::span);
        let at = to_blame.or_else(length).unwrap_or_else(|| section.name.span());
        text.fault(&at, format!("method `{name}`: {e}"))
    })
}

const ITERATIONS: &str = "train.iterations";
/// Values to put beside ours; they must know the methods that ask for them.
fn published(
    text: &Text<'_>,
    places: &Places<'_>,
    path: &Spanned<PathBuf>,
    methods: &[MethodSection],
) -> Result<Published> {
    let published = Published::read(&places.find(path.get_ref()).map_err(|e| text.fault(&path.span(), e))?)?;
    let known = published.methods();
    let mut asked = methods.iter().filter_map(|method| method.published.as_ref());
    if let Some(name) = asked.find(|name| !known.contains(&name.get_ref().as_str())) {
        let problem = format!("published = `{}`: the file has values for {} only", name.get_ref(), known.join(", "));
        return Err(text.fault(&name.span(), problem));
    }
    Ok(published)
}
