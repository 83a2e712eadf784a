//! Results of a study, set beside each other and beside published values.

use crate::data::DataSet;
use crate::layout::{Dimension, TableLayout};
use crate::outcome::{Outcome, Results};
use crate::plan::{Method, Study};
use crate::scores::Score;
use nertca_vk::error::Result;
use std::path::Path;

const DIMENSIONS: [Dimension; 3] = [Dimension::Data, Dimension::Views, Dimension::Method];

/// A table as a list of entries.
#[derive(Debug, Clone)]
pub struct Table {
    /// Title of the table.
    pub title: String,
    /// Every score of every method on every data set, data sets first.
    pub entries: Vec<Entry>,
    /// Notes below the table, a sentence or two each.
    pub notes: Vec<String>,
    layout: TableLayout,
}

/// A score of a method on a data set.
#[derive(Debug, Clone)]
pub struct Entry {
    /// Label of the data set.
    pub data: String,
    /// Number of views, where the data set states it.
    pub views: Option<u32>,
    /// Label of the method.
    pub method: String,
    /// The score.
    pub score: Score,
    /// Values of the score.
    pub cell: Cell,
}

/// Values of a score over the seeds.
#[derive(Debug, Clone, PartialEq)]
pub struct Cell {
    /// State of our own values.
    pub state: State,
    /// The published value.
    pub published: Option<f64>,
    /// Whether no other method of the study is better on these data.
    pub best: bool,
}

/// State of our own values of a score.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum State {
    /// At least one run has the score.
    Scored {
        /// Mean.
        mean: f64,
        /// Standard deviation; none of a single run.
        deviation: Option<f64>,
        /// Number of runs with the score.
        runs: usize,
        /// Runs that the study asks for.
        of: usize,
    },
    /// Runs were scored, but none of them has this score.
    NoScore,
    /// No run was scored, and some failed.
    Failed,
    /// No run has a result yet.
    NotRun,
    /// The study does not have this method; only its published value is shown.
    Published,
}

/// A table as rows and columns.
#[derive(Debug)]
pub struct Grid<'a> {
    /// Headings of the columns that name the rows.
    pub headings: Vec<&'static str>,
    /// Name of the group of columns and the score, for each column.
    pub columns: Vec<(String, Score)>,
    /// Names and cells of each row; a cell is none where the table has no entry.
    pub rows: Vec<(Vec<String>, Vec<Option<&'a Cell>>)>,
}

impl Entry {
    fn label(&self, dimension: Dimension) -> String {
        match dimension {
            Dimension::Data => self.data.clone(),
            Dimension::Views => self.views.map_or(String::new(), |views| format!("{views} views")),
            Dimension::Method => self.method.clone(),
        }
    }
}

/// Results of the runs of one method on one data set.
struct Group {
    of: usize,
    outcomes: Vec<Outcome>,
}

impl Group {
    fn state(&self, score: Score) -> State {
        let values: Vec<f64> = self.outcomes.iter().filter_map(|outcome| outcome.score(score)).collect();
        if let Some((mean, deviation)) = spread(&values) {
            return State::Scored { mean, deviation, runs: values.len(), of: self.of };
        }
        match (self.outcomes.is_empty(), self.outcomes.iter().any(|outcome| outcome.scores.is_some())) {
            (true, _) => State::NotRun,
            (false, true) => State::NoScore,
            (false, false) => State::Failed,
        }
    }
}

/// Mean and standard deviation; no deviation for a single value, and none for no values.
fn spread(values: &[f64]) -> Option<(f64, Option<f64>)> {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let squares = values.iter().map(|value| (value - mean).powi(2)).sum::<f64>();
    match values.len() {
        0 => None,
        1 => Some((mean, None)),
        _ => Some((mean, Some((squares / (n - 1.0)).sqrt()))),
    }
}

impl Table {
    /// Gathers the results in a study's directory. Results of other data or another configuration are left out and counted; the
    /// commits that made the results are noted.
    ///
    /// # Errors
    /// Errors of results that cannot be read.
    pub fn gather(study: &Study, directory: &Path) -> Result<Table> {
        let results = Results::open(directory)?;
        let mut gathered = Gathered::default();
        let mut entries = Vec::new();
        for (data, set) in study.data.iter().enumerate() {
            let mut of_set = Vec::new();
            for (method, m) in study.methods.iter().enumerate() {
                let group = gathered.group(study, &results, (data, method))?;
                let published =
                    |score| study.published.as_ref()?.value(m.published.as_ref()?, &set.name, set.views, score);
                of_set.extend(study.table.scores.iter().map(|score| {
                    let cell = Cell { state: group.state(*score), published: published(*score), best: false };
                    entry(set, &m.label, *score, cell)
                }));
            }
            mark_best(&mut of_set, &study.table.scores);
            of_set.extend(published_alone(study, set));
            entries.extend(of_set);
        }
        let notes = gathered.notes(study);
        Ok(Table { title: study.title.clone(), entries, notes, layout: study.table.clone() })
    }

    /// Arranges the entries as rows and columns.
    pub fn grid(&self) -> Grid<'_> {
        let in_rows: Vec<Dimension> = DIMENSIONS.into_iter().filter(|d| !self.layout.columns.contains(d)).collect();
        // A dimension with the same label everywhere needs no column.
        let differs = |d: &Dimension| {
            self.entries.iter().any(|entry| Some(entry.label(*d)) != self.entries.first().map(|first| first.label(*d)))
        };
        let mut shown: Vec<Dimension> = in_rows.iter().copied().filter(|d| differs(d)).collect();
        if shown.is_empty() {
            shown.extend(in_rows.last());
        }
        let row_of = |entry: &Entry| -> Vec<String> { shown.iter().map(|d| entry.label(*d)).collect() };
        let column_of = |entry: &Entry| {
            let labels: Vec<String> = self.layout.columns.iter().map(|d| entry.label(*d)).collect();
            (labels.iter().filter(|l| !l.is_empty()).cloned().collect::<Vec<_>>().join(", "), entry.score)
        };
        let (mut names, mut columns) = (Vec::new(), Vec::new());
        for entry in &self.entries {
            let (name, column) = (row_of(entry), column_of(entry));
            if !names.contains(&name) {
                names.push(name);
            }
            if !columns.contains(&column) {
                columns.push(column);
            }
        }
        let cell = |name: &Vec<String>, column: &(String, Score)| {
            let here = self.entries.iter().find(|entry| row_of(entry) == *name && column_of(entry) == *column);
            here.map(|entry| &entry.cell)
        };
        let rows = names.into_iter().map(|name| {
            let cells = columns.iter().map(|column| cell(&name, column)).collect();
            (name, cells)
        });
        let rows = rows.collect();
        Grid { headings: shown.into_iter().map(Dimension::heading).collect(), columns, rows }
    }
}

fn entry(set: &DataSet, method: &str, score: Score, cell: Cell) -> Entry {
    Entry { data: set.label.clone(), views: set.views, method: method.to_owned(), score, cell }
}

/// Published values of methods that the study does not have.
fn published_alone(study: &Study, set: &DataSet) -> Vec<Entry> {
    let Some(published) = &study.published else { return Vec::new() };
    let ours = |name: &str| study.methods.iter().any(|m| m.published.as_deref() == Some(name));
    let others = published.methods().into_iter().filter(|name| !ours(name));
    others
        .flat_map(|name| {
            study.table.scores.iter().map(move |score| {
                let value = published.value(name, &set.name, set.views, *score);
                entry(set, name, *score, Cell { state: State::Published, published: value, best: false })
            })
        })
        .collect()
}

/// Marks the best of our own values of each score, compared as rounded in tables, where there are at least two.
fn mark_best(entries: &mut [Entry], scores: &[Score]) {
    for &score in scores {
        let shown = |entry: &Entry| match entry.cell.state {
            State::Scored { mean, .. } if entry.score == score => score.text(mean).parse::<f64>().ok(),
            _ => None,
        };
        let values: Vec<f64> = entries.iter().filter_map(shown).collect();
        let best = if score.more_is_better() {
            values.iter().copied().fold(f64::NEG_INFINITY, f64::max)
        } else {
            values.iter().copied().fold(f64::INFINITY, f64::min)
        };
        if values.len() > 1 {
            entries.iter_mut().for_each(|entry| entry.cell.best |= shown(entry) == Some(best));
        }
    }
}

/// Notes to be written below a table.
#[derive(Default)]
struct Gathered {
    /// Commits, devices and drivers, in the order of their first occurrence.
    made_by: Vec<String>,
    failures: Vec<String>,
    warnings: Vec<String>,
    /// Number of results of other data or another configuration.
    others: usize,
}

impl Gathered {
    fn group(&mut self, study: &Study, results: &Results<'_>, (data, method): (usize, usize)) -> Result<Group> {
        let runs = study.seeds.iter().map(|seed| study.run_of(data, method, *seed));
        let mut group = Group { of: study.seeds.len(), outcomes: Vec::new() };
        for run in runs {
            let Some(outcome) = results.read(&run)? else { continue };
            if !outcome.fingerprint.asks_the_same(&study.fingerprint(&run)?) {
                self.others += 1;
                continue;
            }
            let made_by = format!("{} on {} ({})", outcome.fingerprint.commit, outcome.device, outcome.driver);
            if !self.made_by.contains(&made_by) {
                self.made_by.push(made_by);
            }
            self.failures.extend(outcome.failure.iter().map(|failure| format!("{} failed: {failure}", run.id)));
            let warnings = outcome.scores.iter().flat_map(|scores| &scores.warnings);
            self.warnings.extend(warnings.map(|warning| format!("{}: {warning}", run.id)));
            group.outcomes.push(outcome);
        }
        Ok(group)
    }

    fn notes(self, study: &Study) -> Vec<String> {
        let seeds: Vec<String> = study.seeds.iter().map(u32::to_string).collect();
        let mut notes = vec![match seeds.len() {
            1 => format!("Seed {}. The best of each group is bold.", seeds[0]),
            _ => format!("Mean ± standard deviation over seeds {}. The best of each group is bold.", seeds.join(", ")),
        }];
        let meanings = study.table.scores.iter().map(|score| format!("{}: {}", score.heading(), score.meaning()));
        notes.push(format!("{}.", meanings.collect::<Vec<_>>().join("; ")));
        if let Some(published) = &study.published {
            let note = published.note.as_ref().map_or(String::new(), |note| format!(" {note}"));
            notes.push(format!("In brackets: {}.{note}", published.source));
        }
        notes.extend(study.methods.iter().filter_map(scaled));
        if !self.made_by.is_empty() {
            notes.push(format!("Made by {}.", self.made_by.join("; ")));
        }
        if self.others > 0 {
            let problem = "from data or a configuration that differ from the study's, and are omitted";
            notes.push(format!("{} results in this directory are {problem}.", self.others));
        }
        notes.extend(self.failures.into_iter().chain(self.warnings));
        notes
    }
}

/// Note on a method whose number of iterations differs from its preset's.
fn scaled(method: &Method) -> Option<String> {
    let (own, preset) = (method.config.train.iterations, method.preset_iterations);
    let of = format!("{}: {own} iterations instead of the {preset} of the preset", method.label);
    (own != preset).then(|| format!("{of} `{}`.", nertca_vk::choice::Choice::name(method.config.preset)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spread_is_that_of_a_sample() {
        assert_eq!(spread(&[]), None);
        assert_eq!(spread(&[2.0]), Some((2.0, None)));
        let (mean, deviation) = spread(&[1.0, 2.0, 3.0]).unwrap();
        assert_eq!((mean, deviation), (2.0, Some(1.0)));
    }

    fn scored(data: &str, views: u32, method: &str, score: Score, mean: f64) -> Entry {
        let state = State::Scored { mean, deviation: None, runs: 1, of: 1 };
        let cell = Cell { state, published: None, best: false };
        Entry { data: data.into(), views: Some(views), method: method.into(), score, cell }
    }

    #[test]
    fn the_best_is_marked_as_shown() {
        let of = |score, values: [f64; 3]| {
            let mut entries: Vec<Entry> = values.iter().map(|v| scored("a", 3, "m", score, *v)).collect();
            mark_best(&mut entries, &[score]);
            entries.iter().map(|e| e.cell.best).collect::<Vec<_>>()
        };
        // Rounded to three digits, 0.8401 and 0.8404 are the same number.
        assert_eq!(of(Score::Dice, [0.8401, 0.7, 0.8404]), [true, false, true]);
        assert_eq!(of(Score::Minutes, [3.0, 1.0, 2.0]), [false, true, false]);
        let mut alone = [scored("a", 3, "m", Score::Dice, 0.5)];
        mark_best(&mut alone, &[Score::Dice]);
        assert!(!alone[0].cell.best, "the only one is no best");
    }

    #[test]
    fn dimensions_become_rows_or_columns() {
        let entries: Vec<Entry> = ["x", "y"]
            .into_iter()
            .flat_map(|data| [3, 4].map(|views| (data, views)))
            .flat_map(|(data, views)| ["m", "n"].map(|method| scored(data, views, method, Score::Dice, 0.5)))
            .collect();
        let grid = |columns: &[Dimension]| {
            let layout = TableLayout { columns: columns.to_vec(), scores: vec![Score::Dice] };
            let table = Table { title: String::new(), entries: entries.clone(), notes: Vec::new(), layout };
            let grid = table.grid();
            let columns: Vec<String> = grid.columns.iter().map(|c| c.0.clone()).collect();
            (grid.headings.clone(), columns, grid.rows.iter().map(|row| row.0.join(" ")).collect::<Vec<_>>())
        };
        let of = |texts: &[&str]| texts.iter().map(|t| (*t).to_owned()).collect::<Vec<_>>();
        let (headings, columns, rows) = grid(&[Dimension::Views]);
        assert_eq!((headings, columns), (vec!["data", "method"], of(&["3 views", "4 views"])));
        assert_eq!(rows, of(&["x m", "x n", "y m", "y n"]));
        let (headings, columns, rows) = grid(&[Dimension::Views, Dimension::Method]);
        assert_eq!((headings, rows), (vec!["data"], of(&["x", "y"])));
        assert_eq!(columns, of(&["3 views, m", "3 views, n", "4 views, m", "4 views, n"]));
    }
}
