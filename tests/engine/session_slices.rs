//! Long work of a session is done in slices: live pictures pass between them, and it can be cancelled there.

use crate::common::{expect_silence, gpu, small_config, small_dataset, tuning};
use nertca_vk::error::Error;
use nertca_vk::gpu::device::Gpu;
use nertca_vk::model::component::Component;
use nertca_vk::render::grid::PatientGrid;
use nertca_vk::render::quantity::{Projection, Quantity};
use nertca_vk::scan::dataset::{Dataset, Split};
use nertca_vk_runs::session::{FrameTime, NewFrame, Session, SessionOptions};
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::mpsc::channel;
use std::time::Duration;

const SHOWN: Quantity = Quantity { component: Component::Total, projection: Projection::Drr };

/// A session that was trained a little, with frames to score.
fn trained(gpu: &Gpu, dataset: &Dataset) -> Arc<Session> {
    let options = SessionOptions {
        config: small_config("fast", &["train.iterations=20"]),
        phases: dataset.n_phases,
        depth_half_extent_mm: 100.0,
        vessel_attenuation_per_mm: Some(0.01),
        deterministic: true,
        still: false,
    };
    let session = Session::new(Some(gpu.clone()), Some(tuning(gpu)), options).unwrap();
    for frame in dataset.training() {
        for split in [Split::Train, Split::Validation] {
            let new = NewFrame {
                geometry: dataset.views[frame.view].geometry.clone(),
                moment: FrameTime::Phase(frame.phase),
                split,
                width: dataset.width,
                height: dataset.height,
                integrals: frame.integrals.to_vec(),
                mask: None,
            };
            session.add_frame(new).unwrap();
        }
    }
    session.train(20, &mut |_| true).unwrap();
    Arc::new(session)
}

/// Draws a live picture in another thread before each slice of `work`, and waits for it there: work that holds what pictures need
/// would never end. Returns the number of slices and the work's result.
fn with_pictures<T>(session: &Arc<Session>, dataset: &Dataset, work: impl FnOnce() -> T) -> (u32, T) {
    let slices = Arc::new(AtomicU32::new(0));
    let (drawing, rays, size, seen) =
        (Arc::downgrade(session), dataset.views[0].rays.clone(), (dataset.width, dataset.height), slices.clone());
    session.on_slices(Some(Arc::new(move || {
        let (session, rays, (told, hears)) = (drawing.upgrade().unwrap(), rays.clone(), channel());
        let drawer = std::thread::spawn(move || {
            let picture = session.render(&rays, size, 1u32, SHOWN).unwrap();
            told.send(picture.len()).unwrap();
        });
        let drawn = hears.recv_timeout(Duration::from_secs(300)).expect("a live picture while long work goes on");
        assert_eq!(drawn, size.0 * size.1);
        drawer.join().unwrap();
        seen.fetch_add(1, Ordering::Relaxed);
    })));
    let done = work();
    session.on_slices(None);
    (slices.load(Ordering::Relaxed), done)
}

#[test]
fn training_goes_on_with_new_frames_after_a_picture() {
    let gpu = gpu();
    let dataset = small_dataset(16, 16);
    let session = trained(&gpu, &dataset);
    let (rays, size) = (&dataset.views[0].rays, (dataset.width, dataset.height));
    let before = session.render(rays, size, 1u32, SHOWN).unwrap();
    let again = session.frame_status(0).unwrap();
    session.set_geometry(0, dataset.views[again.view].geometry.clone()).unwrap();
    // What the picture showed is prepared from the new field, in this thread, before training goes on.
    session.train(20, &mut |_| true).unwrap();
    assert_eq!(session.render(rays, size, 1u32, SHOWN).unwrap().len(), before.len());
    drop(session);
    expect_silence(gpu);
}

#[test]
fn live_pictures_pass_while_long_work_goes_on() {
    let gpu = gpu();
    let dataset = small_dataset(16, 16);
    let session = trained(&gpu, &dataset);
    let (rays, size) = (&dataset.views[0].rays, (dataset.width, dataset.height));
    let grid = PatientGrid { origin_mm: glam::DVec3::splat(-30.0), spacing_mm: glam::DVec3::splat(2.0), size: [31; 3] };
    // What is undisturbed is the same, bit by bit.
    let alone = (
        session.evaluate(None).unwrap().psnr,
        session.sample(Component::Total, 1, &grid).unwrap(),
        session.render_fields(rays, size, 1.0).unwrap().total_integral(),
    );
    let (slices, psnr) = with_pictures(&session, &dataset, || session.evaluate(None).unwrap().psnr);
    assert!(slices >= dataset.training().len() as u32, "{slices} slices");
    assert_eq!(psnr, alone.0);
    let (slices, cells) = with_pictures(&session, &dataset, || session.sample(Component::Total, 1, &grid).unwrap());
    assert!(slices >= 2, "{slices} slices");
    assert_eq!(cells, alone.1);
    let (slices, seen) = with_pictures(&session, &dataset, || session.render_fields(rays, size, 1.0).unwrap());
    assert!(slices >= 1, "{slices} slices");
    assert_eq!(seen.total_integral(), alone.2);
    let (slices, _) = with_pictures(&session, &dataset, || session.trees(Some(1e-4), None));
    assert!(slices >= 1, "{slices} slices");
    drop(session);
    expect_silence(gpu);
}

#[test]
fn long_work_is_cancelled_before_its_next_slice() {
    let gpu = gpu();
    let dataset = small_dataset(16, 16);
    let session = trained(&gpu, &dataset);
    let slices = Arc::new(AtomicU32::new(0));
    let (cancelling, seen) = (Arc::downgrade(&session), slices.clone());
    session.on_slices(Some(Arc::new(move || {
        cancelling.upgrade().unwrap().cancel();
        seen.fetch_add(1, Ordering::Relaxed);
    })));
    assert!(matches!(session.evaluate(None), Err(Error::Interrupted)));
    assert_eq!(slices.swap(0, Ordering::Relaxed), 1, "the slice that was under way, and no other");
    assert!(matches!(session.trees(Some(1e-4), None), Err(Error::Interrupted)));
    assert_eq!(slices.swap(0, Ordering::Relaxed), 1);
    // What begins later goes on; without work, there is nothing to cancel.
    session.on_slices(None);
    session.cancel();
    session.evaluate(None).unwrap();
    drop(session);
    expect_silence(gpu);
}

#[test]
fn a_closed_session_ends_long_work_and_begins_no_more() {
    let gpu = gpu();
    let dataset = small_dataset(16, 16);
    let session = trained(&gpu, &dataset);
    let slices = Arc::new(AtomicU32::new(0));
    let (closing, seen) = (Arc::downgrade(&session), slices.clone());
    session.on_slices(Some(Arc::new(move || {
        closing.upgrade().unwrap().close().unwrap();
        seen.fetch_add(1, Ordering::Relaxed);
    })));
    assert!(matches!(session.evaluate(None), Err(Error::Interrupted)));
    assert_eq!(slices.load(Ordering::Relaxed), 1, "the slice that was under way, and no other");
    assert!(matches!(session.trees(Some(1e-4), None), Err(Error::Interrupted)), "work that begins later");
    assert!(session.is_closed());
    assert_eq!(slices.load(Ordering::Relaxed), 1);
    drop(session);
    expect_silence(gpu);
}
