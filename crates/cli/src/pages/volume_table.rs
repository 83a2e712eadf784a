//! Scores in 3D as a table.

use crate::pages::score_table::{Column, ScoreTable, mm, percent};
use nertca_vk_vessels::score::volume::{Scores, VolumeScores};

const COLUMNS: [Column<Scores>; 11] = [
    Column { heading: ["3D", "Dice"], text: |s| format!("{:.3}", s.agreement.dice) },
    Column { heading: ["lumen", "Dice"], text: |s| s.lumen_dice.map_or("-".into(), |v| format!("{v:.3}")) },
    Column { heading: ["Chamfer", "mm"], text: |s| mm(s.agreement.chamfer_mm) },
    Column { heading: ["Hausdorff", "95 %, mm"], text: |s| mm(s.agreement.hausdorff95_mm) },
    Column { heading: ["centreline", "found"], text: |s| percent(s.agreement.true_centreline_found) },
    Column { heading: ["centreline", "true"], text: |s| percent(s.agreement.our_centreline_true) },
    Column { heading: ["", "clDice"], text: |s| s.agreement.cl_dice.map_or("-".into(), |v| format!("{v:.3}")) },
    Column { heading: ["", "components"], text: |s| format!("{:.1}", s.agreement.components) },
    Column { heading: ["components", "of truth"], text: |s| format!("{:.1}", s.agreement.true_components) },
    Column { heading: ["mass beyond", "2 pixels"], text: |s| percent(s.mass_beyond_2_pixels) },
    Column { heading: ["mass beyond", "2 mm"], text: |s| percent(s.mass_beyond_2_mm) },
];

/// Returns the table of all phases and their mean.
pub fn table(volume: &VolumeScores) -> ScoreTable {
    let phases = volume.phases.iter().map(|p| (p.phase, &p.scores));
    ScoreTable::new("Scores in 3D", legend(volume), &COLUMNS, phases, &volume.mean, volume.mean_as_stated.as_ref())
}

/// Describes the numbers of the table.
fn legend(volume: &VolumeScores) -> String {
    format!(
        "A voxel is vessel where the dynamic field exceeds {:.4e} per mm, and lumen where it exceeds half of the stated vessel \
         attenuation, as voxels of the truth do. Centrelines agree where their distance is at \
         most {} mm, and components count if they have at least {:.3} mm³; a pixel at the isocentre is {:.3} mm wide.",
        volume.threshold_per_mm, volume.within_mm, volume.smallest_component_mm3, volume.pixel_mm
    )
}
