//! Datasets with one of the usual mistakes are distinguished from sound ones. The mistakes are made here by independent
//! loops.

use crate::common::gpu;
use glam::DVec3;
use nertca_vk::check::{Check, Verdict, check, compare};
use nertca_vk::config::{Config, Preset};
use nertca_vk::geometry::{CArm, Geometry};
use nertca_vk::plan::Plan;
use nertca_vk::random::{STREAM_PHOTON, normal, uniform01};
use nertca_vk::scan::dataset::{Dataset, Frame, Layout, Split, View};
use nertca_vk_phantom::dataset::{PhantomOptions, Setting, make};
use nertca_vk_phantom::degradations::Degradations;
use nertca_vk_phantom::views::ViewAngles;
use std::f64::consts::TAU;

const PHASES: u32 = 8;
const SIZE: usize = 100;

/// Imperfections that are no mistakes.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Flaws {
    pub(crate) seed: u32,
    /// Standard deviation of the stated angles' errors.
    pub(crate) angle_deg: f64,
    /// Standard deviation of a pixel's noise; the strongest vessel has about 0.5.
    pub(crate) noise: f64,
}

/// Angiograms over a regular beat, see [`angiograms_at`].
fn angiograms(n_views: usize, flaws: Flaws) -> Dataset {
    let moments: Vec<_> = (0..PHASES).map(|phase| Some(f64::from(phase) / f64::from(PHASES))).collect();
    angiograms_at(n_views, flaws, &moments)
}

/// Angiograms of a beating vessel made of Gaussian blobs, whose line integrals are known exactly, in front of a smooth body.
/// `moments` are the fractions of the beat at the phases; a phase without one shows no vessel.
pub(crate) fn angiograms_at(n_views: usize, flaws: Flaws, moments: &[Option<f64>]) -> Dataset {
    let angles = [(-30.0, 25.0), (40.0, 20.0), (-45.0, -20.0), (5.0, -30.0)];
    let vessels = moments.iter().map(|moment| moment.map_or(Vec::new(), |moment| blobs(flaws.seed, moment)));
    angiograms_of(&angles[..n_views], flaws, &vessels.collect::<Vec<_>>())
}

/// Angiograms of the blobs at each phase, from views at the given angles.
fn angiograms_of(angles: &[(f64, f64)], flaws: Flaws, vessels: &[Vec<(DVec3, f64)>]) -> Dataset {
    let (n_views, n_phases) = (angles.len(), vessels.len() as u32);
    let view = |v: usize, error: f64| {
        let off = |k: u32| error * normal(flaws.seed, STREAM_PHOTON, v as u32, k);
        let geometry = Geometry::CArm(CArm {
            primary_deg: angles[v].0 + off(0),
            secondary_deg: angles[v].1 + off(1),
            sid_mm: 1100.0,
            sod_mm: 750.0,
            pixel_mm: [2.0; 2],
            offset_mm: [0.0; 2],
            table_mm: [0.0; 3],
        });
        View::new(geometry, [SIZE; 2]).unwrap()
    };
    let mut frames = Vec::new();
    for v in 0..n_views {
        let rays = view(v, 0.0).rays;
        for (phase, blobs) in (0..).zip(vessels) {
            let integral = |p: usize| {
                let (anchor, direction) = rays.pixel((p % SIZE) as f64, (p / SIZE) as f64);
                let d = direction.normalize();
                let past = |x: DVec3| (x - anchor).cross(d).length_squared();
                let vessel: f64 = blobs.iter().map(|(x, r)| 12.0 * r * (-past(*x) / (2.0 * r * r)).exp()).sum();
                let body = 1.5 * (-past(DVec3::new(0.2, 0.45, 0.5)) / 0.72).exp() + 0.6;
                let noise = normal(flaws.seed, STREAM_PHOTON, 100 + v as u32 * n_phases + phase, p as u32);
                (body + vessel + flaws.noise * noise) as f32
            };
            frames.push(Frame {
                name: format!("view{v}-phase{phase}"),
                view: v,
                phase,
                split: Split::Train,
                integrals: (0..SIZE * SIZE).map(integral).collect(),
                mask: None,
                after_phase: 0.0,
                heart_shift_mm: [0.0; 3],
                contrast: 1.0,
            });
        }
    }
    Dataset {
        path: "angiograms".into(),
        layout: Layout::Native,
        views: (0..n_views).map(|v| view(v, flaws.angle_deg)).collect(),
        frames,
        width: SIZE,
        height: SIZE,
        n_phases,
        depth_range: (-1.0, 1.0),
        hidden: Default::default(),
        vessel_attenuation: None,
        still: false,
        vessels_alone: false,
        views_adjusted: false,
        prior: None,
        notes: Vec::new(),
    }
}

/// Centres and radii of a vessel at a moment of the beat, 100 mm: fast and strong contraction, slow relaxation.
pub(crate) fn blobs(seed: u32, moment: f64) -> Vec<(DVec3, f64)> {
    let of = |k: u32| uniform01(seed, STREAM_PHOTON, 7, k);
    let beat = if moment < 0.35 { (TAU * moment / 1.4).sin() } else { (TAU * (1.0 - moment) / 2.6).sin() };
    let shrink = 1.0 - 0.22 * beat;
    let at = |i: usize| {
        let t = i as f64 / 119.0;
        let turn = (1.4 + 0.5 * of(0)) * TAU / 2.0 * t + TAU * of(1);
        let x = DVec3::new(
            0.28 * shrink * turn.cos() + 0.05 * beat,
            0.24 * shrink * turn.sin() + 0.03 * (5.0 * t).sin(),
            0.45 * (t - 0.5) * (1.0 - 0.15 * beat) + 0.06 * (TAU * (t + of(2))).sin(),
        );
        (x, 0.018 - 0.010 * t)
    };
    (0..120).map(at).collect()
}

fn told(dataset: &Dataset) -> Check {
    let found = check(dataset).unwrap();
    let shares = found.agreement.as_ref().map(|a| (a.fine, a.coarse));
    println!("{:?} {shares:?} {:?} {:?}", found.verdict, found.explained, found.mistakes);
    found
}

#[test]
#[ignore = "long: tools/test --all"]
fn sound_data_raise_no_alarm() {
    for n_views in [4, 3] {
        for (seed, angle_deg, noise) in [(1, 0.0, 0.0), (2, 0.0, 0.0), (3, 0.3, 0.0), (4, 0.0, 0.03), (5, 0.3, 0.03)] {
            let flaws = Flaws { seed, angle_deg, noise };
            let found = told(&angiograms(n_views, flaws));
            assert!(found.sound() && found.mistakes.is_empty(), "{n_views} views, {flaws:?}: {found:?}");
        }
    }
}

type Plant = fn(&mut Dataset);

fn each_image(dataset: &mut Dataset, of: impl Fn(&[f32], usize, usize) -> f32) {
    for frame in &mut dataset.frames {
        let old = frame.integrals.clone();
        for row in 0..SIZE {
            for column in 0..SIZE {
                frame.integrals[row * SIZE + column] = of(&old, row, column);
            }
        }
    }
}

fn each_c_arm(dataset: &mut Dataset, change: impl Fn(&mut CArm)) {
    for view in &mut dataset.views {
        let Geometry::CArm(c_arm) = &mut view.geometry else { panic!("a C-arm") };
        change(c_arm);
        view.rays = view.geometry.rays(SIZE, SIZE).unwrap();
    }
}

fn phases_of_view(dataset: &mut Dataset, view: usize, to: impl Fn(u32) -> u32) {
    dataset.frames.iter_mut().filter(|f| f.view == view).for_each(|f| f.phase = to(f.phase));
    dataset.frames.sort_by_key(|f| (f.view, f.phase));
}

#[test]
fn each_usual_mistake_is_named() {
    let plants: [(&str, Plant); 13] = [
        ("transposed", |d| each_image(d, |old, row, column| old[column * SIZE + row])),
        ("mirrored", |d| each_image(d, |old, row, column| old[row * SIZE + SIZE - 1 - column])),
        ("upside down", |d| each_image(d, |old, row, column| old[(SIZE - 1 - row) * SIZE + column])),
        ("rotated by 180 degrees", |d| {
            each_image(d, |old, row, column| old[(SIZE - 1 - row) * SIZE + SIZE - 1 - column])
        }),
        ("primary angle has the wrong sign", |d| each_c_arm(d, |c| c.primary_deg *= -1.0)),
        ("secondary angle has the wrong sign", |d| each_c_arm(d, |c| c.secondary_deg *= -1.0)),
        ("primary and secondary angle are exchanged", |d| {
            each_c_arm(d, |c| (c.primary_deg, c.secondary_deg) = (c.secondary_deg, c.primary_deg));
        }),
        ("pitch at the isocentre", |d| each_c_arm(d, |c| c.pixel_mm = c.pixel_mm.map(|p| p * c.sod_mm / c.sid_mm))),
        ("logarithm was taken twice", |d| each_image(d, |old, row, column| -old[row * SIZE + column].max(1e-3).ln())),
        ("intensities, not line integrals", |d| {
            each_image(d, |old, row, column| 4000.0 * (-old[row * SIZE + column]).exp());
        }),
        ("phases of view 1 are in reverse order", |d| phases_of_view(d, 1, |phase| PHASES - 1 - phase)),
        ("view 2 is late by 3 phases", |d| phases_of_view(d, 2, |phase| (phase + 3) % PHASES)),
        ("views 0 and 2 are exchanged", |d| {
            let (a, b) = (d.views[0].clone(), d.views[2].clone());
            (d.views[0], d.views[2]) = (b, a);
        }),
    ];
    let sound = angiograms(4, Flaws { seed: 6, noise: 0.005, ..Flaws::default() });
    for (name, plant) in plants {
        let mut wrong = sound.clone();
        plant(&mut wrong);
        let found = told(&wrong);
        let first = found.mistakes.first().unwrap_or_else(|| panic!("{name}: {found:?}"));
        assert!(first.contains(name), "{name}: {:?}", found.mistakes);
        assert!(!found.sound());
    }
}

#[test]
fn views_that_have_nothing_to_do_with_each_other_are_told() {
    let (mut mixed, other) =
        (angiograms(3, Flaws { seed: 1, ..Flaws::default() }), angiograms(3, Flaws { seed: 9, ..Flaws::default() }));
    for (frame, stranger) in mixed.frames.iter_mut().zip(other.frames).filter(|(f, _)| f.view > 0) {
        // Two views are foreign, one of them rotated, so that no single mistake explains the disagreement.
        frame.integrals = stranger.integrals;
        if frame.view == 2 {
            frame.integrals.reverse();
        }
    }
    let found = told(&mixed);
    assert!(!found.sound() && found.mistakes.is_empty(), "{found:?}");
    assert!(found.warnings.iter().any(|w| w.contains("none of the usual mistakes")), "{found:?}");
}

/// A procedural phantom of six phases, in which the heart moves as well as the vessels.
fn phantom_of_six_phases() -> Dataset {
    let options = PhantomOptions {
        setting: Setting::SmallXcat,
        size: 100,
        phases: 6,
        views: ViewAngles::published(4).unwrap(),
        seed: 1,
        stenoses: Vec::new(),
        degradations: Degradations::default(),
        layout: Layout::Native,
        anatomy: None,
        volumes_every: None,
    };
    let directory = tempfile::tempdir().unwrap();
    let data = directory.path().join("data");
    make(&gpu(), &options, &data, |_, _, _| ()).unwrap();
    Dataset::open(&data).unwrap()
}

#[test]
fn a_view_of_few_phases_is_missing_evidence() {
    let whole = phantom_of_six_phases();
    assert_eq!(told(&whole).missing, Vec::<String>::new());
    for kept in [&[0, 3][..], &[0, 2, 4], &[0, 1, 2]] {
        let mut few = whole.clone();
        few.frames.retain(|f| f.view != 1 || kept.contains(&f.phase));
        let found = told(&few);
        assert_eq!((found.verdict, found.mistakes.len()), (Verdict::Agree, 0), "{kept:?}: {found:?}");
        let [missing] = &found.missing[..] else { panic!("{kept:?}: {:?}", found.missing) };
        let said = format!("view 1: {} of 6 phases", kept.len());
        assert!(missing.starts_with(&said), "{kept:?}: {missing}");
        let pairs = &found.agreement.unwrap().pairs;
        assert!(pairs.iter().all(|pair| pair.judged != pair.views.contains(&1)), "{kept:?}: {pairs:?}");
    }
    // The other views still accuse each other.
    let mut wrong = whole;
    wrong.frames.retain(|f| f.view != 1 || f.phase < 2);
    wrong.frames.iter_mut().filter(|f| f.view == 2).for_each(|f| f.integrals.reverse());
    assert!(told(&wrong).faulty());
}

#[test]
fn a_blank_view_is_named() {
    let mut blank = angiograms(4, Flaws { seed: 2, ..Flaws::default() });
    blank.frames.iter_mut().filter(|f| f.view == 2).for_each(|f| f.integrals.fill(1.5));
    let found = told(&blank);
    assert_eq!(found.verdict, Verdict::Blank);
    assert!(found.missing.iter().any(|m| m.starts_with("view 2: nothing changes")), "{:?}", found.missing);
    assert_eq!(found.views[2].noise, None);
    assert!(found.views.iter().filter_map(|v| v.noise).all(|noise| noise < 1.0), "{:?}", found.views);
    let refusal = Plan::new(&Config::preset(Preset::Fast), &blank).err().expect("nothing to fit").to_string();
    assert!(refusal.contains("[2]") && refusal.contains("nothing changes"), "{refusal}");
}

#[test]
fn vessels_that_stay_longer_than_they_are_away_are_not_inverted() {
    let flaws = Flaws { seed: 3, ..Flaws::default() };
    for moments in [&[Some(0.0), Some(0.0), None][..], &[Some(0.0), Some(0.05), None], &[Some(0.0), None]] {
        // Integrals around .9 look like intensities, too.
        for (scale, offset) in [(1.0, 0.0), (0.1, 0.8)] {
            let mut few = angiograms_at(4, flaws, moments);
            few.frames.iter_mut().flat_map(|f| &mut f.integrals).for_each(|v| *v = scale * *v + offset);
            let found = told(&few);
            assert!(found.mistakes.is_empty() && !found.faulty(), "{moments:?}, {scale}: {found:?}");
            // The same images as intensities are reported; where their range is small, both mistakes explain them.
            few.frames.iter_mut().flat_map(|f| &mut f.integrals).for_each(|v| *v = 4000.0 * (-*v).exp());
            let found = told(&few);
            let named = found.mistakes.iter().any(|m| m.contains("are intensities") || scale < 1.0);
            assert!(named && found.faulty(), "{moments:?}, {scale}: {found:?}");
        }
    }
}

#[test]
fn motion_within_the_planes_through_both_sources_tells_nothing() {
    // Both sources are at one height, and the vessel moves across the body.
    let (at_rest, aside) = (blobs(1, 0.0), DVec3::new(0.0, 0.05, 0.0));
    let moved = at_rest.iter().map(|(centre, radius)| (*centre + aside, *radius)).collect();
    let found = told(&angiograms_of(&[(0.0, 0.0), (80.0, 0.0)], Flaws::default(), &[at_rest, moved]));
    assert!(found.mistakes.is_empty() && found.verdict == Verdict::Unknown, "{found:?}");
    assert!(found.missing.iter().any(|m| m.starts_with("views 0 and 1: what moves stays")), "{:?}", found.missing);
}

#[test]
fn two_views_are_told_with_their_angle() {
    let found = told(&angiograms(2, Flaws { seed: 4, ..Flaws::default() }));
    // Angle between directions of longitude -30 and 40 and latitude 25 and 20 degrees, by the spherical law of cosines.
    let [a, b, along] = [25f64, 20.0, 70.0].map(f64::to_radians);
    let apart = (a.sin() * b.sin() + a.cos() * b.cos() * along.cos()).acos().to_degrees();
    let said = format!("{apart:.0} degrees apart");
    assert!(
        found.warnings.iter().any(|w| w.contains(&said) && w.contains("ambiguous")),
        "{said}: {:?}",
        found.warnings
    );
    let three = told(&angiograms(3, Flaws { seed: 4, ..Flaws::default() }));
    assert!(three.warnings.iter().all(|w| !w.contains("degrees apart")), "{:?}", three.warnings);
}

#[test]
fn agreement_is_told_against_chance() {
    let sound = compare(&angiograms(4, Flaws { seed: 5, ..Flaws::default() })).unwrap();
    let [explained, by_chance] = sound.explained;
    println!("{explained} {by_chance}");
    assert!(explained > 0.95 && by_chance < 0.7, "{explained} {by_chance}");
    assert_eq!(sound.verdict, Verdict::Agree);
}

#[test]
fn one_view_is_not_enough() {
    let mut single = angiograms(3, Flaws::default());
    single.frames.retain(|f| f.view == 0);
    let refusal = check(&single).unwrap_err().to_string();
    assert!(refusal.contains("two such views are needed"), "{refusal}");
}
