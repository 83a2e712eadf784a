//! File formats of trees (see `docs/formats.md`): JSON, VTK, SWC and glTF.

#[cfg(feature = "dicom")]
pub mod measurements;
#[cfg(feature = "dicom")]
pub mod over_frames;
mod tubes;

use crate::error::{Error, Result};
use crate::files;
use crate::formats::swc;
use crate::formats::vtp::{self, Values};
use crate::trees::files::tubes::to_glb;
use crate::trees::lesions::{Lesion, MeasuredBeat, lesions};
use crate::trees::sight::TreeInView;
use crate::trees::tree::{BeatTree, Branch, Doubt, PhaseTree, RadiiFrom, TreeView};
use glam::DVec3;
use serde::Serialize;
use std::path::{Path, PathBuf};

const FORMAT: &str = "nertca-tree";
const VERSION: u32 = 1;
const AXES: &str = "left, posterior, superior";
/// Rounding of coordinates, per mm: a tenth of a micrometre.
const PER_MM: f64 = 1e4;

/// File format of trees.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TreeFormat {
    /// JSON: all phases in one file.
    Json,
    /// VTK poly data, a file per phase with a `.pvd` collection.
    Vtp,
    /// SWC, a file per phase.
    Swc,
    /// Binary glTF: tubes, all phases in one animated file.
    Glb,
}

impl TreeFormat {
    /// Returns the format by the extension of a file name.
    pub fn of(path: &Path) -> Option<TreeFormat> {
        match path.extension()?.to_str()?.to_lowercase().as_str() {
            "json" => Some(TreeFormat::Json),
            "vtp" => Some(TreeFormat::Vtp),
            "swc" => Some(TreeFormat::Swc),
            "glb" => Some(TreeFormat::Glb),
            _ => None,
        }
    }
}

/// Content of `tree.json`.
#[derive(Serialize)]
struct TreeFile {
    format: &'static str,
    version: u32,
    axes: &'static str,
    tracked: bool,
    reference_phase: Option<u32>,
    note: &'static str,
    threshold_per_mm: f64,
    resolution_mm: f64,
    spacing_mm: f64,
    radii_from: RadiiFrom,
    phases: Vec<PhaseRow>,
}

#[derive(Serialize)]
struct PhaseRow {
    phase: u32,
    length_mm: f64,
    branches: Vec<BranchRow>,
    lesions: Vec<LesionRow>,
}

#[derive(Serialize)]
struct LesionRow {
    branch: usize,
    point: usize,
    from_root_mm: f64,
    length_mm: f64,
    min_diameter_mm: f64,
    reference_diameter_mm: f64,
    stenosis_percent: f64,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    over_beat_percent: Vec<f64>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    views: Vec<SightRow>,
}

/// Sight of a lesion in a training view.
#[derive(Serialize)]
struct SightRow {
    view: usize,
    primary_deg: Option<f64>,
    secondary_deg: Option<f64>,
    foreshortening: f64,
    overlap: f64,
}

impl LesionRow {
    fn of(lesion: &Lesion, over_beat: Vec<f64>, tree: &PhaseTree, views: &[(&TreeView, TreeInView)]) -> LesionRow {
        let tenths = |percent: f64| (10.0 * percent).round() / 10.0;
        let sight = |(view, shown): &(&TreeView, TreeInView)| {
            let sight = shown.sight(tree, &lesion.places)?;
            Some(SightRow {
                view: view.view,
                primary_deg: view.angles_deg.map(|angles| angles.0),
                secondary_deg: view.angles_deg.map(|angles| angles.1),
                foreshortening: rounded(sight.foreshortening),
                overlap: rounded(sight.overlap),
            })
        };
        LesionRow {
            views: views.iter().filter_map(sight).collect(),
            stenosis_percent: tenths(lesion.percent()),
            over_beat_percent: over_beat.into_iter().map(tenths).collect(),
            branch: lesion.branch,
            point: lesion.point,
            from_root_mm: rounded(lesion.from_root_mm),
            length_mm: rounded(lesion.length_mm),
            min_diameter_mm: rounded(lesion.min_diameter_mm),
            reference_diameter_mm: rounded(lesion.reference_diameter_mm),
        }
    }
}

#[derive(Serialize)]
struct BranchRow {
    parent: Option<usize>,
    length_mm: f64,
    points_mm: Vec<[f64; 3]>,
    radius_mm: Vec<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    gap_mm: Option<f64>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    agreement: Vec<f64>,
    #[serde(flatten, skip_serializing_if = "Option::is_none")]
    doubt: Option<DoubtRows>,
}

/// Doubt about the points of a branch.
#[derive(Serialize)]
struct DoubtRows {
    doubt_mm: Vec<f64>,
    doubt_direction: Vec<[f64; 3]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    doubt_with_motion_mm: Option<Vec<f64>>,
    existence: Vec<f64>,
}

impl DoubtRows {
    /// Returns the rows of a branch; `None` where doubt is not stated.
    fn of(branch: &Branch) -> Option<DoubtRows> {
        let doubts = || branch.doubt.iter();
        (!branch.doubt.is_empty()).then(|| DoubtRows {
            doubt_mm: doubts().map(|doubt| rounded(doubt.across_mm)).collect(),
            doubt_direction: doubts().map(|doubt| rounded_point(&doubt.direction)).collect(),
            doubt_with_motion_mm: doubts().map(|doubt| doubt.with_motion_mm.map(rounded)).collect(),
            existence: doubts().map(|doubt| rounded(doubt.existence)).collect(),
        })
    }
}

fn rounded(mm: f64) -> f64 {
    (mm * PER_MM).round() / PER_MM
}

fn rounded_point(point_mm: &DVec3) -> [f64; 3] {
    point_mm.to_array().map(rounded)
}

impl BranchRow {
    fn of(branch: &Branch) -> BranchRow {
        BranchRow {
            parent: branch.parent,
            length_mm: rounded(branch.length_mm()),
            points_mm: branch.points_mm.iter().map(rounded_point).collect(),
            radius_mm: branch.radius_mm.iter().copied().map(rounded).collect(),
            gap_mm: (branch.gap_mm > 0.0).then(|| rounded(branch.gap_mm)),
            agreement: branch.agreement.iter().copied().map(rounded).collect(),
            doubt: DoubtRows::of(branch),
        }
    }
}

/// Note in every file on the correspondence of points between phases.
pub fn note(beat: &BeatTree) -> &'static str {
    match beat.reference_phase {
        Some(_) => {
            "tracked: a point of a branch is the same material point at every phase; motion along a vessel is not \
             observed in projections"
        }
        None => {
            "not tracked: each phase has its own tree, whose branches and points do not correspond to those of other \
             phases"
        }
    }
}

/// Writes a tree and returns the files written. `sequence` adds a number to each file name in a format with a file per
/// phase and, for VTK, a collection, even for one phase.
///
/// # Errors
/// [`Error::Config`] for the name of a VTK series that is not text; [`Error::Io`].
pub fn write(beat: &BeatTree, path: &Path, format: TreeFormat, sequence: bool) -> Result<Vec<PathBuf>> {
    match format {
        TreeFormat::Json => {
            files::write_atomic(path, to_json(beat)?.as_bytes())?;
            Ok(vec![path.to_path_buf()])
        }
        TreeFormat::Vtp => {
            if sequence && path.file_name().is_some_and(|name| name.to_str().is_none()) {
                let problem =
                    "is not text in UTF-8, and the .pvd that lists the files cannot name them: choose another name";
                return Err(Error::config("--out", path.display(), problem));
            }
            let mut made = write_phases(beat, path, sequence, to_vtp)?;
            if sequence {
                // The collection is written last, so that all files it lists exist.
                let collection = path.with_extension("pvd");
                files::write_atomic(&collection, to_collection(beat, &made).as_bytes())?;
                made.push(collection);
            }
            Ok(made)
        }
        TreeFormat::Swc => write_phases(beat, path, sequence, to_swc),
        TreeFormat::Glb => {
            files::write_atomic(path, &to_glb(beat)?)?;
            Ok(vec![path.to_path_buf()])
        }
    }
}

/// Writes one file per phase: `name.vtp`, or `name_0000.vtp` and so on.
fn write_phases(
    beat: &BeatTree,
    path: &Path,
    sequence: bool,
    content: fn(&BeatTree, &PhaseTree) -> String,
) -> Result<Vec<PathBuf>> {
    let write = |tree: &PhaseTree| -> Result<PathBuf> {
        let file = match sequence {
            true => files::of_phase(path, tree.phase),
            false => path.to_path_buf(),
        };
        files::write_atomic(&file, content(beat, tree).as_bytes())?;
        Ok(file)
    };
    beat.phases.iter().map(write).collect()
}

/// Formats all phases as the text of a `.json` file.
///
/// # Errors
/// [`Error::Internal`] for values that JSON cannot represent.
pub fn to_json(beat: &BeatTree) -> Result<String> {
    let measured = MeasuredBeat::new(beat);
    let phases = beat.phases.iter().map(|tree| {
        let found = lesions(tree, beat.measurement());
        // Views are needed for lesions only.
        let views = if found.is_empty() { Vec::new() } else { in_views(beat, tree) };
        PhaseRow {
            phase: tree.phase,
            length_mm: rounded(tree.length_mm()),
            branches: tree.branches.iter().map(BranchRow::of).collect(),
            lesions: found
                .iter()
                .map(|lesion| LesionRow::of(lesion, measured.percents(lesion), tree, &views))
                .collect(),
        }
    });
    let file = TreeFile {
        format: FORMAT,
        version: VERSION,
        axes: AXES,
        tracked: beat.reference_phase.is_some(),
        reference_phase: beat.reference_phase,
        note: note(beat),
        threshold_per_mm: beat.threshold_per_mm,
        resolution_mm: beat.resolution_mm,
        spacing_mm: beat.spacing_mm,
        radii_from: beat.radii_from,
        phases: phases.collect(),
    };
    serde_json::to_string(&file).map_err(|e| Error::Internal(e.to_string()))
}

/// Returns a tree as each training view shows it.
fn in_views<'a>(beat: &'a BeatTree, tree: &PhaseTree) -> Vec<(&'a TreeView, TreeInView)> {
    beat.views.iter().map(|view| (view, TreeInView::new(tree, &view.rays, beat.resolution_mm))).collect()
}

fn title(beat: &BeatTree, tree: &PhaseTree) -> String {
    format!("centrelines of vessels, LPS mm, phase {}; {}", tree.phase, note(beat))
}

fn to_vtp(beat: &BeatTree, tree: &PhaseTree) -> String {
    let branches = || tree.branches.iter();
    let radii: Vec<f64> = branches().flat_map(|b| b.radius_mm.iter().copied().map(rounded)).collect();
    let mut of_points = vec![
        Values::Float("Radius", radii.clone()),
        // VMTK and its 3D Slicer extension expect this name.
        Values::Float("MaximumInscribedSphereRadius", radii),
        Values::Int("PointId", branches().flat_map(|b| 0..b.points_mm.len() as i64).collect()),
    ];
    if branches().all(|b| b.agreement.len() == b.points_mm.len()) {
        let agreement = branches().flat_map(|b| b.agreement.iter().copied().map(rounded)).collect();
        of_points.push(Values::Float("Agreement", agreement));
    }
    if branches().all(|b| b.doubt.len() == b.points_mm.len()) {
        let doubts = |pick: fn(&Doubt) -> f64| branches().flat_map(|b| &b.doubt).map(pick).map(rounded).collect();
        of_points.push(Values::Float("Doubt", doubts(|doubt| doubt.across_mm)));
        of_points.push(Values::Float("Existence", doubts(|doubt| doubt.existence)));
        let with_motion: Option<Vec<f64>> =
            branches().flat_map(|b| &b.doubt).map(|doubt| doubt.with_motion_mm.map(rounded)).collect();
        of_points.extend(with_motion.map(|widths| Values::Float("DoubtWithMotion", widths)));
    }
    let lines = vtp::Lines {
        title: title(beat, tree),
        time: f64::from(tree.phase),
        points: branches().flat_map(|b| b.points_mm.iter().map(rounded_point)).collect(),
        counts: branches().map(|b| b.points_mm.len()).collect(),
        of_points,
        of_lines: vec![
            Values::Int("BranchId", (0..tree.branches.len() as i64).collect()),
            Values::Int("ParentId", branches().map(|b| b.parent.map_or(-1, |parent| parent as i64)).collect()),
            Values::Int("Tracked", branches().map(|_| i64::from(beat.reference_phase.is_some())).collect()),
        ],
    };
    lines.to_vtp()
}

fn to_collection(beat: &BeatTree, files: &[PathBuf]) -> String {
    let name = |file: &PathBuf| file.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let entries = beat.phases.iter().zip(files).map(|(tree, file)| (f64::from(tree.phase), name(file)));
    vtp::collection(&entries.collect::<Vec<_>>())
}

fn to_swc(beat: &BeatTree, tree: &PhaseTree) -> String {
    let mut points: Vec<swc::Point> = Vec::new();
    // Index of the last point of each branch among all points.
    let mut ends = Vec::new();
    for branch in &tree.branches {
        let mut before = branch.parent.map(|parent| ends[parent]);
        // The first point of a branch is the last of its parent, which is already stored.
        let first = usize::from(before.is_some());
        for (point, radius) in branch.points_mm.iter().zip(&branch.radius_mm).skip(first) {
            points.push(swc::Point { position: rounded_point(point), radius: rounded(*radius), parent: before });
            before = Some(points.len() - 1);
        }
        ends.push(points.len() - 1);
    }
    swc::to_swc(&title(beat, tree), &points)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn beat(reference_phase: Option<u32>) -> BeatTree {
        let line = |points: &[f64]| points.iter().map(|x| DVec3::new(*x, 0.0, 1.0)).collect();
        let branches = vec![
            Branch {
                parent: None,
                points_mm: line(&[0.0, 1.0]),
                radius_mm: vec![2.0, 1.5],
                agreement: Vec::new(),
                doubt: Vec::new(),
                gap_mm: 0.0,
            },
            Branch {
                parent: Some(0),
                points_mm: line(&[1.0, 2.0, 3.0]),
                radius_mm: vec![1.5, 1.0, 0.5],
                agreement: Vec::new(),
                doubt: Vec::new(),
                gap_mm: 0.0,
            },
            Branch {
                parent: Some(0),
                points_mm: line(&[1.0, 5.0]),
                radius_mm: vec![1.5, 0.7],
                agreement: Vec::new(),
                doubt: Vec::new(),
                gap_mm: 0.0,
            },
        ];
        let phases = vec![PhaseTree { phase: 3, branches }];
        BeatTree {
            reference_phase,
            threshold_per_mm: 0.02,
            resolution_mm: 0.5,
            spacing_mm: 0.25,
            views: Vec::new(),
            phases,
            vessel_per_mm: None,
            radii_from: RadiiFrom::Field,
            measured_mm: Vec::new(),
        }
    }

    #[test]
    fn points_of_swc_come_from_the_parents_end() {
        let beat = beat(Some(0));
        let text = to_swc(&beat, &beat.phases[0]);
        let rows: Vec<&str> = text.lines().filter(|line| !line.starts_with('#')).collect();
        let expected = ["1 0 0 0 1 2 -1", "2 0 1 0 1 1.5 1", "3 0 2 0 1 1 2", "4 0 3 0 1 0.5 3", "5 0 5 0 1 0.7 2"];
        assert_eq!(rows, expected);
    }

    #[test]
    fn all_files_say_whether_points_are_followed() {
        for (reference, said) in [(Some(0), "tracked: a point"), (None, "not tracked: each phase")] {
            let beat = beat(reference);
            let tree = &beat.phases[0];
            for text in [to_json(&beat).unwrap(), to_vtp(&beat, tree), to_swc(&beat, tree)] {
                assert_eq!(text.matches(said).count(), 1, "{text}");
            }
        }
    }

    #[test]
    fn json_states_gaps_where_there_are_any() {
        let mut beat = beat(None);
        assert!(!to_json(&beat).unwrap().contains("gap_mm"));
        beat.phases[0].branches[1].gap_mm = 8.25;
        let json: serde_json::Value = serde_json::from_str(&to_json(&beat).unwrap()).unwrap();
        let gaps = [0, 1, 2].map(|branch| json["phases"][0]["branches"][branch]["gap_mm"].as_f64());
        assert_eq!(gaps, [None, Some(8.25), None]);
    }

    #[test]
    fn names_tell_the_format() {
        let of = |name: &str| TreeFormat::of(Path::new(name));
        assert_eq!(of("beat.VTP"), Some(TreeFormat::Vtp));
        assert_eq!((of("a.json"), of("a.swc")), (Some(TreeFormat::Json), Some(TreeFormat::Swc)));
        assert_eq!(of("a.glb"), Some(TreeFormat::Glb));
        assert_eq!((of("a.vtk"), of("json"), of("a.json.gz")), (None, None, None));
    }
}
