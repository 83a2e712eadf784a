//! Times of the frames of a run.

use crate::error::Result;
use crate::reader::Reader;
use dicom_core::Tag;
use dicom_dictionary_std::tags;

/// Frame rate where a file states none, per second.
const USUAL_RATE_HZ: f64 = 15.0;

/// Returns the time of each of `n` frames after the first, seconds. FrameIncrementPointer decides whether FrameTimeVector or FrameTime
/// holds; where it is missing, a vector with a value for each frame comes first. Where neither gives a time, CineRate and then
/// RecommendedDisplayFrameRate stand in.
///
/// # Errors
/// [`crate::error::Error::Data`] naming the element.
pub(super) fn times(run: &Reader<'_>, n: usize, notes: &mut Vec<String>) -> Result<Vec<f64>> {
    if n == 1 {
        return Ok(vec![0.0]);
    }
    let named: Vec<Tag> = run.get(tags::FRAME_INCREMENT_POINTER).map(|pointer| pointer.tags()).unwrap_or_default();
    let time_first = named.contains(&tags::FRAME_TIME) && !named.contains(&tags::FRAME_TIME_VECTOR);
    let steady = |step_s: f64| (0..n).map(|i| i as f64 * step_s).collect::<Vec<f64>>();
    if time_first && let Some(step_s) = frame_time_s(run, notes)? {
        return Ok(steady(step_s));
    }
    if let Some(times) = vector(run, n, notes)? {
        return Ok(times);
    }
    if !time_first && let Some(step_s) = frame_time_s(run, notes)? {
        return Ok(steady(step_s));
    }
    let rates = [
        (tags::CINE_RATE, "CineRate"),
        (tags::RECOMMENDED_DISPLAY_FRAME_RATE, "RecommendedDisplayFrameRate"),
        (tags::RECOMMENDED_DISPLAY_FRAME_RATE_IN_FLOAT, "RecommendedDisplayFrameRateInFloat"),
    ];
    for (tag, name) in rates {
        if let Some(rate) = run.number(tag, name)?.filter(|rate| *rate > 0.0) {
            notes.push(format!("FrameTime states no time: {rate} frames per second of {name} are used"));
            return Ok(steady(1.0 / rate));
        }
    }
    notes.push(format!("frame times are missing: {USUAL_RATE_HZ} frames per second are assumed"));
    Ok(steady(1.0 / USUAL_RATE_HZ))
}

/// Time between frames by FrameTime; none where it is missing or zero.
fn frame_time_s(run: &Reader<'_>, notes: &mut Vec<String>) -> Result<Option<f64>> {
    let ms = run.number(tags::FRAME_TIME, "FrameTime")?;
    if let Some(negative) = ms.filter(|ms| *ms < 0.0) {
        notes.push(format!("FrameTime of {negative} ms was not used"));
    }
    Ok(ms.filter(|ms| *ms > 0.0).map(|ms| ms / 1e3))
}

/// Times by FrameTimeVector; none where it is missing, has not one value per frame, or does not rise.
fn vector(run: &Reader<'_>, n: usize, notes: &mut Vec<String>) -> Result<Option<Vec<f64>>> {
    let Some(steps_ms) = run.numbers(tags::FRAME_TIME_VECTOR, "FrameTimeVector")? else { return Ok(None) };
    if steps_ms.len() != n {
        notes.push(format!("FrameTimeVector has {} values for {n} frames, and was not used", steps_ms.len()));
        return Ok(None);
    }
    // The first value belongs to the first frame, whose time is zero.
    if steps_ms[1..].iter().any(|step| *step <= 0.0) {
        notes.push("the steps of FrameTimeVector are not all positive, and were not used".into());
        return Ok(None);
    }
    let mut now = 0.0;
    let sums = steps_ms.iter().enumerate().map(|(i, step)| {
        now += if i == 0 { 0.0 } else { step / 1e3 };
        now
    });
    Ok(Some(sums.collect()))
}
