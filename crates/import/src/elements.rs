//! Elements of a DICOM file. Lengths that elements state are checked against the file before anything of that length is read. What
//! the import does not use, such as private elements, is passed over by its length.
//!
//! Files of scanners and archives break rules in ways that other readers accept, and so does this one: see [`read`].

use crate::error::{Error, Result};
use dicom_core::dictionary::{DataDictionary, DataDictionaryEntry};
use dicom_core::{Tag, VR};
use dicom_dictionary_std::{StandardDataDictionary, tags};
use std::collections::BTreeMap;
use std::io::{BufReader, Cursor, Read, Seek};
use std::path::Path;

/// Largest accepted nesting depth of sequences.
const DEEPEST: u32 = 64;
const UNDEFINED: u32 = u32::MAX;
/// Largest size of a deflated data set, inflated: a small file could claim a thousand times its own size.
const MAX_INFLATED_BYTES: u64 = 1 << 30;
const PREAMBLE_BYTES: u64 = 128;
const PREFIX: &[u8] = b"DICM";
/// Shortest element: a tag and a length.
const SHORTEST_ELEMENT: u64 = 8;
const META_GROUP: u16 = 0x0002;
/// Group with which data sets begin.
const FIRST_GROUP: u16 = 0x0008;
/// Group of items and of their delimiters, which have no type.
const ITEM_GROUP: u16 = 0xfffe;
const ITEM: Tag = Tag(ITEM_GROUP, 0xe000);
const ITEM_END: Tag = Tag(ITEM_GROUP, 0xe00d);
const SEQUENCE_END: Tag = Tag(ITEM_GROUP, 0xe0dd);

/// UIDs of the transfer syntaxes that decide how elements are encoded.
pub(super) mod syntax {
    pub(crate) const IMPLICIT: &str = "1.2.840.10008.1.2";
    pub(crate) const EXPLICIT: &str = "1.2.840.10008.1.2.1";
    pub(crate) const DEFLATED: &str = "1.2.840.10008.1.2.1.99";
    pub(crate) const EXPLICIT_BIG_ENDIAN: &str = "1.2.840.10008.1.2.2";
    /// Beginning of all UIDs that the DICOM standard defines.
    pub(crate) const STANDARD: &str = "1.2.840.10008.";
}

/// Encoding of elements.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Encoding {
    big_endian: bool,
    /// Whether elements do not state their types.
    implicit: bool,
}

/// Part 5, 6.2.2: the content of an element of unknown type and undefined length, whatever the rest of the file has.
const INSIDE_UNKNOWN: Encoding = Encoding { big_endian: false, implicit: true };

/// Elements of a data set or of an item of a sequence.
#[derive(Debug, Default)]
pub(super) struct DataSet(BTreeMap<Tag, Element>);

impl DataSet {
    pub(super) fn get(&self, tag: Tag) -> Option<&Element> {
        self.0.get(&tag)
    }
}

/// An element with its type, which the file states or the dictionary knows; [`VR::UN`] where neither does.
#[derive(Debug)]
pub(super) struct Element {
    pub(super) vr: VR,
    pub(super) value: Value,
}

/// Value of an element.
#[derive(Debug)]
pub(super) enum Value {
    Bytes {
        bytes: Vec<u8>,
        big_endian: bool,
    },
    Items(Vec<DataSet>),
    Fragments(Fragments),
    /// A sequence that could not be read, with the problem: an error for whoever needs it.
    Broken(String),
}

/// Encapsulated pixel data.
#[derive(Debug, Default)]
pub(super) struct Fragments {
    /// Basic offset table: places of the frames' first fragments; often empty.
    pub(super) offsets: Vec<u64>,
    pub(super) fragments: Vec<Vec<u8>>,
}

/// Content of a DICOM file.
pub(super) struct Content {
    /// UID of the transfer syntax.
    pub(super) syntax: String,
    pub(super) data: DataSet,
    /// Notes on rules that the file breaks.
    pub(super) notes: Vec<String>,
}

/// Reads a file. It may lack the preamble and the file meta information, whose lengths and names are not needed; its elements may
/// have types where the transfer syntax says that they have none, and the reverse, as a whole or one by one; standard
/// elements of unknown type (UN) get the type of the dictionary; and the pixel data may be followed by anything.
///
/// # Errors
/// [`Error::Data`] naming the element; [`Error::Io`].
pub(super) fn read(path: &Path) -> Result<Content> {
    let file = std::fs::File::open(path).map_err(Error::io("read", path))?;
    let end = file.metadata().map_err(Error::io("read", path))?.len();
    let mut w = Walker { file: BufReader::new(file), at: 0, end, path };
    let mut notes = Vec::new();
    w.skip_preamble(&mut notes)?;
    let syntax = w.meta_syntax()?;
    if let Some(syntax) = syntax.as_deref().filter(|syntax| !syntax.starts_with(syntax::STANDARD)) {
        let problem = format!(
            "{syntax} is a private transfer syntax, which only its maker defines; export the run again as Explicit VR Little \
             Endian, or try `gdcmconv --raw`"
        );
        return Err(Error::data(path, "(0002,0010) TransferSyntaxUID", problem));
    }
    match syntax.as_deref() {
        Some(syntax::DEFLATED) => {
            let mut bytes = Vec::new();
            let inflated =
                flate2::read::DeflateDecoder::new(w.file).take(MAX_INFLATED_BYTES + 1).read_to_end(&mut bytes);
            inflated.map_err(|e| Error::data(path, "DICOM", format!("the deflated data set is damaged: {e}")))?;
            if bytes.len() as u64 > MAX_INFLATED_BYTES {
                let problem = format!(
                    "the deflated data set has more than {} MB; convert the file, for example with `dcmconv +te FILE NEW.dcm`",
                    MAX_INFLATED_BYTES >> 20
                );
                return Err(Error::data(path, "DICOM", problem));
            }
            let end = bytes.len() as u64;
            Walker { file: Cursor::new(bytes), at: 0, end, path }.content(syntax, notes)
        }
        _ => w.content(syntax, notes),
    }
}

struct Walker<'a, R> {
    file: R,
    at: u64,
    end: u64,
    path: &'a Path,
}

/// Beginning of an element.
struct Header {
    tag: Tag,
    /// Type that the file states.
    vr: Option<VR>,
    length: u32,
}

impl Header {
    /// Type that the file states, or else that of the dictionary.
    fn kind(&self) -> VR {
        match self.vr {
            Some(vr) if vr != VR::UN => vr,
            _ => StandardDataDictionary.by_tag(self.tag).map_or(VR::UN, |entry| entry.vr().relaxed()),
        }
    }

    fn is_private(&self) -> bool {
        self.tag.group() % 2 == 1
    }
}

/// Step of a walk through elements.
enum Step {
    Element(Tag, Element),
    /// An element that is not kept.
    Passed,
    EndOfItem,
}

impl<R: Read + Seek> Walker<'_, R> {
    fn short(&self) -> Error {
        Error::data(self.path, "DICOM", format!("ends inside an element at byte {}; it may be truncated", self.at))
    }

    fn left(&self) -> u64 {
        self.end.saturating_sub(self.at)
    }

    fn take(&mut self, n: u64) -> Result<Vec<u8>> {
        if self.left() < n {
            return Err(self.short());
        }
        let mut bytes = vec![0; n as usize];
        self.file.read_exact(&mut bytes).map_err(Error::io("read", self.path))?;
        self.at += n;
        Ok(bytes)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N]> {
        if self.left() < N as u64 {
            return Err(self.short());
        }
        let mut bytes = [0; N];
        self.file.read_exact(&mut bytes).map_err(Error::io("read", self.path))?;
        self.at += N as u64;
        Ok(bytes)
    }

    fn seek(&mut self, to: u64) -> Result<()> {
        // Most steps end within the buffer, which a relative seek keeps.
        self.file.seek_relative(to as i64 - self.at as i64).map_err(Error::io("read", self.path))?;
        self.at = to;
        Ok(())
    }

    /// Returns the next bytes without passing them; fewer at the end of the file.
    fn peek(&mut self, n: u64) -> Result<Vec<u8>> {
        let begin = self.at;
        let bytes = self.take(n.min(self.left()))?;
        self.seek(begin)?;
        Ok(bytes)
    }

    fn skip_preamble(&mut self, notes: &mut Vec<String>) -> Result<()> {
        let head = self.peek(PREAMBLE_BYTES + PREFIX.len() as u64)?;
        if head.get(PREAMBLE_BYTES as usize..) == Some(PREFIX) {
            return self.seek(PREAMBLE_BYTES + PREFIX.len() as u64);
        }
        let [first, swapped] = match head[..] {
            [a, b, ..] => [u16::from_le_bytes([a, b]), u16::from_be_bytes([a, b])],
            _ => return Err(self.short()),
        };
        if ![META_GROUP, FIRST_GROUP].contains(&first) && swapped != FIRST_GROUP {
            let problem =
                "has no DICM after its preamble, and does not begin with an element, so it is not a DICOM file";
            return Err(Error::data(self.path, "DICOM", problem));
        }
        notes.push("the file has no preamble; it was read from its first byte on".into());
        Ok(())
    }

    /// Reads the file meta information and returns the UID of the transfer syntax.
    fn meta_syntax(&mut self) -> Result<Option<String>> {
        // The meta information is always little endian with explicit types.
        let encoding = Encoding { big_endian: false, implicit: false };
        let mut syntax = None;
        while self.peek(2)? == META_GROUP.to_le_bytes() {
            let Header { tag, length, .. } = self.header(encoding)?;
            self.fits(tag, length)?;
            let value = self.take(length.into())?;
            if tag == tags::TRANSFER_SYNTAX_UID {
                syntax = Some(text_of(&value)).filter(|uid| !uid.is_empty());
            }
        }
        Ok(syntax)
    }

    /// Reads the data set from here on.
    fn content(mut self, syntax: Option<String>, mut notes: Vec<String>) -> Result<Content> {
        let first = self.peek(6)?;
        let typed = first.get(4..6).is_some_and(is_known_type);
        let big_endian = match syntax.as_deref() {
            Some(syntax) => syntax == syntax::EXPLICIT_BIG_ENDIAN,
            None => first.get(..2) == Some(&FIRST_GROUP.to_be_bytes()),
        };
        let encoding = Encoding { big_endian, implicit: !typed };
        let found = match (typed, big_endian) {
            (true, true) => syntax::EXPLICIT_BIG_ENDIAN,
            (true, false) => syntax::EXPLICIT,
            (false, _) => syntax::IMPLICIT,
        };
        match syntax.as_deref() {
            None => notes.push("TransferSyntaxUID is missing; it was recognised from the first element".into()),
            Some(syntax::IMPLICIT) if typed => {
                notes.push("elements have types, though the transfer syntax says that they have none".into());
            }
            Some(syntax) if syntax != syntax::IMPLICIT && !typed => {
                notes.push("elements have no types, though the transfer syntax says that they have".into());
            }
            Some(_) => {}
        }
        let data = self.data_set(encoding, &mut notes)?;
        Ok(Content { syntax: syntax.unwrap_or_else(|| found.to_owned()), data, notes })
    }

    fn data_set(&mut self, encoding: Encoding, notes: &mut Vec<String>) -> Result<DataSet> {
        let mut found = DataSet::default();
        while self.at < self.end {
            let begin = self.at;
            match self.element(0, encoding) {
                Ok(Step::Element(tag, element)) => {
                    found.0.insert(tag, element);
                }
                Ok(Step::Passed | Step::EndOfItem) => {}
                // Nothing that belongs to the image is left.
                Err(Error::Data { .. }) if found.get(tags::PIXEL_DATA).is_some() => {
                    notes.push(format!("{} bytes after the pixel data are no elements", self.end - begin));
                    break;
                }
                Err(error) => return Err(error),
            }
        }
        Ok(found)
    }

    /// Reads the beginning of an element.
    fn header(&mut self, encoding: Encoding) -> Result<Header> {
        let number = |b: [u8; 2]| if encoding.big_endian { u16::from_be_bytes(b) } else { u16::from_le_bytes(b) };
        let long = |b: [u8; 4]| if encoding.big_endian { u32::from_be_bytes(b) } else { u32::from_le_bytes(b) };
        let [a, b, c, d, e, f, g, h] = self.array()?;
        let (tag, rest) = (Tag(number([a, b]), number([c, d])), [e, f, g, h]);
        // An element without letters where its type should be has none, in files that mix both encodings.
        if encoding.implicit || tag.group() == ITEM_GROUP || !(e.is_ascii_uppercase() && f.is_ascii_uppercase()) {
            return Ok(Header { tag, vr: None, length: long(rest) });
        }
        // Unknown types have 32-bit lengths, like the newer types.
        let vr = VR::from_binary([e, f]).unwrap_or(VR::UN);
        let length = if has_short_length(&[e, f]) { number([g, h]).into() } else { long(self.array()?) };
        Ok(Header { tag, vr: Some(vr), length })
    }

    fn fits(&self, tag: Tag, length: u32) -> Result<()> {
        if u64::from(length) <= self.left() {
            return Ok(());
        }
        let problem = format!("states {length} bytes, but the file has only {} left; it may be truncated", self.left());
        Err(Error::data(self.path, name_of(tag), problem))
    }

    /// Reads an element at a nesting depth.
    fn element(&mut self, depth: u32, encoding: Encoding) -> Result<Step> {
        let header = self.header(encoding)?;
        let Header { tag, length, .. } = header;
        match tag {
            ITEM_END => return Ok(Step::EndOfItem),
            SEQUENCE_END => return Ok(Step::Passed),
            _ => {}
        }
        let kind = header.kind();
        if length == UNDEFINED {
            let value = match kind {
                _ if tag == tags::PIXEL_DATA => Value::Fragments(self.fragments(encoding)?),
                VR::OB | VR::OW | VR::OD | VR::OF | VR::OL | VR::OV => Value::Fragments(self.fragments(encoding)?),
                _ => Value::Items(self.open_sequence(depth, self.encoding_inside(&header, encoding), encoding)?),
            };
            return Ok(if header.is_private() {
                Step::Passed
            } else {
                Step::Element(tag, Element { vr: kind, value })
            });
        }
        self.fits(tag, length)?;
        let after = self.at + u64::from(length);
        if header.is_private() || tag.group() == 0 || tag.element() == 0 {
            self.seek(after)?;
            return Ok(Step::Passed);
        }
        let inside = self.encoding_inside(&header, encoding);
        let value = if kind == VR::SQ {
            let read = self.items(after, depth + 1, inside);
            self.seek(after)?;
            match read {
                Ok(items) => Value::Items(items),
                Err(Error::Data { field, problem, .. }) => Value::Broken(format!("{field}: {problem}")),
                Err(error) => return Err(error),
            }
        } else {
            Value::Bytes { bytes: self.take(length.into())?, big_endian: inside.big_endian }
        };
        Ok(Step::Element(tag, Element { vr: kind, value }))
    }

    fn encoding_inside(&self, header: &Header, encoding: Encoding) -> Encoding {
        if header.vr == Some(VR::UN) { INSIDE_UNKNOWN } else { encoding }
    }

    /// Reads the items of a sequence of undefined length.
    fn open_sequence(&mut self, depth: u32, inside: Encoding, encoding: Encoding) -> Result<Vec<DataSet>> {
        let begin = self.at;
        match self.items(self.end, depth + 1, inside) {
            // Some writers leave the types where there should be none. The outermost sequence alone is read twice, as otherwise
            // the work could double with each level.
            Err(Error::Data { .. }) if depth == 0 && inside != encoding => {
                self.seek(begin)?;
                self.items(self.end, depth + 1, encoding)
            }
            read => read,
        }
    }

    /// Reads items up to a position in the file, or to the delimiter of their sequence.
    fn items(&mut self, end: u64, depth: u32, encoding: Encoding) -> Result<Vec<DataSet>> {
        if depth > DEEPEST {
            return Err(Error::data(self.path, "DICOM", format!("sequences are nested more than {DEEPEST} deep")));
        }
        let mut items = Vec::new();
        while self.at < end {
            let Header { tag, length, .. } = self.header(encoding)?;
            match tag {
                SEQUENCE_END => break,
                ITEM if length == UNDEFINED => items.push(self.item(self.end, depth, encoding)?),
                ITEM => {
                    self.fits(tag, length)?;
                    let after = self.at + u64::from(length);
                    items.push(self.item(after, depth, encoding)?);
                    self.seek(after)?;
                }
                // A delimiter that an item of known length does not need.
                ITEM_END => {}
                _ => return Err(Error::data(self.path, name_of(tag), "was found where an item is expected")),
            }
        }
        Ok(items)
    }

    fn item(&mut self, end: u64, depth: u32, encoding: Encoding) -> Result<DataSet> {
        let mut found = DataSet::default();
        while self.at < end {
            match self.element(depth, encoding)? {
                Step::Element(tag, element) => {
                    found.0.insert(tag, element);
                }
                Step::Passed => {}
                Step::EndOfItem => break,
            }
        }
        Ok(found)
    }

    /// Reads encapsulated pixel data up to their delimiter, or to the end of the file where that is missing.
    fn fragments(&mut self, encoding: Encoding) -> Result<Fragments> {
        let mut items: Vec<Vec<u8>> = Vec::new();
        while self.left() >= SHORTEST_ELEMENT {
            let Header { tag, length, .. } = self.header(encoding)?;
            match tag {
                SEQUENCE_END => break,
                ITEM => {
                    self.fits(tag, length)?;
                    items.push(self.take(length.into())?);
                }
                _ => {
                    return Err(Error::data(
                        self.path,
                        name_of(tag),
                        "was found where a fragment of pixel data is expected",
                    ));
                }
            }
        }
        if items.is_empty() {
            return Ok(Fragments::default());
        }
        let table = items.remove(0);
        let offsets = table.chunks_exact(4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]).into()).collect();
        Ok(Fragments { offsets, fragments: items })
    }
}

/// Types whose lengths have 16 bits in files with explicit types.
fn has_short_length(vr: &[u8]) -> bool {
    const SHORT: &[u8] = b"AE AS AT CS DA DS DT FL FD IS LO LT PN SH SL SS ST TM UI UL US";
    SHORT.chunks(3).any(|known| known[..2] == *vr)
}

fn is_known_type(vr: &[u8]) -> bool {
    <[u8; 2]>::try_from(vr).is_ok_and(|vr| VR::from_binary(vr).is_some())
}

fn name_of(tag: Tag) -> String {
    format!("({:04X},{:04X})", tag.group(), tag.element())
}

/// Text without the padding of its ends.
pub(super) fn text_of(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).trim_matches(|c: char| c.is_whitespace() || c == '\0').to_owned()
}

impl Element {
    /// Text without the padding of its ends; none for numbers and sequences.
    pub(super) fn text(&self) -> Option<String> {
        match &self.value {
            Value::Bytes { bytes, .. } => Some(text_of(bytes)),
            _ => None,
        }
    }

    /// Bytes as the file has them, and whether numbers among them are big endian.
    pub(super) fn bytes(&self) -> Option<(&[u8], bool)> {
        match &self.value {
            Value::Bytes { bytes, big_endian } => Some((bytes, *big_endian)),
            _ => None,
        }
    }

    /// Numbers, stored as such or as text.
    ///
    /// # Errors
    /// The problem of a value that holds none.
    pub(super) fn numbers(&self) -> std::result::Result<Vec<f64>, String> {
        let (bytes, big_endian) = match &self.value {
            Value::Bytes { bytes, big_endian } => (bytes, *big_endian),
            Value::Broken(problem) => return Err(problem.clone()),
            Value::Items(_) | Value::Fragments(_) => return Err("is no list of numbers".into()),
        };
        match self.vr {
            VR::US | VR::OW => numbers(bytes, big_endian, |b| u16::from_le_bytes(b).into()),
            VR::SS => numbers(bytes, big_endian, |b| i16::from_le_bytes(b).into()),
            VR::UL | VR::OL => numbers(bytes, big_endian, |b| u32::from_le_bytes(b).into()),
            VR::SL => numbers(bytes, big_endian, |b| i32::from_le_bytes(b).into()),
            VR::UV | VR::OV => numbers(bytes, big_endian, |b| u64::from_le_bytes(b) as f64),
            VR::SV => numbers(bytes, big_endian, |b| i64::from_le_bytes(b) as f64),
            VR::FL | VR::OF => numbers(bytes, big_endian, |b| f32::from_le_bytes(b).into()),
            VR::FD | VR::OD => numbers(bytes, big_endian, f64::from_le_bytes),
            VR::OB | VR::UN | VR::AT => Err(format!("has the type {}, which holds no numbers", self.vr)),
            _ => match text_of(bytes) {
                empty if empty.is_empty() => Ok(Vec::new()),
                list => list.split('\\').map(number_of).collect(),
            },
        }
    }

    /// Tags that an element lists.
    pub(super) fn tags(&self) -> Vec<Tag> {
        let Some((bytes, big_endian)) = self.bytes() else { return Vec::new() };
        let halves: Vec<u16> = numbers(bytes, big_endian, u16::from_le_bytes).unwrap_or_default();
        halves.chunks_exact(2).map(|pair| Tag(pair[0], pair[1])).collect()
    }
}

fn number_of(text: &str) -> std::result::Result<f64, String> {
    let text = text.trim_matches(|c: char| c.is_whitespace() || c == '\0');
    text.parse().map_err(|_| format!("`{text}` is not a number"))
}

/// Numbers of N bytes each.
pub(super) fn numbers<const N: usize, T>(
    bytes: &[u8],
    big_endian: bool,
    number: impl Fn([u8; N]) -> T,
) -> std::result::Result<Vec<T>, String> {
    let (parts, rest) = bytes.as_chunks::<N>();
    if !rest.is_empty() {
        return Err(format!("has {} bytes, which is not a multiple of {N}, the size of its numbers", bytes.len()));
    }
    let ordered = |mut part: [u8; N]| {
        if big_endian {
            part.reverse();
        }
        part
    };
    Ok(parts.iter().map(|part| number(ordered(*part))).collect())
}
