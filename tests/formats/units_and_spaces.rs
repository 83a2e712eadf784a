//! Units and spaces that files of other tools state: lengths come out in mm, and positions in LPS.

use crate::python::python;
use nertca_vk::formats::volume::VolumeHints;
use nertca_vk::formats::{nifti, volume_files, vtp};
use std::path::Path;

/// Runs a script in Python with a directory as its argument, and returns its output.
fn run(script: &str, directory: &Path) -> String {
    let outcome = python().arg("-c").arg(script).arg(directory).output().unwrap();
    assert!(outcome.status.success(), "{}", String::from_utf8_lossy(&outcome.stderr));
    String::from_utf8(outcome.stdout).unwrap()
}

/// Writes a volume with nibabel in each unit, and prints spacing and origin as SimpleITK reads them, mm and LPS.
const VOLUMES: &str = r#"
import sys, numpy, nibabel, SimpleITK
for unit, in_mm in [("meter", 1e3), ("mm", 1.0), ("micron", 1e-3), ("unknown", 1.0)]:
    affine = numpy.diag([0.5, 0.75, 1.5, in_mm]) / in_mm
    affine[:3, 3] = numpy.array([-3.0, 4.0, 5.0]) / in_mm
    image = nibabel.Nifti1Image(numpy.arange(24, dtype=numpy.float32).reshape(2, 3, 4), affine)
    image.header.set_xyzt_units(unit)
    file = f"{sys.argv[1]}/{unit}.nii"
    image.to_filename(file)
    seen = SimpleITK.ReadImage(file)
    print(unit, *seen.GetSpacing(), *seen.GetOrigin())
"#;

#[test]
fn volumes_come_out_in_millimetres() {
    let directory = tempfile::tempdir().unwrap();
    let seen = run(VOLUMES, directory.path());
    assert_eq!(seen.lines().count(), 4);
    for line in seen.lines() {
        let (unit, numbers) = line.split_once(' ').unwrap();
        let want: Vec<f64> = numbers.split(' ').map(|number| number.parse().unwrap()).collect();
        let volume = nifti::read(&directory.path().join(format!("{unit}.nii"))).unwrap();
        let m = volume.index_to_lps.matrix3;
        let lengths = [m.x_axis, m.y_axis, m.z_axis].map(|axis| axis.length());
        let found = [lengths, volume.index_to_lps.translation.to_array()].concat();
        let off = found.iter().zip(&want).map(|(found, want)| (found - want).abs()).fold(0.0, f64::max);
        assert!(off < 1e-5, "{unit}: {found:?} instead of {want:?}");
        assert!((lengths[0] - 0.5).abs() < 1e-5, "{unit}");
    }
    // A unit that NIfTI does not define is refused.
    let file = directory.path().join("mm.nii");
    let mut bytes = std::fs::read(&file).unwrap();
    bytes[123] = 7;
    std::fs::write(&file, bytes).unwrap();
    let error = nifti::read(&file).unwrap_err().to_string();
    assert!(error.contains("xyzt_units") && error.contains("micrometres"), "{error}");
}

/// Writes a volume with nibabel, changes slope and intercept in its header, and prints its values as nibabel reads them.
const SCALINGS: &str = r#"
import math, struct, sys, numpy, nibabel
image = nibabel.Nifti1Image(numpy.arange(24, dtype=numpy.int16).reshape(2, 3, 4), numpy.eye(4))
for name, slope, intercept in [
    ("nan", math.nan, math.nan), ("slope-nan", math.nan, 5.0), ("infinite", math.inf, 5.0), ("zero", 0.0, 5.0), ("plain", 0.5, -2.0),
    ("inter-nan", 0.5, math.nan),
]:
    file = f"{sys.argv[1]}/{name}.nii"
    image.to_filename(file)
    data = bytearray(open(file, "rb").read())
    data[112:120] = struct.pack("<2f", slope, intercept)
    open(file, "wb").write(data)
    if name != "inter-nan":
        print(name, *nibabel.load(file).get_fdata().ravel(order="F"))
"#;

#[test]
fn a_slope_that_is_no_number_scales_nothing() {
    let directory = tempfile::tempdir().unwrap();
    let seen = run(SCALINGS, directory.path());
    assert_eq!(seen.lines().count(), 5);
    for line in seen.lines() {
        let (name, numbers) = line.split_once(' ').unwrap();
        let want: Vec<f32> = numbers.split(' ').map(|number| number.parse().unwrap()).collect();
        assert_eq!(nifti::read(&directory.path().join(format!("{name}.nii"))).unwrap().values, want, "{name}");
    }
    let error = nifti::read(&directory.path().join("inter-nan.nii")).unwrap_err().to_string();
    assert!(error.contains("scl_inter: NaN is not finite, but scl_slope is 0.5"), "{error}");
}

/// Writes one line with VTK in each encoding: without a space, in RAS and in LPS.
const LINES: &str = r#"
import sys, vtk
for space in [None, "RAS", "LPS", "IJK"]:
    points, cells = vtk.vtkPoints(), vtk.vtkCellArray()
    points.SetDataTypeToDouble()
    line = vtk.vtkPolyLine()
    line.GetPointIds().SetNumberOfIds(3)
    for i, point in enumerate([(1.0, 2.0, 3.0), (4.0, -5.0, 6.0), (7.0, 8.0, -9.0)]):
        line.GetPointIds().SetId(i, points.InsertNextPoint(point))
    cells.InsertNextCell(line)
    data = vtk.vtkPolyData()
    data.SetPoints(points)
    data.SetLines(cells)
    if space:
        array = vtk.vtkStringArray()
        array.SetName("SPACE")
        array.InsertNextValue(space)
        data.GetFieldData().AddArray(array)
    for mode in ["Ascii", "Binary", "Appended"]:
        writer = vtk.vtkXMLPolyDataWriter()
        getattr(writer, f"SetDataModeTo{mode}")()
        writer.SetFileName(f"{sys.argv[1]}/{space}-{mode}.vtp")
        writer.SetInputData(data)
        assert writer.Write() == 1
"#;

#[test]
fn lines_come_out_in_lps() {
    let directory = tempfile::tempdir().unwrap();
    run(LINES, directory.path());
    let lps = vec![[1.0, 2.0, 3.0], [4.0, -5.0, 6.0], [7.0, 8.0, -9.0]];
    let from_ras = vec![[-1.0, -2.0, 3.0], [-4.0, 5.0, 6.0], [-7.0, -8.0, -9.0]];
    for mode in ["Ascii", "Binary", "Appended"] {
        let read = |space: &str| vtp::read(&directory.path().join(format!("{space}-{mode}.vtp")));
        for (space, want) in [("None", &lps), ("LPS", &lps), ("RAS", &from_ras)] {
            assert_eq!(&read(space).unwrap().points, want, "{space} {mode}");
        }
        let error = read("IJK").unwrap_err().to_string();
        assert!(error.contains("SPACE") && error.contains("`IJK`"), "{error}");
    }
}

/// Writes volumes whose headers state where the data begin in several ways, and prints their values, spacing and origin as SimpleITK reads
/// them.
const PLACES: &str = r#"
import gzip, sys, numpy, SimpleITK
values = numpy.arange(24, dtype=numpy.float32) ** 2
raw = values.tobytes()
axes = "dimension: 3\nspace: left-posterior-superior\nsizes: 2 3 4\nspace directions: (0.5,0,0) (0,0.75,0) (0,0,1.5)\n"
nrrd = "NRRD0004\ntype: float\n" + axes + "space origin: (-3,4,5)\nendian: little\n"
mha = "ObjectType = Image\nNDims = 3\nBinaryData = True\nBinaryDataByteOrderMSB = False\n" \
    + "Offset = -3 4 5\nDimSize = 2 3 4\nElementType = MET_FLOAT\n"
files = {
    "plain.nrrd": (nrrd + "encoding: raw\n\n").encode() + raw,
    "bytes.nrrd": (nrrd + "encoding: raw\nbyte skip: 16\n\n").encode() + bytes(range(16)) + raw,
    "last.nrrd": (nrrd + "encoding: raw\nbyte skip: -1\n\n").encode() + b"anything" + raw,
    "lines.nrrd": (nrrd + "encoding: raw\nline skip: 2\n\n").encode() + b"one\ntwo\n" + raw,
    "gzip-bytes.nrrd": (nrrd + "encoding: gzip\nbyte skip: 4\n\n").encode() + gzip.compress(b"abcd" + raw),
    "named.nrrd": (nrrd + "encoding: raw\ncontent: a name\nkinds: domain domain domain\na key:=a value\n\n").encode() + raw,
    "size.mha": (mha + "ElementSize = 0.5 0.75 1.5\nElementSpacing = 0.5 0.75 1.5\nElementDataFile = LOCAL\n").encode() + raw,
    "origin.mha": (mha.replace("Offset", "Origin") + "ElementSpacing = 0.5 0.75 1.5\nElementDataFile = LOCAL\n").encode() + raw,
}
for name, data in files.items():
    file = f"{sys.argv[1]}/{name}"
    open(file, "wb").write(data)
    seen = SimpleITK.ReadImage(file)
    print(name, *seen.GetSpacing(), *seen.GetOrigin(), *SimpleITK.GetArrayFromImage(seen).ravel())
# Files that SimpleITK reads in another way: in its units, as four axes, not at all.
seen = [0.5, 0.75, 1.5, -3, 4, 5, *values]
units = nrrd.replace("(0.5,0,0) (0,0.75,0) (0,0,1.5)", "(0.05,0,0) (0,0.075,0) (0,0,0.15)").replace("(-3,4,5)", "(-0.3,0.4,0.5)")
list_of_one = nrrd.replace("dimension: 3", "dimension: 4").replace("sizes: ", "sizes: 1 ").replace("directions: ", "directions: none ")
known = {
    "cm.nrrd": (units + 'space units: "cm" "cm" "cm"\nencoding: raw\n\n').encode() + raw,
    "list.nrrd": (list_of_one + "kinds: list domain domain domain\nencoding: raw\n\n").encode() + raw,
    "crlf.nrrd": (nrrd + "encoding: raw\n\n").replace("\n", "\r\n").encode() + raw,
    "element-size.mha": (mha + "ElementSize = 0.5 0.75 1.5\nElementDataFile = LOCAL\n").encode() + raw,
    "unit.mha": (mha + "DistanceUnits = ?\nElementSpacing = 0.5 0.75 1.5\nElementDataFile = LOCAL\n").encode() + raw,
    "header.mha": (mha + "HeaderSize = -1\nElementSpacing = 0.5 0.75 1.5\nElementDataFile = LOCAL\n").encode() + b"anything" + raw,
}
for name, data in known.items():
    open(f"{sys.argv[1]}/{name}", "wb").write(data)
    print(name, *seen)
refused = {
    "unknown.nrrd": (nrrd + "encoding: raw\nmirror: x\n\n").encode() + raw,
    "unit.nrrd": (nrrd + 'space units: "ell" "ell" "ell"\nencoding: raw\n\n').encode() + raw,
    "channels.mha": (mha + "ElementNumberOfChannels = 3\nElementSpacing = 1 1 1\nElementDataFile = LOCAL\n").encode() + raw,
    "text.mha": (mha.replace("BinaryData = True", "BinaryData = False") + "ElementSpacing = 1 1 1\nElementDataFile = LOCAL\n").encode() + raw,
}
for name, data in refused.items():
    open(f"{sys.argv[1]}/{name}", "wb").write(data)
    print(name)
"#;

#[test]
fn header_fields_that_move_the_data_are_read_or_refused() {
    let directory = tempfile::tempdir().unwrap();
    let seen = run(PLACES, directory.path());
    assert_eq!(seen.lines().count(), 18);
    for line in seen.lines() {
        let (name, numbers) = line.split_once(' ').unwrap_or((line, ""));
        let read = volume_files::read(&directory.path().join(name), &VolumeHints::default());
        if numbers.is_empty() {
            assert!(read.is_err(), "{name} is refused");
            continue;
        }
        let volume = read.unwrap();
        let m = volume.index_to_lps.matrix3;
        let lengths = [m.x_axis, m.y_axis, m.z_axis].map(|axis| axis.length() as f32);
        let origin = volume.index_to_lps.translation.as_vec3().to_array();
        let found = [&lengths[..], &origin, &volume.values].concat();
        let want: Vec<f32> = numbers.split(' ').map(|number| number.parse().unwrap()).collect();
        assert!(found.iter().zip(&want).all(|(found, want)| (found - want).abs() < 1e-5), "{name}: {found:?} {want:?}");
        assert_eq!(found.len(), want.len(), "{name}");
    }
}
