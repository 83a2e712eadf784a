//! Times, distances, angles and ECGs of angiography runs that state them in one of several ways.

use crate::dicom;
use dicom_core::value::DataSetSequence;
use dicom_core::{DataElement, PrimitiveValue, Tag, VR};
use dicom_dictionary_std::tags;
use dicom_object::InMemDicomObject;
use nertca_vk::scan::gating::{BeatScaling, RPeaks};
use nertca_vk_import::dicom::Run;

fn read(change: impl Fn(&mut InMemDicomObject)) -> nertca_vk::error::Result<Run> {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("run.dcm");
    dicom::angiogram(&file, change);
    Run::read(&file, None)
}

/// Writes text, or removes the element.
fn put(o: &mut InMemDicomObject, tag: Tag, vr: VR, text: &str) {
    match text {
        "-" => drop(o.take(tag)),
        text => drop(o.put(DataElement::new(tag, vr, PrimitiveValue::from(text)))),
    }
}

/// Times of the six frames, in ms, of a run with these texts; the pointer names the vector, the time, or nothing.
#[track_caller]
fn times(pointer: Option<Tag>, texts: [&str; 4]) -> (Vec<f64>, String) {
    let [time, vector, cine, display] = texts;
    let run = read(|o| {
        put(o, tags::FRAME_TIME, VR::DS, time);
        put(o, tags::FRAME_TIME_VECTOR, VR::DS, vector);
        put(o, tags::CINE_RATE, VR::IS, cine);
        put(o, tags::RECOMMENDED_DISPLAY_FRAME_RATE, VR::IS, display);
        if let Some(tag) = pointer {
            o.put(DataElement::new(
                tags::FRAME_INCREMENT_POINTER,
                VR::AT,
                PrimitiveValue::Tags([tag].into_iter().collect()),
            ));
        }
    });
    let run = run.unwrap();
    (run.times_s.iter().map(|s| (s * 1e6).round() / 1e3).collect(), run.notes.join("\n"))
}

#[test]
fn the_pointer_decides_which_frame_time_holds() {
    let steady = |ms: f64| (0..6).map(|i| f64::from(i) * ms).collect::<Vec<f64>>();
    let (time, vector) = (Some(tags::FRAME_TIME), Some(tags::FRAME_TIME_VECTOR));
    let listed = [0.0, 10.0, 30.0, 60.0, 100.0, 150.0];
    assert_eq!(times(time, ["80", "0\\10\\20\\30\\40\\50", "-", "-"]).0, steady(80.0));
    assert_eq!(times(vector, ["80", "0\\10\\20\\30\\40\\50", "-", "-"]).0, listed);
    assert_eq!(times(None, ["80", "0\\10\\20\\30\\40\\50", "-", "-"]).0, listed);
    // A vector of one value holds no times, and a note names it where it is not used.
    assert_eq!(times(time, ["80", "0", "-", "-"]), (steady(80.0), String::new()));
    let (found, told) = times(None, ["80", "0", "-", "-"]);
    assert!(found == steady(80.0) && told.contains("FrameTimeVector has 1 values for 6 frames"), "{told}");
    let (found, told) = times(vector, ["80", "0\\10\\20\\0\\40\\50", "-", "-"]);
    assert!(found == steady(80.0) && told.contains("not all positive"), "{told}");
    // Zero is no time.
    let (found, told) = times(time, ["0", "-", "20", "10"]);
    assert!(found == steady(50.0) && told.contains("20 frames per second of CineRate"), "{told}");
    let (found, told) = times(time, ["0", "-", "0", "10"]);
    assert!(found == steady(100.0) && told.contains("10 frames per second of RecommendedDisplayFrameRate"), "{told}");
    assert_eq!(times(time, ["0", "0\\10\\20\\30\\40\\50", "20", "10"]).0, listed);
    assert_eq!(times(vector, ["-", "0\\0\\0\\0\\0\\0", "20", "-"]).0, steady(50.0));
    let (_, told) = times(None, ["0", "-", "0", "-"]);
    assert!(told.contains("15 frames per second are assumed"), "{told}");
}

#[test]
fn a_missing_distance_follows_from_the_magnification() {
    let (sid, sod) = (tags::DISTANCE_SOURCE_TO_DETECTOR, tags::DISTANCE_SOURCE_TO_PATIENT);
    let read = |sid_mm: &str, sod_mm: &str, factor: &str| {
        read(|o| {
            put(o, sid, VR::DS, sid_mm);
            put(o, sod, VR::DS, sod_mm);
            put(o, tags::ESTIMATED_RADIOGRAPHIC_MAGNIFICATION_FACTOR, VR::DS, factor);
        })
    };
    let distances = |run: Run| {
        let c_arm = &run.c_arms[0];
        ([c_arm.sid_mm, c_arm.sod_mm].map(|mm| (mm * 1e6).round() / 1e6), run.notes.join("\n"))
    };
    let ([sid_mm, sod_mm], told) = distances(read("1000", "-", "1.25").unwrap());
    assert_eq!([sid_mm, sod_mm], [1000.0, 800.0]);
    assert!(told.contains("800.0 mm are used") && told.contains("EstimatedRadiographicMagnificationFactor"), "{told}");
    assert_eq!(distances(read("1000", "0", "1.25").unwrap()).0, [1000.0, 800.0]);
    assert_eq!(distances(read("-", "800", "1.25").unwrap()).0, [1000.0, 800.0]);
    // A distance that is there holds.
    let ([_, sod_mm], told) = distances(read("1000", "700", "1.25").unwrap());
    assert!(sod_mm == 700.0 && told.is_empty(), "{told}");
    for (missing, factor) in [("-", "-"), ("-", "0"), ("-", "0.8")] {
        let told = read("1000", missing, factor).err().unwrap().to_string();
        assert!(told.contains("(0018,1111) DistanceSourceToPatient: is missing"), "{told}");
    }
}

#[test]
fn increments_are_differences_from_the_first_position_and_said_to_be() {
    let read = |increments: &str| {
        let run = read(|o| put(o, tags::POSITIONER_PRIMARY_ANGLE_INCREMENT, VR::DS, increments)).unwrap();
        (run.c_arms.iter().map(|c_arm| c_arm.primary_deg).collect::<Vec<f64>>(), run.notes.join("\n"))
    };
    let (angles, told) = read("0\\1\\3\\6\\8\\9");
    assert_eq!(angles, [30.0, 31.0, 33.0, 36.0, 38.0, 39.0]);
    assert!(
        told.contains("PositionerPrimaryAngleIncrement: its values, 0 to 9, are taken as differences from the first"),
        "{told}"
    );
    assert!(!told.contains("warning"), "{told}");
    let (angles, told) = read("0\\2\\2\\2\\2\\2");
    assert_eq!(angles, [30.0, 32.0, 32.0, 32.0, 32.0, 32.0]);
    assert!(told.contains("warning: PositionerPrimaryAngleIncrement is 2 for every frame after the first"), "{told}");
    let (angles, told) = read("2");
    assert_eq!(angles, [30.0, 32.0, 34.0, 36.0, 38.0, 40.0]);
    assert!(told.contains("2 is added from each frame to the next"), "{told}");
    assert_eq!(read("0\\0\\0\\0\\0\\0"), (vec![30.0; 6], String::new()));
}

/// R-peaks of the traces in these tests, seconds.
const BEATS_S: [f64; 4] = [0.4, 1.1, 1.9, 2.6];

/// Value of an ECG at a time.
fn ecg(time_s: f64) -> f64 {
    let bump = |at: f64, width: f64, height: f64| height * (-((time_s - at) / width).powi(2)).exp();
    BEATS_S.iter().map(|beat| bump(*beat, 0.012, 1000.0) + bump(beat + 0.28, 0.05, 250.0)).sum()
}

#[track_caller]
fn expect_beats(found: Option<&RPeaks>) {
    let found = found.expect("no R-peaks");
    let phase = |time_s| found.beat_time(time_s, 20, BeatScaling::Linear).map(|taken| taken.phase);
    for beat in &BEATS_S[..3] {
        assert_eq!((phase(beat - 0.02), phase(beat + 0.02)), (Some(19), Some(0)), "{beat}");
    }
}

/// Makes the run three seconds long.
fn three_seconds(o: &mut InMemDicomObject) {
    put(o, tags::FRAME_TIME, VR::DS, "500");
}

/// Adds a curve of signed numbers.
fn curve(o: &mut InMemDicomObject, group: u16, kind: &str, dimensions: u16, values: &[f64]) {
    let number = |o: &mut InMemDicomObject, element, value: u16| {
        o.put(DataElement::new(Tag(group, element), VR::US, PrimitiveValue::from(value)));
    };
    number(o, 0x0005, dimensions);
    number(o, 0x0010, values.len() as u16 / dimensions);
    put(o, Tag(group, 0x0020), VR::CS, kind);
    number(o, 0x0103, 1);
    let words = values.iter().map(|v| *v as i16 as u16).collect();
    o.put(DataElement::new(Tag(group, 0x3000), VR::OW, PrimitiveValue::U16(words)));
}

#[test]
fn ecg_curves_are_found_wherever_they_stand() {
    let even: Vec<f64> = (0..750).map(|i| ecg(f64::from(i) / 250.0)).collect();
    let pressure: Vec<f64> = (0..750).map(|i| 100.0 + 20.0 * (f64::from(i) / 30.0).sin()).collect();
    let run = read(|o| {
        three_seconds(o);
        curve(o, 0x5000, "ECG", 1, &even);
    });
    expect_beats(run.unwrap().r_peaks.as_ref());
    // Behind a pressure curve, in two dimensions with times in ms, and of a general type.
    let timed: Vec<f64> = (0..750).flat_map(|i| [f64::from(i) * 4.0, ecg(f64::from(i) / 250.0)]).collect();
    for kind in ["ECG", "PHYSIO"] {
        for units in ["MSEC\\MV", "-"] {
            let run = read(|o| {
                three_seconds(o);
                curve(o, 0x5000, "PRESSURE", 1, &pressure);
                curve(o, 0x5004, kind, 2, &timed);
                put(o, Tag(0x5004, 0x0030), VR::SH, units);
            });
            let run = run.unwrap();
            expect_beats(run.r_peaks.as_ref());
            let told = run.notes.join("\n");
            assert!(told.contains("curve 5000 was not used as an ECG: its type is PRESSURE"), "{told}");
            assert!(told.contains("R-peaks found in the ECG of curve 5004"), "{told}");
        }
    }
    // Times that are not even: the first second has every second sample only.
    let uneven: Vec<f64> = (0..750)
        .filter(|i| *i >= 250 || i % 2 == 0)
        .flat_map(|i| [f64::from(i) * 4.0, ecg(f64::from(i) / 250.0)])
        .collect();
    let run = read(|o| {
        three_seconds(o);
        curve(o, 0x5002, "ECG", 2, &uneven);
        put(o, Tag(0x5002, 0x0030), VR::SH, "MSEC\\MV");
    });
    expect_beats(run.unwrap().r_peaks.as_ref());
    // Times given by a first value and a step: the curve begins a fifth of a second after the first frame.
    let late: Vec<f64> = (0..700).map(|i| ecg(0.2 + f64::from(i) / 250.0)).collect();
    let run = read(|o| {
        three_seconds(o);
        curve(o, 0x5006, "ECG", 2, &late);
        put(o, Tag(0x5006, 0x0030), VR::SH, "MSEC\\MV");
        o.put(DataElement::new(Tag(0x5006, 0x0010), VR::US, PrimitiveValue::from(700u16)));
        for (element, values) in [(0x0110, [0u16, 1]), (0x0112, [200, 0]), (0x0114, [4, 0])] {
            o.put(DataElement::new(Tag(0x5006, element), VR::US, PrimitiveValue::U16(values.into_iter().collect())));
        }
    });
    expect_beats(run.unwrap().r_peaks.as_ref());
}

#[test]
fn each_curve_that_is_not_used_has_its_reason_said() {
    let flat = [5.0; 600];
    let run = read(|o| {
        three_seconds(o);
        curve(o, 0x5000, "RESP", 1, &flat);
        curve(o, 0x5002, "ECG", 3, &flat);
        curve(o, 0x5004, "ECG", 1, &flat);
        curve(o, 0x5006, "ECG", 1, &flat);
        put(o, Tag(0x5006, 0x0103), VR::US, "-");
        curve(o, 0x5008, "ECG", 2, &flat);
    });
    let run = run.unwrap();
    let told = run.notes.join("\n");
    assert!(run.r_peaks.is_none());
    for reason in [
        "curve 5000 was not used as an ECG: its type is RESP",
        "curve 5002 was not used as an ECG: it has 3 dimensions",
        "curve 5004 was not used as an ECG: 0 R-peaks are given, but at least two are needed",
        "curve 5006 was not used as an ECG: its DataValueRepresentation is missing",
        "curve 5008 was not used as an ECG: its times do not rise",
    ] {
        assert!(told.contains(reason), "{reason}: {told}");
    }
}

/// A waveform whose channels have labels and values.
fn waveform(channels: &[(&str, Vec<f64>)], rate_hz: &str, begin_ms: &str) -> InMemDicomObject {
    let mut group = InMemDicomObject::new_empty();
    group.put(DataElement::new(tags::NUMBER_OF_WAVEFORM_CHANNELS, VR::US, PrimitiveValue::from(channels.len() as u16)));
    put(&mut group, tags::SAMPLING_FREQUENCY, VR::DS, rate_hz);
    put(&mut group, tags::MULTIPLEX_GROUP_TIME_OFFSET, VR::DS, begin_ms);
    put(&mut group, tags::WAVEFORM_SAMPLE_INTERPRETATION, VR::CS, "SS");
    let definition = |label: &str| {
        let (mut source, mut definition) = (InMemDicomObject::new_empty(), InMemDicomObject::new_empty());
        put(&mut source, tags::CODE_MEANING, VR::LO, label);
        definition.put(DataElement::new(tags::CHANNEL_SOURCE_SEQUENCE, VR::SQ, DataSetSequence::from(vec![source])));
        definition
    };
    let definitions: Vec<_> = channels.iter().map(|(label, _)| definition(label)).collect();
    group.put(DataElement::new(tags::CHANNEL_DEFINITION_SEQUENCE, VR::SQ, DataSetSequence::from(definitions)));
    let samples =
        (0..channels[0].1.len()).flat_map(|i| channels.iter().map(move |(_, values)| values[i] as i16 as u16));
    group.put(DataElement::new(tags::WAVEFORM_DATA, VR::OW, PrimitiveValue::U16(samples.collect())));
    group
}

#[test]
fn the_ecg_of_a_waveform_is_found_among_its_channels() {
    let even = |begin_s: f64| (0..600).map(|i| ecg(begin_s + f64::from(i) / 200.0)).collect::<Vec<f64>>();
    let pressure: Vec<f64> = (0..600).map(|i| if i % 100 < 10 { 900.0 } else { 100.0 }).collect();
    let run = |groups: Vec<InMemDicomObject>| {
        let run = read(|o| {
            three_seconds(o);
            o.put(DataElement::new(tags::WAVEFORM_SEQUENCE, VR::SQ, DataSetSequence::from(groups.clone())));
        });
        run.unwrap()
    };
    let groups = vec![
        waveform(&[("Arterial pressure", pressure.clone())], "200", "-"),
        waveform(
            &[("Respiration", pressure.clone()), ("Something", pressure.clone()), ("Lead II", even(0.0))],
            "200",
            "-",
        ),
    ];
    let both = run(groups);
    expect_beats(both.r_peaks.as_ref());
    let told = both.notes.join("\n");
    assert!(told.contains("waveform 1, channel 1 (Arterial pressure) was not used as an ECG: it is no ECG"), "{told}");
    assert!(told.contains("R-peaks found in the ECG of waveform 2, channel 3 (Lead II)"), "{told}");
    // It begins after the first frame.
    expect_beats(run(vec![waveform(&[("Lead I", even(0.15))], "200", "150")]).r_peaks.as_ref());
    // Without a rate, the reason is said.
    let without = run(vec![waveform(&[("Lead I", even(0.0))], "-", "-")]);
    assert!(without.notes.join("\n").contains("waveform 1 was not used as an ECG: its SamplingFrequency is missing"));
}

#[test]
fn a_field_of_view_that_is_turned_or_flipped_is_undone() {
    let upright = read(|_| ()).unwrap();
    let flipped = read(|o| put(o, tags::FIELD_OF_VIEW_HORIZONTAL_FLIP, VR::CS, "YES")).unwrap();
    assert!(flipped.notes.iter().any(|note| note.contains("FieldOfViewHorizontalFlip")), "{:?}", flipped.notes);
    let turned = read(|o| put(o, tags::FIELD_OF_VIEW_ROTATION, VR::IS, "180")).unwrap();
    for (frame, stored) in upright.frames.iter().enumerate() {
        for (p, value) in stored.iter().enumerate() {
            let (x, y) = (p % upright.width, p / upright.width);
            let beside = upright.width - 1 - x;
            assert_eq!(flipped.frames[frame][y * upright.width + beside], *value);
            assert_eq!(turned.frames[frame][(upright.height - 1 - y) * upright.width + beside], *value);
        }
    }
    let quarter = read(|o| put(o, tags::FIELD_OF_VIEW_ROTATION, VR::IS, "90")).unwrap();
    assert_eq!([quarter.width, quarter.height], [upright.height, upright.width]);
    let [column_mm, row_mm] = upright.c_arms[0].pixel_mm;
    assert_eq!(quarter.c_arms[0].pixel_mm, [row_mm, column_mm]);
    for (tag, vr, text) in
        [(tags::FIELD_OF_VIEW_ROTATION, VR::IS, "45"), (tags::FIELD_OF_VIEW_HORIZONTAL_FLIP, VR::CS, "MAYBE")]
    {
        let refused = read(|o| put(o, tag, vr, text)).unwrap_err().to_string();
        assert!(refused.contains(text) && refused.contains("(0018,703"), "{refused}");
    }
}

#[test]
fn a_negative_image_is_inverted_once_whichever_attribute_states_it() {
    let upright = read(|_| ()).unwrap();
    let [photometric, sign] = [
        (tags::PHOTOMETRIC_INTERPRETATION, VR::CS, "MONOCHROME1"),
        (tags::PIXEL_INTENSITY_RELATIONSHIP_SIGN, VR::SS, "-1"),
    ];
    for stated in [vec![photometric], vec![sign], vec![photometric, sign]] {
        let run = read(|o| {
            for (tag, vr, text) in &stated {
                if *vr == VR::SS {
                    o.put(DataElement::new(*tag, *vr, PrimitiveValue::from(text.parse::<i16>().unwrap())));
                } else {
                    put(o, *tag, *vr, text);
                }
            }
        })
        .unwrap();
        let white = upright.range.low + upright.range.white;
        assert!(run.frames[0].iter().zip(&upright.frames[0]).all(|(now, value)| *now == white - value), "{stated:?}");
    }
}

#[test]
fn more_frames_than_stated_and_impossible_heart_rates_are_told() {
    let run = read(|o| put(o, tags::NUMBER_OF_FRAMES, VR::IS, "4")).unwrap();
    assert!(
        run.notes.iter().any(|note| note.contains("holds 6 frames, but NumberOfFrames states 4")),
        "{:?}",
        run.notes
    );
    let run = read(|o| {
        let every_2_ms = (0..20u8).map(|k| 2.0 * f32::from(k));
        let peaks = PrimitiveValue::F32(every_2_ms.collect());
        o.put(DataElement::new(tags::R_WAVE_TIME_VECTOR, VR::FL, peaks));
    })
    .unwrap();
    assert!(run.r_peaks.is_none());
    assert!(run.notes.iter().any(|note| note.contains("30000") && note.contains("20 to 300")), "{:?}", run.notes);
}
