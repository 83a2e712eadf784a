//! Identity of a run's file, for an import that keeps references.

use crate::import::reader::Reader;
use crate::scan::references::{SourceImage, SourceStudy, is_uid};
use dicom_core::Tag;
use dicom_dictionary_std::tags;
use dicom_encoding::text::{DefaultCharacterSetCodec, SpecificCharacterSet, TextCodec};

impl Reader<'_> {
    /// Returns the identity of the file; `None` where it lacks a UID, so that nothing can refer to it.
    pub(super) fn source(&self, size: [usize; 2]) -> Option<SourceImage> {
        let uid = |tag: Tag| self.text(tag).filter(|text| is_uid(text));
        let first = |tag: Tag| self.numbers(tag, "window").ok().flatten().map(|numbers| numbers[0]);
        let window = first(tags::WINDOW_CENTER).zip(first(tags::WINDOW_WIDTH));
        Some(SourceImage {
            study: SourceStudy {
                study_uid: uid(tags::STUDY_INSTANCE_UID)?,
                patient_name: self.decoded(tags::PATIENT_NAME),
                patient_id: self.decoded(tags::PATIENT_ID),
                patient_birth_date: self.decoded(tags::PATIENT_BIRTH_DATE),
                patient_sex: self.decoded(tags::PATIENT_SEX),
                study_date: self.decoded(tags::STUDY_DATE),
                study_time: self.decoded(tags::STUDY_TIME),
                study_id: self.decoded(tags::STUDY_ID),
                accession_number: self.decoded(tags::ACCESSION_NUMBER),
                referring_physician: self.decoded(tags::REFERRING_PHYSICIAN_NAME),
            },
            series_uid: uid(tags::SERIES_INSTANCE_UID)?,
            class_uid: uid(tags::SOP_CLASS_UID)?,
            instance_uid: uid(tags::SOP_INSTANCE_UID)?,
            size,
            window: window.map(|(centre, width)| [centre, width]),
        })
    }

    /// Returns a text in the character set that the file states; empty where it is missing.
    fn decoded(&self, tag: Tag) -> String {
        let Some((bytes, _)) = self.get(tag).and_then(|element| element.bytes()) else { return String::new() };
        let stated = self.text(tags::SPECIFIC_CHARACTER_SET).unwrap_or_default();
        // Of several sets, the first is that of texts without escape sequences.
        let code = stated.split('\\').next().unwrap_or_default().trim();
        let text = match SpecificCharacterSet::from_code(code) {
            Some(set) => set.decode(bytes),
            None => DefaultCharacterSetCodec.decode(bytes),
        };
        let text = text.unwrap_or_else(|_| String::from_utf8_lossy(bytes).into_owned());
        text.trim_matches(|c: char| c.is_whitespace() || c == '\0').to_owned()
    }
}
