//! Frames that arrive while a session trains: the fit of the Gaussians is continued or restarted, and the rendering
//! meanwhile is never worse than before.

use crate::common::{expect_silence, gpu, tuning};
use nertca_vk::checkpoint::Checkpoint;
use nertca_vk::choice::Choice;
use nertca_vk::config::{Config, GaussianForm, Preset};
use nertca_vk::fitting::fit::{FitField, Start, Use};
use nertca_vk::gaussians::field::GaussianField;
use nertca_vk::geometry::MM_PER_UNIT;
use nertca_vk::gpu::device::Gpu;
use nertca_vk::plan::Plan;
use nertca_vk::render::renderer::Renderer;
use nertca_vk::scan::dataset::{Dataset, Frame, Layout, Split};
use nertca_vk::train::trainer::Trainer;
use nertca_vk_phantom::dataset::{PhantomOptions, Setting, make};
use nertca_vk_phantom::degradations::Degradations;
use nertca_vk_phantom::views::ViewAngles;
use nertca_vk_runs::session::{FrameTime, NewFrame, Session, SessionOptions};
use nertca_vk_twins::selftest::problems::with_values;
use nertca_vk_vessels::score::eval::evaluate;
use std::sync::OnceLock;

const PHASES: u32 = 10;
/// Iterations of Gaussians; a continued fit skips the first third.
const GAUSSIAN_ITERATIONS: u32 = 120;
const CARRIED: u32 = 40;

/// A phantom of 64 x 64 pixels, made once.
fn phantom() -> &'static Dataset {
    static DATASET: OnceLock<Dataset> = OnceLock::new();
    DATASET.get_or_init(|| {
        let (gpu, directory) = (gpu(), tempfile::tempdir().unwrap());
        let options = PhantomOptions {
            setting: Setting::SmallXcat,
            anatomy: None,
            size: 64,
            phases: PHASES,
            views: ViewAngles::published(4).unwrap(),
            seed: 1,
            stenoses: Vec::new(),
            degradations: Degradations::default(),
            layout: Layout::Native,
            volumes_every: None,
        };
        make(&gpu, &options, &directory.path().join("data"), |_, _, _| ()).unwrap();
        expect_silence(gpu);
        Dataset::open(&directory.path().join("data")).unwrap()
    })
}

fn session(gpu: &Gpu, dataset: &Dataset) -> Session {
    session_of(gpu, dataset, &["gaussians.form=deformable"], GAUSSIAN_ITERATIONS + 1)
}

fn session_of(gpu: &Gpu, dataset: &Dataset, settings: &[&str], iterations: u32) -> Session {
    let mut config = with_values(&Config::preset(Preset::Fast), settings.iter().copied()).unwrap();
    config.train.iterations = iterations;
    let options = SessionOptions {
        config,
        phases: PHASES,
        depth_half_extent_mm: dataset.depth_range.1 * MM_PER_UNIT,
        vessel_attenuation_per_mm: dataset.vessel_attenuation.map(|a| a / MM_PER_UNIT),
        still: false,
        deterministic: true,
    };
    Session::new(Some(gpu.clone()), Some(tuning(gpu)), options).unwrap()
}

fn add(session: &Session, dataset: &Dataset, wanted: impl Fn(&Frame) -> bool) {
    for f in dataset.training().iter().filter(|f| f.split == Split::Train && wanted(f)) {
        let new = NewFrame {
            geometry: dataset.views[f.view].geometry.clone(),
            moment: FrameTime::Phase(f.phase),
            split: f.split,
            width: dataset.width,
            height: dataset.height,
            integrals: f.integrals.to_vec(),
            mask: None,
        };
        session.add_frame(new).unwrap();
    }
}

/// Trains to the end of the run, and returns the number of iterations.
fn train(session: &Session) -> u32 {
    session.train(u32::MAX, &mut |_| true).unwrap()
}

fn field(session: &Session) -> GaussianField {
    session.checkpoint().unwrap().model.gaussians.unwrap()
}

/// Dice of the dynamic field on unseen images.
fn dice(gpu: &Gpu, session: &Session, dataset: &Dataset) -> f64 {
    let model = session.checkpoint().unwrap().model;
    let renderer = Renderer::new(gpu, &model, tuning(gpu)).unwrap();
    let unseen: Vec<&Frame> = dataset.frames.iter().filter(|f| f.split == Split::Validation).step_by(5).collect();
    evaluate(&renderer, dataset, &unseen, model.step, None, |_| Ok(())).unwrap().dice.dynamic.unwrap()
}

#[test]
#[ignore = "long: tools/test --all"]
fn gaussians_go_on_where_they_explain_what_is_new() {
    let gpu = gpu();
    let (directory, dataset) = (tempfile::tempdir().unwrap(), phantom());
    let at_once = session(&gpu, dataset);
    add(&at_once, dataset, |_| true);
    assert_eq!(train(&at_once), GAUSSIAN_ITERATIONS + 1);
    let (wanted, anew) = (dice(&gpu, &at_once, dataset), field(&at_once));
    drop(at_once);

    // The last two phases lie between known ones.
    let (early, late) = (|f: &Frame| f.phase < 8, |f: &Frame| f.phase >= 8);
    let grown = session(&gpu, dataset);
    add(&grown, dataset, early);
    train(&grown);
    let saved = directory.path().join("early.safetensors");
    grown.checkpoint().unwrap().write(&saved).unwrap();
    add(&grown, dataset, late);
    assert_eq!(train(&grown), GAUSSIAN_ITERATIONS + 1 - CARRIED);
    let reached = dice(&gpu, &grown, dataset);
    println!("at once {wanted}, grown {reached}");
    assert!(reached > wanted - 0.01, "{reached}, where all frames at once reach {wanted}");
    let loaded = session(&gpu, dataset);
    loaded.load(Checkpoint::read(&saved).unwrap()).unwrap();
    add(&loaded, dataset, |_| true);
    assert_eq!(train(&loaded), GAUSSIAN_ITERATIONS + 1 - CARRIED);
    assert_eq!(field(&loaded), field(&grown), "also across save and load");
    drop((grown, loaded));

    // Half of the beat, or another view, is new information that restarts the fit.
    for late in [&(|f: &Frame| f.phase > 4) as &dyn Fn(&Frame) -> bool, &|f: &Frame| f.view == 3] {
        let grown = session(&gpu, dataset);
        add(&grown, dataset, |f| !late(f));
        train(&grown);
        add(&grown, dataset, late);
        assert_eq!(train(&grown), GAUSSIAN_ITERATIONS + 1);
        assert_eq!(field(&grown), anew);
    }
    expect_silence(gpu);
}

/// A run that ends before a fit would continue, or in the middle of one.
#[test]
fn short_runs_take_in_frames_as_well() {
    const ITERATIONS: u32 = 30;
    let gpu = gpu();
    let dataset = phantom();
    for form in [GaussianForm::Phase, GaussianForm::Deformable] {
        // A short preparation: the fields are compared with each other alone.
        let chosen = format!("gaussians.form={}", form.name());
        let settings = [chosen.as_str(), "deformable.warm_iterations=20", "deformable.track_iterations=5"];
        let [at_once, grown] = [(); 2].map(|()| session_of(&gpu, dataset, &settings, ITERATIONS));
        add(&at_once, dataset, |_| true);
        assert_eq!(train(&at_once), ITERATIONS);
        add(&grown, dataset, |f| f.phase < 8);
        assert_eq!(train(&grown), ITERATIONS);
        add(&grown, dataset, |f| f.phase >= 8);
        assert_eq!(train(&grown), ITERATIONS);
        assert_eq!(field(&grown), field(&at_once), "{form:?}");
    }
    expect_silence(gpu);
}

#[test]
fn what_was_there_is_shown_until_there_is_better() {
    let gpu = gpu();
    let dataset = phantom();
    let earlier = {
        let three_views = session(&gpu, dataset);
        add(&three_views, dataset, |f| f.view < 3);
        three_views.train(2, &mut |_| true).unwrap();
        field(&three_views)
    };
    let plan = Plan::new(&Config::preset(Preset::Fast), dataset).unwrap();
    let shown = FitField::of_gaussians(earlier.clone());
    let from = Start { field: Some((&shown, Use::GoOn)), ..Start::default() };
    let mut trainer = Trainer::begin(&gpu, plan, dataset, tuning(&gpu), from).unwrap();
    let feed = trainer.feed().gaussians.unwrap();
    let shown = || feed.lock().unwrap().1.clone();
    let (mut with_earlier, mut with_sets) = (0, 0);
    while trainer.preparation().is_some() {
        if shown() == earlier {
            assert_eq!(with_sets, 0, "the earlier field does not come back");
            with_earlier += 1;
        } else {
            assert!(shown().moving().is_none(), "a set per phase");
            with_sets += 1;
        }
        trainer.advance(1).unwrap();
    }
    assert!(with_earlier > 1 && with_sets > 3, "{with_earlier} and {with_sets} advances");
    assert!(shown() != earlier && shown().moving().is_some());
    drop(trainer);
    expect_silence(gpu);
}
