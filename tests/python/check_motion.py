"""Opens exported motion with the tools people would use and with parsers of its own, and compares it with what moved.

    python3 check_motion.py DIRECTORY   # made by tests/cli/motion.rs
"""
import gzip
import json
import sys
from itertools import product
from pathlib import Path

import nrrd
import numpy as np
import SimpleITK as sitk

directory = Path(sys.argv[1])
expected = json.loads((directory / "expected.json").read_text())
phases, n = expected["phases"], expected["size"]
places, moved = np.array(expected["places_mm"]), np.array(expected["displacements_mm"])


def numbers(text):
    return np.array([float(w) for w in text.replace("(", " ").replace(")", " ").replace(",", " ").split() if w != "none"])


def read_nrrd(name):
    """Header and values by the words of the format: the first axis is the fastest."""
    header, body = (directory / name).read_bytes().split(b"\n\n", 1)
    lines = header.decode().split("\n")
    assert lines[0] == "NRRD0004" and any(l.startswith("#") and "along a vessel is not observed" in l for l in lines)
    fields = dict(l.split(":", 1) for l in lines[1:] if not l.startswith("#"))
    fields = {k: v.lstrip("= ") for k, v in fields.items()}
    assert fields["type"] == "float" and fields["endian"] == "little"
    data = gzip.decompress(body) if fields["encoding"] == "gzip" else body
    sizes = numbers(fields["sizes"]).astype(int)
    return fields, np.frombuffer(data, "<f4").reshape(sizes, order="F")


def at(field, origin, spacing, place):
    """Trilinear value of field[component, left, posterior, superior]."""
    x = (place - origin) / spacing
    first = np.floor(x).astype(int)
    part = x - first
    total = np.zeros(3)
    for corner in product((0, 1), repeat=3):
        share = np.prod([p if c else 1 - p for c, p in zip(corner, part)])
        total += share * field[(slice(None), *(first + corner))]
    return total


fields, every = read_nrrd("field.nrrd")
assert fields["dimension"] == "5" and fields["kinds"] == "vector domain domain domain list"
assert every.shape == (3, n, n, n, phases)
assert fields["space"] == "left-posterior-superior" and fields["space units"] == '"mm" "mm" "mm"'
directions = fields["space directions"].split()
assert directions[0] == directions[-1] == "none"
spacing = numbers(fields["space directions"]).reshape(3, 3)
assert np.allclose(spacing, np.eye(3) * spacing[0, 0])
spacing, origin = np.diag(spacing), numbers(fields["space origin"])
assert numbers(fields["axis 4 index values"]).tolist() == list(range(phases))
rest = expected["rest_phase"]
assert fields["quantity"] == f"displacement from phase {rest}, mm", fields["quantity"]
assert (every[..., rest] == 0).all() and np.abs(every[..., 0]).max() > 1
for phase in range(phases):
    for place, want in zip(places, moved[phase]):
        got = at(every[..., phase], origin, spacing, place)
        assert np.allclose(got, want, atol=2e-4), f"phase {phase} at {place}: {got}, not {want}"

zipped, values = read_nrrd("zipped.nrrd")
assert zipped["encoding"] == "gzip" and (values == every).all()
data, header = nrrd.read(str(directory / "field.nrrd"))
assert (data == every).all() and list(header["kinds"]) == ["vector", "domain", "domain", "domain", "list"]

# One phase is a field as ITK's and 3D Slicer's displacement transforms have it.
_, one = read_nrrd("one.nrrd")
assert (one == every[..., 1]).all()
image = sitk.ReadImage(str(directory / "one.nrrd"))
assert image.GetNumberOfComponentsPerPixel() == 3 and image.GetDimension() == 3
assert np.allclose(image.GetOrigin(), origin) and np.allclose(image.GetSpacing(), spacing)
transform = sitk.DisplacementFieldTransform(sitk.Cast(image, sitk.sitkVectorFloat64))
for place, want in zip(places, moved[1]):
    assert np.allclose(np.array(transform.TransformPoint(place.tolist())) - place, want, atol=2e-4)

for name, phase in [("one.vtk", 1)] + [(f"field_{p:04}.vtk", p) for p in range(phases)]:
    raw = (directory / name).read_bytes()
    head, data = raw.split(b"VECTORS displacement_mm float\n")
    head = head.decode().split("\n")
    assert head[0].startswith("# vtk DataFile") and f"phase {phase};" in head[1] and "not observed" in head[1] and len(head[1]) < 256
    words = {line.split()[0]: line.split()[1:] for line in head[2:] if line}
    assert words["DATASET"] == ["STRUCTURED_POINTS"] and words["DIMENSIONS"] == [str(n)] * 3
    assert words["POINT_DATA"] == [str(n**3)]
    assert np.allclose([float(v) for v in words["ORIGIN"]], origin) and np.allclose([float(v) for v in words["SPACING"]], spacing)
    values = np.frombuffer(data, ">f4").reshape((3, n, n, n), order="F")
    assert (values == every[..., phase]).all(), name
    image = sitk.ReadImage(str(directory / name))
    assert (sitk.GetArrayFromImage(image).transpose(3, 2, 1, 0) == every[..., phase]).all()

# Lines.
raw = (directory / "lines.vtk").read_bytes()
trajectories = np.array(expected["trajectories_mm"])
count = len(trajectories)


def section(head, kind, size):
    """What follows a line of the header."""
    start = raw.index(head.encode() + b"\n") + len(head) + 1
    return np.frombuffer(raw[start : start + 4 * size], kind)


assert b"not observed" in raw.split(b"\n")[1] and raw.split(b"\n")[2:4] == [b"BINARY", b"DATASET POLYDATA"]
points = section(f"POINTS {count * phases} float", ">f4", 3 * count * phases).reshape(count, phases, 3)
assert np.allclose(points, trajectories, atol=1e-4)
lines = section(f"LINES {count} {count * (phases + 2)}", ">u4", count * (phases + 2)).reshape(count, phases + 2)
for i, line in enumerate(lines):
    places = [i * phases + t for t in range(phases)]
    assert line.tolist() == [phases + 1, *places, places[0]], "a closed line"
assert f"\nPOINT_DATA {count * phases}\n".encode() in raw


def values(name, width):
    return section(f"SCALARS {name} float {width}\nLOOKUP_TABLE default", ">f4", width * count * phases).reshape(count, phases, width)


assert (values("phase", 1)[..., 0] == np.arange(phases)).all()
assert np.allclose(values("scale_mm", 3), np.array(expected["scales_mm"])[:, None], rtol=1e-5)
assert np.allclose(values("attenuation_per_mm", 1)[..., 0], np.array(expected["attenuation_per_mm"])[:, None], rtol=1e-5)
print("every file opened, and says the same")
