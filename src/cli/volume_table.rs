//! Scores in 3D as a table: the same columns on the terminal and on the page.

use nertca_vk::score::volume::{Scores, VolumeScores};

/// A column: what it shows, in two lines, and how.
pub struct Column {
    /// First and second line of its heading.
    pub heading: [&'static str; 2],
    text: fn(&Scores) -> String,
}

/// All columns but the first, which names the phase.
pub const COLUMNS: [Column; 10] = [
    Column { heading: ["3D", "Dice"], text: |s| format!("{:.3}", s.agreement.dice) },
    Column { heading: ["Chamfer", "mm"], text: |s| mm(s.agreement.chamfer_mm) },
    Column { heading: ["Hausdorff", "95 %, mm"], text: |s| mm(s.agreement.hausdorff95_mm) },
    Column { heading: ["centreline", "found"], text: |s| percent(s.agreement.true_centreline_found) },
    Column { heading: ["centreline", "true"], text: |s| percent(s.agreement.our_centreline_true) },
    Column { heading: ["", "clDice"], text: |s| s.agreement.cl_dice.map_or("-".into(), |v| format!("{v:.3}")) },
    Column { heading: ["", "components"], text: |s| s.agreement.components.to_string() },
    Column { heading: ["components", "of truth"], text: |s| s.agreement.true_components.to_string() },
    Column { heading: ["mass beyond", "2 pixels"], text: |s| percent(s.mass_beyond_2_pixels) },
    Column { heading: ["mass beyond", "2 mm"], text: |s| percent(s.mass_beyond_2_mm) },
];

fn mm(value: Option<f64>) -> String {
    value.map_or("-".into(), |v| format!("{v:.2}"))
}

fn percent(share: Option<f64>) -> String {
    share.map_or("-".into(), |v| format!("{:.1} %", 100.0 * v))
}

/// Rows of the table: the phase, or `mean`, and the text of each column.
pub fn rows(volume: &VolumeScores) -> Vec<(String, Vec<String>)> {
    let row = |name: String, scores: &Scores| (name, COLUMNS.iter().map(|column| (column.text)(scores)).collect());
    let phases = volume.phases.iter().map(|p| row(p.phase.to_string(), &p.scores));
    phases.chain([row("mean".into(), &volume.mean)]).collect()
}

/// What the numbers of the table mean.
pub fn legend(volume: &VolumeScores) -> String {
    format!(
        "Vessel where the moving field exceeds {:.4e} per mm. Centrelines count within {} mm, components from {:.3} mm³ on; \
         a pixel at the isocentre is {:.3} mm.",
        volume.threshold_per_mm, volume.within_mm, volume.smallest_component_mm3, volume.pixel_mm
    )
}

/// Prints the table and what it means.
pub fn print(volume: &VolumeScores) {
    let line = |name: &str, cells: Vec<&str>| {
        out!("{name:5}{}", cells.iter().map(|cell| format!("{cell:>13}")).collect::<String>());
    };
    line("", COLUMNS.iter().map(|c| c.heading[0]).collect());
    line("phase", COLUMNS.iter().map(|c| c.heading[1]).collect());
    for (name, cells) in rows(volume) {
        line(&name, cells.iter().map(String::as_str).collect());
    }
    out!("{}", legend(volume));
}
