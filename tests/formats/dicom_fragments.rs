//! Compressed frames in fragments: which belong together follows from offset tables that agree with the fragments, or from markers.

use crate::dicom::compressed_run;
use crate::pydicom::Files;
use nertca_vk_import::dicom::Run;

/// Names for the scripts: `lossless` and `baseline` have the JPEG images of all frames, `SYNTAX` their transfer syntaxes.
const JPEG: &str = "
import SimpleITK, PIL.Image
from pydicom import encaps
pixels = read().pixel_array
def lossless(frame):
    writer = SimpleITK.ImageFileWriter()
    writer.SetImageIO('GDCMImageIO')
    writer.UseCompressionOn()
    writer.SetCompressor('JPEG')
    path = str(out / 'one.dat')
    writer.SetFileName(path)
    writer.Execute(SimpleITK.GetImageFromArray(frame[None]))
    return next(encaps.generate_frames(pydicom.dcmread(path).PixelData, number_of_frames=1))
LOSSLESS = pydicom.uid.JPEGLosslessSV1
frames = [lossless(frame) for frame in pixels]
def compressed(name, data, syntax=LOSSLESS, values=pixels, change=lambda d: None):
    d = read()
    d.file_meta.TransferSyntaxUID = syntax
    d.PixelData = data
    d['PixelData'].VR = 'OB'
    d['PixelData'].is_undefined_length = True
    change(d)
    save(name, d, values)
def items(table, parts):
    item = lambda b: bytes.fromhex('feff00e0') + struct.pack('<I', len(b)) + b
    return item(struct.pack(f'<{len(table)}I', *table)) + b''.join(item(p) for p in parts)
# Fragments of even lengths, as many of each frame as `counts` says, and the true offsets of the frames.
def split(frames, counts):
    parts, offsets, at = [], [], 0
    for frame, count in zip(frames, counts):
        frame = frame + b'\\0' * (len(frame) % 2)
        step = max(2, len(frame) // count // 2 * 2)
        cuts = [k * step for k in range(count)] + [len(frame)]
        offsets.append(at)
        for a, b in zip(cuts, cuts[1:]):
            parts.append(frame[a:b])
            at += 8 + b - a
    return parts, offsets
";

fn files(script: &str) -> Files {
    Files::by(&format!("{JPEG}{script}"))
}

#[test]
fn frames_are_put_together_from_their_fragments() {
    let files = files(
        "
counts = [1, 2, 1, 3, 2, 1]
parts, offsets = split(frames, counts)
compressed('no-table', items([], parts))
compressed('table', items(offsets, parts))
compressed('zero-table', items([0] * 6, parts))
compressed('shifted-table', items([o + 2 for o in offsets], parts))
compressed('short-table', items(offsets[:3], parts))
# Offsets of fragments, but not of those with which frames begin.
places = np.cumsum([0] + [8 + len(p) for p in parts])
compressed('wrong-table', items([int(places[k]) for k in (0, 1, 2, 4, 5, 8)], parts))
even, _ = split(frames, [2] * 6)
compressed('two-each', items([], even))
compressed('one-each', items([], split(frames, [1] * 6)[0]))
# Zeros after the end of the image.
compressed('padded', items([], [p + bytes(6) if p.rstrip(b'\\0').endswith(b'\\xff\\xd9') else p for p in parts]))
# An extended table, and a basic one that is empty, as it has to be.
def extended(d):
    d.ExtendedOffsetTable = struct.pack('<6Q', *offsets)
    d.ExtendedOffsetTableLengths = struct.pack('<6Q', *map(len, frames))
compressed('extended', items([], parts), change=extended)
def wrong(d):
    d.ExtendedOffsetTable = struct.pack('<6Q', *range(6))
compressed('wrong-extended', items(offsets, parts), change=wrong)
# One frame in three fragments, with and without a table.
def one(d):
    d.NumberOfFrames = 1
for name, table in (('one', []), ('one-table', [0])):
    compressed(name, items(table, split(frames[:1], [3])[0]), values=pixels[:1], change=one)
# pydicom finds the same frames.
for name in ('no-table', 'table', 'two-each', 'padded', 'extended'):
    d = pydicom.dcmread(out / f'{name}.dcm')
    extension = (d.ExtendedOffsetTable, d.ExtendedOffsetTableLengths) if 'ExtendedOffsetTable' in d else None
    found = list(encaps.generate_frames(d.PixelData, number_of_frames=6, extended_offsets=extension))
    strip = lambda frame: frame.rstrip(b'\\0')
    assert [strip(f) for f in found] == [strip(f) for f in frames] or name == 'extended', name
# Nothing tells where frames begin.
(out / 'lost.dcm').write_bytes((out / 'no-table.dcm').read_bytes().replace(b'\\xff\\xd9', b'\\xff\\xd0').replace(b'\\xff\\xd8', b'\\xff\\xd1'))
few = split(frames[:5], [1] * 5)[0]
compressed('few', items([], few))
",
    );
    let names: Vec<String> = files.names().into_iter().filter(|name| name != "few").collect();
    assert_eq!(names.len(), 13);
    for name in &names {
        let told = files.read(name).notes.join("\n");
        let wrong =
            ["zero-table", "shifted-table", "short-table", "wrong-table", "wrong-extended"].contains(&name.as_str());
        assert_eq!(told.contains("does not agree with the fragments"), wrong, "{name}: {told}");
    }
    assert!(files.refusal("lost").contains("tell where frames begin"), "{}", files.refusal("lost"));
    assert!(files.refusal("few").contains("5 fragments, but 6 frames"), "{}", files.refusal("few"));
}

#[test]
fn run_length_frames_are_read() {
    let files = files(
        "
d = read()
d.compress(pydicom.uid.RLELossless)
save('eight', d, pixels)
packed = list(encaps.generate_frames(d.PixelData, number_of_frames=6))
counts = [1, 2, 1, 1, 3, 1]
parts, offsets = split(packed, counts)
compressed('fragments', items(offsets, parts), syntax=pydicom.uid.RLELossless)
compressed('lost', items([], parts), syntax=pydicom.uid.RLELossless)
deep = (pixels.astype('i2') << 4) - 2048
def wide(d):
    d.BitsAllocated, d.BitsStored, d.HighBit, d.PixelRepresentation = 16, 12, 11, 1
d = read()
wide(d)
d['PixelData'].VR = 'OW'
d.PixelData = deep.tobytes()
d.compress(pydicom.uid.RLELossless)
assert (pydicom.dcmread(io.BytesIO((lambda b: (d.save_as(b), b.getvalue())[1])(io.BytesIO()))).pixel_array == deep).all()
save('sixteen', d, deep)
packed = list(encaps.generate_frames(d.PixelData, number_of_frames=6))
# Damaged in frame 3: no bytes, half of them, a segment that lies elsewhere, one segment of two.
damages = {
    'empty': b'', 'half': packed[2][:len(packed[2]) // 4 * 2], 'elsewhere': packed[2][:8] + b'\\xff\\xff\\xff\\x0f' + packed[2][12:],
    'single': b'\\1' + packed[2][1:],
}
for name, damage in damages.items():
    compressed('bad-' + name, items([], packed[:2] + [damage] + packed[3:]), syntax=pydicom.uid.RLELossless, change=wide)
",
    );
    for name in ["eight", "fragments", "sixteen"] {
        files.read(name);
    }
    assert!(files.refusal("lost").contains("tell where frames begin"));
    for (name, told) in
        [("empty", "header is incomplete"), ("half", "RLE segment"), ("elsewhere", "RLE segment 0 lies outside")]
    {
        let refusal = files.refusal(&format!("bad-{name}"));
        assert!(refusal.contains("frame 3") && refusal.contains(told), "{name}: {refusal}");
    }
    assert!(files.refusal("bad-single").contains("has 1 segments where 2 are needed"));
}

#[test]
fn jpeg_frames_are_read_or_named() {
    let files = files(
        "
def baseline(frame):
    b = io.BytesIO()
    PIL.Image.fromarray(frame).save(b, 'JPEG', quality=95)
    return b.getvalue()
lossy = [baseline(frame) for frame in pixels]
flat = [baseline(np.full((64, 64), 16 * k + 40, 'u1')) for k in range(6)]
compressed('flat', items([], split(flat, [1, 2, 1, 1, 1, 1])[0]), syntax=pydicom.uid.JPEGBaseline8Bit,
           values=np.repeat(16 * np.arange(6) + 40, 4096))
deep = (pixels.astype('u2') << 8) + 77
def wide(d):
    d.BitsAllocated, d.BitsStored, d.HighBit = 16, 16, 15
compressed('sixteen', items([], split([lossless(f) for f in deep], [1] * 6)[0]), values=deep, change=wide)
other = baseline(np.zeros((64, 63), 'u1'))
compressed('size', items([], split(lossy[:3] + [other] + lossy[4:], [1] * 6)[0]), syntax=pydicom.uid.JPEGBaseline8Bit)
cut = [f[:200] for f in frames]
compressed('cut', items([], split(cut, [1] * 6)[0]))
# Twelve bits: a lossy image whose header says so.
twelve = [f.replace(b'\\xff\\xc0\\0\\x0b\\x08', b'\\xff\\xc1\\0\\x0b\\x0c') for f in lossy]
assert twelve != lossy
compressed('twelve', items([], split(twelve, [1] * 6)[0]), syntax='1.2.840.10008.1.2.4.51')
",
    );
    for name in ["flat", "sixteen"] {
        files.read(name);
    }
    let told = [
        ("size", "frame 4: its JPEG image has 63 x 64 pixels where 64 x 64 are needed"),
        ("cut", "frame 1: its JPEG image cannot be decoded"),
        (
            "twelve",
            "lossy JPEG image of 12 bits per pixel (JPEG extended), which is not read; convert the file, for example with `dcmdjpeg",
        ),
    ];
    for (name, told) in told {
        let refusal = files.refusal(name);
        assert!(refusal.contains(told), "{name}: {refusal}");
    }
}

#[test]
fn jpeg_2000_frames_are_read() {
    let files = files(
        "
def lossless2000(frame):
    writer = SimpleITK.ImageFileWriter()
    writer.SetImageIO('GDCMImageIO')
    writer.UseCompressionOn()
    writer.SetCompressor('JPEG2000')
    path = str(out / 'one.dat')
    writer.SetFileName(path)
    writer.Execute(SimpleITK.GetImageFromArray(frame[None]))
    assert (SimpleITK.GetArrayFromImage(SimpleITK.ReadImage(path))[0] == frame).all()
    return next(encaps.generate_frames(pydicom.dcmread(path).PixelData, number_of_frames=1))
SYNTAX = pydicom.uid.JPEG2000Lossless
rough = np.random.default_rng(1)
noisy = rough.integers(0, 256, pixels.shape).astype('u1')
def layout(bits, signed):
    def change(d):
        d.BitsAllocated = 8 if bits == 8 else 16
        d.BitsStored, d.HighBit, d.PixelRepresentation = bits, bits - 1, int(signed)
    return change
kinds = {
    'eight': (pixels, 8, False), 'noisy': (noisy, 8, False), 'twelve': ((noisy.astype('u2') << 4) + 9, 12, False),
    'sixteen': (rough.integers(0, 65536, pixels.shape).astype('u2'), 16, False),
    'signed': (rough.integers(-32768, 32768, pixels.shape).astype('i2'), 16, True),
}
for name, (values, bits, signed) in kinds.items():
    images = [lossless2000(frame) for frame in values]
    compressed(name, items([], split(images, [1] * 6)[0]), syntax=SYNTAX, values=values, change=layout(bits, signed))
    if name == 'noisy':
        compressed('fragments', items([], split(images, [1, 2, 1, 3, 2, 1])[0]), syntax=SYNTAX, values=values)
        images[2] = images[2][:len(images[2]) // 2]
        compressed('cut', items([], split(images, [1] * 6)[0]), syntax=SYNTAX)
# A lossy image, decoded by OpenJPEG.
def lossy(frame):
    b = io.BytesIO()
    PIL.Image.fromarray(frame).save(b, 'JPEG2000', no_jp2=True, irreversible=True, quality_mode='rates', quality_layers=[8])
    return b.getvalue()
images = [lossy(frame) for frame in pixels]
decoded = np.stack([np.asarray(PIL.Image.open(io.BytesIO(image))) for image in images])
compressed('lossy', items([], split(images, [1] * 6)[0]), syntax=pydicom.uid.JPEG2000, values=decoded)
",
    );
    for name in ["eight", "noisy", "twelve", "sixteen", "signed", "fragments"] {
        files.read(name);
    }
    // Decoders may round the samples of lossy images differently.
    assert!(files.off("lossy") <= 1.0);
    assert!(
        files.refusal("cut").contains("frame 3: its JPEG 2000 image cannot be decoded"),
        "{}",
        files.refusal("cut")
    );
}

/// Frames that CharLS has encoded. Those of `near` are at most 2 off.
#[test]
fn jpeg_ls_frames_are_read() {
    const SIZE: [usize; 2] = [32, 24];
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("a.dcm");
    let eight = |x: usize, y: usize| if (11..14).contains(&x) { 90 } else { 190 + y / 4 };
    let twelve = |x: usize, y: usize| 16 * eight(x, y) + (7 * x + 3 * y) % 16;
    let (lossless, near) = ("1.2.840.10008.1.2.4.80", "1.2.840.10008.1.2.4.81");
    let eight_bits = include_bytes!("../common/frames/lossless.jls").as_slice();
    let twelve_bits = include_bytes!("../common/frames/lossless12.jls").as_slice();
    let rounded = include_bytes!("../common/frames/near.jls").as_slice();
    type Pixel<'a> = &'a dyn Fn(usize, usize) -> usize;
    let kinds: [(&str, &[u8], u16, Pixel<'_>, f32); 3] = [
        (lossless, eight_bits, 8, &eight, 0.0),
        (lossless, twelve_bits, 12, &twelve, 0.0),
        (near, rounded, 12, &twelve, 2.0),
    ];
    for (syntax, frame, bits, value, most) in kinds {
        compressed_run(&path, syntax, frame, bits);
        let run = Run::read(&path, None).unwrap();
        assert_eq!((run.width, run.height, run.frames.len()), (SIZE[0], SIZE[1], 2));
        for frame in &run.frames {
            let off = |(i, found): (usize, &f32)| (found - value(i % SIZE[0], i / SIZE[0]) as f32).abs();
            let off = frame.iter().enumerate().map(off).fold(0.0, f32::max);
            assert_eq!(off, most, "{syntax}, {bits} bits");
        }
    }
    compressed_run(&path, lossless, &twelve_bits[..300], 12);
    let refusal = Run::read(&path, None).err().unwrap().to_string();
    assert!(refusal.contains("JPEG-LS image cannot be decoded"), "{refusal}");
    let mut wide = eight_bits.to_vec();
    let header = wide.windows(2).position(|marker| marker == [0xff, 0xf7]).unwrap();
    wide[header + 7..header + 9].copy_from_slice(&33u16.to_be_bytes());
    compressed_run(&path, lossless, &wide, 8);
    let refusal = Run::read(&path, None).err().unwrap().to_string();
    assert!(refusal.contains("JPEG-LS image cannot be decoded"), "{refusal}");
}

#[test]
fn other_codecs_are_named_with_a_tool_that_converts_them() {
    let files = files(
        "
def other(name, uid):
    compressed('plain', items([], frames))
    data = (out / 'plain.dcm').read_bytes()
    d = pydicom.dcmread(out / 'plain.dcm')
    d.file_meta.TransferSyntaxUID = uid
    b = io.BytesIO()
    pydicom.filewriter.write_file_meta_info(b, d.file_meta, enforce_standard=False)
    start = data.index(bytes.fromhex('08001600') + b'UI')
    (out / f'{name}.dcm').write_bytes(bytes(128) + b'DICM' + b.getvalue() + data[start:])
for uid in ('4.201', '4.110', '4.102', '1.97'):
    other(uid, '1.2.840.10008.1.2.' + uid)
other('private', '1.3.46.670589.33.1.4.1')
",
    );
    for (name, told) in [
        (
            "4.201",
            "High-Throughput JPEG 2000 (1.2.840.10008.1.2.4.201), which is not read; convert the file, for example with",
        ),
        ("4.110", "JPEG XL"),
        ("4.102", "a video (MPEG or HEVC)"),
        ("1.97", "is no transfer syntax that is read"),
        ("private", "1.3.46.670589.33.1.4.1 is a private transfer syntax, which only its maker defines"),
    ] {
        let refusal = files.refusal(name);
        assert!(refusal.contains("TransferSyntaxUID") && refusal.contains(told), "{name}: {refusal}");
    }
}
