//! `watch`: reconstructs DICOM runs as they appear in a folder.

mod watch_leave;
mod watch_live;

use crate::args::dicom_args::DicomArgs;
use crate::args::options::{ConfigArgs, GlobalOptions};
use crate::progress::stop_flag;
use crate::viewer::igtl_server::IgtlServer;
use crate::viewer::view_server::{AngiogramGeometry, Server};
use crate::viewer::view_tree::TreeWork;
use crate::watch::watch_leave::{TrainedRun, prepare, remove_empty};
use crate::watch::watch_live::Live;
use clap::Args;
use nertca_vk::config::Config;
use nertca_vk::error::{Error, Result};
use nertca_vk::geometry::Geometry;
use nertca_vk::gpu::device::Gpu;
use nertca_vk::kernels::tuning::Tuning;
use nertca_vk::scan::dataset::Split;
use nertca_vk::scan::prior::VesselPrior;
use nertca_vk_import::angiograms::ImportOptions;
use nertca_vk_import::dicom::Run;
use nertca_vk_import::folder::Folder;
use nertca_vk_import::intake::Intake;
use nertca_vk_import::intake::StatedRun;
use nertca_vk_import::stated::StatedGeometry;
use nertca_vk_runs::session::{FrameTime, NewFrame, Session, SessionOptions, State};
use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};
use tokio::sync::oneshot;

/// Time between two checks of the folder.
const LOOK_EVERY: Duration = Duration::from_millis(500);

/// Arguments of `watch`.
#[derive(Debug, Args)]
pub struct WatchArgs {
    /// Folder in which DICOM runs (XA or RF, one file per view) appear. A file is read once it no longer changes; other files
    /// are reported and ignored until they change.
    #[arg(value_name = "DIR")]
    pub directory: PathBuf,
    /// Run directory to write in the end, with the runs that were read as a dataset in `data`.
    #[arg(short, long, value_name = "RUN")]
    pub out: PathBuf,
    /// End after this many seconds without a new run and without training; otherwise Ctrl-C ends the program.
    #[arg(long, value_name = "SECONDS", value_parser = seconds)]
    pub until_idle: Option<Duration>,
    /// Port of the viewer's page on 127.0.0.1; a free one by default.
    #[arg(long, default_value_t = 0)]
    pub port: u16,
    /// Also send the overlay and the vessels to OpenIGTLink clients, such as 3D Slicer, that connect to this port; 0 for a free one.
    #[arg(long, value_name = "PORT")]
    pub igtl: Option<u16>,
    /// Address of the OpenIGTLink port. Anyone who reaches it can read the reconstruction: this computer alone by default.
    #[arg(long, value_name = "ADDRESS", requires = "igtl", default_value = "127.0.0.1")]
    pub igtl_bind: IpAddr,
    /// Vessels that are known before, e.g. from a CT, as `train --prior` takes them.
    #[arg(long, value_name = "FILE")]
    pub prior: Option<PathBuf>,
    /// Options of reading runs.
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

/// Reads runs until a signal ends it, and writes a run directory.
pub fn run(global: &GlobalOptions, args: &WatchArgs) -> Result<()> {
    let (config, options) = (args.config.load([])?, args.reading.options()?);
    // Runs come in an order that nobody knows, so what is stated is stated of all.
    let stated = args.reading.stated(1)?.remove(0);
    let prior = crate::command::train::prior(args.prior.as_deref(), &config)?;
    let mut folder = Folder::new(&args.directory);
    folder.look()?;
    let _lock = prepare(&args.out)?;
    let stop = stop_flag()?;
    let gpu = global.open_device()?;
    let tuning = global.tuning(&gpu, &config);
    let intake = Intake::new(options.clone());
    let live = Arc::new(Live::new(if intake.is_still() { 1 } else { intake.phases() }, config.train.iterations));
    let tree = Arc::new(TreeWork::new(&gpu, tuning.clone()));
    let server = Server::open(args.port, live.clone(), tree.clone())?;
    let igtl =
        args.igtl.map(|port| IgtlServer::open((args.igtl_bind, port), live.clone(), tree.clone())).transpose()?;
    out!("{}", server.url());
    if let Some(igtl) = &igtl {
        eprintln!("OpenIGTLink: {}", igtl.address());
    }
    eprintln!("watching {}; press Ctrl-C to end", args.directory.display());
    let (end, ended) = oneshot::channel::<()>();
    let serving = std::thread::spawn(move || {
        server.serve(async {
            // A dropped sender also ends the server.
            let _ = ended.await;
        })
    });
    let mut watch = Watch {
        gpu: &gpu,
        tuning,
        config,
        prior,
        options,
        stated,
        intake,
        live,
        tree,
        under_way: None,
        kept: None,
        failed: false,
        waits: None,
        training: false,
    };
    let ends = || stop.load(Ordering::Relaxed) || serving.is_finished();
    let watched = watch.until(&mut folder, &ends, args.until_idle);
    drop(igtl);
    // The run directory is written before everything that may fail or take long.
    let left = watch.leave(&args.out);
    drop(end);
    watch.live.follow(None, None, 0);
    let served = serving.join().unwrap_or_else(|_| Err(Error::Internal("the viewer's server panicked".into())));
    watched?;
    left?;
    served?;
    global.close_device(&gpu)
}

/// State of the command.
struct Watch<'a> {
    gpu: &'a Gpu,
    tuning: Tuning,
    config: Config,
    /// Vessels that are known before.
    prior: Option<VesselPrior>,
    options: ImportOptions,
    stated: StatedRun,
    intake: Intake,
    live: Arc<Live>,
    tree: Arc<TreeWork>,
    /// Session that trains, or has trained.
    under_way: Option<UnderWay>,
    /// Reconstruction from before training started again.
    kept: Option<TrainedRun>,
    /// Whether the user was told that training has failed.
    failed: bool,
    /// Reason why training waits, as the user was told.
    waits: Option<String>,
    /// Whether training was running at the last check.
    training: bool,
}

/// A session and its runs.
struct UnderWay {
    session: Arc<Session>,
    /// Number of runs handed to it.
    runs: usize,
}

impl Watch<'_> {
    fn until(&mut self, folder: &mut Folder, ends: &dyn Fn() -> bool, until_idle: Option<Duration>) -> Result<()> {
        let (mut busy, mut unreadable) = (Instant::now(), false);
        while !ends() {
            let files = match folder.look() {
                // The folder may become readable again, as network shares do.
                Err(error @ Error::Io { .. }) => {
                    if !unreadable {
                        eprintln!("{error}; the folder will be read again");
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

    /// Tells whether training is running; reports a failure once.
    fn trains(&mut self) -> bool {
        let Some(UnderWay { session, .. }) = &self.under_way else { return false };
        if let Some(problem) = session.failure().filter(|_| !self.failed) {
            eprintln!("training failed: {problem}; it starts again with the next run");
            self.failed = true;
        }
        if let Some(why) = session.waits_for().filter(|_| self.intake.runs() > 1)
            && self.waits.as_ref() != Some(&why)
        {
            eprintln!("training waits for other runs: {why}");
            self.waits = Some(why);
        }
        // Planning, and frames that training has not looked at yet, are work, too.
        let trains = session.is_busy();
        if self.training && !trains {
            // A tree found during training shows an earlier state of the vessels.
            self.tree.forget();
        }
        self.training = trains;
        trains
    }

    /// Reads a file; returns whether it could be used.
    fn take(&mut self, file: &Path) -> Result<bool> {
        let geometry = StatedGeometry { pixel_mm: self.options.pixel_mm, ..self.stated.geometry };
        let read = Run::read_as_stated(file, &geometry).and_then(|run| match self.intake.copy_of(&run) {
            Some(first) => {
                Err(Error::data(file, "SOPInstanceUID", format!("is the same as that of {first}, which was imported")))
            }
            None => Ok(run),
        });
        let taken = read.and_then(|run| {
            let told = describe(&run);
            Ok((told, self.intake.take_gated(vec![run], std::slice::from_ref(&self.stated.gating))?))
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
                eprintln!("imported: {told}, phases {}", phases.join(" "));
                Ok(true)
            }
            // Other files may be usable, so the program continues.
            Err(error @ (Error::Data { .. } | Error::Config { .. } | Error::Unmet { .. } | Error::Io { .. })) => {
                eprintln!("not imported: {error}");
                Ok(false)
            }
            Err(error) => Err(error),
        }
    }

    /// Hands the newest run to training. If training is past its half or finished, it starts again with all runs, because the
    /// remaining iterations would not suffice for the new one.
    fn feed(&mut self) -> Result<()> {
        let Some(first) = self.intake.first() else { return Ok(()) };
        let taken =
            AngiogramGeometry { c_arm: first.c_arm.clone(), image_size: [first.image.width, first.image.height] };
        let young = |session: &Session| {
            let state = session.state();
            matches!(state, State::Running | State::Waiting) && 2 * session.step() <= self.config.train.iterations
        };
        let newest = self.intake.runs() - 1;
        match &self.under_way {
            Some(now) if young(&now.session) => self.add(&now.session, newest)?,
            _ => {
                // The memory of the old session must be freed first.
                self.live.follow(None, None, newest);
                self.keep();
                let options = SessionOptions {
                    config: self.config.clone(),
                    phases: self.intake.phases(),
                    depth_half_extent_mm: self.options.depth_half_extent_mm,
                    vessel_attenuation_per_mm: None,
                    still: self.intake.is_still(),
                    deterministic: false,
                };
                let session = Session::new(Some(self.gpu.clone()), Some(self.tuning.clone()), options)?;
                session.set_prior(self.prior.clone())?;
                (0..=newest).try_for_each(|run| self.add(&session, run))?;
                session.start(Box::new(|_| true))?;
                self.under_way = Some(UnderWay { session: Arc::new(session), runs: 0 });
                self.failed = false;
            }
        }
        self.tree.forget();
        self.waits = None;
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
                moment: FrameTime::Beat(frame.taken),
                split: Split::Train,
                width: frame.image.width,
                height: frame.image.height,
                integrals: frame.image.values.clone(),
                mask: None,
            })
        })
    }

    /// Stops training and keeps its result, if that is better than the one kept before. Returns the reason if there is no
    /// result.
    fn keep(&mut self) -> Option<Error> {
        let UnderWay { session, runs, .. } = self.under_way.take()?;
        match TrainedRun::of(&session, runs) {
            Ok(kept) => {
                if self.kept.as_ref().is_none_or(|before| kept.replaces(before)) {
                    self.kept = Some(kept);
                }
                None
            }
            Err(error) => Some(session.failure().map_or(error, Error::NotReady)),
        }
    }

    /// Writes a run directory like `train` does, with its dataset.
    fn leave(&mut self, run: &Path) -> Result<()> {
        let nothing = self.keep();
        let Some(kept) = &self.kept else {
            remove_empty(run);
            let why = match nothing {
                Some(Error::NotReady(why)) if self.failed => why,
                Some(error) if !matches!(error, Error::NotReady(_)) => return Err(error),
                _ => self.waits.take().unwrap_or_else(|| "runs from at least two angles are needed".into()),
            };
            return Err(Error::NotReady(format!("nothing was reconstructed: {why}")));
        };
        if let Some(error) = nothing {
            eprintln!("the earlier reconstruction is written: {error}");
        }
        if let Some(prior) = &self.prior {
            prior.write(run)?;
        }
        let saved = kept.leave(&self.intake, (self.gpu, &self.tuning), run)?;
        eprintln!("{} of {} iterations", kept.step(), self.config.train.iterations);
        out!("{}", saved.display());
        Ok(())
    }
}

/// Describes a run in a few words.
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
