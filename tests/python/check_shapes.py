"""Scores pairs of voxel sets with SciPy and scikit-image, and compares with what the program says of them.

    python3 check_shapes.py DIRECTORY   # made by tests/cli/volume_scores.rs
"""
import json
import sys
from pathlib import Path

import numpy as np
from scipy.ndimage import distance_transform_edt, label
from skimage.morphology import skeletonize

directory = Path(sys.argv[1])
TOUCHING = np.ones((3, 3, 3))


def n_components(mask, voxel_mm3, smallest_mm3):
    labels, n = label(mask, TOUCHING)
    return int((np.bincount(labels.ravel())[1:] * voxel_mm3 >= smallest_mm3).sum()) if n else 0


def near(line, other, spacing, within_mm):
    return (distance_transform_edt(~other, sampling=spacing)[line] <= within_mm).mean()


pairs = sorted(directory.glob("pair-*.json"))
assert pairs, "nothing to check"
for file in pairs:
    said = json.loads(file.read_text())
    # (z, y, x)
    truth, ours = (np.load(file.with_suffix(f".{name}.npy")).astype(bool) for name in ("truth", "ours"))
    spacing = said["spacing_mm"][::-1]
    scores = said["scores"]

    dice = 2 * (truth & ours).sum() / (truth.sum() + ours.sum())
    directed = [
        distance_transform_edt(~b, sampling=spacing)[a] for a, b in ((truth, ours), (ours, truth))
    ]
    chamfer = np.mean([d.mean() for d in directed])
    hausdorff95 = max(np.percentile(d, 95, method="lower") for d in directed)
    for name, value in (("dice", dice), ("chamfer_mm", chamfer), ("hausdorff95_mm", hausdorff95)):
        assert np.isclose(scores[name], value, rtol=1e-5, atol=1e-6), (file.name, name, scores[name], value)
    for name, mask in (("true_components", truth), ("components", ours)):
        assert scores[name] == n_components(mask, np.prod(spacing), said["smallest_component_mm3"]), (file.name, name)

    # What is said of our own centrelines, which scikit-image's are near to: both thin by the rules of Lee et al., but not
    # in the same order of voxels.
    lines = [np.load(file.with_suffix(f".{name}.npy")).astype(bool) for name in ("truth_line", "our_line")]
    for mask, line in zip((truth, ours), lines):
        other = skeletonize(mask, method="lee") > 0
        assert label(line, TOUCHING)[1] == label(other, TOUCHING)[1] == label(mask, TOUCHING)[1], file.name
        assert 0.8 < line.sum() / other.sum() < 1.25, (file.name, line.sum(), other.sum())
        assert min(near(line, other, spacing, 1.0), near(other, line, spacing, 1.0)) > 0.9, file.name
    truth_line, our_line = lines
    covered, inside = ours[truth_line].mean(), truth[our_line].mean()
    for name, value in (
        ("true_centreline_found", near(truth_line, our_line, spacing, 1.0)),
        ("our_centreline_true", near(our_line, truth_line, spacing, 1.0)),
        ("cl_dice", 2 * covered * inside / (covered + inside)),
    ):
        assert np.isclose(scores[name], value, atol=1e-9), (file.name, name, scores[name], value)
