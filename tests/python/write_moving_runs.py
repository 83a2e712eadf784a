"""Writes DICOM runs of a phantom, as pydicom has them: a C-arm that turns during a run, or a table that moves.

usage: write_moving_runs.py DATA OUT

DATA has training views of as many phases each. OUT gets turning.dcm (frame i of view i, at phase i modulo the phases), still.dcm
(all phases of the first view), other.dcm (of the last), panned.dcm (still.dcm with a table that goes 4 mm to the left and 2 mm
down over the second half),
and trembling.dcm (a table that moves by 5 micrometres a frame)."""
import json
import sys
from pathlib import Path

import numpy as np
from pydicom.dataset import FileDataset, FileMetaDataset
from pydicom.uid import ExplicitVRLittleEndian, XRayAngiographicImageStorage, generate_uid

SPAN = 3.0  # line integrals that display grey values span in our import
data, out = Path(sys.argv[1]), Path(sys.argv[2])
manifest = json.loads((data / "dataset.json").read_text())
views: dict[str, list] = {}
for frame in manifest["frames"]:
    if frame["split"] == "train":
        views.setdefault(json.dumps(frame["geometry"]), []).append(frame)
arms = [json.loads(key) for key in views]
frames = [sorted(of_view, key=lambda f: f["phase"]) for of_view in views.values()]
read = lambda frame: np.load(data / frame["image"])
most = max(read(frame).max() for of_view in frames for frame in of_view)


def write(name, images, arm, **tags):
    grey = np.stack([np.round(65535 * (1 - 0.8 * image / most / SPAN)) for image in images]).astype(np.uint16)
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID, meta.MediaStorageSOPInstanceUID = XRayAngiographicImageStorage, generate_uid()
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    run = FileDataset(None, {}, file_meta=meta, preamble=b"\0" * 128)
    run.SOPClassUID, run.SOPInstanceUID = meta.MediaStorageSOPClassUID, meta.MediaStorageSOPInstanceUID
    run.Modality, run.PatientID, run.StudyInstanceUID = "XA", "phantom", "1.2.3"
    run.PhotometricInterpretation, run.SamplesPerPixel, run.PixelIntensityRelationship = "MONOCHROME2", 1, "LOG"
    run.NumberOfFrames, run.Rows, run.Columns = grey.shape
    run.BitsAllocated, run.BitsStored, run.HighBit, run.PixelRepresentation = 16, 16, 15, 0
    run.FrameTime = 66.0
    run.PositionerPrimaryAngle, run.PositionerSecondaryAngle = arm["primary_deg"], arm["secondary_deg"]
    run.DistanceSourceToDetector, run.DistanceSourceToPatient = arm["sid_mm"], arm["sod_mm"]
    run.ImagerPixelSpacing = [round(p, 6) for p in reversed(arm["pixel_mm"])]
    run.PositionerMotion = "DYNAMIC" if "PositionerPrimaryAngleIncrement" in tags else "STATIC"
    run.TableMotion = "DYNAMIC" if "TableLateralIncrement" in tags else "STATIC"
    for tag, value in tags.items():
        setattr(run, tag, value)
    run.PixelData = grey.tobytes()
    run.save_as(out / name, enforce_file_format=True)


phases = len(frames[0])
base = arms[0]
write(
    "turning.dcm",
    [read(of_view[i % phases]) for i, of_view in enumerate(frames)],
    base,
    PositionerPrimaryAngleIncrement=[arm["primary_deg"] - base["primary_deg"] for arm in arms],
    PositionerSecondaryAngleIncrement=[arm["secondary_deg"] - base["secondary_deg"] for arm in arms],
)
for name, of_view, arm in (("still.dcm", frames[0], arms[0]), ("other.dcm", frames[-1], arms[-1])):
    write(name, [read(frame) for frame in of_view], arm)
half = phases // 2
ramp = [max(0, i + 1 - half) / (phases - half) for i in range(phases)]
first = [read(frame) for frame in frames[0]]
write(
    "panned.dcm",
    first,
    base,
    TableHeight=100.0,
    TableLateralIncrement=[4 * share for share in ramp],
    TableVerticalIncrement=[2 * share for share in ramp],
)
write("trembling.dcm", first, base, TableLateralIncrement=[0.005 * (i % 2) for i in range(phases)])
