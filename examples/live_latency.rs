//! Measures live pictures while frames arrive, while training goes on, and while scores are computed: 15 frames arrive and 15 pictures
//! are drawn per second. Prints latencies and the processor time of the whole process.
//!
//! ```sh
//! nertca-vk phantom P --size 200
//! cargo run --release --example live_latency -- P [SIDE]
//! ```

use nertca_vk::config::{Config, Preset};
use nertca_vk::error::{Error, Result};
use nertca_vk::geometry::{CArm, Geometry, MM_PER_UNIT, ViewRays};
use nertca_vk::gpu::device::{DeviceOptions, Gpu};
use nertca_vk::kernels::tuning::Tuning;
use nertca_vk::model::component::Component;
use nertca_vk::render::quantity::{Projection, Quantity};
use nertca_vk::scan::dataset::{Dataset, Frame};
use nertca_vk_runs::session::{FrameTime, NewFrame, Session, SessionOptions};
use nertca_vk_vessels::score::metrics::best_dice;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::{Duration, Instant};

/// Time from one frame to the next, and from one picture to the next.
const INTERVAL: Duration = Duration::from_nanos(1_000_000_000 / 15);
/// Columns and rows of the pictures.
const SIDE: usize = 512;
/// Clock ticks per second of `/proc/self/stat` on Linux.
const TICKS_PER_S: f64 = 100.0;
const SHOWN: Quantity = Quantity { component: Component::Total, projection: Projection::Drr };

fn main() -> Result<()> {
    let mut arguments = std::env::args().skip(1);
    let Some(data) = arguments.next() else {
        return Err(Error::config("DATA", "", "is missing: give the directory of a dataset"));
    };
    let side = arguments.next().and_then(|side| side.parse().ok()).unwrap_or(SIDE);
    let dataset = Dataset::open(Path::new(&data))?;
    let gpu = Gpu::open(&DeviceOptions::default())?;
    let tuning = Tuning::for_device(gpu.info());
    println!("{}; pictures of {side} x {side} pixels", gpu.info().name);
    let options = SessionOptions {
        still: false,
        config: Config::load(Some(Preset::Fast), None, &[])?,
        phases: dataset.n_phases,
        depth_half_extent_mm: dataset.depth_range.1 * MM_PER_UNIT,
        vessel_attenuation_per_mm: dataset.vessel_attenuation.map(|a| a / MM_PER_UNIT),
        deterministic: false,
    };
    let session = Arc::new(Session::new(Some(gpu), Some(tuning), options)?);
    dataset.validation().iter().try_for_each(|frame| session.add_frame(new_frame(&dataset, frame)))?;
    session.start(Box::new(|_| true))?;
    let (rays, size) = (rays(&dataset, side)?, (side, side));
    let draw = |phase: u32| session.render(&rays, size, phase % dataset.n_phases, SHOWN);

    let all = dataset.training().len() as u32;
    let pushed = Arc::new(AtomicU32::new(0));
    let pushing = {
        let (session, dataset, pushed) = (session.clone(), dataset.clone(), pushed.clone());
        std::thread::spawn(move || -> Result<Instant> {
            let begin = Instant::now();
            for (index, frame) in dataset.training().iter().enumerate() {
                std::thread::sleep((INTERVAL * index as u32).saturating_sub(begin.elapsed()));
                session.add_frame(new_frame(&dataset, frame))?;
                pushed.fetch_add(1, Ordering::Release);
            }
            Ok(Instant::now())
        })
    };
    let mut with_all = None;
    let while_frames_arrive = watch(&draw, &mut || pushed.load(Ordering::Acquire) < all)?;
    let last_frame = pushing.join().unwrap_or_else(|_| Err(Error::Internal("a thread panicked".into())))?;
    let while_training = watch(&draw, &mut || {
        if with_all.is_none() && session.drawn().is_some_and(|drawn| drawn.frames == all) {
            let seen_at = Instant::now();
            with_all = Some((seen_at, picture_dice(&session, &dataset)));
        }
        !session.wait(Duration::ZERO)
    })?;
    let scored = Arc::new(AtomicBool::new(false));
    let scoring = {
        let (session, scored) = (session.clone(), scored.clone());
        std::thread::spawn(move || {
            let evaluation = session.evaluate(None);
            scored.store(true, Ordering::Release);
            evaluation
        })
    };
    let while_scoring = watch(&draw, &mut || !scored.load(Ordering::Acquire))?;
    let evaluation = scoring.join().unwrap_or_else(|_| Err(Error::Internal("a thread panicked".into())))?;
    for (name, watched) in
        [("frames arrive", while_frames_arrive), ("training", while_training), ("scores", while_scoring)]
    {
        println!("{name:>14}: {watched}");
    }
    if let Some((seen_at, dice)) = with_all {
        println!(
            "first picture of all {all} frames: {:.2} s after the last; best Dice of its vessels: {:.3}",
            (seen_at - last_frame).as_secs_f64(),
            dice?
        );
    }
    println!("Dice of the dynamic field: {:?}; {:?}", evaluation.dice.dynamic, session.state());
    Ok(())
}

fn new_frame(dataset: &Dataset, frame: &Frame) -> NewFrame {
    let (view, own) = (&dataset.views[frame.view], dataset.own_frame(frame).into_owned());
    NewFrame {
        geometry: view.geometry.clone(),
        moment: FrameTime::Beat(own.beat_time()),
        split: own.split,
        width: view.size[0],
        height: view.size[1],
        integrals: own.integrals.into_vec(),
        mask: own.mask,
    }
}

/// Dice of live pictures of the dynamic field at the unseen views of phase 0, at the best threshold of all.
fn picture_dice(session: &Session, dataset: &Dataset) -> Result<f64> {
    let vessels = Quantity { component: Component::Dynamic, projection: Projection::Drr };
    let frames = dataset.validation().iter().filter(|frame| frame.phase == 0);
    let scored = frames.filter_map(|frame| frame.mask.as_deref().map(|mask| (frame, mask)));
    let draw = |(frame, mask): (&Frame, _)| {
        let view = &dataset.views[frame.view];
        Ok((session.render(&view.rays, (view.size[0], view.size[1]), 0, vessels)?, mask))
    };
    let drawn = scored.map(draw).collect::<Result<Vec<_>>>()?;
    let images: Vec<(&[f32], &[bool])> = drawn.iter().map(|(image, mask)| (image.as_slice(), *mask)).collect();
    Ok(best_dice(&images, 0.0).map_or(f64::NAN, |(dice, _)| dice))
}

/// Rays of a view that no frame was taken from, on a square of `side` pixels.
fn rays(dataset: &Dataset, side: usize) -> Result<ViewRays> {
    let (c_arm, [width, height]) = (dataset.reference_c_arm(), dataset.reference_view().size);
    let shrink = width.max(height) as f64 / side as f64;
    let turned =
        CArm { primary_deg: c_arm.primary_deg + 15.0, pixel_mm: c_arm.pixel_mm.map(|pitch| pitch * shrink), ..c_arm };
    Geometry::CArm(turned).rays(side, side).map_err(|(field, problem)| Error::config(field, "", problem))
}

/// Latencies of pictures, and what the process did meanwhile.
struct Watched {
    latencies_ms: Vec<f64>,
    seconds: f64,
    cpu_s: Option<f64>,
}

/// Draws pictures of a beat that plays, while `goes_on`. Before there is a reconstruction, there is no picture.
fn watch(draw: &dyn Fn(u32) -> Result<Vec<f32>>, goes_on: &mut dyn FnMut() -> bool) -> Result<Watched> {
    let (begin, cpu_before, mut latencies_ms) = (Instant::now(), cpu_s(), Vec::new());
    for picture in 0.. {
        if !goes_on() {
            break;
        }
        std::thread::sleep((INTERVAL * picture).saturating_sub(begin.elapsed()));
        let asked = Instant::now();
        match draw(picture) {
            Ok(_) => latencies_ms.push(1e3 * asked.elapsed().as_secs_f64()),
            Err(Error::NotReady(_)) => (),
            Err(error) => return Err(error),
        }
    }
    latencies_ms.sort_by(f64::total_cmp);
    let cpu_s = cpu_s().zip(cpu_before).map(|(now, before)| now - before);
    Ok(Watched { latencies_ms, seconds: begin.elapsed().as_secs_f64(), cpu_s })
}

impl std::fmt::Display for Watched {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let n = self.latencies_ms.len();
        let at = |share: f64| self.latencies_ms.get(((n as f64 * share) as usize).min(n.saturating_sub(1)));
        let [p50, p99, worst] = [0.5, 0.99, 1.0].map(|share| at(share).copied().unwrap_or(f64::NAN));
        write!(f, "{n} pictures in {:.1} s, p50 {p50:.1} ms, p99 {p99:.1} ms, worst {worst:.1} ms", self.seconds)?;
        self.cpu_s.map_or(Ok(()), |cpu_s| write!(f, ", {cpu_s:.1} s of CPU"))
    }
}

/// Processor time of this process so far, seconds; none where the system does not tell.
fn cpu_s() -> Option<f64> {
    let stat = std::fs::read_to_string("/proc/self/stat").ok()?;
    // The name in parentheses may contain spaces; user and system time are the 12th and 13th numbers behind it.
    let mut fields = stat.rsplit_once(')')?.1.split_whitespace().skip(11);
    let mut ticks = || fields.next()?.parse::<f64>().ok();
    Some((ticks()? + ticks()?) / TICKS_PER_S)
}
