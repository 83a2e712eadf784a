"""Opens exported DICOM segmentations with pydicom, highdicom and dcmqi, and compares their voxels with the exported volumes.

    python3 check_segmentation.py DIRECTORY THRESHOLD   # made by tests/cli/dicom_export.rs
"""
import subprocess
import sys
import tempfile
from pathlib import Path

import dcmqi
import highdicom
import nrrd
import numpy as np
import pydicom
from pydicom.config import RAISE, settings

settings.reading_validation_mode = RAISE
directory, threshold = Path(sys.argv[1]), float(sys.argv[2])
volume, header = nrrd.read(str(directory / "beat.nrrd"))
directions = np.array(header["space directions"], dtype=float)
spatial = [row for row in range(4) if not np.isnan(directions[row]).any()]
phase_axis = ({0, 1, 2, 3} - set(spatial)).pop()
spacing, origin = np.diag(directions[spatial]), np.array(header["space origin"])
files = sorted(directory.glob("vessels_*.dcm"))
assert len(files) == volume.shape[phase_axis] > 1


def same_voxels(name, voxels, first_mm):
    """Compares voxels[left, posterior, superior] whose first lies at a place with those of the volume."""
    offset = (first_mm - origin) / spacing
    index = np.round(offset).astype(int)
    assert np.abs(offset - index).max() < 1e-3, (name, offset)
    whole = np.zeros(vessel.shape, bool)
    part = tuple(slice(i, i + n) for i, n in zip(index, voxels.shape))
    whole[part] = voxels
    assert (whole == vessel).all(), (name, int((whole != vessel).sum()), int(vessel.sum()))


made, frames = set(), set()
for phase, file in enumerate(files):
    vessel = np.take(volume, phase, axis=phase_axis) > threshold
    assert vessel.any() and not vessel.all()
    dataset = pydicom.dcmread(file)
    made.add(dataset.SOPInstanceUID)
    frames.add((dataset.StudyInstanceUID, dataset.SeriesInstanceUID, dataset.FrameOfReferenceUID))
    assert dataset.SeriesDescription == "RESEARCH USE ONLY - NOT FOR DIAGNOSIS"
    assert f"Phase {phase} of {len(files)}" in dataset.SegmentSequence[0].SegmentDescription

    read = highdicom.seg.segread(str(file))
    assert read.segmentation_type == highdicom.seg.SegmentationTypeValues.BINARY
    described = read.get_segment_description(1)
    assert described.segmented_property_type.meaning == "Coronary artery"
    assert described.algorithm_type.value == "AUTOMATIC"
    voxels = read.get_volume(combine_segments=True)
    # Axes of the array may be in any order: columns of the affine tell their directions in LPS.
    axes = np.abs(voxels.affine[:3, :3]).argmax(axis=0)
    array, affine = voxels.array.astype(bool), voxels.affine.copy()
    for axis in range(3):
        if affine[:3, axis].sum() < 0:
            affine[:3, 3] += (array.shape[axis] - 1) * affine[:3, axis]
            affine[:3, axis] *= -1
            array = np.flip(array, axis)
    same_voxels("highdicom", np.transpose(array, np.argsort(axes)), affine[:3, 3])

    with tempfile.TemporaryDirectory() as out:
        program = Path(dcmqi.__file__).parent / "bin" / "segimage2itkimage"
        subprocess.run([program, "--inputDICOM", file, "--outputDirectory", out, "--outputType", "nrrd"], check=True,
                       stdout=subprocess.DEVNULL)
        array, its = nrrd.read(str(Path(out) / "1.nrrd"))
        assert its["space"] == "left-posterior-superior" and np.allclose(its["space directions"], directions[spatial])
        same_voxels("dcmqi", array > 0, np.array(its["space origin"]))
assert len(made) == len(files) and len(frames) == 1, "one series and one frame of reference, an instance per phase"
print(f"{len(files)} segmentations: as highdicom and dcmqi read them")
