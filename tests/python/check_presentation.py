"""Reads a presentation state with pydicom, and compares it with the runs and the tree it belongs to.

    python3 check_presentation.py STATE.dcm TREE.json RUN.dcm...   # made by tests/cli/presentation.rs
"""
import json
import sys

import numpy as np
import pydicom
from pydicom.config import RAISE, settings

settings.reading_validation_mode = RAISE
state = pydicom.dcmread(sys.argv[1])
with open(sys.argv[2], encoding="utf-8") as file:
    tree = json.load(file)
runs = {run.SOPInstanceUID: run for run in map(pydicom.dcmread, sys.argv[3:])}
first = next(iter(runs.values()))

assert state.SOPClassUID.name == "Grayscale Softcopy Presentation State Storage" and state.Modality == "PR"
assert str(state.PatientName) == str(first.PatientName) == "Müller^Jörg"
for name in ("PatientID", "PatientBirthDate", "PatientSex", "StudyInstanceUID", "StudyDate", "StudyTime", "StudyID", "AccessionNumber"):
    assert state[name].value == first[name].value, name
assert state.SeriesInstanceUID not in {run.SeriesInstanceUID for run in runs.values()}
listed = {image.ReferencedSOPInstanceUID: series.SeriesInstanceUID
          for series in state.ReferencedSeriesSequence for image in series.ReferencedImageSequence}
assert listed == {uid: run.SeriesInstanceUID for uid, run in runs.items()}
for area in state.DisplayedAreaSelectionSequence:
    run = runs[area.ReferencedImageSequence[0].ReferencedSOPInstanceUID]
    assert list(area.DisplayedAreaBottomRightHandCorner) == [run.Columns, run.Rows]
for window in state.SoftcopyVOILUTSequence:
    run = runs[window.ReferencedImageSequence[0].ReferencedSOPInstanceUID]
    assert abs(window.WindowCenter - run.WindowCenter) < 1e-6 and abs(window.WindowWidth - run.WindowWidth) < 1e-6


def project(run, points_mm):
    """Places in pixels from the outer corner of the first one (PS3.3 C.8.7.5: positioner angles in patient axes)."""
    primary, secondary = np.radians([float(run.PositionerPrimaryAngle), float(run.PositionerSecondaryAngle)])
    to_detector = np.array([np.sin(primary) * np.cos(secondary), -np.cos(primary) * np.cos(secondary), np.sin(secondary)])
    columns = np.array([np.cos(primary), np.sin(primary), 0])
    rows = -np.cross(to_detector, columns)
    sid, sod = float(run.DistanceSourceToDetector), float(run.DistanceSourceToPatient)
    pitch = np.array([float(run.ImagerPixelSpacing[1]), float(run.ImagerPixelSpacing[0])])
    points = np.array(points_mm)
    scale = sid / (sod + points @ to_detector)
    flat = np.stack([points @ columns, points @ rows], 1) * scale[:, None] / pitch
    return flat + np.array([run.Columns, run.Rows]) / 2


BESIDE = [(-9, 0), (9, 0), (0, -9), (0, 9)]


def integral(values, line):
    """Mean line integral along a line of an image that is linear in intensity."""
    at = line.astype(int).clip(0, [values.shape[1] - 1, values.shape[0] - 1])
    return -np.log(values[at[:, 1], at[:, 0]]).mean()


phases, seen, deeper = {phase["phase"]: phase for phase in tree["phases"]}, set(), []
for annotation in state.GraphicAnnotationSequence:
    [image] = annotation.ReferencedImageSequence
    run = runs[image.ReferencedSOPInstanceUID]
    frame = int(image.ReferencedFrameNumber)  # one frame for each phase
    seen.add((run.SOPInstanceUID, frame))
    assert annotation.GraphicLayer == state.GraphicLayerSequence[0].GraphicLayer
    assert "NOT FOR DIAGNOSIS" in annotation.TextObjectSequence[0].UnformattedTextValue
    branches = phases[frame - 1]["branches"]
    assert len(annotation.GraphicObjectSequence) == len(branches) > 0
    values = run.pixel_array[frame - 1].astype(float)
    for graphic, branch in zip(annotation.GraphicObjectSequence, branches):
        assert (graphic.GraphicType, graphic.GraphicAnnotationUnits) == ("POLYLINE", "PIXEL")
        line = np.array(graphic.GraphicData).reshape(-1, 2)
        assert len(line) == graphic.NumberOfGraphicPoints
        off = np.abs(line - project(run, branch["points_mm"])).max()
        assert off < 0.02, f"{off} pixels from the projection of the branch"
        deeper.append(integral(values, line) - np.mean([integral(values, line + s) for s in BESIDE]))
assert seen == {(uid, frame + 1) for uid in runs for frame in range(len(phases))}, "each frame has its lines"
print(f"{len(seen)} frames with centrelines, where line integrals are {np.mean(deeper):.5f} larger than beside them")
assert np.mean(deeper) > 5e-4 and np.mean(np.array(deeper) > 0) > 0.8, "lines lie on vessels, which absorb"
