"""Lines with radii as VTK writes them, in every encoding it has, for `phantom --tree`.

    python3 write_lines.py DIRECTORY   # called by tests/cli/tree_files.rs
"""
import json
import sys
from pathlib import Path

import numpy as np
from vtkmodules.util.numpy_support import numpy_to_vtk
from vtkmodules.vtkCommonCore import vtkPoints, vtkStringArray
from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData
from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

directory = Path(sys.argv[1])
# A trunk and two branches that begin with its last point, which is there once.
LINES = [list(range(40)), [39, *range(40, 75)], [39, *range(75, 100)]]


def points(phase):
    along = np.arange(100) / 100
    return np.stack([30 * along + phase, 20 * np.cos(7 * along), -15 * np.sin(5 * along) + 0.1], axis=1)


radii = np.linspace(2.0, 0.7, 100)


def polydata(kind, name, phase=0, lines=LINES):
    made, places = vtkPolyData(), vtkPoints()
    places.SetData(numpy_to_vtk(points(phase).astype(kind), deep=True))
    cells = vtkCellArray()
    for line in lines:
        cells.InsertNextCell(len(line))
        for point in line:
            cells.InsertCellPoint(point)
    made.SetPoints(places)
    made.SetLines(cells)
    words = vtkStringArray()
    words.SetName("Labels")
    for i in range(100):
        words.InsertNextValue(f"p{i}")
    tangents = numpy_to_vtk(np.ones((100, 3)), deep=True)
    tangents.SetName("FrenetTangent")
    radius = numpy_to_vtk(radii.astype(kind), deep=True)
    radius.SetName(name)
    for array in (words, tangents, radius):
        made.GetPointData().AddArray(array)
    return made


def write(name, made, mode, compressor="None", base64=True, big=False, wide=False):
    writer = vtkXMLPolyDataWriter()
    writer.SetFileName(str(directory / name))
    writer.SetInputData(made)
    {"ascii": writer.SetDataModeToAscii, "binary": writer.SetDataModeToBinary,
     "appended": writer.SetDataModeToAppended}[mode]()
    {"None": writer.SetCompressorTypeToNone, "ZLib": writer.SetCompressorTypeToZLib,
     "LZ4": writer.SetCompressorTypeToLZ4}[compressor]()
    writer.SetEncodeAppendedData(base64)
    writer.SetByteOrderToBigEndian() if big else writer.SetByteOrderToLittleEndian()
    writer.SetHeaderTypeToUInt64() if wide else writer.SetHeaderTypeToUInt32()
    # Several blocks of zlib in each array.
    writer.SetBlockSize(256)
    assert writer.Write() == 1
    return name


names = []
for kind, radius in ((np.float64, "MaximumInscribedSphereRadius"), (np.float32, "Radius"), (np.float64, "radius")):
    for mode in ("ascii", "binary", "appended"):
        for compressor in ("None", "ZLib"):
            for base64, big, wide in ((True, False, False), (False, True, True), (False, False, False), (True, True, True)):
                name = f"{radius}-{mode}-{compressor}-{base64}-{big}-{wide}.vtp"
                names.append(write(name, polydata(kind, radius), mode, compressor, base64, big, wide))
write("lz4.vtp", polydata(np.float64, "Radius"), "appended", "LZ4")
write("nameless.vtp", polydata(np.float64, "Width"), "ascii")

for phase in range(3):
    write(f"phase{phase}.vtp", polydata(np.float64, "Radius", phase), "appended")
write("shorter.vtp", polydata(np.float64, "Radius", 1, LINES[:2]), "appended")
sets = "".join(f'<DataSet timestep="{phase}" file="phase{phase}.vtp"/>' for phase in (2, 0, 1))
(directory / "beat.pvd").write_text(f'<VTKFile type="Collection"><Collection>{sets}</Collection></VTKFile>')
sets = sets.replace("phase1.vtp", "shorter.vtp")
(directory / "unlike.pvd").write_text(f'<VTKFile type="Collection"><Collection>{sets}</Collection></VTKFile>')

lines = [[[points(phase)[i].tolist() for i in line] for line in LINES] for phase in range(3)]
radius_mm = [[radii[i] for i in line] for line in LINES]
(directory / "expected.json").write_text(json.dumps({"files": names, "lines": lines, "radius_mm": radius_mm}))
