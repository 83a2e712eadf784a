//! Writes lines over the frames of DICOM images as a presentation state (Grayscale Softcopy Presentation State Storage, PS3.3 A.33.1),
//! which viewers show over these images without changing them.

use crate::error::{Error, Result};
use crate::export::dicom::{LABEL, add_sequence, add_text, add_unknown, decimal, uid, write_object};
use crate::scan::references::{SourceImage, SourceStudy};
use dicom_core::chrono::{DateTime, Utc};
use dicom_core::{DataElement, PrimitiveValue, Tag, VR};
use dicom_dictionary_std::tags;
use dicom_dictionary_std::uids::GRAYSCALE_SOFTCOPY_PRESENTATION_STATE_STORAGE;
use dicom_object::InMemDicomObject;
use std::path::Path;
use std::time::SystemTime;

/// Name of the layer of all graphics.
const LAYER: &str = "VESSELS";
/// Colour of the layer that viewers may use, CIE L*a*b* as DICOM scales it (PS3.3 C.10.7.1.1): red.
const RED_LAB: [u16; 3] = [34_885, 53_485, 50_171];
/// Largest number of points of a line, which DICOM counts with 16 bits (PS3.3 C.10.5).
const MAX_POINTS: usize = u16::MAX as usize;

/// Lines over frames of an image.
#[derive(Debug, Clone)]
pub struct FrameGraphics<'a> {
    /// Image.
    pub source: &'a SourceImage,
    /// Frames of the image, from 1.
    pub frames: &'a [u32],
    /// Lines through (column, row), counted from the outer corner of the first pixel.
    pub lines_px: Vec<Vec<[f64; 2]>>,
}

/// Random numbers from which the UIDs of a presentation state are made.
#[derive(Debug, Clone, Copy)]
pub struct PresentationSeeds {
    /// Seed of the series.
    pub series: u128,
    /// Seed of the instance.
    pub instance: u128,
}

/// Writes a presentation state for images of one study, to which it then belongs.
///
/// # Errors
/// [`Error::Config`] for no graphics, and for images of several studies; [`Error::Io`].
pub fn write(path: &Path, graphics: &[FrameGraphics<'_>], description: &str, seeds: &PresentationSeeds) -> Result<()> {
    let Some(first) = graphics.first() else {
        return Err(Error::config("frames", 0, "no image of the dataset has a reference to the frames of a run"));
    };
    let mut images: Vec<&SourceImage> = Vec::new();
    for graphic in graphics {
        if !images.iter().any(|image| image.instance_uid == graphic.source.instance_uid) {
            images.push(graphic.source);
        }
    }
    let study = &first.source.study;
    if let Some(other) = images.iter().find(|image| image.study.study_uid != study.study_uid) {
        let problem =
            format!("differs from that of other runs, {}: a presentation state belongs to one study", study.study_uid);
        return Err(Error::config("study", &other.study.study_uid, problem));
    }
    let mut object = InMemDicomObject::new_empty();
    identify(&mut object, study, description, seeds);
    relate(&mut object, &images);
    add_sequence(
        &mut object,
        tags::DISPLAYED_AREA_SELECTION_SEQUENCE,
        images.iter().map(|i| displayed_area(i)).collect(),
    );
    let annotations: Vec<InMemDicomObject> = graphics.iter().filter_map(annotation).collect();
    add_sequence(&mut object, tags::GRAPHIC_ANNOTATION_SEQUENCE, annotations);
    add_sequence(&mut object, tags::GRAPHIC_LAYER_SEQUENCE, vec![layer()]);
    let windows: Vec<InMemDicomObject> = images.iter().filter_map(|image| window(image)).collect();
    if !windows.is_empty() {
        add_sequence(&mut object, tags::SOFTCOPY_VOILUT_SEQUENCE, windows);
    }
    add_text(&mut object, tags::PRESENTATION_LUT_SHAPE, VR::CS, "IDENTITY");
    write_object(path, object)
}

/// Adds patient and study as the images state them, and the identity of the presentation state.
fn identify(object: &mut InMemDicomObject, study: &SourceStudy, description: &str, seeds: &PresentationSeeds) {
    let [series, instance] = [seeds.series, seeds.instance].map(uid);
    let now = DateTime::<Utc>::from(SystemTime::now());
    let (date, time) = (now.format("%Y%m%d").to_string(), now.format("%H%M%S").to_string());
    let texts: [(Tag, VR, &str); 29] = [
        (tags::SPECIFIC_CHARACTER_SET, VR::CS, "ISO_IR 192"),
        (tags::SOP_CLASS_UID, VR::UI, GRAYSCALE_SOFTCOPY_PRESENTATION_STATE_STORAGE),
        (tags::SOP_INSTANCE_UID, VR::UI, &instance),
        (tags::STUDY_DATE, VR::DA, &study.study_date),
        (tags::STUDY_TIME, VR::TM, &study.study_time),
        (tags::ACCESSION_NUMBER, VR::SH, &study.accession_number),
        (tags::MODALITY, VR::CS, "PR"),
        (tags::MANUFACTURER, VR::LO, "nertca-vk"),
        (tags::REFERRING_PHYSICIAN_NAME, VR::PN, &study.referring_physician),
        (tags::SERIES_DESCRIPTION, VR::LO, LABEL),
        (tags::BODY_PART_EXAMINED, VR::CS, "HEART"),
        (tags::MANUFACTURER_MODEL_NAME, VR::LO, "nertca-vk"),
        (tags::PATIENT_NAME, VR::PN, &study.patient_name),
        (tags::PATIENT_ID, VR::LO, &study.patient_id),
        (tags::PATIENT_BIRTH_DATE, VR::DA, &study.patient_birth_date),
        (tags::PATIENT_SEX, VR::CS, &study.patient_sex),
        (tags::DEVICE_SERIAL_NUMBER, VR::LO, "0"),
        (tags::SOFTWARE_VERSIONS, VR::LO, env!("CARGO_PKG_VERSION")),
        (tags::STUDY_INSTANCE_UID, VR::UI, &study.study_uid),
        (tags::SERIES_INSTANCE_UID, VR::UI, &series),
        (tags::STUDY_ID, VR::SH, &study.study_id),
        (tags::SERIES_NUMBER, VR::IS, "1"),
        (tags::INSTANCE_NUMBER, VR::IS, "1"),
        (tags::CONTENT_LABEL, VR::CS, "CENTRELINES"),
        (tags::CONTENT_DESCRIPTION, VR::LO, description),
        (tags::PRESENTATION_CREATION_DATE, VR::DA, &date),
        (tags::PRESENTATION_CREATION_TIME, VR::TM, &time),
        (tags::CONTENT_CREATOR_NAME, VR::PN, "nertca-vk^reconstruction"),
        (tags::SERIES_DATE, VR::DA, &date),
    ];
    for (tag, vr, text) in texts {
        if text.is_empty() { add_unknown(object, tag, vr) } else { add_text(object, tag, vr, text) }
    }
}

/// Adds the images to which the presentation state applies, by series.
fn relate(object: &mut InMemDicomObject, images: &[&SourceImage]) {
    let mut series: Vec<(&str, Vec<InMemDicomObject>)> = Vec::new();
    for image in images {
        let item = reference(image, None);
        match series.iter_mut().find(|(uid, _)| *uid == image.series_uid) {
            Some((_, items)) => items.push(item),
            None => series.push((&image.series_uid, vec![item])),
        }
    }
    let item = |(uid, images): (&str, Vec<InMemDicomObject>)| {
        let mut item = InMemDicomObject::new_empty();
        add_text(&mut item, tags::SERIES_INSTANCE_UID, VR::UI, uid);
        add_sequence(&mut item, tags::REFERENCED_IMAGE_SEQUENCE, images);
        item
    };
    add_sequence(object, tags::REFERENCED_SERIES_SEQUENCE, series.into_iter().map(item).collect());
}

/// Returns a reference to an image, or to some of its frames.
fn reference(image: &SourceImage, frames: Option<&[u32]>) -> InMemDicomObject {
    let mut item = InMemDicomObject::new_empty();
    add_text(&mut item, tags::REFERENCED_SOP_CLASS_UID, VR::UI, &image.class_uid);
    add_text(&mut item, tags::REFERENCED_SOP_INSTANCE_UID, VR::UI, &image.instance_uid);
    if let Some(frames) = frames {
        let numbers: Vec<String> = frames.iter().map(u32::to_string).collect();
        add_text(&mut item, tags::REFERENCED_FRAME_NUMBER, VR::IS, &numbers.join("\\"));
    }
    item
}

/// Returns the area of an image that is shown: all of it.
fn displayed_area(image: &SourceImage) -> InMemDicomObject {
    let mut item = InMemDicomObject::new_empty();
    add_sequence(&mut item, tags::REFERENCED_IMAGE_SEQUENCE, vec![reference(image, None)]);
    let [columns, rows] = image.size.map(|side| side as i32);
    for (tag, corner) in [
        (tags::DISPLAYED_AREA_TOP_LEFT_HAND_CORNER, [1, 1]),
        (tags::DISPLAYED_AREA_BOTTOM_RIGHT_HAND_CORNER, [columns, rows]),
    ] {
        item.put(DataElement::new(tag, VR::SL, PrimitiveValue::I32(corner.as_slice().into())));
    }
    add_text(&mut item, tags::PRESENTATION_SIZE_MODE, VR::CS, "SCALE TO FIT");
    add_text(&mut item, tags::PRESENTATION_PIXEL_ASPECT_RATIO, VR::IS, "1\\1");
    item
}

/// Returns the window by which an image is shown, which a presentation state must repeat.
fn window(image: &SourceImage) -> Option<InMemDicomObject> {
    let [centre, width] = image.window?;
    let mut item = InMemDicomObject::new_empty();
    add_sequence(&mut item, tags::REFERENCED_IMAGE_SEQUENCE, vec![reference(image, None)]);
    add_text(&mut item, tags::WINDOW_CENTER, VR::DS, &decimal(centre));
    add_text(&mut item, tags::WINDOW_WIDTH, VR::DS, &decimal(width));
    Some(item)
}

/// Returns the lines over some frames; `None` without lines.
fn annotation(graphics: &FrameGraphics<'_>) -> Option<InMemDicomObject> {
    let lines: Vec<InMemDicomObject> = graphics.lines_px.iter().flat_map(|line| pieces(line)).map(polyline).collect();
    if lines.is_empty() {
        return None;
    }
    let mut item = InMemDicomObject::new_empty();
    add_sequence(&mut item, tags::REFERENCED_IMAGE_SEQUENCE, vec![reference(graphics.source, Some(graphics.frames))]);
    add_text(&mut item, tags::GRAPHIC_LAYER, VR::CS, LAYER);
    add_sequence(&mut item, tags::TEXT_OBJECT_SEQUENCE, vec![label(graphics.source)]);
    add_sequence(&mut item, tags::GRAPHIC_OBJECT_SEQUENCE, lines);
    Some(item)
}

/// Divides a line into pieces that DICOM can hold, which share their ends.
fn pieces(line: &[[f64; 2]]) -> impl Iterator<Item = &[[f64; 2]]> {
    let starts = (0..line.len().saturating_sub(1)).step_by(MAX_POINTS - 1);
    starts.map(|start| &line[start..line.len().min(start + MAX_POINTS)])
}

/// Returns a line as graphic object.
fn polyline(points_px: &[[f64; 2]]) -> InMemDicomObject {
    let mut item = InMemDicomObject::new_empty();
    add_text(&mut item, tags::GRAPHIC_ANNOTATION_UNITS, VR::CS, "PIXEL");
    item.put(DataElement::new(tags::GRAPHIC_DIMENSIONS, VR::US, PrimitiveValue::from(2u16)));
    let n = points_px.len() as u16;
    item.put(DataElement::new(tags::NUMBER_OF_GRAPHIC_POINTS, VR::US, PrimitiveValue::from(n)));
    let flat: Vec<f32> = points_px.iter().flatten().map(|v| *v as f32).collect();
    item.put(DataElement::new(tags::GRAPHIC_DATA, VR::FL, PrimitiveValue::F32(flat.into())));
    add_text(&mut item, tags::GRAPHIC_TYPE, VR::CS, "POLYLINE");
    add_text(&mut item, tags::GRAPHIC_FILLED, VR::CS, "N");
    item
}

/// Returns the label that stands in a corner of the image.
fn label(image: &SourceImage) -> InMemDicomObject {
    let mut item = InMemDicomObject::new_empty();
    add_text(&mut item, tags::BOUNDING_BOX_ANNOTATION_UNITS, VR::CS, "PIXEL");
    add_text(&mut item, tags::UNFORMATTED_TEXT_VALUE, VR::ST, LABEL);
    let [columns, rows] = image.size.map(|side| side as f32);
    for (tag, corner) in [
        (tags::BOUNDING_BOX_TOP_LEFT_HAND_CORNER, [0.0, 0.94 * rows]),
        (tags::BOUNDING_BOX_BOTTOM_RIGHT_HAND_CORNER, [columns, rows]),
    ] {
        item.put(DataElement::new(tag, VR::FL, PrimitiveValue::F32(corner.as_slice().into())));
    }
    add_text(&mut item, tags::BOUNDING_BOX_TEXT_HORIZONTAL_JUSTIFICATION, VR::CS, "CENTER");
    item
}

/// Returns the layer of all graphics.
fn layer() -> InMemDicomObject {
    let mut item = InMemDicomObject::new_empty();
    add_text(&mut item, tags::GRAPHIC_LAYER, VR::CS, LAYER);
    add_text(&mut item, tags::GRAPHIC_LAYER_ORDER, VR::IS, "1");
    let colour = PrimitiveValue::U16(RED_LAB.as_slice().into());
    item.put(DataElement::new(tags::GRAPHIC_LAYER_RECOMMENDED_DISPLAY_CIE_LAB_VALUE, VR::US, colour));
    add_text(&mut item, tags::GRAPHIC_LAYER_DESCRIPTION, VR::LO, "Centrelines of a reconstruction");
    item
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_lines_are_divided_without_a_gap() {
        let line: Vec<[f64; 2]> = (0..MAX_POINTS + 10).map(|i| [i as f64, 0.0]).collect();
        let found: Vec<&[[f64; 2]]> = pieces(&line).collect();
        assert_eq!(found.iter().map(|piece| piece.len()).collect::<Vec<_>>(), [MAX_POINTS, 11]);
        assert_eq!(found[0].last(), found[1].first());
        assert_eq!(pieces(&line[..MAX_POINTS]).count(), 1);
        assert_eq!(pieces(&line[..1]).count(), 0, "a point is no line");
    }
}
