//! How much goes into a submit: as much as no watchdog minds.

use std::sync::{Mutex, PoisonError};

/// Longest submit, seconds: systems reset devices that are busy for two, and what draws the screen waits behind each.
pub const LONGEST_SUBMIT_S: f64 = 0.1;
/// Submits that are looked at before more than the first few items go into one: the first of all may have waited for others.
const TRIALS: u32 = 3;

/// How many items, iterations or rays, a submit takes on a device; found by its first submits.
#[derive(Debug)]
pub struct SubmitPace {
    longest_s: Option<f64>,
    first: u32,
    most: u32,
    seen: Mutex<Seen>,
}

#[derive(Debug, Clone, Copy)]
struct Seen {
    submits: u32,
    least_s_per_item: f64,
}

impl SubmitPace {
    /// Begins with `first` items to a submit, and never takes more than `most`; without a longest submit it takes these at once.
    pub fn new(longest_s: Option<f64>, first: u32, most: u32) -> SubmitPace {
        let seen = Mutex::new(Seen { submits: 0, least_s_per_item: f64::INFINITY });
        SubmitPace { longest_s, first: first.min(most), most, seen }
    }

    fn seen(&self) -> Seen {
        *self.seen.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether submits are still looked at.
    pub fn is_trying(&self) -> bool {
        self.longest_s.is_some() && self.seen().submits < TRIALS
    }

    /// Items of the next submit, at least one.
    pub fn items(&self) -> u32 {
        match self.longest_s {
            None => self.most,
            Some(_) if self.is_trying() => self.first,
            Some(longest_s) => ((longest_s / self.seen().least_s_per_item) as u32).clamp(1, self.most),
        }
    }

    /// Tells how long a submit of so many items took, the wait for it included.
    pub fn note(&self, items: u32, seconds: f64) {
        let mut seen = self.seen.lock().unwrap_or_else(PoisonError::into_inner);
        seen.submits = seen.submits.saturating_add(1);
        seen.least_s_per_item = seen.least_s_per_item.min(seconds / f64::from(items.max(1)));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn submits_grow_to_what_no_watchdog_minds() {
        let pace = SubmitPace::new(Some(0.1), 4, 1000);
        // The first waited behind something else.
        for seconds in [3.0, 0.008, 0.008] {
            assert_eq!((pace.items(), pace.is_trying()), (4, true));
            pace.note(4, seconds);
        }
        assert_eq!((pace.items(), pace.is_trying()), (50, false));
        // A slow one says that the device was busy, a fast one that it can do more.
        pace.note(50, 1.0);
        assert_eq!(pace.items(), 50);
        pace.note(50, 0.001);
        assert_eq!(pace.items(), 1000);
    }

    #[test]
    fn slow_devices_get_one_item_and_processors_all() {
        let pace = SubmitPace::new(Some(0.1), 1, 16);
        (0..TRIALS).for_each(|_| pace.note(1, 5.0));
        assert_eq!(pace.items(), 1);
        let pace = SubmitPace::new(None, 1, 16);
        assert_eq!((pace.items(), pace.is_trying()), (16, false));
    }
}
