//! Compares every compute stage with its f64 twin on the user's own device. Someone with an unknown card runs this first, and a
//! fault report begins with it. The tests use the same problems, comparisons and tolerances.
//!
//! 1. [`problems`] are small, seeded, and need no file; [`compare`] keeps how far the device was off, a row per stage
//! 2. [`iteration`], [`networks`], [`occupancy`] and [`drawing`] are about the two fields, on f32 layers and on matrices;
//!    [`gaussians`] and [`blobs`] about Gaussians; methods have files of their own,
//!    [`projections`] about phantoms
//! 3. [`repeats`] are runs that must come to the same bits

pub mod blobs;
pub mod compare;
pub mod drawing;
pub mod dynamic_gaussians;
pub mod gaussians;
pub mod iteration;
pub mod networks;
pub mod occupancy;
pub mod problems;
pub mod projections;
pub mod r2_gaussian;
pub mod repeats;
pub mod sax_nerf;
pub mod x_gaussian;

use crate::error::{Error, Result};
use crate::gpu::device::Gpu;
use crate::kernels::push::{self, PushConstants};
use crate::kernels::stages;
use crate::kernels::tuning::{Layers, MatrixTuning, Tuning};
use crate::scan::dataset::Dataset;
use crate::scan::small::{small_dataset, uneven_dataset};
use compare::{Findings, Row};
use problems::{FAST_NETWORK, PAPER_NETWORK, PUBLIC_NETWORK, TWO_NETWORKS};
use serde::Serialize;
use std::time::Instant;

/// Stages that measure a device's limits: their results are not used.
const MEASURING: [&str; 3] = [push::PeakCopy::SHADER, push::PeakF32::SHADER, push::PeakMatrix::SHADER];

/// Result of a self-test.
#[derive(Debug, Clone, Serialize)]
pub struct Report {
    /// A row for each stage and path, in the order in which stages run.
    pub rows: Vec<Row>,
    /// Parts of the test that ended with an error.
    pub errors: Vec<Failure>,
    /// Stages that were not compared with anything.
    pub untested: Vec<&'static str>,
    /// Paths through the kernels that the device got, a sentence each, with the reasons why others were left out.
    pub paths: Vec<String>,
}

/// A part of the test that ended with an error.
#[derive(Debug, Clone, Serialize)]
pub struct Failure {
    /// The part.
    pub part: String,
    /// The error, in words.
    pub error: String,
}

impl Report {
    /// Rows of stages that do not compute what their twins do.
    pub fn failed(&self) -> impl Iterator<Item = &Row> {
        self.rows.iter().filter(|row| !row.is_ok())
    }

    /// Tells whether every comparison passed. Stages without a comparison are listed, and do not count as failures.
    pub fn is_ok(&self) -> bool {
        self.errors.is_empty() && self.failed().next().is_none() && !self.rows.is_empty()
    }
}

/// Progress of a self-test.
#[derive(Debug)]
pub enum Progress<'a> {
    /// A part begins.
    Begun {
        /// Name of the part.
        part: &'a str,
        /// Parts before it.
        done: usize,
        /// All parts.
        parts: usize,
    },
    /// A part has ended.
    Ended {
        /// Rows to which the part has added comparisons, as they are now.
        rows: &'a [Row],
        /// Duration of the part, seconds.
        seconds: f64,
    },
}

/// A part of the test.
type TestPart<'a> = (String, Box<dyn Fn(&mut Findings) -> Result<()> + 'a>);

/// The parts for a path through the network's layers, on images at phases (`even`) and between them (`dataset`).
fn network_parts<'a>(gpu: &'a Gpu, even: &'a Dataset, dataset: &'a Dataset, tuning: &'a Tuning) -> Vec<TestPart<'a>> {
    let name = |what: &str| format!("{what} ({})", iteration::path_name(tuning.layers));
    let cases = match tuning.layers {
        Layers::F32 => vec![(dataset, iteration::F32_CASES)],
        Layers::Matrices => vec![(even, iteration::MATRIX_CASES), (dataset, iteration::MATRIX_CASES_BETWEEN_PHASES)],
    };
    let iterations = move |findings: &mut Findings| {
        let mut all = cases.iter().flat_map(|(images, cases)| cases.iter().map(move |case| (images, case)));
        all.try_for_each(|(images, case)| iteration::compare(gpu, images, case, tuning, findings))
    };
    let both = move |findings: &mut Findings| {
        networks::CASES.iter().try_for_each(|case| networks::compare(gpu, dataset, case, tuning, findings))
    };
    let views = move |findings: &mut Findings| {
        let presets = [PAPER_NETWORK, PUBLIC_NETWORK, FAST_NETWORK, TWO_NETWORKS];
        presets.into_iter().try_for_each(|preset| drawing::compare_views(gpu, preset, tuning, findings))
    };
    let mut parts: Vec<TestPart<'a>> = vec![
        (name("iterations"), Box::new(iterations)),
        (name("two networks"), Box::new(both)),
        (name("empty cells"), Box::new(move |findings| occupancy::compare(gpu, dataset, tuning, findings))),
        (name("views"), Box::new(views)),
        (name("volumes"), Box::new(move |findings| drawing::compare_volumes(gpu, tuning, findings))),
        (name("equal runs"), Box::new(move |findings| repeats::compare_network(gpu, dataset, tuning, findings))),
    ];
    if tuning.layers == Layers::Matrices {
        // The device chooses whether the backward pass recomputes or keeps results: the other way must be right, too.
        let matrices = MatrixTuning { recompute: !tuning.matrices.recompute, ..tuning.matrices };
        let other_way = Tuning { matrices, ..tuning.clone() };
        let case = &iteration::MATRIX_CASES[0];
        let iteration = move |findings: &mut Findings| iteration::compare(gpu, even, case, &other_way, findings);
        parts.push((name("iterations with the other backward pass"), Box::new(iteration)));
    }
    parts
}

/// The parts about Gaussians and phantoms, which have no choice of layers.
fn other_parts<'a>(gpu: &'a Gpu, tuning: &'a Tuning) -> Vec<TestPart<'a>> {
    vec![
        ("Gaussians per phase".into(), Box::new(move |findings| gaussians::compare(gpu, findings))),
        ("R2-Gaussian".into(), Box::new(move |findings| r2_gaussian::compare(gpu, findings))),
        ("X-Gaussian".into(), Box::new(move |findings| x_gaussian::compare(gpu, findings))),
        ("SAX-NeRF".into(), Box::new(move |findings| sax_nerf::compare(gpu, findings))),
        ("a deformable set of Gaussians".into(), Box::new(move |findings| dynamic_gaussians::compare(gpu, findings))),
        ("views of Gaussians".into(), Box::new(move |findings| blobs::compare_rays(gpu, tuning, findings))),
        (
            "views of many Gaussians".into(),
            Box::new(move |findings| {
                blobs::compare_maxima(gpu, &r2_gaussian::small_config(&[])?.into_any(), tuning, findings)
            }),
        ),
        ("volumes of Gaussians".into(), Box::new(move |findings| blobs::compare_cells(gpu, tuning, findings))),
        (
            "equal runs of Gaussians".into(),
            Box::new(move |findings| dynamic_gaussians::compare_equal_runs(gpu, findings)),
        ),
        ("projections of volumes".into(), Box::new(move |findings| projections::compare(gpu, findings))),
    ]
}

/// Compares every stage that the device can run with its twin. `progress` is called when a part begins and when it has ended.
///
/// # Errors
/// [`Error::DeviceLost`], after which nothing can be compared; other errors are part of the report.
pub fn run(gpu: &Gpu, progress: &mut dyn FnMut(Progress<'_>)) -> Result<Report> {
    let (even, dataset) = (small_dataset(13, 11, 3)?, uneven_dataset(13, 11)?);
    let chosen = Tuning::for_device(gpu.info());
    let on = |layers| chosen.clone().with_layers(layers, String::new());
    let (f32_layers, matrices) = (on(Layers::F32), on(Layers::Matrices));
    let has_matrices = stages::matrix_shape(gpu.info()).is_some();
    let mut parts = other_parts(gpu, &f32_layers);
    parts.extend(network_parts(gpu, &even, &dataset, &f32_layers));
    if has_matrices {
        parts.extend(network_parts(gpu, &even, &dataset, &matrices));
    }
    let (mut findings, mut errors) = (Findings::default(), Vec::new());
    for (at, (part, compare)) in parts.iter().enumerate() {
        progress(Progress::Begun { part, done: at, parts: parts.len() });
        let (begin, before) = (Instant::now(), findings.rows().to_vec());
        let outcome = compare(&mut findings);
        let touched = |(at, row): &(usize, &Row)| before.get(*at).is_none_or(|old| old.cases != row.cases);
        let rows: Vec<Row> = findings.rows().iter().enumerate().filter(touched).map(|(_, row)| row.clone()).collect();
        progress(Progress::Ended { rows: &rows, seconds: begin.elapsed().as_secs_f64() });
        match outcome {
            Ok(()) => {}
            Err(lost @ Error::DeviceLost { .. }) => return Err(lost),
            Err(error) => errors.push(Failure { part: part.clone(), error: error.to_string() }),
        }
    }
    let mut paths = chosen.reasons.clone();
    if !has_matrices {
        paths.push(format!("matrix layers are not tested, because {}", stages::why_no_matrices()));
    }
    let rows = findings.rows().to_vec();
    Ok(Report { untested: untested(gpu, &rows), rows, errors, paths })
}

/// Stages that no row is about, or that were never recorded on the device.
fn untested(gpu: &Gpu, rows: &[Row]) -> Vec<&'static str> {
    let recorded = gpu.recorded_shaders();
    let compared = |stage: &str| rows.iter().any(|row| row.stages.contains(&stage));
    let tested = |stage: &&str| MEASURING.contains(stage) || (recorded.contains(stage) && compared(stage));
    stages::shaders().into_iter().filter(|stage| !tested(stage)).collect()
}
