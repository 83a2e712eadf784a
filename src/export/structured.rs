//! Structured reports of DICOM: a tree of content items (PS3.3 C.17.3) in a file (Comprehensive 3D SR Storage, PS3.3 A.35.13), marked as
//! not for diagnosis.

use crate::error::Result;
use crate::export::dicom::{Code, Identity, add_sequence, add_text, decimal, identify, uid, write_object};
use dicom_core::chrono::{DateTime, Utc};
use dicom_core::{DataElement, PrimitiveValue, Tag, VR};
use dicom_dictionary_std::tags;
use dicom_dictionary_std::uids::COMPREHENSIVE3_DSR_STORAGE;
use dicom_object::InMemDicomObject;
use glam::DVec3;
use std::path::Path;
use std::time::SystemTime;

/// Relationship of a content item to the item that contains it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Relationship {
    /// The item is a part of the other.
    Contains,
    /// The item says who observed, and what.
    HasObsContext,
    /// The item makes the name of the other more precise.
    HasConceptMod,
    /// The other was computed from the item.
    InferredFrom,
}

impl Relationship {
    fn text(self) -> &'static str {
        match self {
            Relationship::Contains => "CONTAINS",
            Relationship::HasObsContext => "HAS OBS CONTEXT",
            Relationship::HasConceptMod => "HAS CONCEPT MOD",
            Relationship::InferredFrom => "INFERRED FROM",
        }
    }
}

/// Value of a content item.
#[derive(Debug, Clone, PartialEq)]
pub enum Value {
    /// Items of a template of PS3.16 (`1500` for TID 1500), or of none.
    Container(Option<&'static str>),
    /// Text for people.
    Text(String),
    /// Code.
    Code(Code),
    /// Unique identifier, as random number.
    Uid(u128),
    /// Number with a unit of UCUM.
    Number(f64, Code),
    /// Line through points, or a point where there is one: LPS mm in the frame of reference of the report.
    Points(Vec<DVec3>),
}

/// Content item of a report.
#[derive(Debug, Clone, PartialEq)]
pub struct ContentItem {
    /// Relationship to the item that contains this one; the root ignores it.
    pub relationship: Relationship,
    /// Name of the value.
    pub name: Code,
    /// Value.
    pub value: Value,
    /// Items that this one contains.
    pub children: Vec<ContentItem>,
}

impl ContentItem {
    /// Makes an item without children.
    pub fn new(relationship: Relationship, name: Code, value: Value) -> ContentItem {
        ContentItem { relationship, name, value, children: Vec::new() }
    }

    /// Returns the item with these children.
    pub fn with(self, children: impl IntoIterator<Item = ContentItem>) -> ContentItem {
        ContentItem { children: children.into_iter().collect(), ..self }
    }

    /// Adds the item to an object: an item of a content sequence, or the report whose root it is.
    fn add_to(&self, object: &mut InMemDicomObject, frame_uid: &str) {
        add_sequence(object, tags::CONCEPT_NAME_CODE_SEQUENCE, vec![self.name.item()]);
        add_text(object, tags::VALUE_TYPE, VR::CS, self.value.kind());
        self.value.add_to(object, frame_uid);
        let item = |child: &ContentItem| {
            let mut item = InMemDicomObject::new_empty();
            add_text(&mut item, tags::RELATIONSHIP_TYPE, VR::CS, child.relationship.text());
            child.add_to(&mut item, frame_uid);
            item
        };
        if !self.children.is_empty() {
            add_sequence(object, tags::CONTENT_SEQUENCE, self.children.iter().map(item).collect());
        }
    }
}

impl Value {
    /// Returns the value type of PS3.3 C.17.3.2.1.
    fn kind(&self) -> &'static str {
        match self {
            Value::Container(_) => "CONTAINER",
            Value::Text(_) => "TEXT",
            Value::Code(_) => "CODE",
            Value::Uid(_) => "UIDREF",
            Value::Number(..) => "NUM",
            Value::Points(_) => "SCOORD3D",
        }
    }

    fn add_to(&self, object: &mut InMemDicomObject, frame_uid: &str) {
        match self {
            Value::Container(template) => {
                add_text(object, tags::CONTINUITY_OF_CONTENT, VR::CS, "SEPARATE");
                if let Some(template) = template {
                    let mut item = InMemDicomObject::new_empty();
                    add_text(&mut item, tags::MAPPING_RESOURCE, VR::CS, "DCMR");
                    add_text(&mut item, tags::TEMPLATE_IDENTIFIER, VR::CS, template);
                    add_sequence(object, tags::CONTENT_TEMPLATE_SEQUENCE, vec![item]);
                }
            }
            Value::Text(text) => add_text(object, tags::TEXT_VALUE, VR::UT, text),
            Value::Code(code) => add_sequence(object, tags::CONCEPT_CODE_SEQUENCE, vec![code.item()]),
            Value::Uid(random) => add_text(object, tags::UID, VR::UI, &uid(*random)),
            Value::Number(value, unit) => {
                let mut measured = InMemDicomObject::new_empty();
                add_text(&mut measured, tags::NUMERIC_VALUE, VR::DS, &decimal(*value));
                add_sequence(&mut measured, tags::MEASUREMENT_UNITS_CODE_SEQUENCE, vec![unit.item()]);
                add_sequence(object, tags::MEASURED_VALUE_SEQUENCE, vec![measured]);
            }
            Value::Points(points_mm) => {
                let kind = if points_mm.len() == 1 { "POINT" } else { "POLYLINE" };
                let flat: Vec<f32> = points_mm.iter().flat_map(|point| point.as_vec3().to_array()).collect();
                object.put(DataElement::new(tags::GRAPHIC_DATA, VR::FL, PrimitiveValue::F32(flat.into())));
                add_text(object, tags::GRAPHIC_TYPE, VR::CS, kind);
                add_text(object, tags::REFERENCED_FRAME_OF_REFERENCE_UID, VR::UI, frame_uid);
            }
        }
    }
}

/// Coding scheme of codes that no standard has.
#[derive(Debug, Clone, Copy)]
pub struct PrivateScheme {
    /// Designator, which begins with 99.
    pub designator: &'static str,
    /// Name.
    pub name: &'static str,
    /// Organization that defines the codes.
    pub organization: &'static str,
}

/// Random numbers from which the UIDs of a report are made.
#[derive(Debug, Clone, Copy)]
pub struct ReportSeeds {
    /// Seed of the study.
    pub study: u128,
    /// Seed of the series.
    pub series: u128,
    /// Seed of the frame of reference.
    pub frame: u128,
    /// Seed of the instance.
    pub instance: u128,
    /// Seed of what the report follows: vessels and stenoses.
    pub tracking: u128,
}

/// Writes a report, with the codes of a private scheme.
///
/// # Errors
/// [`crate::error::Error::Io`].
pub fn write(path: &Path, root: &ContentItem, scheme: &PrivateScheme, seeds: &ReportSeeds) -> Result<()> {
    let [study, series, frame, instance] = [seeds.study, seeds.series, seeds.frame, seeds.instance].map(uid);
    let mut object = InMemDicomObject::new_empty();
    let uids = [study.as_str(), &series, &instance];
    identify(&mut object, &Identity { class: COMPREHENSIVE3_DSR_STORAGE, uids, modality: "SR", number: 1 });
    let now = DateTime::<Utc>::from(SystemTime::now());
    for (tag, vr, value) in [
        (tags::CONTENT_DATE, VR::DA, now.format("%Y%m%d").to_string().as_str()),
        (tags::CONTENT_TIME, VR::TM, &now.format("%H%M%S").to_string()),
        (tags::COMPLETION_FLAG, VR::CS, "COMPLETE"),
        (tags::VERIFICATION_FLAG, VR::CS, "UNVERIFIED"),
        (tags::DEVICE_SERIAL_NUMBER, VR::LO, "0"),
    ] {
        add_text(&mut object, tag, vr, value);
    }
    // Required sequences whose content is not known.
    for tag in [tags::REFERENCED_PERFORMED_PROCEDURE_STEP_SEQUENCE, tags::PERFORMED_PROCEDURE_CODE_SEQUENCE] {
        add_sequence(&mut object, tag, Vec::new());
    }
    add_sequence(&mut object, tags::CODING_SCHEME_IDENTIFICATION_SEQUENCE, vec![scheme_item(scheme)]);
    root.add_to(&mut object, &frame);
    write_object(path, object)
}

fn scheme_item(scheme: &PrivateScheme) -> InMemDicomObject {
    let mut item = InMemDicomObject::new_empty();
    let texts: [(Tag, VR, &str); 3] = [
        (tags::CODING_SCHEME_DESIGNATOR, VR::SH, scheme.designator),
        (tags::CODING_SCHEME_NAME, VR::ST, scheme.name),
        (tags::CODING_SCHEME_RESPONSIBLE_ORGANIZATION, VR::ST, scheme.organization),
    ];
    texts.into_iter().for_each(|(tag, vr, text)| add_text(&mut item, tag, vr, text));
    item
}
