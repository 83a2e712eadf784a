//! Units and spaces that files of other tools state: lengths come out in mm, and positions in LPS.

use crate::python::python;
use nertca_vk::formats::{nifti, vtp};
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
