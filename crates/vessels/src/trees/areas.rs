//! Radii of vessels from the images that they were reconstructed from.
//!
//! A field of limited resolution shows thin vessels and short stenoses blurred. Images show them blurred as well, but the sum of line
//! integrals across the shadow of a vessel stays in proportion to its area, however thin it is. The areas of all points of a tree are
//! found together by least squares: the shadows of the centrelines are added to the static background of each view, so that vessels that lie
//! over each other in a view share its pixels. Errors of the places of points along their vessels are found beside the areas; the blur along
//! vessels that the rest of them causes is taken out at the end.

pub(in crate::trees) mod blur;
mod shadowed;
mod shadows;
mod slides;

use crate::calibrate::observed::binned_to;
use crate::evidence::series::Series;
use crate::linear::conjugate_gradients;
use crate::raster::percentile;
use crate::scan::dataset::Dataset;
use crate::trees::areas::blur::without_blur;
use crate::trees::areas::shadowed::ShadowedView;
use crate::trees::areas::slides::Slides;
use crate::trees::tree::{BeatTree, PhaseTree, RadiiFrom};
use std::f64::consts::PI;

// Numbers of this file without another source: developed on five draws of stenoses in five trees; a sixth draw took no part
// (docs/performance.md, Stenoses; docs/tried.md).
/// Minimum smaller side, pixels, of the binned images in which areas are measured.
const SIDE: usize = 200;
/// Difference of the areas that both halves of the views show, as a share of the typical area, at which half of what images add to the field
/// is believed.
const DISAGREEMENT: f64 = 0.25;
/// Rounds of weights and areas, and of slides, weights and areas after them. A second round of slides showed a false stenosis in a vessel of a
/// pixel.
const ROUNDS: usize = 3;
const SLIDING_ROUNDS: usize = 1;
/// Standard deviation of the difference of an area from that of the field, as a share of the typical area.
const FROM_FIELD: f64 = 1.0;
/// Additional certainty of the field for vessels of two resolution lengths, in units of that for thin ones, and the power of the diameter with
/// which it grows: the field shows wide vessels well, and the middle of their shadows is never uncovered.
const WIDE_CERTAINTY: f64 = 30.0;
const WIDE_POWER: i32 = 12;
/// Standard deviation of the difference of two successive radii, as a share of the typical radius, where pixels are as wide as the field's
/// resolution, and where they are half as wide or narrower ([`narrow`]). Errors of shadows in wide pixels look like changes of the radius.
const STEP_CHANGE_IN_WIDE_PIXELS: f64 = 0.25;
const STEP_CHANGE: f64 = 0.35;
/// Standard deviation of the blur along vessels, in units of the field's resolution, that is taken out of areas of thin vessels where pixels are
/// half as wide as the resolution or narrower: points at stenoses are off by half of the resolution along their vessels, partly by slides that are
/// not found. Wide pixels make areas so noisy that more blur is better than less.
const BLUR: f64 = 0.25;
/// Typical diameter, in units of the field's resolution, up to which a vessel has this blur, and from which it has none.
const BLURRED: f64 = 1.0;
const SHARP: f64 = 1.5;
/// Minimum radius, as a share of the typical one, for which differences of radii are expressed by those of areas.
const MIN_SHARE: f64 = 0.3;
/// Number of points on each side over which the typical area is a median, and then a mean.
const TYPICAL_MEDIAN: usize = 15;
const TYPICAL_MEAN: usize = 5;
/// Minimum typical area, in units of the square of the field's resolution.
const MIN_TYPICAL: f64 = 0.06;
/// Factor on the certainty of the field at the end of a branch, and the number of points over which it falls: shadows go on beyond ends and are
/// shared at bifurcations.
const END_CERTAINTY: f64 = 300.0;
const END_POINTS: f64 = 2.0;
/// Minimum number of views: radii of one alone could not be compared.
const MIN_VIEWS: usize = 2;
/// Minimum radius, in units of the field's resolution.
const MIN_RADIUS: f64 = 0.03;

/// Replaces the radii of a tree whose points are followed by those that the training images show. The dataset has the geometry that the
/// reconstruction used.
///
/// # Errors
/// The reason why the radii stay those of the field.
pub fn measure_radii(beat: &mut BeatTree, dataset: &Dataset) -> Result<(), &'static str> {
    if beat.reference_phase.is_none() {
        return Err("the points of the tree are not followed over the beat");
    }
    let attenuation = beat
        .vessel_per_mm
        .ok_or("the attenuation of the vessels is not known, or contrast fills them over the beat")?;
    let first = beat.phases.first().ok_or("the tree has no phase")?;
    let field: Vec<f64> = first.branches.iter().flat_map(|b| &b.radius_mm).map(|r| PI * r * r).collect();
    let lengths: Vec<usize> = first.branches.iter().map(|branch| branch.points_mm.len()).collect();
    if field.is_empty() {
        return Err("the tree has no points");
    }
    let dataset = &binned_to(dataset, SIDE);
    let of_view = |series: Series| ShadowedView::new(series, dataset, &beat.phases, attenuation);
    let mut views: Vec<ShadowedView> = Series::each(dataset).filter_map(of_view).collect();
    if views.len() < MIN_VIEWS {
        return Err("fewer than two training views show three phases of the tree");
    }
    let pixel_mm = views.iter().map(|view| view.pixel_mm).fold(0.0, f64::max);
    let pixel = pixel_mm / beat.resolution_mm;
    let expected = Expected::new(&field, &lengths, beat.resolution_mm, step_change(pixel));
    let (mut areas, mut slides) = (field.clone(), Slides::none(&beat.phases));
    for round in 0..ROUNDS + SLIDING_ROUNDS {
        if round >= ROUNDS {
            slides.improve(&views, &areas);
        }
        let at_phases = slides.at_phases(&areas);
        views.iter_mut().for_each(|view| view.weigh(&at_phases));
        areas = solved(&views.iter().collect::<Vec<_>>(), &slides, &expected, &areas);
    }
    let areas = believed(&views, &slides, &expected, areas);
    let at_rest = beat.phases.iter().find(|tree| Some(tree.phase) == beat.reference_phase).unwrap_or(first);
    let blur_mm = expected.blur_mm(narrow(pixel) * BLUR * beat.resolution_mm, beat.resolution_mm);
    let areas = sharpened(&areas, at_rest, &blur_mm);
    let least_mm = MIN_RADIUS * beat.resolution_mm;
    let radii: Vec<f64> = areas.iter().map(|area| (area.max(0.0) / PI).sqrt().max(least_mm)).collect();
    for tree in &mut beat.phases {
        let mut rest = radii.as_slice();
        for branch in &mut tree.branches {
            let (own, others) = rest.split_at(branch.points_mm.len());
            branch.radius_mm = own.to_vec();
            rest = others;
        }
    }
    beat.radii_from = RadiiFrom::Images;
    Ok(())
}

/// Returns how far pixels are narrow, for a width in units of the field's resolution: from 0 for 1 to 1 for a half.
fn narrow(pixel: f64) -> f64 {
    (2.0 * (1.0 - pixel)).clamp(0.0, 1.0)
}

/// Returns the standard deviation of the difference of two successive radii, as a share of the typical one, for pixels of a width in units of the
/// field's resolution.
fn step_change(pixel: f64) -> f64 {
    STEP_CHANGE_IN_WIDE_PIXELS + narrow(pixel) * (STEP_CHANGE - STEP_CHANGE_IN_WIDE_PIXELS)
}

/// Areas that are expected before the images are compared, and how certain they are.
struct Expected<'a> {
    /// Areas of the field, mm^2.
    field: &'a [f64],
    /// Inverse variance of the difference from the field's area.
    certainty: Vec<f64>,
    /// Typical area around each point, mm^2.
    typical: Vec<f64>,
    /// Whether a point is followed by another one of its branch.
    goes_on: Vec<bool>,
    /// Standard deviation of the difference of two successive radii, as a share of the typical radius.
    step_change: f64,
}

impl Expected<'_> {
    /// Returns the expectation for branches of numbers of points, from a field of a resolution.
    fn new<'a>(field: &'a [f64], lengths: &[usize], resolution_mm: f64, step_change: f64) -> Expected<'a> {
        let mut expected =
            Expected { field, certainty: Vec::new(), typical: Vec::new(), goes_on: Vec::new(), step_change };
        let mut rest = field;
        for n in lengths {
            let (own, others) = rest.split_at(*n);
            rest = others;
            for (i, area) in typical(own).into_iter().enumerate() {
                let area = area.max(MIN_TYPICAL * resolution_mm.powi(2));
                let end = i.min(n - 1 - i) as f64;
                let at_end = END_CERTAINTY * (-0.5 * (end / END_POINTS).powi(2)).exp();
                let half_widths = (area / PI).sqrt() / resolution_mm;
                let wide = WIDE_CERTAINTY * half_widths.powi(WIDE_POWER);
                expected.certainty.push((FROM_FIELD.powi(-2) + at_end + wide) / area.powi(2));
                expected.typical.push(area);
                expected.goes_on.push(i + 1 < *n);
            }
        }
        expected
    }

    /// Returns the standard deviation of the blur along the vessel at each point, mm, from that of thin vessels.
    fn blur_mm(&self, of_thin_mm: f64, resolution_mm: f64) -> Vec<f64> {
        let at = |typical: &f64| {
            let diameter = 2.0 * (typical / PI).sqrt() / resolution_mm;
            of_thin_mm * ((SHARP - diameter) / (SHARP - BLURRED)).clamp(0.0, 1.0).sqrt()
        };
        self.typical.iter().map(at).collect()
    }

    /// Returns the inverse variances of the differences of successive areas, for which the differences of their radii are expected to be small.
    fn smoothness(&self, areas: &[f64]) -> Vec<f64> {
        let step = |i: usize| {
            if !self.goes_on[i] {
                return 0.0;
            }
            let typical = 0.5 * (self.typical[i] + self.typical[i + 1]);
            let share = (0.5 * (areas[i] + areas[i + 1]) / typical).max(MIN_SHARE.powi(2));
            // The area is pi r^2, and its difference 2 pi r times that of the radius.
            (2.0 * self.step_change * typical).powi(-2) / share
        };
        (0..areas.len()).map(step).collect()
    }

    /// Returns the gradient of half the squared, weighted differences of areas: those of successive ones, and those from zero.
    fn applied(&self, smoothness: &[f64], areas: &[f64]) -> Vec<f64> {
        let mut out: Vec<f64> = areas.iter().zip(&self.certainty).map(|(area, weight)| area * weight).collect();
        for i in 0..areas.len() - 1 {
            let force = smoothness[i] * (areas[i] - areas[i + 1]);
            out[i] += force;
            out[i + 1] -= force;
        }
        out
    }
}

/// Returns the typical area around each point of a branch, mm^2: short narrowings do not change it.
fn typical(areas: &[f64]) -> Vec<f64> {
    let around = |values: &[f32], i: usize, reach: usize| {
        values[i.saturating_sub(reach)..(i + reach + 1).min(values.len())].to_vec()
    };
    let areas: Vec<f32> = areas.iter().map(|area| *area as f32).collect();
    let medians: Vec<f32> = (0..areas.len()).map(|i| percentile(&around(&areas, i, TYPICAL_MEDIAN), 0.5)).collect();
    let mean = |i: usize| {
        let part = around(&medians, i, TYPICAL_MEAN);
        f64::from(part.iter().sum::<f32>()) / part.len() as f64
    };
    (0..areas.len()).map(mean).collect()
}

/// Returns the areas that explain the images best, by conjugate gradients from given areas.
fn solved(views: &[&ShadowedView], slides: &Slides, expected: &Expected<'_>, start: &[f64]) -> Vec<f64> {
    let smoothness = expected.smoothness(start);
    let add_sums = |view: &ShadowedView, images: &[Vec<f64>], sums: &mut [f64]| {
        for (frame, of_phase) in view.frames.iter().zip(view.sums(images, sums.len())) {
            slides.add_transposed(frame.phase, &of_phase, sums);
        }
    };
    let applied = |areas: &[f64]| {
        let mut out = expected.applied(&smoothness, areas);
        let at_phases = slides.at_phases(areas);
        views.iter().for_each(|view| add_sums(view, &view.images(&at_phases), &mut out));
        out
    };
    let mut right: Vec<f64> =
        expected.field.iter().zip(&expected.certainty).map(|(area, weight)| area * weight).collect();
    for view in views {
        let images: Vec<Vec<f64>> = view.frames.iter().map(|frame| frame.image.clone()).collect();
        add_sums(view, &images, &mut right);
    }
    conjugate_gradients(applied, &right, start)
}

/// Returns the areas where both halves of the views agree on them, and those of the field where they do not: where vessels lie over each other in
/// some views, shadows there may be shared wrongly.
fn believed(views: &[ShadowedView], slides: &Slides, expected: &Expected<'_>, areas: Vec<f64>) -> Vec<f64> {
    let half = |first: usize| {
        let own: Vec<&ShadowedView> = views.iter().skip(first).step_by(2).collect();
        solved(&own, slides, expected, &areas)
    };
    let (even, odd) = (half(0), half(1));
    let share = |i: usize| {
        let apart = (even[i] - odd[i]) / (DISAGREEMENT * expected.typical[i]);
        1.0 / (1.0 + apart * apart)
    };
    (0..areas.len()).map(|i| expected.field[i] + share(i) * (areas[i] - expected.field[i])).collect()
}

/// Takes a blur along the vessels, of a standard deviation at each point, out of the areas of the points of a tree.
fn sharpened(areas: &[f64], tree: &PhaseTree, blur_mm: &[f64]) -> Vec<f64> {
    let mut first = 0;
    let mut sharp = Vec::with_capacity(areas.len());
    for branch in &tree.branches {
        let own = first..first + branch.points_mm.len();
        first = own.end;
        let step_mm = branch.length_mm() / (own.len().max(2) - 1) as f64;
        let steps = |blur_mm: &f64| if step_mm > 0.0 { blur_mm / step_mm } else { 0.0 };
        let deviations: Vec<f64> = blur_mm[own.clone()].iter().map(steps).collect();
        sharp.extend(without_blur(&areas[own], &deviations));
    }
    sharp
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{CArm, Geometry, MM_PER_UNIT};
    use crate::scan::dataset::{Frame, Layout, Split, View};
    use crate::trees::tree::Branch;
    use glam::DVec3;

    const PER_MM: f64 = 0.1;
    const PIXEL_MM: f64 = 1.6;
    const SIZE: [usize; 2] = [40, 50];
    const PHASES: u32 = 5;

    /// Radius of the true vessel: a stenosis of 60 % and 9 mm.
    fn radius_mm(z: f64) -> f64 {
        let away = (z - 4.0) / 9.0;
        0.7 * if away.abs() < 0.5 { 1.0 - 0.3 * (1.0 + (2.0 * PI * away).cos()) } else { 1.0 }
    }

    /// Place of the vessel's axis along left and posterior at a phase, mm.
    fn axis_mm(phase: u32) -> [f64; 2] {
        [5.0 * f64::from(phase) - 11.0, 4.0 * f64::from((2 * phase) % PHASES) - 7.0]
    }

    fn contrast(phase: u32) -> f64 {
        if phase == 1 || phase == 3 { 0.4 } else { 1.0 }
    }

    /// Images from the front and from the side of a vessel along the head's direction over a sloping background: exact chords, 8 x 8 of them
    /// in a pixel.
    fn dataset() -> Dataset {
        dataset_with(|_, _| 1.0)
    }

    /// Images of a vessel whose radius a view shows enlarged by a factor of the place along the vessel, mm.
    fn dataset_with(enlarged: impl Fn(usize, f64) -> f64) -> Dataset {
        let view = |primary_deg: f64| {
            let pixel_mm = [PIXEL_MM * 1e5 / 9e4; 2];
            let (sid_mm, sod_mm, zero) = (1e5, 9e4, [0.0; 2]);
            let c_arm =
                CArm { primary_deg, secondary_deg: 0.0, sid_mm, sod_mm, pixel_mm, offset_mm: zero, table_mm: [0.0; 3] };
            View::new(Geometry::CArm(c_arm), SIZE).unwrap()
        };
        let views = vec![view(0.0), view(90.0)];
        let line_integral = |view: usize, phase: u32, column: f64, row: f64| {
            let (anchor, _) = views[view].rays.pixel(column, row);
            // World axes are (posterior, left, superior); the rays are parallel.
            let [left, posterior] = axis_mm(phase);
            let across = if view == 0 { anchor.y * MM_PER_UNIT - left } else { anchor.x * MM_PER_UNIT - posterior };
            let z = anchor.z * MM_PER_UNIT;
            let shown_mm = enlarged(view, z) * radius_mm(z);
            2.0 * PER_MM * (shown_mm.powi(2) - across * across).max(0.0).sqrt()
        };
        let pixel = |view: usize, phase: u32, p: usize| {
            let at = |k: usize| (k as f64 + 0.5) / 8.0 - 0.5;
            let (x, y) = ((p % SIZE[0]) as f64, (p / SIZE[0]) as f64);
            let sum: f64 = (0..64).map(|k| line_integral(view, phase, x + at(k % 8), y + at(k / 8))).sum();
            (contrast(phase) * sum / 64.0 + 0.8 + 0.01 * x - 0.006 * y) as f32
        };
        let frame = |view: usize, phase: u32| Frame {
            name: format!("view {view}, phase {phase}"),
            view,
            phase,
            after_phase: 0.0,
            split: Split::Train,
            integrals: (0..SIZE[0] * SIZE[1]).map(|p| pixel(view, phase, p)).collect::<Vec<f32>>().into(),
            mask: None,
            heart_shift_mm: [0.0; 3],
            contrast: contrast(phase),
        };
        Dataset {
            path: "test".into(),
            layout: Layout::Native,
            frames: (0..2)
                .flat_map(|view| (0..PHASES).map(move |phase| (view, phase)))
                .map(|(v, p)| frame(v, p))
                .collect(),
            views: views.clone(),
            width: SIZE[0],
            height: SIZE[1],
            n_phases: PHASES,
            notes: Vec::new(),
            depth_range: (-0.5, 0.5),
            hidden: Default::default(),
            vessel_attenuation: Some(PER_MM * MM_PER_UNIT),
            still: false,
            vessels_alone: false,
            views_adjusted: false,
            prior: None,
        }
    }

    /// A tree as a blurred field shows the vessel: too wide, without the stenosis, and with centrelines off by most of a pixel.
    fn tree() -> BeatTree {
        let branch = |phase: u32| {
            let [left, posterior] = axis_mm(phase);
            let off_mm = 1.4 * if phase.is_multiple_of(2) { 1.0 } else { -1.0 };
            Branch {
                parent: None,
                points_mm: (0..60)
                    .map(|i| DVec3::new(left + off_mm, posterior - off_mm, 0.9 * f64::from(i) - 27.0))
                    .collect(),
                radius_mm: vec![0.85; 60],
                agreement: Vec::new(),
                doubt: Vec::new(),
                gap_mm: 0.0,
            }
        };
        BeatTree {
            reference_phase: Some(0),
            threshold_per_mm: 0.2 * PER_MM,
            resolution_mm: 1.8,
            spacing_mm: 0.9,
            vessel_per_mm: Some(PER_MM),
            radii_from: RadiiFrom::Field,
            views: Vec::new(),
            phases: (0..PHASES).map(|phase| PhaseTree { phase, branches: vec![branch(phase)] }).collect(),
            measured_mm: Vec::new(),
        }
    }

    #[test]
    fn radii_change_more_freely_in_narrow_pixels() {
        for (pixel, expected) in [(0.2, STEP_CHANGE), (0.5, STEP_CHANGE), (0.75, 0.3), (1.0, 0.25), (1.3, 0.25)] {
            assert!((step_change(pixel) - expected).abs() < 1e-12, "{pixel}: {}", step_change(pixel));
        }
    }

    #[test]
    fn a_blur_is_taken_out_of_each_branch_by_its_own_steps() {
        assert_eq!([0.4, 0.5, 0.75, 1.0, 1.2].map(narrow), [1.0, 1.0, 0.5, 0.0, 0.0]);
        let branch = |step_mm: f64| Branch {
            points_mm: (0..4).map(|i| DVec3::new(step_mm * f64::from(i), 0.0, 0.0)).collect(),
            radius_mm: vec![1.0; 4],
            ..tree().phases[0].branches[0].clone()
        };
        let tree = PhaseTree { phase: 0, branches: vec![branch(0.5), branch(1.0), branch(0.0)] };
        let areas = [3.0, 2.0, 3.0, 3.0];
        let mut blur_mm = [0.5; 12];
        blur_mm[6] = 1.0;
        let sharp = sharpened(&areas.repeat(3), &tree, &blur_mm);
        // Half the squared deviation in steps is 0.5, and 0.125 or 0.5; the second differences are -1, 2, -1 and 0.
        assert_eq!(sharp[..4], [3.5, 1.0, 3.5, 3.0]);
        assert_eq!(sharp[4..8], [3.125, 1.75, 3.5, 3.0]);
        assert_eq!(sharp[8..], areas, "points in one place");
    }

    #[test]
    fn thin_vessels_have_a_blur_and_wide_ones_have_none() {
        let area = |diameter_mm: f64| 0.25 * PI * diameter_mm * diameter_mm;
        for (diameter_mm, expected_mm) in [(1.0, 0.4), (2.0, 0.4), (2.5, 0.4 * 0.5f64.sqrt()), (3.0, 0.0), (4.0, 0.0)] {
            let found = Expected::new(&[area(diameter_mm); 30], &[30], 2.0, STEP_CHANGE).blur_mm(0.4, 2.0);
            assert!((found[15] - expected_mm).abs() < 1e-3, "{diameter_mm} mm: {}", found[15]);
        }
    }

    #[test]
    fn images_show_a_stenosis_that_the_field_does_not() {
        let mut beat = tree();
        measure_radii(&mut beat, &dataset()).unwrap();
        assert_eq!(beat.radii_from, RadiiFrom::Images);
        let branch = &beat.phases[2].branches[0];
        let off = |i: usize| (branch.radius_mm[i] - radius_mm(branch.points_mm[i].z)).abs();
        let worst = (8..52).max_by(|a, b| off(*a).total_cmp(&off(*b))).unwrap();
        assert!(off(worst) < 0.06, "{} mm at {}: {:?}", off(worst), branch.points_mm[worst].z, branch.radius_mm);
        assert!(
            beat.phases.iter().all(|tree| tree.branches[0].radius_mm == branch.radius_mm),
            "points keep their radii"
        );
    }

    #[test]
    fn a_stenosis_is_shown_in_full_though_points_slide_along_the_vessel() {
        let mut beat = tree();
        for (phase, along_mm) in beat.phases.iter_mut().zip([2.0, -2.0, 1.5, -1.5, 0.0]) {
            phase.branches[0].points_mm.iter_mut().for_each(|point| point.z += along_mm);
        }
        measure_radii(&mut beat, &dataset()).unwrap();
        // The last phase is in the middle of the others. Without slides, the least radius is 0.34 instead of 0.28 mm, and 2.2 mm away.
        let branch = &beat.phases[4].branches[0];
        let (least, at) =
            (28..42).map(|i| (branch.radius_mm[i], branch.points_mm[i].z)).min_by(|a, b| a.0.total_cmp(&b.0)).unwrap();
        assert!(
            (least - radius_mm(4.0)).abs() < 0.05 && (at - 4.0).abs() < 1.5,
            "{least} mm at {at}: {:?}",
            branch.radius_mm
        );
    }

    #[test]
    fn a_blur_that_slides_leave_is_taken_out_in_narrow_pixels() {
        // Points slide farther than slides that are looked for. The blur alone would leave a least radius of 0.31 instead of 0.28 mm.
        let mut beat = BeatTree { resolution_mm: 1.5 * PIXEL_MM, ..tree() };
        for (phase, along_mm) in beat.phases.iter_mut().zip([3.5, -3.5, 3.5, -3.5, 0.0]) {
            phase.branches[0].points_mm.iter_mut().for_each(|point| point.z += along_mm);
        }
        measure_radii(&mut beat, &dataset()).unwrap();
        let radii_mm = &beat.phases[4].branches[0].radius_mm;
        let least_mm = radii_mm[28..42].iter().copied().fold(f64::INFINITY, f64::min);
        assert!((least_mm - radius_mm(4.0)).abs() < 0.015, "{least_mm} mm: {radii_mm:?}");
    }

    #[test]
    fn the_field_decides_where_halves_of_the_views_disagree() {
        // One view shows a part of the vessel wider than the other one. Both together would give a radius of 0.87 mm.
        let wider = |view: usize, z: f64| if view == 0 && z > -18.0 && z < -8.0 { 1.6 } else { 1.0 };
        let field = 1.0;
        let mut beat = tree();
        beat.phases.iter_mut().for_each(|tree| tree.branches[0].radius_mm.fill(field));
        measure_radii(&mut beat, &dataset_with(wider)).unwrap();
        let branch = &beat.phases[0].branches[0];
        let radius_at = |z: f64| {
            let i = branch.points_mm.iter().position(|p| p.z > z).unwrap();
            branch.radius_mm[i]
        };
        assert!((radius_at(-13.0) - field).abs() < 0.05, "{:?}", branch.radius_mm);
        assert!(
            (radius_at(12.0) - radius_mm(12.0)).abs() < 0.06,
            "elsewhere the images decide: {:?}",
            branch.radius_mm
        );
    }

    #[test]
    fn radii_stay_where_images_do_not_tell_them() {
        let dataset = dataset();
        let refused = |beat: &mut BeatTree, dataset: &Dataset, reason: &str| {
            let before = beat.clone();
            let told = measure_radii(beat, dataset).unwrap_err();
            assert!(told.contains(reason) && *beat == before, "{told}");
        };
        refused(&mut BeatTree { vessel_per_mm: None, ..tree() }, &dataset, "attenuation");
        refused(&mut BeatTree { reference_phase: None, ..tree() }, &dataset, "not followed");
        let mut short = tree();
        short.keep_phases(&[0, 4]);
        assert_eq!(short.phases.iter().map(|tree| tree.phase).collect::<Vec<_>>(), [0, 4]);
        refused(&mut short, &dataset, "three phases");
        let mut empty = tree();
        empty.phases.iter_mut().for_each(|tree| tree.branches.clear());
        refused(&mut empty, &dataset, "no points");
        let mut one_view = dataset.clone();
        one_view.frames.retain(|frame| frame.view == 0);
        refused(&mut tree(), &one_view, "two training views");
    }
}
