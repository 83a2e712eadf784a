//! Stenoses in the report: a table with their sight in each training view, and the vessels straightened with their diameters.

use maud::{Markup, html};
use nertca_vk_vessels::trees::lesions::{Lesion, MIN_PERCENT, StraightVessel, straight_vessels};
use nertca_vk_vessels::trees::sight::TreeInView;
use nertca_vk_vessels::trees::tree::{BeatTree, PhaseTree, TreeView};
use std::fmt::Write as _;

/// Number of vessels that are drawn straightened, besides those with a stenosis.
const LONGEST: usize = 3;
/// Width of the drawing of a straightened vessel, pixels of the page.
const WIDTH: f64 = 560.0;
/// Pixels of the page per mm of diameter.
const PER_MM: f64 = 14.0;
/// Space for the scale at the left, pixels of the page.
const LEFT: f64 = 34.0;
/// Space for the scale below, pixels of the page.
const BELOW: f64 = 20.0;
/// Minimum diameter that a drawing has room for, mm.
const MIN_ROOM_MM: f64 = 3.0;
/// Interval of the marks along a short vessel, mm.
const SHORT_MARK_MM: f64 = 10.0;
/// Interval of the marks along a long vessel, mm.
const LONG_MARK_MM: f64 = 20.0;
/// Length from which a vessel is long, mm.
const LONG_MM: f64 = 80.0;

/// Renders the stenoses of a tree of a beat.
pub fn section(beat: &BeatTree, tree: &PhaseTree) -> Markup {
    let vessels = straight_vessels(tree, beat.measurement());
    let lesions: Vec<&Lesion> = vessels.iter().flat_map(|vessel| &vessel.lesions).collect();
    html! {
        @if lesions.is_empty() {
            p { "No stenosis of " (format!("{MIN_PERCENT:.0}")) " % or more was found." }
        } @else {
            (table(beat, tree, &lesions))
        }
        (strips(vessels))
    }
}

/// Renders the table of stenoses.
fn table(beat: &BeatTree, tree: &PhaseTree, lesions: &[&Lesion]) -> Markup {
    let shown: Vec<(&TreeView, TreeInView)> =
        beat.views.iter().map(|view| (view, TreeInView::new(tree, &view.rays, beat.resolution_mm))).collect();
    html! {
        p { "Stenoses of " (format!("{MIN_PERCENT:.0}")) " % or more"
            @if !shown.is_empty() {
                "; for each training view, the share of the length that the projection loses, and the share over which another vessel \
                 touches it in the image"
            } ":" }
        table {
            tr { th { "stenosis, %" } th { "branch" } th { "from the root, mm" } th { "length, mm" } th { "diameter, mm" }
                th { "reference, mm" } @for (view, _) in &shown { th { "view " (view.view) ", %" } } }
            @for lesion in lesions {
                tr {
                    td { (format!("{:.0}", lesion.percent())) }
                    td { (lesion.branch) }
                    td { (format!("{:.1}", lesion.from_root_mm)) }
                    td { (format!("{:.1}", lesion.length_mm)) }
                    td { (format!("{:.2}", lesion.min_diameter_mm)) }
                    td { (format!("{:.2}", lesion.reference_diameter_mm)) }
                    @for (_, shown) in &shown { td { (sight(shown, tree, lesion)) } }
                }
            }
        }
    }
}

/// Describes the sight of a lesion in a view: foreshortening and overlap in percent.
fn sight(shown: &TreeInView, tree: &PhaseTree, lesion: &Lesion) -> String {
    let percent = |share: f64| (100.0 * share).round();
    shown
        .sight(tree, &lesion.places)
        .map_or("-".into(), |sight| format!("{} / {}", percent(sight.foreshortening), percent(sight.overlap)))
}

/// Draws the vessels with stenoses and the longest others, straightened.
fn strips(mut vessels: Vec<StraightVessel>) -> Markup {
    let length = |vessel: &StraightVessel| vessel.along_mm[vessel.along_mm.len() - 1] - vessel.along_mm[0];
    vessels.sort_by(|a, b| length(b).total_cmp(&length(a)));
    let mut others = 0;
    vessels.retain(|vessel| {
        others += usize::from(vessel.lesions.is_empty());
        !vessel.lesions.is_empty() || others <= LONGEST
    });
    html! {
        @if !vessels.is_empty() {
            p { "Vessels straightened: the lumen (filled) and its reference (dashed) over the length from the root, mm; stenoses are red. \
                 Drawn are all vessels with a stenosis and the " (LONGEST) " longest others." }
            @for vessel in &vessels { (strip(vessel)) }
        }
    }
}

/// Draws a straightened vessel.
fn strip(vessel: &StraightVessel) -> Markup {
    let (start_mm, end_mm) = (vessel.along_mm[0], vessel.along_mm[vessel.along_mm.len() - 1]);
    let widest_mm = vessel.diameter_mm.iter().chain(&vessel.reference_mm).copied().fold(MIN_ROOM_MM, f64::max);
    let high = PER_MM * widest_mm;
    let middle = 0.5 * high;
    let across = |mm: f64| LEFT + (WIDTH - LEFT) * (mm - start_mm) / (end_mm - start_mm).max(f64::MIN_POSITIVE);
    let edges = |diameters: &[f64], first: usize| {
        let at = |side: f64| {
            let point = move |(i, diameter): (usize, &f64)| {
                format!("{:.1},{:.1}", across(vessel.along_mm[first + i]), middle + side * 0.5 * PER_MM * diameter)
            };
            diameters.iter().enumerate().map(point).collect::<Vec<_>>()
        };
        [at(-1.0), at(1.0)]
    };
    let closed = |diameters: &[f64], first: usize| {
        let [upper, mut lower] = edges(diameters, first);
        lower.reverse();
        [upper, lower].concat().join(" ")
    };
    let [upper, lower] = edges(&vessel.reference_mm, 0).map(|edge| edge.join(" "));
    let narrowed = vessel.lesions.iter().filter_map(|lesion| {
        let first = vessel.places.iter().position(|place| Some(place) == lesion.places.first())?;
        Some(closed(&vessel.diameter_mm[first..first + lesion.places.len()], first))
    });
    let mark_mm = if end_mm - start_mm < LONG_MM { SHORT_MARK_MM } else { LONG_MARK_MM };
    let first_mm = (start_mm / mark_mm).ceil() * mark_mm;
    let marks = (0..).map(|k| first_mm + f64::from(k) * mark_mm).take_while(|mm| *mm <= end_mm);
    let branches = vessel.places.chunk_by(|a, b| a.0 == b.0).fold(String::new(), |mut names, part| {
        // Writing to a string cannot fail.
        let _ = write!(names, " {}", part[0].0);
        names
    });
    html! {
        svg.strip width=(WIDTH) height=(high + BELOW) viewBox=(format!("0 0 {WIDTH} {}", high + BELOW)) role="img"
            aria-label=(format!("branches{branches}, straightened")) {
            polygon points=(closed(&vessel.diameter_mm, 0)) fill="#9db8d9" {}
            @for part in narrowed { polygon points=(part) fill="#d0342c" {} }
            @for edge in [upper, lower] {
                polyline points=(edge) fill="none" stroke="#444" stroke-dasharray="4 3" {}
            }
            line x1=(LEFT - 6.0) x2=(LEFT - 6.0) y1=(middle - 0.5 * PER_MM) y2=(middle + 0.5 * PER_MM) stroke="#444" {}
            text x="0" y=(middle + 4.0) font-size="11" { "1 mm" }
            @for mm in marks {
                text x=(format!("{:.1}", across(mm))) y=(high + BELOW - 6.0) font-size="11" text-anchor="middle" { (format!("{mm:.0}")) }
            }
            title { "branches" (branches) }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_straightened_vessel_is_as_wide_as_its_diameters() {
        let n = 51;
        let diameter = |i: usize| if (20..30).contains(&i) { 1.0 } else { 3.0 };
        let vessel = StraightVessel {
            places: (0..n).map(|i| (0, i)).collect(),
            along_mm: (0..n).map(|i| i as f64).collect(),
            diameter_mm: (0..n).map(diameter).collect(),
            reference_mm: vec![3.0; n],
            lesions: vec![Lesion {
                branch: 0,
                point: 24,
                from_root_mm: 24.0,
                length_mm: 10.0,
                min_diameter_mm: 1.0,
                reference_diameter_mm: 3.0,
                places: (20..30).map(|i| (0, i)).collect(),
            }],
        };
        let drawn = strip(&vessel).into_string();
        // The middle is at 21 px; the lumen reaches 1.5 mm of 14 px above and below it.
        assert!(drawn.contains("34.0,0.0") && drawn.contains("34.0,42.0"), "{drawn}");
        let red = drawn.split("#d0342c").next().unwrap().rsplit("points=").next().unwrap();
        assert_eq!(red.matches(",14.0").count(), 10, "the narrow part begins half a mm above the middle: {red}");
        assert_eq!(drawn.matches("#d0342c").count(), 1);
        assert!(drawn.contains(">50</text>") && !drawn.contains(">60</text>"));
    }
}
