//! Size of a submit: as large as possible without alarming a watchdog.

use super::capabilities::DeviceInfo;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::ThreadId;
use std::time::{Duration, Instant};

/// Longest submit, seconds: systems reset devices that are busy for two seconds, and drawing of the screen waits behind each
/// submit.
pub const LONGEST_SUBMIT_S: f64 = 0.1;
/// Longest submit during training while someone looks at pictures of the run, seconds. A picture waits for the two submits
/// under way, which then take little longer than one frame of a display at 60 Hz.
pub const LONGEST_SUBMIT_LOOKED_AT_S: f64 = 0.01;
/// Longest slice of long work that live pictures pass before, such as scores, seconds: on every device, also where no watchdog
/// limits a submit.
pub const LONGEST_SLICE_S: f64 = 0.05;
/// Time after a request for a picture during which another is expected: a user who turns a view or plays a beat makes several
/// requests a second.
const LOOKS_LAST: Duration = Duration::from_secs(1);
/// Number of submits that are remembered: if the shortest of them took long, the reason was not waiting behind other work.
const REMEMBERED: usize = 3;

/// Live pictures, which pass before long work: when the last one was requested, and which are being drawn. Clones share it.
#[derive(Debug, Clone, Default)]
pub struct PictureRequests(Arc<Pictures>);

#[derive(Debug, Default)]
struct Pictures {
    state: Mutex<PicturesState>,
    /// Signals the end of a picture.
    ended: Condvar,
}

#[derive(Debug, Default)]
struct PicturesState {
    last: Option<Instant>,
    /// Number of the next picture.
    next: u64,
    /// Pictures being drawn, by their numbers, and their threads.
    drawn: Vec<(u64, ThreadId)>,
}

/// A live picture that is being drawn; it ends when this is dropped.
#[derive(Debug)]
pub struct PictureDrawn {
    requests: PictureRequests,
    number: u64,
}

impl PictureRequests {
    fn state(&self) -> MutexGuard<'_, PicturesState> {
        self.0.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Notes a request for a picture that waits behind the device's work.
    pub fn note(&self) {
        self.note_at(Instant::now());
    }

    fn note_at(&self, when: Instant) {
        self.state().last = Some(when);
    }

    /// Notes a request for a live picture, and that it is being drawn from now on, in this thread.
    #[must_use]
    pub fn begin(&self) -> PictureDrawn {
        let mut state = self.state();
        let number = state.next;
        (state.next, state.last) = (number + 1, Some(Instant::now()));
        state.drawn.push((number, std::thread::current().id()));
        PictureDrawn { requests: self.clone(), number }
    }

    /// Waits for the live pictures that began before this call, as long work does between its slices. Pictures that begin later do
    /// not prolong the wait. A thread that draws a picture itself does not wait, because others may wait for it.
    pub fn give_way(&self) {
        let (mut state, this) = (self.state(), std::thread::current().id());
        let newest = state.next;
        while must_wait(&state.drawn, newest, this) {
            state = self.0.ended.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Tells whether another request is likely.
    pub fn are_recent(&self) -> bool {
        is_recent(self.state().last, Instant::now())
    }
}

impl Drop for PictureDrawn {
    fn drop(&mut self) {
        self.requests.state().drawn.retain(|(number, _)| *number != self.number);
        self.requests.0.ended.notify_all();
    }
}

/// Tells whether long work in a thread waits for pictures with numbers below `newest`.
fn must_wait(drawn: &[(u64, ThreadId)], newest: u64, this: ThreadId) -> bool {
    drawn.iter().any(|(number, _)| *number < newest) && drawn.iter().all(|(_, thread)| *thread != this)
}

fn is_recent(last: Option<Instant>, now: Instant) -> bool {
    last.is_some_and(|last| now.saturating_duration_since(last) < LOOKS_LAST)
}

/// Number of items (iterations or rays) per submit, derived from the times of the device's last submits.
#[derive(Debug)]
pub struct SubmitPace {
    longest_s: Option<f64>,
    /// Requests of the users whose pictures wait behind these submits.
    looks: Option<PictureRequests>,
    first: u32,
    max: u32,
    /// Seconds per item of the last submits, the newest last.
    seen: Mutex<Vec<f64>>,
}

/// Returns the longest submit of a device, seconds; none where no watchdog limits it.
pub fn longest_submit_s(info: &DeviceInfo) -> Option<f64> {
    (!info.is_cpu()).then_some(LONGEST_SUBMIT_S)
}

impl SubmitPace {
    /// Starts with `first` items per submit, and never takes more than `most`. Without a longest submit, it always takes
    /// `most`.
    pub fn new(longest_s: Option<f64>, first: u32, max: u32) -> SubmitPace {
        SubmitPace { longest_s, looks: None, first: first.min(max), max, seen: Mutex::default() }
    }

    /// Makes submits short while somebody looks at pictures.
    pub fn giving_way_to(self, looks: &PictureRequests) -> SubmitPace {
        SubmitPace { looks: Some(looks.clone()), ..self }
    }

    /// Tells whether there are too few submits yet to derive a pace.
    pub fn is_trying(&self) -> bool {
        self.longest_s.is_some() && self.seen.lock().unwrap_or_else(PoisonError::into_inner).len() < REMEMBERED
    }

    /// Returns the number of items of the next submit, at least one.
    pub fn items(&self) -> u32 {
        let Some(mut longest_s) = self.longest_s else { return self.max };
        if self.looks.as_ref().is_some_and(PictureRequests::are_recent) {
            longest_s = longest_s.min(LONGEST_SUBMIT_LOOKED_AT_S);
        }
        if self.is_trying() {
            return self.first;
        }
        let seen = self.seen.lock().unwrap_or_else(PoisonError::into_inner);
        let min_s = seen.iter().copied().fold(f64::INFINITY, f64::min);
        ((longest_s / min_s) as u32).clamp(1, self.max)
    }

    /// Notes the duration of a submit of `items` items, including the wait for it.
    pub fn note(&self, items: u32, seconds: f64) {
        let mut seen = self.seen.lock().unwrap_or_else(PoisonError::into_inner);
        if seen.len() == REMEMBERED {
            seen.remove(0);
        }
        seen.push(seconds / f64::from(items.max(1)));
    }

    /// Forgets all submits, before items of another kind.
    pub fn restart(&self) {
        self.seen.lock().unwrap_or_else(PoisonError::into_inner).clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn submits_grow_to_what_no_watchdog_minds() {
        let pace = SubmitPace::new(Some(0.1), 4, 1000);
        // The first submit waited behind something else.
        for seconds in [3.0, 0.008, 0.008] {
            assert_eq!((pace.items(), pace.is_trying()), (4, true));
            pace.note(4, seconds);
        }
        assert_eq!((pace.items(), pace.is_trying()), (50, false));
        // A single slow submit may have waited; several in a row have not.
        pace.note(50, 1.0);
        pace.note(50, 1.0);
        assert_eq!(pace.items(), 50);
        pace.note(50, 1.0);
        assert_eq!(pace.items(), 5);
        pace.note(5, 0.0001);
        assert_eq!(pace.items(), 1000);
        pace.restart();
        assert_eq!((pace.items(), pace.is_trying()), (4, true));
    }

    #[test]
    fn submits_are_short_while_somebody_looks() {
        let hour = Duration::from_secs(3600);
        let looks = PictureRequests::default();
        let pace = |longest_s, seconds| {
            let pace = SubmitPace::new(longest_s, 1, 1000).giving_way_to(&looks);
            (0..REMEMBERED).for_each(|_| pace.note(1, seconds));
            pace
        };
        let (quick, slow, shorter, unwatched) =
            (pace(Some(0.1), 0.002), pace(Some(0.1), 0.02), pace(Some(0.001), 0.0005), pace(None, 0.002));
        let items = || [&quick, &slow, &shorter, &unwatched].map(SubmitPace::items);
        assert_eq!(items(), [50, 5, 2, 1000]);
        // This time is later than any clock reading of this test.
        looks.note_at(Instant::now() + hour);
        assert_eq!(items(), [5, 1, 2, 1000], "a hundredth of a second, or an iteration, which is not divided");
        let (now, moment) = (Instant::now() + hour, Duration::from_millis(1));
        assert!(!is_recent(None, now) && is_recent(Some(now), now));
        assert!(is_recent(Some(now + moment - LOOKS_LAST), now) && !is_recent(Some(now - LOOKS_LAST), now));
    }

    #[test]
    fn long_work_waits_for_the_pictures_that_began_before_and_for_no_others() {
        let requests = PictureRequests::default();
        requests.give_way();
        let own = requests.begin();
        // This thread draws itself.
        requests.give_way();
        let (told, hears) = std::sync::mpsc::channel();
        let worker = {
            let requests = requests.clone();
            std::thread::spawn(move || {
                requests.give_way();
                told.send("passed").unwrap();
            })
        };
        let later = requests.begin();
        assert!(hears.try_recv().is_err(), "a picture is being drawn");
        drop((own, later));
        assert_eq!(hears.recv().unwrap(), "passed");
        worker.join().unwrap();
        // Pictures that began later do not count.
        let (this, other) = (std::thread::current().id(), std::thread::spawn(|| ()).thread().id());
        assert!(must_wait(&[(3, other), (4, other)], 4, this));
        assert!(!must_wait(&[(4, other)], 4, this) && !must_wait(&[(3, other), (5, this)], 4, this));
    }

    #[test]
    fn slow_devices_get_one_item_and_processors_all() {
        let pace = SubmitPace::new(Some(0.1), 1, 16);
        (0..REMEMBERED).for_each(|_| pace.note(1, 5.0));
        assert_eq!(pace.items(), 1);
        let pace = SubmitPace::new(None, 1, 16);
        assert_eq!((pace.items(), pace.is_trying()), (16, false));
    }
}
