//! `watch`: DICOM runs that appear in a folder are reconstructed as they come.

use super::args::{Cli, ConfigArgs};
use super::dicom_args::DicomArgs;
use super::progress::stop_flag;
use super::report::Report;
use super::view_server::{Server, Taken};
use super::view_tree::TreeWork;
use super::watch_live::Live;
use clap::Args;
use nertca_vk::config::Config;
use nertca_vk::error::{Error, Result};
use nertca_vk::files;
use nertca_vk::gpu::device::Gpu;
use nertca_vk::import::angiograms::ImportOptions;
use nertca_vk::import::dicom::Run;
use nertca_vk::import::folder::Folder;
use nertca_vk::import::intake::Intake;
use nertca_vk::kernels::tuning::Tuning;
use nertca_vk::model::checkpoint;
use nertca_vk::run::info::RunInfo;
use nertca_vk::run::score::as_trained;
use nertca_vk::scan::dataset::{Dataset, Split};
use nertca_vk::session::{Moment, NewFrame, Session, SessionOptions, State};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use tokio::sync::oneshot;

/// Time between two looks at the folder.
const LOOK_EVERY: Duration = Duration::from_millis(500);
/// Dataset of the runs that were taken in, inside the run directory.
const DATA: &str = "data";

/// `watch`.
#[derive(Debug, Args)]
pub struct WatchArgs {
    /// Folder in which DICOM runs (XA or RF, one file per view) appear. A file is taken in once it rests; other files are named
    /// and left alone until they change.
    #[arg(value_name = "DIR")]
    pub directory: PathBuf,
    /// Run directory to leave in the end, with the runs that were taken in as a dataset in `data`.
    #[arg(short, long, value_name = "RUN")]
    pub out: PathBuf,
    /// End once no run has come, and nothing was trained, for so many seconds; otherwise Ctrl-C ends it.
    #[arg(long, value_name = "SECONDS", value_parser = seconds)]
    pub until_idle: Option<Duration>,
    /// Port of the viewer's page on 127.0.0.1; a free one by default.
    #[arg(long, default_value_t = 0)]
    pub port: u16,
    /// How runs are read.
    #[command(flatten)]
    pub reading: DicomArgs,
    /// Hyper-parameters.
    #[command(flatten)]
    pub config: ConfigArgs,
}

fn seconds(text: &str) -> std::result::Result<Duration, String> {
    let seconds: f64 = text.parse().map_err(|_| "is not a number".to_owned())?;
    Duration::try_from_secs_f64(seconds).map_err(|_| "is not a time in seconds".to_owned())
}

/// Takes runs in until it is told to end, and leaves a run directory.
pub fn run(cli: &Cli, args: &WatchArgs) -> Result<()> {
    let (config, options) = (args.config.load([])?, args.reading.options()?);
    let mut folder = Folder::new(&args.directory);
    folder.look()?;
    if args.out.exists() && !checkpoint::list(&args.out)?.is_empty() {
        return Err(Error::config("--out", args.out.display(), "already holds a run: choose another directory"));
    }
    let stop = stop_flag()?;
    let gpu = cli.open_device()?;
    let tuning = cli.tuning(&gpu, &config);
    let intake = Intake::new(options.clone());
    let live = Arc::new(Live::new(intake.phases(), config.train.iterations));
    let tree = Arc::new(TreeWork::new(&gpu, tuning.clone()));
    let server = Server::open(args.port, live.clone(), tree.clone())?;
    out!("{}", server.url());
    eprintln!("watching {}; Ctrl-C ends", args.directory.display());
    let (end, ended) = oneshot::channel::<()>();
    let serving = std::thread::spawn(move || {
        server.serve(async {
            // What was dropped has ended, too.
            let _ = ended.await;
        })
    });
    let mut watch = Watch { gpu: &gpu, tuning, config, options, intake, live, tree, session: None, failed: false };
    let watched = watch.until(&mut folder, &stop, args.until_idle);
    drop(end);
    watch.live.follow(None, None, 0);
    let served = serving.join().unwrap_or_else(|_| Err(Error::Internal("the viewer's server panicked".into())));
    watched?;
    watch.leave(&args.out)?;
    served?;
    cli.close_device(&gpu)
}

/// What is under way.
struct Watch<'a> {
    gpu: &'a Gpu,
    tuning: Tuning,
    config: Config,
    options: ImportOptions,
    intake: Intake,
    live: Arc<Live>,
    tree: Arc<TreeWork>,
    /// What trains, and the size of its images.
    session: Option<(Arc<Session>, [usize; 2])>,
    /// Whether it was told that training has failed.
    failed: bool,
}

impl Watch<'_> {
    fn until(&mut self, folder: &mut Folder, stop: &AtomicBool, until_idle: Option<Duration>) -> Result<()> {
        let mut busy = Instant::now();
        while !stop.load(Ordering::Relaxed) {
            for file in folder.look()? {
                if self.take(&file)? {
                    busy = Instant::now();
                }
            }
            if self.trains() {
                busy = Instant::now();
            }
            if until_idle.is_some_and(|limit| busy.elapsed() >= limit) {
                break;
            }
            std::thread::sleep(LOOK_EVERY);
        }
        Ok(())
    }

    /// Whether training goes on; tells once that it has failed.
    fn trains(&mut self) -> bool {
        let Some((session, _)) = &self.session else { return false };
        if let Some(problem) = session.failure().filter(|_| !self.failed) {
            eprintln!("training ended: {problem}; it begins anew with the next run");
            self.failed = true;
        }
        session.state() == State::Running
    }

    /// Takes a file in; whether it could be.
    fn take(&mut self, file: &Path) -> Result<bool> {
        let read = Run::read(file, self.options.pixel_mm).and_then(|run| match self.intake.copy_of(&run) {
            Some(first) => Err(Error::data(file, "SOPInstanceUID", format!("is that of {first}, which was taken in"))),
            None => Ok(run),
        });
        let taken = read.and_then(|run| {
            let told = describe(&run);
            Ok((told, self.intake.take(vec![run])?))
        });
        match taken {
            Ok((told, notes)) => {
                notes.iter().for_each(|note| eprintln!("{note}"));
                let phases: Vec<String> = self
                    .intake
                    .frames(self.intake.runs() - 1)
                    .iter()
                    .map(|frame| frame.taken.phase.to_string())
                    .collect();
                self.feed()?;
                eprintln!("taken in: {told}, phases {}", phases.join(" "));
                Ok(true)
            }
            // Others are no reason to end.
            Err(error @ (Error::Data { .. } | Error::Config { .. } | Error::Io { .. })) => {
                eprintln!("not taken in: {error}");
                Ok(false)
            }
            Err(error) => Err(error),
        }
    }

    /// Hands the newest run to training. Where that is past its half or over, or images have another size now, it begins anew
    /// with all runs: the last iterations alone would not do the new ones justice.
    fn feed(&mut self) -> Result<()> {
        let Some((size, c_arm)) = self.intake.size().zip(self.intake.c_arm().cloned()) else { return Ok(()) };
        let young = |session: &Session| {
            let state = session.state();
            matches!(state, State::Running | State::Waiting) && 2 * session.step() <= self.config.train.iterations
        };
        let newest = self.intake.runs() - 1;
        match &self.session {
            Some((session, of)) if *of == size && young(session) => self.add(session, newest)?,
            _ => {
                // The old one's memory is needed first.
                self.live.follow(None, None, newest);
                self.session = None;
                let options = SessionOptions {
                    config: self.config.clone(),
                    phases: self.intake.phases(),
                    depth_half_extent_mm: self.options.depth_half_extent_mm,
                    vessel_attenuation_per_mm: None,
                    deterministic: false,
                };
                let session = Session::new(Some(self.gpu.clone()), Some(self.tuning.clone()), options)?;
                (0..=newest).try_for_each(|run| self.add(&session, run))?;
                session.start(Box::new(|_| true))?;
                (self.session, self.failed) = (Some((Arc::new(session), size)), false);
            }
        }
        self.tree.forget();
        let session = self.session.as_ref().map(|(session, _)| session.clone());
        self.live.follow(session, Some(Taken { c_arm, image_size: size }), newest + 1);
        Ok(())
    }

    fn add(&self, session: &Session, run: usize) -> Result<()> {
        self.intake.frames(run).into_iter().try_for_each(|frame| {
            session.add_frame(NewFrame {
                geometry: frame.geometry,
                moment: Moment::Beat(frame.taken),
                split: Split::Train,
                width: frame.image.width,
                height: frame.image.height,
                integrals: frame.image.values,
                mask: None,
            })
        })
    }

    /// Leaves a run directory as `train` does, with its dataset.
    fn leave(self, run: &Path) -> Result<()> {
        let none = || Error::NotReady("nothing was reconstructed: runs from two angles are needed".into());
        let (session, _) = self.session.ok_or_else(none)?;
        session.stop()?;
        let checkpoint = session.checkpoint().map_err(|error| match session.failure() {
            Some(problem) => Error::NotReady(format!("nothing was reconstructed: {problem}")),
            None if matches!(error, Error::NotReady(_)) => none(),
            None => error,
        })?;
        let data = run.join(DATA);
        eprintln!("{}", self.intake.write(&data)?);
        RunInfo { dataset: data.canonicalize().unwrap_or_else(|_| data.clone()) }.write(run)?;
        files::write_atomic(&run.join("config.toml"), checkpoint.model.config.to_toml()?.as_bytes())?;
        if let Some(calibration) = session.calibration() {
            calibration.write(run)?;
        }
        let saved = checkpoint.save(run)?;
        Report {
            gpu: self.gpu,
            tuning: &self.tuning,
            model: &checkpoint.model,
            dataset: &as_trained(Dataset::open(&data)?, run)?,
            evaluation: None,
            warnings: &[],
            tree: None,
            run,
            pictures: Path::new(""),
        }
        .write(&run.join("report.html"))?;
        eprintln!("{} of {} iterations", checkpoint.model.step, self.config.train.iterations);
        out!("{}", saved.display());
        Ok(())
    }
}

/// A run in a few words.
fn describe(run: &Run) -> String {
    let c_arm = &run.c_arms[0];
    let angle =
        |deg: f64, plus: &str, minus: &str| format!("{} {:.1} deg", if deg < 0.0 { minus } else { plus }, deg.abs());
    format!(
        "{} ({}, {}), {} frames",
        run.name(),
        angle(c_arm.primary_deg, "LAO", "RAO"),
        angle(c_arm.secondary_deg, "CRA", "CAU"),
        run.frames.len()
    )
}
