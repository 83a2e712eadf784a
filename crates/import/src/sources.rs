//! Identity of a run's file, for an import that keeps references.

use crate::reader::Reader;
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
        let bytes = self.get(tag).and_then(|element| element.bytes()).map_or(&[][..], |(bytes, _)| bytes);
        text_in(bytes, &self.text(tags::SPECIFIC_CHARACTER_SET).unwrap_or_default())
    }
}

/// Decodes a text in stated character sets (PS3.3 C.12.1.1.2). Of several sets, which texts change by escape sequences, the first is used: a name
/// keeps its first form, which has no such sequences.
fn text_in(bytes: &[u8], stated: &str) -> String {
    let mut sets = stated.split('\\').map(str::trim);
    let set = SpecificCharacterSet::from_code(sets.next().unwrap_or_default());
    let bytes = match sets.next() {
        Some(_) => bytes.split(|byte| *byte == b'=').next().unwrap_or_default(),
        None => bytes,
    };
    let decoded = match set {
        Some(set) => set.decode(bytes),
        None => DefaultCharacterSetCodec.decode(bytes),
    };
    let text = decoded.unwrap_or_else(|_| String::from_utf8_lossy(bytes).into_owned());
    text.chars().filter(|c| !c.is_control()).collect::<String>().trim().to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_are_decoded_as_the_file_states() {
        let of = |bytes: &[u8], stated: &str| text_in(bytes, stated);
        assert_eq!(of(b"M\xfcller^J\xf6rg ", "ISO_IR 100"), "Müller^Jörg");
        assert_eq!(of("Müller^Jörg".as_bytes(), "ISO_IR 192"), "Müller^Jörg");
        // The Russian example of PS3.5, H.2.
        assert_eq!(of(b"\xbb\xee\xda\x63\x65\xdc\xd1\x79\x70\xd3\0", "ISO_IR 144 "), "Люкceмбypг");
        // The example H.3-1 of PS3.5: romanized, ideographic and phonetic form of a name.
        let japanese = b"Yamada^Tarou=\x1b$B;3ED\x1b(B^\x1b$BB@O:\x1b(B=\x1b$B$d$^$@\x1b(B^\x1b$B$?$m$&\x1b(B";
        assert_eq!(of(japanese, "\\ISO 2022 IR 87"), "Yamada^Tarou");
        assert_eq!(of(b"Doe^Jane", ""), "Doe^Jane");
        assert_eq!(of(b"Doe^Jane", "unknown"), "Doe^Jane");
        assert_eq!(of(b"", "ISO_IR 100"), "");
    }
}
