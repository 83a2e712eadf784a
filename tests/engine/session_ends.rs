//! The end of training in the background, as seen by waiting threads: training may restart at once, however long its thread
//! takes to exit.

use crate::common::{add_training_frames, expect_silence, gpu, small_config, small_dataset, tuning};
use nertca_vk_runs::session::{Session, SessionOptions, State};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;
use tracing::span::{Attributes, Id, Record};
use tracing::{Event, Metadata, Subscriber};

/// Time that a thread stays after training has ended, caused by the log that it drops last.
const LINGERS: Duration = Duration::from_millis(300);

/// A log whose destruction takes time.
struct SlowToGo(Arc<AtomicBool>);

impl Subscriber for SlowToGo {
    fn enabled(&self, _: &Metadata<'_>) -> bool {
        false
    }
    fn new_span(&self, _: &Attributes<'_>) -> Id {
        Id::from_u64(1)
    }
    fn record(&self, _: &Id, _: &Record<'_>) {}
    fn record_follows_from(&self, _: &Id, _: &Id) {}
    fn event(&self, _: &Event<'_>) {}
    fn enter(&self, _: &Id) {}
    fn exit(&self, _: &Id) {}
}

impl Drop for SlowToGo {
    fn drop(&mut self) {
        std::thread::sleep(LINGERS);
        self.0.store(true, Ordering::Release);
    }
}

#[test]
fn who_waited_for_the_end_may_start_and_train_at_once() {
    let gpu = gpu();
    let dataset = small_dataset(8, 8);
    let options = SessionOptions {
        config: small_config("fast-mlp", &["train.iterations=1000"]),
        phases: dataset.n_phases,
        depth_half_extent_mm: 100.0,
        vessel_attenuation_per_mm: None,
        still: false,
        deterministic: true,
    };
    let session = Session::new(Some(gpu.clone()), Some(tuning(&gpu)), options).unwrap();
    add_training_frames(&session, &dataset);
    for again in [start, train] {
        let gone = Arc::new(AtomicBool::new(false));
        // The thread keeps the log of its creator, and drops it last.
        tracing::subscriber::with_default(SlowToGo(gone.clone()), || session.start(Box::new(|_| false)).unwrap());
        ended(&session);
        again(&session);
        assert!(gone.load(Ordering::Acquire), "the thread before has left");
    }
    session.stop().unwrap();
    drop(session);
    expect_silence(gpu);
}

fn ended(session: &Session) {
    assert!(session.wait(Duration::from_secs(900)), "training that its observer ends");
    assert_eq!(session.state(), State::Cancelled);
}

fn start(session: &Session) {
    session.start(Box::new(|_| false)).unwrap();
    ended(session);
}

fn train(session: &Session) {
    assert!(session.train(1, &mut |_| true).unwrap() > 0);
}
