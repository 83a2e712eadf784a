"""Reads a measurement report of a tree with highdicom, and compares it with the tree's JSON.

    python3 check_measurements.py REPORT.dcm TREE.json   # made by tests/cli/trees.rs
"""
import json
import sys

import highdicom
import numpy as np
from pydicom.config import RAISE, settings
from pydicom.sr.codedict import codes

settings.reading_validation_mode = RAISE
report = highdicom.sr.srread(sys.argv[1])
with open(sys.argv[2], encoding="utf-8") as file:
    tree = json.load(file)
LENGTH = highdicom.sr.CodedConcept("410668003", "SCT", "Length")
DIAMETER = highdicom.sr.CodedConcept("397413000", "SCT", "Vessel lumen diameter")
STENOSIS = highdicom.sr.CodedConcept("408715008", "SCT", "Degree of blood vessel lumen diameter reduction")
MEAN, MINIMUM = "Mean", "Minimum"

assert isinstance(report, highdicom.sr.Comprehensive3DSR)
assert report.SeriesDescription == "RESEARCH USE ONLY - NOT FOR DIAGNOSIS"
assert isinstance(report.content, highdicom.sr.MeasurementReport), "TID 1500"
groups = report.content.get_image_measurement_groups()


def own(group, code):
    """Values with a code of the program itself, at most one."""
    concept = highdicom.sr.CodedConcept(code, "99NERTCA", code)
    return [m.value for m in group.get_measurements() if m.name.value == concept.value and m.name.scheme_designator == "99NERTCA"]


def of_phase(phase):
    """Groups of a phase, in the order of the file."""
    def is_of_it(group):
        order = [m.value for m in group.get_measurements(codes.DCM.TimePointOrder)]
        return order == [phase]

    return [group for group in groups if is_of_it(group)]


identifiers, n_stenoses = {}, 0
for number, phase in enumerate(tree["phases"]):
    vessels, *others = of_phase(phase["phase"])
    assert vessels.tracking_identifier == "vessels" and vessels.finding_type.meaning == "Coronary artery"
    [length] = vessels.get_measurements(LENGTH)
    assert abs(length.value - phase["length_mm"]) < 1e-3 and length.unit.value == "mm"
    branches = [g for g in others if g.tracking_identifier.startswith("branch ")]
    stenoses = [g for g in others if g.tracking_identifier.startswith("stenosis ")]
    assert len(branches) == len(phase["branches"]) > 0 and len(branches) + len(stenoses) == len(others)
    for index, (group, branch) in enumerate(zip(branches, phase["branches"])):
        name = f"branch {index}" + (f", which leaves branch {branch['parent']}" if branch["parent"] is not None else "")
        assert group.tracking_identifier == name
        identifiers.setdefault(index, set()).add(group.tracking_uid)
        [length] = group.get_measurements(LENGTH)
        assert abs(length.value - branch["length_mm"]) < 1e-3
        [line] = length.referenced_coordinates
        assert np.abs(np.array(line.value) - np.array(branch["points_mm"])).max() < 1e-4, "the centreline itself"
        diameters = {m.derivation.meaning: m.value for m in group.get_measurements(DIAMETER)}
        points, radii = np.array(branch["points_mm"]), np.array(branch["radius_mm"])
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        mean = 2 * np.sum(steps * (radii[1:] + radii[:-1]) / 2) / steps.sum()
        assert set(diameters) == {MEAN, MINIMUM}
        assert abs(diameters[MEAN] - mean) < 1e-3 and abs(diameters[MINIMUM] - 2 * radii.min()) < 1e-3
        if "doubt_mm" in branch:
            [doubt], [existence] = own(group, "DOUBT"), own(group, "EXISTENCE")
            assert min(branch["doubt_mm"]) <= doubt <= max(branch["doubt_mm"])
            assert abs(existence - np.mean(branch["existence"])) < 1e-3
    if number > 0 and tree["tracked"]:
        assert not stenoses, "followed points keep their radii"
        continue
    assert len(stenoses) == len(phase["lesions"])
    n_stenoses += len(stenoses)
    for group, lesion in zip(stenoses, phase["lesions"]):
        assert group.finding_type.meaning == "Stenosis"
        [percent] = group.get_measurements(STENOSIS)
        assert abs(percent.value - lesion["stenosis_percent"]) < 0.06 and percent.unit.value == "%"
        least, reference = group.get_measurements(DIAMETER)
        assert least.derivation.meaning == MINIMUM and reference.method.meaning == "Curve Fitted Reference"
        assert abs(least.value - lesion["min_diameter_mm"]) < 1e-3
        assert abs(reference.value - lesion["reference_diameter_mm"]) < 1e-3
        [place] = least.referenced_coordinates
        branch = phase["branches"][lesion["branch"]]
        assert np.abs(np.array(place.value[0]) - np.array(branch["points_mm"][lesion["point"]])).max() < 1e-4
        [length], [from_root] = group.get_measurements(LENGTH), own(group, "FROMROOT")
        assert abs(length.value - lesion["length_mm"]) < 1e-3 and abs(from_root - lesion["from_root_mm"]) < 1e-3
for index, uids in identifiers.items():
    assert len(uids) == (1 if tree["tracked"] else len(tree["phases"])), f"branch {index}"
print(f"{len(groups)} groups with {n_stenoses} stenoses: as highdicom reads them")
