//! Images of a volume that does not change, kept for the next picture from the same direction: while a beat plays, the static field
//! looks the same in every picture.

use crate::error::Result;
use crate::geometry::ViewRays;
use crate::render::quantity::Projection;
use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Number of directions that are kept: those of a display that shows several views side by side.
const DIRECTIONS: usize = 8;
/// Sum of the pixels that are kept: 64 MiB.
const MAX_PIXELS: usize = 1 << 24;

/// Direction, size and projection of an image.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct ImageKey {
    pub(super) rays: ViewRays,
    /// Columns and rows.
    pub(super) size: (usize, usize),
    pub(super) projection: Projection,
}

impl ImageKey {
    fn n_pixels(&self) -> usize {
        self.size.0 * self.size.1
    }
}

/// The last images of a volume.
#[derive(Default)]
pub(super) struct KeptImages {
    state: Mutex<State>,
}

struct Kept {
    key: ImageKey,
    image: Arc<Vec<f32>>,
    /// When it was last shown.
    shown: Instant,
}

#[derive(Default)]
struct State {
    /// Images, the newest last.
    images: VecDeque<Kept>,
    /// Number of times that the volume has changed.
    changes: u64,
}

impl State {
    fn find(&mut self, key: &ImageKey) -> Option<Arc<Vec<f32>>> {
        let at = self.images.iter().position(|kept| kept.key == *key)?;
        let found = self.images.remove(at)?;
        let image = found.image.clone();
        self.images.push_back(Kept { shown: Instant::now(), ..found });
        Some(image)
    }

    fn keep(&mut self, key: ImageKey, image: Arc<Vec<f32>>, shown: Instant) {
        let n_pixels = key.n_pixels();
        self.images.retain(|kept| kept.key != key);
        if n_pixels > MAX_PIXELS {
            return;
        }
        let n_kept = |images: &VecDeque<Kept>| images.iter().map(|kept| kept.key.n_pixels()).sum::<usize>();
        while self.images.len() >= DIRECTIONS || n_kept(&self.images) + n_pixels > MAX_PIXELS {
            self.images.pop_front();
        }
        self.images.push_back(Kept { key, image, shown });
    }
}

impl KeptImages {
    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the image of a key, which `draw` draws unless it was kept. An image is not kept if the volume changed while it was drawn.
    ///
    /// # Errors
    /// Errors of `draw`.
    pub(super) fn get(&self, key: ImageKey, draw: impl FnOnce() -> Result<Vec<f32>>) -> Result<Arc<Vec<f32>>> {
        let changes = {
            let mut state = self.state();
            if let Some(image) = state.find(&key) {
                return Ok(image);
            }
            state.changes
        };
        let image = Arc::new(draw()?);
        let mut state = self.state();
        if state.changes == changes {
            state.keep(key, image.clone(), Instant::now());
        }
        Ok(image)
    }

    /// Returns the keys of the images that were shown within the last `lately`, and when that was.
    pub(super) fn shown_lately(&self, lately: Duration) -> Vec<(ImageKey, Instant)> {
        let state = self.state();
        let recent = state.images.iter().filter(|kept| kept.shown.elapsed() < lately);
        recent.map(|kept| (kept.key.clone(), kept.shown)).collect()
    }

    /// Replaces the images by those that `draw` draws of a volume that has changed; those that are not in `keys` are discarded. Pictures
    /// show the earlier images until then.
    ///
    /// # Errors
    /// Errors of `draw`.
    pub(super) fn redraw(
        &self,
        keys: Vec<(ImageKey, Instant)>,
        draw: impl Fn(&ImageKey) -> Result<Vec<f32>>,
    ) -> Result<()> {
        let changes = self.state().changes;
        let drawn = keys.into_iter().map(|(key, shown)| Ok((Arc::new(draw(&key)?), key, shown)));
        let drawn = drawn.collect::<Result<Vec<_>>>()?;
        let mut state = self.state();
        if state.changes == changes {
            state.images.clear();
            state.changes += 1;
            drawn.into_iter().for_each(|(image, key, shown)| state.keep(key, image, shown));
        }
        Ok(())
    }

    /// Discards all images, because the volume changes.
    pub(super) fn clear(&self) {
        let mut state = self.state();
        state.images.clear();
        state.changes += 1;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    fn key(sod: f64) -> ImageKey {
        let rays = ViewRays { anchor: [DVec3::ZERO; 3], direction: [DVec3::Z; 3], sod };
        ImageKey { rays, size: (2, 1), projection: Projection::Drr }
    }

    #[test]
    fn the_last_directions_are_kept_until_the_volume_changes() {
        let images = KeptImages::default();
        let draws = |sod: f64, value: f32| {
            let mut drawn = false;
            let image = images.get(key(sod), || {
                drawn = true;
                Ok(vec![value; 2])
            });
            (drawn, image.unwrap()[0])
        };
        assert_eq!(draws(0.0, 1.0), (true, 1.0));
        assert_eq!(draws(0.0, 2.0), (false, 1.0), "kept");
        for other in 1..DIRECTIONS {
            assert_eq!(draws(other as f64, 3.0), (true, 3.0), "another direction");
        }
        assert_eq!(draws(0.0, 4.0), (false, 1.0), "still kept, and now the newest");
        assert_eq!(draws(100.0, 5.0), (true, 5.0));
        assert_eq!(draws(1.0, 6.0), (true, 6.0), "the oldest was dropped");
        images.clear();
        assert_eq!(draws(0.0, 7.0), (true, 7.0), "the volume has changed");
        let maximum = ImageKey { projection: Projection::Mip, ..key(0.0) };
        assert_eq!(images.get(maximum, || Ok(vec![8.0; 2])).unwrap()[0], 8.0, "another projection");
    }

    #[test]
    fn an_image_of_a_volume_that_changed_meanwhile_is_not_kept() {
        let images = KeptImages::default();
        let draw_while_it_changes = || {
            images.clear();
            Ok(vec![1.0; 2])
        };
        assert_eq!(images.get(key(0.0), draw_while_it_changes).unwrap()[0], 1.0);
        assert_eq!(images.get(key(0.0), || Ok(vec![2.0; 2])).unwrap()[0], 2.0);
    }

    #[test]
    fn images_of_a_changed_volume_replace_those_shown_lately() {
        let images = KeptImages::default();
        let get = |sod: f64, value: f32| images.get(key(sod), || Ok(vec![value; 2])).unwrap()[0];
        assert_eq!([get(0.0, 1.0), get(1.0, 1.0)], [1.0, 1.0]);
        assert!(images.shown_lately(Duration::ZERO).is_empty());
        let mut lately = images.shown_lately(Duration::from_secs(3600));
        assert_eq!(lately.len(), 2);
        lately.truncate(1);
        let draw = |drawn: &ImageKey| {
            assert_eq!((get(0.0, 9.0), drawn), (1.0, &key(0.0)), "the earlier image is shown meanwhile");
            Ok(vec![2.0; 2])
        };
        images.redraw(lately, draw).unwrap();
        assert_eq!([get(0.0, 9.0), get(1.0, 3.0)], [2.0, 3.0], "one is replaced, the other discarded");
        let while_it_changes = |_: &ImageKey| {
            images.clear();
            Ok(vec![4.0; 2])
        };
        images.redraw(images.shown_lately(Duration::from_secs(3600)), while_it_changes).unwrap();
        assert_eq!(get(0.0, 5.0), 5.0, "an image of two volumes is not kept");
    }

    #[test]
    fn a_failure_keeps_nothing() {
        let images = KeptImages::default();
        assert!(images.get(key(0.0), || Err(crate::error::Error::Internal("no device".into()))).is_err());
        assert_eq!(images.get(key(0.0), || Ok(vec![1.0; 2])).unwrap()[0], 1.0);
    }
}
