//! Tables as text: Markdown, CSV and LaTeX.

use crate::scores::Score;
use crate::table::{Cell, Grid, State, Table};

/// Markup of a language for the content of cells.
struct Language {
    bold: [&'static str; 2],
    plus_minus: &'static str,
    /// Escapes characters that the language would take for markup.
    escape: fn(&str) -> String,
}

const MARKDOWN: Language = Language { bold: ["**", "**"], plus_minus: "±", escape: markdown_escape };
const LATEX: Language = Language { bold: ["\\textbf{", "}"], plus_minus: "$\\pm$", escape: latex_escape };

fn markdown_escape(text: &str) -> String {
    text.replace('|', "\\|")
}

fn latex_escape(text: &str) -> String {
    text.chars()
        .map(|c| match c {
            '\\' => "\\textbackslash{}".to_owned(),
            '~' => "\\textasciitilde{}".to_owned(),
            '^' => "\\textasciicircum{}".to_owned(),
            '&' | '%' | '$' | '#' | '_' | '{' | '}' => format!("\\{c}"),
            '±' => "$\\pm$".to_owned(),
            '°' => "$^\\circ$".to_owned(),
            c => c.to_string(),
        })
        .collect()
}

impl Cell {
    /// Text of the cell: our mean and its spread, the number of runs where some are missing, and the published value.
    fn text(&self, score: Score, language: &Language) -> String {
        let ours = match self.state {
            State::Scored { mean, deviation, runs, of } => {
                let mean = score.text(mean);
                let [open, close] = if self.best { language.bold } else { ["", ""] };
                let spread = deviation.map_or(String::new(), |d| format!(" {} {}", language.plus_minus, score.text(d)));
                let missing = if runs < of { format!(" [{runs} of {of}]") } else { String::new() };
                format!("{open}{mean}{close}{spread}{missing}")
            }
            State::NoScore | State::Published => "-".to_owned(),
            State::Failed => "failed".to_owned(),
            State::NotRun => "not run".to_owned(),
        };
        match self.published {
            // The published value is written with the digits it was published with.
            Some(value) => format!("{ours} ({value})"),
            None => ours,
        }
    }

    /// Text of the cell without markup.
    pub fn plain(&self, score: Score) -> String {
        self.text(score, &Language { bold: ["", ""], ..MARKDOWN })
    }
}

fn cells(grid: &Grid<'_>, row: &[Option<&Cell>], language: &Language) -> Vec<String> {
    let texts = grid.columns.iter().zip(row);
    texts.map(|((_, score), cell)| cell.map_or(String::new(), |cell| cell.text(*score, language))).collect()
}

/// The table as Markdown, with its title and notes.
pub fn markdown(table: &Table) -> String {
    let grid = table.grid();
    let line = |cells: &[String]| format!("| {} |\n", cells.join(" | "));
    let headings = grid.headings.iter().map(|heading| (*heading).to_owned());
    let columns = grid.columns.iter().map(|(group, score)| match group.as_str() {
        "" => score.heading().to_owned(),
        group => format!("{}: {}", markdown_escape(group), score.heading()),
    });
    let headings: Vec<String> = headings.chain(columns).collect();
    let mut text = format!("# {}\n\n{}", table.title, line(&headings));
    text += &format!("|{}\n", "---|".repeat(headings.len()));
    for (names, row) in &grid.rows {
        let names = names.iter().map(|name| markdown_escape(name));
        text += &line(&names.chain(cells(&grid, row, &MARKDOWN)).collect::<Vec<_>>());
    }
    table.notes.iter().for_each(|note| text += &format!("\n{note}\n"));
    text
}

/// The table as LaTeX, to be inserted into a document; it needs no package.
pub fn latex(table: &Table) -> String {
    let grid = table.grid();
    let names = grid.headings.len();
    let mut groups: Vec<(&str, usize)> = Vec::new();
    for (group, _) in &grid.columns {
        match groups.last_mut() {
            Some((last, columns)) if last == group => *columns += 1,
            _ => groups.push((group, 1)),
        }
    }
    let line = |cells: &[String]| format!("{} \\\\\n", cells.join(" & "));
    let alignment: String = groups.iter().map(|(_, columns)| format!("|{}", "c".repeat(*columns))).collect();
    let mut text = format!("% {}\n\\begin{{tabular}}{{{}{alignment}}}\n\\hline\n", table.title, "l".repeat(names));
    let over = groups.iter().map(|(group, n)| format!("\\multicolumn{{{n}}}{{|c}}{{{}}}", latex_escape(group)));
    text += &line(&std::iter::repeat_n(String::new(), names).chain(over).collect::<Vec<_>>());
    let headings = grid.headings.iter().map(|heading| (*heading).to_owned());
    let scores = grid.columns.iter().map(|(_, score)| latex_escape(score.heading()));
    text += &line(&headings.chain(scores).collect::<Vec<_>>());
    text += "\\hline\n";
    for (names, row) in &grid.rows {
        let names = names.iter().map(|name| (LATEX.escape)(name));
        text += &line(&names.chain(cells(&grid, row, &LATEX)).collect::<Vec<_>>());
    }
    text += "\\hline\n\\end{tabular}\n";
    table.notes.iter().for_each(|note| text += &format!("% {note}\n"));
    text
}

/// The table as CSV (RFC 4180), one line per score, with all digits of the numbers.
pub fn csv(table: &Table) -> String {
    let quote = |text: &str| match text.contains([',', '"', '\n', '\r']) {
        true => format!("\"{}\"", text.replace('"', "\"\"")),
        false => text.to_owned(),
    };
    let number = |value: Option<f64>| value.map_or(String::new(), |v| v.to_string());
    let mut text = "data,views,method,score,mean,deviation,runs,of,published,state\n".to_owned();
    for entry in &table.entries {
        let (mean, deviation, runs, of, state) = match entry.cell.state {
            State::Scored { mean, deviation, runs, of } => {
                (Some(mean), deviation, runs.to_string(), of.to_string(), "scored")
            }
            State::NoScore => (None, None, String::new(), String::new(), "no score"),
            State::Failed => (None, None, String::new(), String::new(), "failed"),
            State::NotRun => (None, None, String::new(), String::new(), "not run"),
            State::Published => (None, None, String::new(), String::new(), "published"),
        };
        let cells = [
            quote(&entry.data),
            entry.views.map_or(String::new(), |views| views.to_string()),
            quote(&entry.method),
            nertca_vk::choice::Choice::name(entry.score).to_owned(),
            number(mean),
            number(deviation),
            runs,
            of,
            number(entry.cell.published),
            state.to_owned(),
        ];
        text += &format!("{}\n", cells.join(","));
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_say_what_there_is() {
        let scored = State::Scored { mean: 0.84, deviation: Some(0.01), runs: 2, of: 3 };
        let cell = Cell { state: scored, published: Some(0.75), best: true };
        assert_eq!(cell.text(Score::Dice, &MARKDOWN), "**0.840** ± 0.010 [2 of 3] (0.75)");
        assert_eq!(cell.text(Score::Dice, &LATEX), "\\textbf{0.840} $\\pm$ 0.010 [2 of 3] (0.75)");
        let missing = Cell { state: State::NotRun, published: None, best: false };
        assert_eq!(missing.plain(Score::Psnr), "not run");
        let theirs = Cell { state: State::Published, published: Some(0.5), best: false };
        assert_eq!(theirs.plain(Score::Ssim), "- (0.5)");
    }

    #[test]
    fn markup_in_names_is_text() {
        assert_eq!(latex_escape("a_b 5 % & {c}"), "a\\_b 5 \\% \\& \\{c\\}");
        assert_eq!(markdown_escape("a|b"), "a\\|b");
    }
}
