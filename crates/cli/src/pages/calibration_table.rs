//! A calibration as a table, with the same columns on the terminal and on the page.

use nertca_vk::calibrate::correction::{Calibration, ViewCorrection};

/// Column of the table: a heading of two lines, and the text of its cells.
pub struct Column {
    /// First and second line of its heading.
    pub heading: [&'static str; 2],
    text: fn(&ViewCorrection) -> String,
}

/// All columns; the table has one row per view.
pub const COLUMNS: [Column; 9] = [
    Column { heading: ["", "view"], text: |v| v.view.to_string() },
    Column { heading: ["primary", "deg"], text: |v| format!("{:+.2}", v.primary_deg) },
    Column { heading: ["secondary", "deg"], text: |v| format!("{:+.2}", v.secondary_deg) },
    Column { heading: ["left", "mm"], text: |v| format!("{:+.2}", v.table_mm[0]) },
    Column { heading: ["posterior", "mm"], text: |v| format!("{:+.2}", v.table_mm[1]) },
    Column { heading: ["superior", "mm"], text: |v| format!("{:+.2}", v.table_mm[2]) },
    Column { heading: ["moved", "px"], text: |v| format!("{:.2}", v.moved_px) },
    Column { heading: ["residual", "before"], text: |v| format!("{:.1} %", 100.0 * v.residual_before) },
    Column { heading: ["residual", "after"], text: |v| format!("{:.1} %", 100.0 * v.residual_after) },
];

/// Returns the rows of the table.
pub fn rows(calibration: &Calibration) -> Vec<Vec<String>> {
    let row = |view| COLUMNS.iter().map(|column| (column.text)(view)).collect();
    calibration.views.iter().map(row).collect()
}

/// Headings of the table of what was corrected frame by frame; the table has one row per view.
pub const FRAME_COLUMNS: [&str; 4] = ["view", "frames", "heart displaced by up to, mm", "contrast"];

/// Returns the rows of the table of frames; none where only views were corrected.
pub fn frame_rows(calibration: &Calibration) -> Vec<[String; 4]> {
    let row = |view: usize| {
        let frames: Vec<_> = calibration.frames.iter().filter(|frame| frame.view == view).collect();
        let shift = |[x, y, z]: [f64; 3]| (x * x + y * y + z * z).sqrt();
        let farthest = frames.iter().map(|frame| shift(frame.heart_shift_mm)).fold(0.0, f64::max);
        let low = frames.iter().map(|frame| frame.contrast).fold(f64::INFINITY, f64::min);
        let high = frames.iter().map(|frame| frame.contrast).fold(0.0, f64::max);
        (!frames.is_empty()).then(|| {
            [view.to_string(), frames.len().to_string(), format!("{farthest:.2}"), format!("{low:.2} to {high:.2}")]
        })
    };
    calibration.views.iter().filter_map(|v| row(v.view)).collect()
}

/// Describes how well the views agree before and after the calibration.
pub fn legend(calibration: &Calibration) -> String {
    let [before, after] = calibration.explained.map(|share| 100.0 * share);
    let chance = calibration.explained_by_chance.map(|share| {
        format!(
            " By chance, with the vessels of a view displaced by a seventh of the image, it would be {:.0} %.",
            100.0 * share
        )
    });
    format!(
        "The views disagreed by {:.2} pixels. All other views together explain {before:.0} % of a view's vessel pixels \
         before the correction, and {after:.0} % after it.{}",
        calibration.disagreement_px,
        chance.unwrap_or_default()
    )
}

/// Prints the table, if something was corrected, and the calibration's notes.
pub fn print(calibration: &Calibration) {
    if !calibration.views.is_empty() {
        let line = |cells: Vec<&str>| out!("{}", cells.iter().map(|cell| format!("{cell:>11}")).collect::<String>());
        line(COLUMNS.iter().map(|c| c.heading[0]).collect());
        line(COLUMNS.iter().map(|c| c.heading[1]).collect());
        rows(calibration).iter().for_each(|cells| line(cells.iter().map(String::as_str).collect()));
        out!("{}", legend(calibration));
    }
    calibration.notes.iter().for_each(|note| out!("{note}"));
}
