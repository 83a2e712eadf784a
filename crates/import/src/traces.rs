//! ECG traces of a run: channels of its waveforms, and curves of the retired groups 50xx.

use crate::ecg;
use crate::elements::numbers;
use crate::error::{Error, Result};
use crate::reader::Reader;
use crate::scan::gating::RPeaks;
use dicom_core::Tag;
use dicom_dictionary_std::tags;

/// Groups of curves.
const FIRST_CURVE_GROUP: u16 = 0x5000;
const LAST_CURVE_GROUP: u16 = 0x501e;
const MAX_CHANNELS: usize = 64;
const MAX_BYTES: usize = 64 << 20;

/// Samples of a trace that may be an ECG.
struct Trace {
    values: Vec<f64>,
    rate_hz: f64,
    /// Time of the first sample after the first frame, seconds.
    begin_s: f64,
    /// Whether the file says that it is an ECG.
    is_ecg: bool,
}

/// Finds R-peaks in the first usable ECG of a run of `length_s` seconds. Each trace that is not used is named with the reason.
pub(super) fn r_peaks(run: &Reader<'_>, length_s: f64, notes: &mut Vec<String>) -> Option<RPeaks> {
    let mut usable: Vec<(String, Trace)> = Vec::new();
    for (name, read) in waveforms(run).into_iter().chain(curves(run, length_s)) {
        match read {
            Ok(trace) => usable.push((name, trace)),
            Err(reason) => notes.push(format!("{name} was not used as an ECG: {reason}")),
        }
    }
    // Traces of an unstated kind come after those that are said to be an ECG.
    usable.sort_by_key(|(_, trace)| !trace.is_ecg);
    for (name, trace) in usable {
        let found = ecg::peak_times_s(&trace.values, trace.rate_hz)
            .and_then(|times| RPeaks::new(&times.iter().map(|time| time + trace.begin_s).collect::<Vec<_>>()));
        match found {
            Ok(peaks) => {
                let guess = if trace.is_ecg { "" } else { ", whose kind the file does not state" };
                let rate = 60.0 / peaks.beat_s();
                notes.push(format!("R-peaks found in the ECG of {name}{guess}: {rate:.0} beats per minute"));
                return Some(peaks);
            }
            Err(error) => notes.push(format!("{name} was not used as an ECG: {}", reason(&error))),
        }
    }
    None
}

/// Reason of an error without the name of an option, which nobody has given.
fn reason(error: &Error) -> String {
    match error {
        Error::Config { value, problem, .. } => format!("{value} {problem}"),
        other => other.to_string(),
    }
}

type Read = (String, std::result::Result<Trace, String>);

/// Channels of all waveforms.
fn waveforms(run: &Reader<'_>) -> Vec<Read> {
    let groups = match run.items(tags::WAVEFORM_SEQUENCE, "WaveformSequence") {
        Ok(groups) => groups,
        Err(error) => return vec![("WaveformSequence".into(), Err(error.to_string()))],
    };
    let mut found = Vec::new();
    for (i, group) in groups.iter().enumerate() {
        let name = format!("waveform {}", i + 1);
        match group_of(group) {
            Ok(channels) => {
                let numbered = channels.into_iter().enumerate();
                found.extend(numbered.map(|(channel, (label, read))| {
                    let label = if label.is_empty() { String::new() } else { format!(" ({label})") };
                    (format!("{name}, channel {}{label}", channel + 1), read)
                }));
            }
            Err(reason) => found.push((name, Err(reason))),
        }
    }
    found
}

/// Channels of a waveform with their labels.
fn group_of(group: &Reader<'_>) -> std::result::Result<Vec<Read>, String> {
    let number = |tag, name| group.number(tag, name).map_err(|e| e.to_string());
    let channels = number(tags::NUMBER_OF_WAVEFORM_CHANNELS, "NumberOfWaveformChannels")?.unwrap_or(1.0);
    if channels.fract() != 0.0 || !(1.0..=MAX_CHANNELS as f64).contains(&channels) {
        return Err(format!("{channels} channels are not in the accepted range, 1 to {MAX_CHANNELS}"));
    }
    let channels = channels as usize;
    let rate_hz = number(tags::SAMPLING_FREQUENCY, "SamplingFrequency")?.ok_or("its SamplingFrequency is missing")?;
    let begin_ms = number(tags::MULTIPLEX_GROUP_TIME_OFFSET, "MultiplexGroupTimeOffset")?.unwrap_or(0.0);
    let kind = group.text(tags::WAVEFORM_SAMPLE_INTERPRETATION).unwrap_or_else(|| "SS".into());
    let data = group.get(tags::WAVEFORM_DATA).and_then(|data| data.bytes());
    let (bytes, big_endian) = data.ok_or("its WaveformData are missing")?;
    if bytes.len() > MAX_BYTES {
        return Err("it is too long".into());
    }
    let values: Vec<f64> = match kind.as_str() {
        "SS" => numbers(bytes, big_endian, |b| i16::from_le_bytes(b).into()),
        "US" => numbers(bytes, big_endian, |b| u16::from_le_bytes(b).into()),
        "SL" => numbers(bytes, big_endian, |b| i32::from_le_bytes(b).into()),
        "UL" => numbers(bytes, big_endian, |b| u32::from_le_bytes(b).into()),
        // A last byte makes the length even.
        "SB" => Ok(bytes.iter().map(|b| f64::from(*b as i8)).collect()),
        "UB" => Ok(bytes.iter().map(|b| f64::from(*b)).collect()),
        other => return Err(format!("its samples are stored as `{other}`, which is not read")),
    }?;
    let definitions = group.items(tags::CHANNEL_DEFINITION_SEQUENCE, "ChannelDefinitionSequence").unwrap_or_default();
    Ok((0..channels)
        .map(|channel| {
            let (label, is_ecg) = definitions.get(channel).map_or((String::new(), None), source_of);
            let trace = match is_ecg {
                Some(false) => Err("it is no ECG".to_owned()),
                _ => Ok(Trace {
                    values: values.chunks_exact(channels).map(|sample| sample[channel]).collect(),
                    rate_hz,
                    begin_s: begin_ms / 1e3,
                    is_ecg: is_ecg == Some(true),
                }),
            };
            (label, trace)
        })
        .collect())
}

/// Label of a channel, and whether it is an ECG, where the file says so.
fn source_of(definition: &Reader<'_>) -> (String, Option<bool>) {
    let source = definition.item(tags::CHANNEL_SOURCE_SEQUENCE, "ChannelSourceSequence").ok().flatten();
    let meaning = source.and_then(|source| source.text(tags::CODE_MEANING));
    let label = meaning.or_else(|| definition.text(tags::CHANNEL_LABEL)).unwrap_or_default();
    let small = label.to_lowercase();
    let has = |words: &[&str]| words.iter().any(|word| small.contains(word));
    let is_ecg = if has(&["lead", "ecg", "ekg", "electrocardio"]) {
        Some(true)
    } else if has(&["pressure", "press", "flow", "resp", "spo2", "oxygen", "temperature", "volume"]) {
        Some(false)
    } else {
        None
    };
    (label, is_ecg)
}

/// Curves of a run of `length_s` seconds.
fn curves(run: &Reader<'_>, length_s: f64) -> Vec<Read> {
    let groups = (FIRST_CURVE_GROUP..=LAST_CURVE_GROUP).step_by(2);
    let present = groups.filter(|group| run.get(Tag(*group, 0x3000)).is_some());
    present.map(|group| (format!("curve {group:04X}"), curve(run, group, length_s))).collect()
}

/// Reads a curve of a group. Where it states no times, it spans the run.
fn curve(run: &Reader<'_>, group: u16, length_s: f64) -> std::result::Result<Trace, String> {
    let texts = |element| run.text(Tag(group, element)).unwrap_or_default();
    let list = |element, name| -> Result<Vec<f64>> { Ok(run.numbers(Tag(group, element), name)?.unwrap_or_default()) };
    let list = |element, name| list(element, name).map_err(|e| e.to_string());
    let kind = texts(0x0020);
    if !["ECG", "PHYSIO", ""].contains(&kind.as_str()) {
        return Err(format!("its type is {kind}"));
    }
    let (bytes, big_endian) = run.get(Tag(group, 0x3000)).and_then(|data| data.bytes()).ok_or("it has no CurveData")?;
    if bytes.len() > MAX_BYTES {
        return Err("it is too long".into());
    }
    let values: Vec<f64> = match list(0x0103, "DataValueRepresentation")?.first().map(|form| *form as u32) {
        Some(0) => numbers(bytes, big_endian, |b| u16::from_le_bytes(b).into()),
        Some(1) => numbers(bytes, big_endian, |b| i16::from_le_bytes(b).into()),
        Some(2) => numbers(bytes, big_endian, |b| f32::from_le_bytes(b).into()),
        Some(3) => numbers(bytes, big_endian, f64::from_le_bytes),
        Some(4) => numbers(bytes, big_endian, |b| i32::from_le_bytes(b).into()),
        Some(other) => return Err(format!("its DataValueRepresentation {other} is unknown")),
        None => return Err("its DataValueRepresentation is missing".into()),
    }?;
    let dimensions = list(0x0005, "CurveDimensions")?.first().copied().unwrap_or(1.0);
    // 0 where the coordinates of a dimension are evenly spaced and not stored, 1 where they are (Part 3 of 2004, C.10.2.1.5).
    let stored: Vec<bool> = list(0x0110, "CurveDataDescriptor")?.iter().map(|d| *d != 0.0).collect();
    let units: Vec<String> = texts(0x0030).split('\\').map(|unit| unit.trim().to_uppercase()).collect();
    let unit_s = match units[0].as_str() {
        "SEC" | "S" => Some(1.0),
        "MSEC" | "MS" => Some(1e-3),
        _ => None,
    };
    let points = list(0x0010, "NumberOfPoints")?.first().map_or(usize::MAX, |n| *n as usize);
    let is_ecg = kind == "ECG";
    if dimensions == 2.0 && stored.first() != Some(&false) {
        let pairs: Vec<[f64; 2]> = values.as_chunks().0.iter().take(points).copied().collect();
        return timed(&pairs, unit_s, length_s).map(|trace| Trace { is_ecg, ..trace });
    }
    if dimensions != 1.0 && dimensions != 2.0 {
        return Err(format!("it has {dimensions} dimensions, where a value over time has two"));
    }
    let values: Vec<f64> = values.into_iter().take(points).collect();
    let coordinate = |element, name| list(element, name).map(|list| list.first().copied());
    let (begin, step) = (coordinate(0x0112, "CoordinateStartValue")?, coordinate(0x0114, "CoordinateStepValue")?);
    let (rate_hz, begin_s) = match (unit_s, step) {
        (Some(unit_s), Some(step)) if step > 0.0 => (1.0 / (step * unit_s), begin.unwrap_or(0.0) * unit_s),
        _ => (values.len() as f64 / length_s, 0.0),
    };
    Ok(Trace { values, rate_hz, begin_s, is_ecg })
}

/// Samples pairs of time and value evenly. Times of an unknown unit span the run.
fn timed(pairs: &[[f64; 2]], unit_s: Option<f64>, length_s: f64) -> std::result::Result<Trace, String> {
    let (Some([begin, _]), Some([end, _])) = (pairs.first(), pairs.last()) else {
        return Err("it has no points".into());
    };
    let span = end - begin;
    if !(span > 0.0 && pairs.windows(2).all(|pair| pair[0][0] <= pair[1][0])) {
        return Err("its times do not rise".into());
    }
    let steps = (pairs.len() - 1) as f64;
    let unit_s = unit_s.unwrap_or(length_s * steps / ((steps + 1.0) * span));
    let begin_s = if begin * unit_s < length_s { begin * unit_s } else { 0.0 };
    let mut at = 0;
    let value_at = |i: usize| {
        let time = begin + span * i as f64 / steps;
        while at + 2 < pairs.len() && pairs[at + 1][0] < time {
            at += 1;
        }
        let ([t0, v0], [t1, v1]) = (pairs[at], pairs[at + 1]);
        if t1 > t0 { v0 + (v1 - v0) * ((time - t0) / (t1 - t0)).clamp(0.0, 1.0) } else { v1 }
    };
    let values = (0..pairs.len()).map(value_at).collect();
    Ok(Trace { values, rate_hz: steps / (span * unit_s), begin_s, is_ecg: false })
}
