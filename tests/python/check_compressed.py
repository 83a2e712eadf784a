"""Opens compressed exports and compares them with the plain ones.

    python3 check_compressed.py DIRECTORY   # made by tests/cli/interop.rs
"""
import gzip
import sys
from pathlib import Path

import nibabel
import nrrd
import numpy as np

directory = Path(sys.argv[1])

plain = nibabel.load(directory / "all.nii")
for name in ("all.nii.gz", "named.nii.gz"):
    assert (directory / name).read_bytes()[:2] == b"\x1f\x8b", f"{name} is no gzip file"
    assert gzip.decompress((directory / name).read_bytes()) == (directory / "all.nii").read_bytes(), name
    zipped = nibabel.load(directory / name)
    assert (np.asarray(zipped.dataobj) == np.asarray(plain.dataobj)).all() and (zipped.affine == plain.affine).all()

for plain, zipped in (("all.seq.nrrd", "zipped.seq.nrrd"), ("one.nrrd", "zipped.nrrd")):
    data, header = nrrd.read(str(directory / plain))
    same, zipped_header = nrrd.read(str(directory / zipped))
    assert header["encoding"] == "raw" and zipped_header["encoding"] == "gzip"
    assert data.max() > 0 and (data == same).all(), zipped
    for field in ("sizes", "space origin", "space directions", "kinds"):
        assert np.array_equal(header[field], zipped_header[field], equal_nan=field == "space directions"), field
    assert (directory / zipped).stat().st_size < (directory / plain).stat().st_size
print("every compressed file holds what the plain one does")
