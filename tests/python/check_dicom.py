"""Opens a view that `render` wrote as DICOM with pydicom, and compares its pixels with those written as .npy.

usage: check_dicom.py VIEW.dcm VIEW.npy"""
import sys

import numpy as np
import pydicom
from pydicom import uid
from pydicom.config import RAISE, settings

settings.reading_validation_mode = RAISE
view, integrals = pydicom.dcmread(sys.argv[1]), np.load(sys.argv[2])

# What the modules of the XA Image IOD demand (PS3.3, A.14): attributes with a value, and those that may be empty.
FILLED = """SOPClassUID SOPInstanceUID StudyInstanceUID SeriesInstanceUID Modality ImageType PixelIntensityRelationship
    RadiationSetting SamplesPerPixel PhotometricInterpretation Rows Columns BitsAllocated BitsStored HighBit PixelRepresentation
    PixelData NumberOfFrames FrameIncrementPointer FrameTime PositionerMotion PositionerPrimaryAngle PositionerSecondaryAngle
    DistanceSourceToDetector DistanceSourceToPatient ImagerPixelSpacing WindowCenter WindowWidth""".split()
PRESENT = """PatientName PatientID PatientBirthDate PatientSex StudyDate StudyTime ReferringPhysicianName StudyID AccessionNumber
    SeriesNumber InstanceNumber PatientOrientation Manufacturer KVP XRayTubeCurrent ExposureTime""".split()
missing = [name for name in FILLED if name not in view or view[name].is_empty] + [n for n in PRESENT if n not in view]
assert not missing, missing
assert view.SOPClassUID == uid.XRayAngiographicImageStorage == view.file_meta.MediaStorageSOPClassUID
assert view.SOPInstanceUID == view.file_meta.MediaStorageSOPInstanceUID
made = [view.SOPInstanceUID, view.SeriesInstanceUID, view.StudyInstanceUID]
assert len(set(made)) == 3 and all(u.is_valid and u.startswith("2.25.") for u in made), made
assert list(view.ImageType) == ["DERIVED", "SECONDARY", "SINGLE PLANE"]
assert view.FrameIncrementPointer == 0x00181063
for name in ("SeriesDescription", "StudyDescription", "ImageComments", "DerivationDescription"):
    assert "RESEARCH USE ONLY - NOT FOR DIAGNOSIS" in view[name].value, name
assert (view.PhotometricInterpretation, view.PixelIntensityRelationship) == ("MONOCHROME2", "LIN")
for element in view.iterall():
    if element.VR == "DS" and not element.is_empty:
        values = element.value if element.VM > 1 else [element.value]
        assert all(len(str(v)) <= 16 for v in values), element
pixels = view.pixel_array.astype(float)
assert pixels.shape == integrals.shape, (pixels.shape, integrals.shape)
away = np.abs(-np.log(np.maximum(pixels, 1) / 65535) - integrals) / np.exp(integrals)
assert away.max() < 0.51 / 65535 * 1.1, away.max()
assert integrals.max() > 0.005, integrals.max()
print(f"{view.NumberOfFrames} frames of {view.Columns} x {view.Rows}, {view.FrameTime} ms: as pydicom reads them")
