//! Decoders that other projects wrote, which may panic on a damaged file: the panic becomes an error of the file, and nothing is
//! printed.

use rayon::{ThreadPool, ThreadPoolBuilder};
use std::cell::Cell;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Once, OnceLock};

thread_local! {
    /// Whether this thread runs decoders and nothing else.
    static DECODES: Cell<bool> = const { Cell::new(false) };
}

/// Threads that run decoders and nothing else, since decoders share their work among the threads of the pool that they run in.
static POOL: OnceLock<ThreadPool> = OnceLock::new();

/// Runs a decoder in threads of its own, and returns an error if it panics. Calls may be nested: a loop over frames and the decoder of
/// each frame.
///
/// The first call installs a panic hook. It drops the reports of panics in these threads, and hands all others to the hook that was there
/// before.
///
/// # Errors
/// A sentence about a decoder that panicked, or about threads that cannot be started.
pub fn caught<T: Send>(decode: impl FnOnce() -> T + Send) -> Result<T, String> {
    hide_reports();
    let decoded = pool()?.install(|| catch_unwind(AssertUnwindSafe(decode)));
    decoded.map_err(|_| "its image is damaged, and the decoder failed on it".into())
}

fn pool() -> Result<&'static ThreadPool, String> {
    if let Some(pool) = POOL.get() {
        return Ok(pool);
    }
    let made = ThreadPoolBuilder::new()
        .thread_name(|i| format!("nertca-decode-{i}"))
        .start_handler(|_| DECODES.set(true))
        .build()
        .map_err(|e| format!("threads for decoders cannot be started: {e}"))?;
    // Of two threads that make one at the same time, the pool of the first is kept.
    Ok(POOL.get_or_init(|| made))
}

fn hide_reports() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        let before = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |info| {
            if !DECODES.try_with(Cell::get).unwrap_or(false) {
                before(info);
            }
        }));
    });
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test")]
mod tests {
    use super::*;
    use rayon::prelude::*;
    use std::sync::{Arc, Mutex};

    #[test]
    fn panics_of_decoders_become_errors_and_are_not_reported_and_all_others_are() {
        let reports = Arc::new(Mutex::new(Vec::new()));
        let kept = reports.clone();
        std::panic::set_hook(Box::new(move |info| kept.lock().unwrap().push(info.to_string())));
        let reported = |what: &str| reports.lock().unwrap().iter().filter(|report| report.contains(what)).count();

        assert_eq!(caught(|| 3), Ok(3));
        let problem = caught(|| panic!("a decoder gave up")).unwrap_err();
        assert!(problem.contains("the decoder failed"), "{problem}");
        // A decoder that shares its work among threads, for some frames of many.
        let frame = |i: usize| caught(|| (0..64).into_par_iter().for_each(|row| assert!(row != i, "row {i} gave up")));
        let frames: Vec<_> = caught(|| (0..128).into_par_iter().map(frame).collect()).unwrap();
        assert!(frames.iter().enumerate().all(|(i, frame)| frame.is_err() == (i < 64)), "{frames:?}");
        assert_eq!(reported("gave up"), 0);

        assert!(catch_unwind(|| panic!("a fault of ours")).is_err());
        assert!(rayon::join(|| catch_unwind(|| panic!("a fault of ours")), || ()).0.is_err());
        assert_eq!(reported("a fault of ours"), 2);
    }
}
