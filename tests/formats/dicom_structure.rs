//! Elements of DICOM files as scanners and archives write them: whatever pydicom reads is read, with the same pixels.

use crate::dicom;
use crate::pydicom::Files;
use dicom_core::{DataElement, PrimitiveValue, VR};
use dicom_dictionary_std::tags;
use nertca_vk_import::dicom::Run;

#[test]
fn elements_of_unknown_type_hold_implicit_types() {
    let files = Files::by(
        "
write('open', before_pixels(element(0x19, 0x1010, b'UN', item(implicit(0x19, 0x10, b'TEST')) + END)))
inner = implicit(0x21, 0x1011, item(implicit(0x21, 0x1012, b'DEEP')) + END) + implicit(0x21, 0x1013, b'ab' * 500)
write('nested', before_pixels(element(0x21, 0x1010, b'UN', known_item(inner) + item(inner) + END)))
write('closed', before_pixels(element(0x19, 0x1010, b'UN', item(implicit(0x19, 0x10, b'TEST')))))
# Standard elements, of which some archive has lost the types.
lost = read()
for tag in ('PositionerPrimaryAngle', 'ImagerPixelSpacing', 'FrameTime'):
    del lost[tag]
b = io.BytesIO()
lost.save_as(b)
text = element(0x18, 0x1510, b'UN', b'30') + element(0x18, 0x1164, b'UN', b'2.0\\\\2.0 ') + element(0x18, 0x1063, b'UN', b'100 ')
write('lost', before_pixels(text, b.getvalue()))
# A whole sequence of unknown type: the table of a modality LUT, which squares.
square = (np.arange(256) ** 2).astype('<u2')
lut = implicit(0x28, 0x3002, struct.pack('<HHH', 256, 0, 16)) + implicit(0x28, 0x3006, square.tobytes())
end = DATA.index(bytes.fromhex('e07f1000') + b'OB')
data = DATA[:end] + element(0x28, 0x3000, b'UN', item(lut) + END) + DATA[end:]
(out / 'lut.dcm').write_bytes(data)
keep('lut', square[read().pixel_array])
",
    );
    for name in files.names() {
        let run = files.read(&name);
        let c_arm = &run.c_arms[0];
        assert_eq!((c_arm.primary_deg, c_arm.pixel_mm, run.times_s[1]), (30.0, [2.0; 2], 0.1), "{name}");
    }
    assert_eq!(files.names().len(), 5);
}

#[test]
fn values_that_look_like_items_are_none() {
    let files = Files::by(
        "
bad = bytes.fromhex('feff00e0')
for kind in (b'OB', b'UN', b'OW'):
    write(f'private-{kind.decode()}', before_pixels(element(0x19, 0x1010, kind, bad + b'x' * 60)))
    write(f'standard-{kind.decode()}', before_pixels(element(0x28, 0x1201, kind, bad + b'x' * 60)))
write('text', before_pixels(element(0x20, 0x4000, b'LT', bad + b'x' * 60)))
# With implicit types.
d = read()
d.add_new(0x00191010, 'OB', bad + b'x' * 60)
d.file_meta.TransferSyntaxUID = '1.2.840.10008.1.2'
b = io.BytesIO()
d.save_as(b)
write('implicit', b.getvalue())
# A palette, which nobody needs, in a sequence that is no sequence, and a number of three bytes.
write('broken', before_pixels(element(0x20, 0x9116, b'SQ', b'x' * 60) + element(0x20, 0x9057, b'UL', b'abc')))
# The pixels themselves.
start = DATA.index(bytes.fromhex('e07f1000') + b'OB') + 12
write('pixels', DATA[:start] + bad + DATA[start + 4:])
",
    );
    assert_eq!(files.names().len(), 10);
    files.names().iter().for_each(|name| drop(files.read(name)));
}

#[test]
fn the_pixel_data_may_be_followed_by_anything() {
    let files = Files::by(
        "
write('zeros', DATA + bytes(512))
write('odd', DATA + bytes(3))
write('trailing', DATA + element(0xfffc, 0xfffc, b'OB', bytes(100)))
(out / 'ones.dcm').write_bytes(DATA + b'\\xff' * 333)
keep('ones', read().pixel_array)
(out / 'text.dcm').write_bytes(DATA + b'-- end of file --\\n')
keep('text', read().pixel_array)
d = read()
d.compress(pydicom.uid.RLELossless)
b = io.BytesIO()
d.save_as(b)
write('compressed', b.getvalue() + bytes(512))
# The delimiter of the pixel data is missing.
(out / 'undelimited.dcm').write_bytes(b.getvalue()[:-8])
keep('undelimited', read().pixel_array)
(out / 'cut.dcm').write_bytes(DATA[:-100])
(out / 'cut-rle.dcm').write_bytes(b.getvalue()[:-100])
",
    );
    assert_eq!(files.names().len(), 7);
    files.names().iter().for_each(|name| drop(files.read(name)));
    assert!(files.read("text").notes.iter().any(|note| note.contains("after the pixel data")));
    for name in ["cut", "cut-rle"] {
        let told = files.refusal(name);
        assert!(told.contains("may be truncated") && told.contains(name), "{told}");
    }
}

#[test]
fn meta_information_is_not_needed() {
    let files = Files::by(
        "
start = DATA.index(bytes.fromhex('08001600') + b'UI')
write('bare', DATA[start:])
write('no-preamble', DATA[132:])
d = read()
d.file_meta.TransferSyntaxUID = '1.2.840.10008.1.2'
b = io.BytesIO()
d.save_as(b)
implicit_data = b.getvalue()
implicit_data = implicit_data[implicit_data.index(bytes.fromhex('08001600')):]
write('bare-implicit', implicit_data)
# The transfer syntax says the opposite.
write('wrong-explicit', DATA[:start] + implicit_data)
d.file_meta.TransferSyntaxUID = '1.2.840.10008.1.2'
b = io.BytesIO()
pydicom.filewriter.write_file_meta_info(b, d.file_meta, enforce_standard=False)
write('wrong-implicit', bytes(128) + b'DICM' + b.getvalue() + DATA[start:])
# No length of the group, and a name of 40 letters.
write('no-length', DATA[:132] + DATA[144:])
d = read()
d.file_meta.ImplementationVersionName = 'A_NAME_THAT_IS_LONGER_THAN_DICOM_ALLOWS '
b = io.BytesIO()
d.save_as(b, enforce_file_format=True)
write('long-name', b.getvalue())
d.file_meta.FileMetaInformationGroupLength = 1
b = io.BytesIO()
pydicom.filewriter.write_file_meta_info(b, d.file_meta, enforce_standard=False)
(out / 'wrong-length.dcm').write_bytes(bytes(128) + b'DICM' + b.getvalue() + DATA[start:])
keep('wrong-length', read().pixel_array)
(out / 'text.dcm').write_bytes(b'a letter to whom it may concern' * 20)
",
    );
    assert_eq!(files.names().len(), 8);
    for name in files.names() {
        let run = files.read(&name);
        assert_eq!((run.c_arms[0].primary_deg, run.times_s[1]), (30.0, 0.1), "{name}");
    }
    assert!(files.read("bare").notes.join("\n").contains("no preamble"));
    assert!(files.read("wrong-explicit").notes.join("\n").contains("have no types"));
    assert!(files.refusal("text").contains("not a DICOM file"));
}

#[test]
fn encodings_give_the_same_pixels() {
    let files = Files::by(
        "
def dcm_big(name, dataset, values):
    assert len([element.value for element in dataset]) > 10
    pydicom.dcmwrite(out / f'{name}.dcm', dataset)
    keep(name, values)
d = read()
pixels = d.pixel_array
d.file_meta.TransferSyntaxUID = pydicom.uid.ImplicitVRLittleEndian
save('implicit', d, pixels)
d.file_meta.TransferSyntaxUID = pydicom.uid.DeflatedExplicitVRLittleEndian
save('deflated', d, pixels)
d.file_meta.TransferSyntaxUID = pydicom.uid.ExplicitVRBigEndian
dcm_big('big', d, pixels)
# Bytes in words: each pair is the other way round.
d['PixelData'].VR = 'OW'
d.PixelData = pixels.view('<u2').astype('>u2').tobytes()
dcm_big('big-words', d, pixels)
# Twelve bits: unsigned, signed, and beside an overlay in the unused bits.
deep = (pixels.astype('u2') << 4) + 5
d = read()
d.BitsAllocated, d.BitsStored, d.HighBit = 16, 12, 11
d['PixelData'].VR = 'OW'
d.PixelData = deep.astype('<u2').tobytes()
save('twelve', d, deep)
d.PixelData = (deep | 0xa000).astype('<u2').tobytes()
save('overlay', d, deep)
d.PixelRepresentation = 1
signed = deep.astype('i2') - 2048
d.PixelData = signed.astype('<i2').tobytes()
save('signed', d, signed)
d.PixelData = (signed & 0xfff).astype('<u2').tobytes()
save('signed-masked', d, signed)
d.file_meta.TransferSyntaxUID = pydicom.uid.ExplicitVRBigEndian
d.PixelData = signed.astype('>i2').tobytes()
dcm_big('big-signed', d, signed)
for name in ('twelve', 'overlay', 'signed', 'signed-masked', 'big', 'big-signed', 'big-words'):
    wanted = np.fromfile(out / f'{name}.values', '<f4').reshape(6, 64, 64)
    assert (pydicom.dcmread(out / f'{name}.dcm').pixel_array == wanted).all(), name
",
    );
    assert_eq!(files.names().len(), 9);
    files.names().iter().for_each(|name| drop(files.read(name)));
}

#[test]
fn sequences_within_sequences_end_somewhere() {
    let nested = |depth: usize| {
        let files = Files::by(&format!(
            "
inner = element(0x20, 0x10, b'SH', b'x ')
for _ in range({depth}):
    inner = element(0x20, 0x9116, b'SQ', item(inner) + END)
(out / 'nested.dcm').write_bytes(before_pixels(inner))
keep('nested', read().pixel_array)
"
        ));
        Run::read(&files.path("nested"), None).map(|run| run.frames.len())
    };
    assert_eq!(nested(40).unwrap(), 6);
    assert!(nested(2000).unwrap_err().to_string().contains("nested more than 64 deep"));
}

#[test]
fn numbers_of_a_wrong_size_are_named_where_they_are_needed() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("run.dcm");
    dicom::angiogram(&file, |o| {
        o.put(DataElement::new(tags::ROWS, VR::OB, PrimitiveValue::from(vec![64u8, 0])));
    });
    let told = Run::read(&file, None).err().unwrap().to_string();
    assert!(told.contains("(0028,0010) Rows") && told.contains("OB"), "{told}");
}
