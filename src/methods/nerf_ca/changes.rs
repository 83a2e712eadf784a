//! Change of the X-ray transmission at each pixel over the beat, by which NeRF-CA chooses and weighs rays.

use crate::fields::motion::ViewMotion;
use crate::scan::dataset::Dataset;
use rayon::prelude::*;

/// Returns, per view, the variance over its training images of the transmission exp(-L) at each pixel of the canvas, scaled
/// from 0 at the view's minimum to 1 at its maximum. It is 0 everywhere in views that do not change, and 0 at pixels that show
/// nothing of the patient.
pub fn of_views(dataset: &Dataset, motion: &[ViewMotion]) -> Vec<Vec<f32>> {
    motion.par_iter().map(|m| of_view(dataset, m.view)).collect()
}

fn of_view(dataset: &Dataset, view: usize) -> Vec<f32> {
    let frames = dataset.training().iter().filter(|frame| frame.view == view);
    let images: Vec<_> = frames.map(|frame| &frame.integrals).collect();
    let variance = |p: usize| {
        let passes = || images.iter().map(|image| (-f64::from(image[p])).exp());
        let mean = passes().sum::<f64>() / images.len() as f64;
        passes().map(|t| (t - mean).powi(2)).sum::<f64>() / images.len() as f64
    };
    let pixels = 0..dataset.n_pixels();
    let all: Vec<Option<f64>> = pixels.map(|p| dataset.shows(view, p).then(|| variance(p))).collect();
    let min = all.iter().flatten().copied().fold(f64::INFINITY, f64::min);
    let span = all.iter().flatten().copied().fold(0.0, f64::max) - min;
    let share = |v: &Option<f64>| v.filter(|_| span > 0.0).map_or(0.0, |v| ((v - min) / span) as f32);
    all.iter().map(share).collect()
}

/// Returns training rays, as frame * pixels + pixel: first the rays that change by more than `least`, then the others, and the
/// number of the first ones. Rays that show nothing of the patient are left out. If all rays change, the second part repeats
/// all of them.
pub fn rays(dataset: &Dataset, motion: &[ViewMotion], changes: &[Vec<f32>], min: f64) -> (Vec<u32>, usize) {
    let pixels = dataset.n_pixels();
    let (mut changing, mut others) = (Vec::new(), Vec::new());
    for (index, frame) in dataset.training().iter().enumerate() {
        let Some(slot) = motion.iter().position(|m| m.view == frame.view) else { continue };
        for p in (0..pixels).filter(|p| dataset.shows(frame.view, *p)) {
            let list = if f64::from(changes[slot][p]) > min { &mut changing } else { &mut others };
            list.push((index * pixels + p) as u32);
        }
    }
    let n_changing = changing.len();
    if others.is_empty() {
        others.clone_from(&changing);
    }
    changing.extend(others);
    (changing, n_changing)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fields::motion::Thresholds;
    use crate::fields::motion::analyse;
    use crate::scan::small::small_dataset;

    #[test]
    fn changes_are_those_of_the_transmission_from_0_to_1_in_each_view() {
        let dataset = small_dataset(6, 5, 3).unwrap();
        let motion = analyse(&dataset, Thresholds::default());
        let changes = of_views(&dataset, &motion);
        for (of_view, m) in changes.iter().zip(&motion) {
            let images: Vec<_> = dataset.training().iter().filter(|f| f.view == m.view).collect();
            let variance = |p: usize| {
                let passes: Vec<f64> = images.iter().map(|f| (-f64::from(f.integrals[p])).exp()).collect();
                let pairs = passes.iter().flat_map(|a| passes.iter().map(move |b| (a - b).powi(2)));
                pairs.sum::<f64>() / 2.0 / (passes.len() as f64).powi(2)
            };
            let all: Vec<f64> = (0..30).map(variance).collect();
            let (min, max) = all.iter().fold((f64::INFINITY, 0f64), |(l, m), v| (l.min(*v), m.max(*v)));
            for (got, want) in of_view.iter().zip(&all) {
                assert!((f64::from(*got) - (want - min) / (max - min)).abs() < 1e-6);
            }
        }
        let (list, n) = rays(&dataset, &motion, &changes, 0.03);
        assert!(n > 0 && n < list.len() && list.len() == dataset.training().len() * 30, "{n} of {}", list.len());
        let change = |id: u32| {
            let view = dataset.training()[id as usize / 30].view;
            changes[motion.iter().position(|m| m.view == view).unwrap()][id as usize % 30]
        };
        assert!(list[..n].iter().all(|id| change(*id) > 0.03) && list[n..].iter().all(|id| change(*id) <= 0.03));
    }

    #[test]
    fn nothing_changes_where_there_is_one_image_and_all_are_the_others_where_all_change() {
        let mut dataset = small_dataset(6, 5, 3).unwrap();
        let motion = analyse(&dataset, Thresholds::default());
        let (list, n) = rays(&dataset, &motion, &of_views(&dataset, &motion), -1.0);
        assert!(n * 2 == list.len() && list[..n] == list[n..]);
        dataset.frames.retain(|f| f.phase == 0);
        let changes = of_views(&dataset, &motion);
        assert!(changes.iter().flatten().all(|c| *c == 0.0));
        assert_eq!(rays(&dataset, &motion, &changes, 0.03).1, 0);
    }
}
