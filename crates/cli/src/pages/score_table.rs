//! Scores by phase as a table, with the same columns on the terminal and on the page.

use maud::{Markup, html};

/// Column of the table: a heading of two lines, and the text of its cells.
pub struct Column<S> {
    /// First and second line of its heading.
    pub heading: [&'static str; 2],
    /// Returns the text of a cell.
    pub text: fn(&S) -> String,
}

/// Formats a length that may be unknown.
pub fn mm(value: Option<f64>) -> String {
    value.map_or("-".into(), |v| format!("{v:.2}"))
}

/// Formats a share that may be unknown.
pub fn percent(share: Option<f64>) -> String {
    share.map_or("-".into(), |v| format!("{:.1} %", 100.0 * v))
}

/// Remark under tables whose truth was moved by the common motion of the calibrated views.
const CARRIED: &str = "The truth was moved by the common displacement of all calibrated views, which images cannot \
                       show; the row `as stated` has the means without it.";

/// A table with one row for each phase and one for their mean.
pub struct ScoreTable {
    title: &'static str,
    /// Meaning of the numbers.
    legend: String,
    headings: Vec<[&'static str; 2]>,
    /// Name of each row (the phase, `mean` or `as stated`), and the text of each column.
    rows: Vec<(String, Vec<String>)>,
}

impl ScoreTable {
    /// Makes a table of all phases with their scores, of the mean, and of the mean with the truth as stated.
    pub fn new<'a, S: 'a>(
        title: &'static str,
        legend: String,
        columns: &[Column<S>],
        phases: impl Iterator<Item = (u32, &'a S)>,
        mean: &S,
        as_stated: Option<&S>,
    ) -> ScoreTable {
        let row = |name: String, scores: &S| (name, columns.iter().map(|column| (column.text)(scores)).collect());
        let means = [Some(row("mean".into(), mean)), as_stated.map(|scores| row("as stated".into(), scores))];
        let rows = phases.map(|(phase, scores)| row(phase.to_string(), scores)).chain(means.into_iter().flatten());
        let rows = rows.collect();
        let legend = if as_stated.is_some() { format!("{legend} {CARRIED}") } else { legend };
        ScoreTable { title, legend, headings: columns.iter().map(|column| column.heading).collect(), rows }
    }

    /// Returns the table for a page.
    pub fn markup(&self) -> Markup {
        html! {
            h2 { (self.title) }
            p.lead { (self.legend) }
            div.scroll { table {
                tr { th { "phase" } @for heading in &self.headings { th { (heading.join(" ").trim()) } } }
                @for (name, cells) in &self.rows { tr { td { (name) } @for cell in cells { td { (cell) } } } }
            } }
        }
    }

    /// Prints the table and its legend.
    pub fn print(&self) {
        let line = |name: &str, cells: Vec<&str>| {
            out!("{name:9}{}", cells.iter().map(|cell| format!("{cell:>13}")).collect::<String>());
        };
        line("", self.headings.iter().map(|heading| heading[0]).collect());
        line("phase", self.headings.iter().map(|heading| heading[1]).collect());
        for (name, cells) in &self.rows {
            line(name, cells.iter().map(String::as_str).collect());
        }
        out!("{}", self.legend);
    }
}
