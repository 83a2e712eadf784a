//! `watch`: DICOM runs that appear in a folder are reconstructed as they come.

use super::args::{Cli, ConfigArgs};
use super::dicom_args::DicomArgs;
use super::progress::stop_flag;
use super::view_server::{Server, Taken};
use super::view_tree::TreeWork;
use super::watch_leave::{Kept, prepare, remove_empty};
use super::watch_live::Live;
use clap::Args;
use nertca_vk::config::Config;
use nertca_vk::error::{Error, Result};
use nertca_vk::geometry::Geometry;
use nertca_vk::gpu::device::Gpu;
use nertca_vk::import::angiograms::ImportOptions;
use nertca_vk::import::dicom::Run;
use nertca_vk::import::folder::Folder;
use nertca_vk::import::intake::Intake;
use nertca_vk::kernels::tuning::Tuning;
use nertca_vk::scan::dataset::Split;
use nertca_vk::session::{Moment, NewFrame, Session, SessionOptions, State};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};
use tokio::sync::oneshot;

/// Time between two looks at the folder.
const LOOK_EVERY: Duration = Duration::from_millis(500);

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
    prepare(&args.out)?;
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
    let mut watch = Watch {
        gpu: &gpu,
        tuning,
        config,
        options,
        intake,
        live,
        tree,
        under_way: None,
        kept: None,
        failed: false,
        training: false,
    };
    let ends = || stop.load(Ordering::Relaxed) || serving.is_finished();
    let watched = watch.until(&mut folder, &ends, args.until_idle);
    // Before all that may fail or take its time.
    let left = watch.leave(&args.out);
    drop(end);
    watch.live.follow(None, None, 0);
    let served = serving.join().unwrap_or_else(|_| Err(Error::Internal("the viewer's server panicked".into())));
    watched?;
    left?;
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
    /// What trains, or has.
    under_way: Option<UnderWay>,
    /// What was reconstructed before training began anew.
    kept: Option<Kept>,
    /// Whether it was told that training has failed.
    failed: bool,
    /// Whether training went on when it was looked at last.
    training: bool,
}

/// A session of runs.
struct UnderWay {
    session: Arc<Session>,
    /// Runs handed to it.
    runs: usize,
}

impl Watch<'_> {
    fn until(&mut self, folder: &mut Folder, ends: &dyn Fn() -> bool, until_idle: Option<Duration>) -> Result<()> {
        let (mut busy, mut unreadable) = (Instant::now(), false);
        while !ends() {
            let files = match folder.look() {
                // It may come back, as shares on a network do.
                Err(error @ Error::Io { .. }) => {
                    if !unreadable {
                        eprintln!("{error}; it is looked at again");
                    }
                    unreadable = true;
                    Vec::new()
                }
                files => {
                    unreadable = false;
                    files?
                }
            };
            for file in files {
                if ends() {
                    break;
                }
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
        let Some(UnderWay { session, .. }) = &self.under_way else { return false };
        if let Some(problem) = session.failure().filter(|_| !self.failed) {
            eprintln!("training ended: {problem}; it begins anew with the next run");
            self.failed = true;
        }
        let trains = session.state() == State::Running;
        if self.training && !trains {
            // What was found on the way is of vessels as they were.
            self.tree.forget();
        }
        self.training = trains;
        trains
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

    /// Hands the newest run to training. Where that is past its half or over, it begins anew with all runs: the last iterations
    /// alone would not do the new ones justice.
    fn feed(&mut self) -> Result<()> {
        let Some(first) = self.intake.first() else { return Ok(()) };
        let taken = Taken { c_arm: first.c_arm.clone(), image_size: [first.image.width, first.image.height] };
        let young = |session: &Session| {
            let state = session.state();
            matches!(state, State::Running | State::Waiting) && 2 * session.step() <= self.config.train.iterations
        };
        let newest = self.intake.runs() - 1;
        match &self.under_way {
            Some(now) if young(&now.session) => self.add(&now.session, newest)?,
            _ => {
                // The old one's memory is needed first.
                self.live.follow(None, None, newest);
                self.keep();
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
                self.under_way = Some(UnderWay { session: Arc::new(session), runs: 0 });
                self.failed = false;
            }
        }
        self.tree.forget();
        let session = self.under_way.as_mut().map(|now| {
            now.runs = newest + 1;
            now.session.clone()
        });
        self.live.follow(session, Some(taken), newest + 1);
        Ok(())
    }

    fn add(&self, session: &Session, run: usize) -> Result<()> {
        self.intake.frames(run).iter().try_for_each(|frame| {
            session.add_frame(NewFrame {
                geometry: Geometry::CArm(frame.c_arm.clone()),
                moment: Moment::Beat(frame.taken),
                split: Split::Train,
                width: frame.image.width,
                height: frame.image.height,
                integrals: frame.image.values.clone(),
                mask: None,
            })
        })
    }

    /// Keeps what training has come to, where that is better than what was kept before; the reason where it has come to nothing.
    fn keep(&mut self) -> Option<Error> {
        let UnderWay { session, runs, .. } = self.under_way.take()?;
        match Kept::of(&session, runs) {
            Ok(kept) => {
                if self.kept.as_ref().is_none_or(|before| kept.replaces(before)) {
                    self.kept = Some(kept);
                }
                None
            }
            Err(error) => Some(session.failure().map_or(error, Error::NotReady)),
        }
    }

    /// Leaves a run directory as `train` does, with its dataset.
    fn leave(&mut self, run: &Path) -> Result<()> {
        let nothing = self.keep();
        let Some(kept) = &self.kept else {
            remove_empty(run);
            let why = match nothing {
                Some(Error::NotReady(why)) if self.failed => why,
                Some(error) if !matches!(error, Error::NotReady(_)) => return Err(error),
                _ => "runs from two angles are needed".into(),
            };
            return Err(Error::NotReady(format!("nothing was reconstructed: {why}")));
        };
        if let Some(error) = nothing {
            eprintln!("what was reconstructed before is left: {error}");
        }
        let saved = kept.leave(&self.intake, (self.gpu, &self.tuning), run)?;
        eprintln!("{} of {} iterations", kept.step(), self.config.train.iterations);
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
