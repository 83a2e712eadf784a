"""Writes the files in tests/formats/rtk with RTK: a geometry, and projections of an ellipsoid in it. Needs itk-rtk (PyPI).

    python3 tests/python/write_rtk.py
"""
from pathlib import Path

import itk
from itk import RTK as rtk

OUT = Path(__file__).resolve().parents[1] / "formats/rtk"
# Angles (gantry, out of plane, in plane), degrees, and offsets (projection x, y, source x, y), mm.
PROJECTIONS = [
    (0, 0, 0, 0, 0, 0, 0),
    (90, 0, 0, 0, 0, 0, 0),
    (200, 12, 0, 3, -2, 0, 0),
    (310, -8, 5, -4, 6, 1, -1.5),
]
geometry = rtk.ThreeDCircularProjectionGeometry.New()
for gantry, out_of_plane, in_plane, *offsets in PROJECTIONS:
    geometry.AddProjection(750, 1100, gantry, offsets[0], offsets[1], out_of_plane, in_plane, offsets[2], offsets[3])
rtk.write_geometry(geometry, str(OUT / "geometry.xml"))

empty = rtk.ConstantImageSource[itk.Image[itk.F, 3]].New()
empty.SetSize([24, 20, len(PROJECTIONS)])
empty.SetSpacing([4, 5, 1])
empty.SetOrigin([-44, -50, 0])
empty.SetConstant(0)
ellipsoid = rtk.RayEllipsoidIntersectionImageFilter[itk.Image[itk.F, 3], itk.Image[itk.F, 3]].New()
ellipsoid.SetInput(empty.GetOutput())
ellipsoid.SetGeometry(geometry)
ellipsoid.SetDensity(0.02)
ellipsoid.SetCenter([6, -9, 13])
ellipsoid.SetAxis([14, 8, 11])
itk.imwrite(ellipsoid.GetOutput(), str(OUT / "projections.mha"), compression=True)
