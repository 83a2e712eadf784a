"""Scores a tree against the true one by SciPy's distances and projections of its own, and compares with what `eval` says.

    python3 check_tree_scores.py DATA RUN   # made by tests/cli/tree_pages.rs; RUN has tree.json and evaluation.json
"""
import json
import sys
from pathlib import Path

import numpy as np
from compare_trees import compare, finely, read_truth
from scipy.spatial import cKDTree

data, run = Path(sys.argv[1]), Path(sys.argv[2])
truth = read_truth(data / "volumes/tree.json")
true_points, true_radii, true_branches = truth
tree = json.loads((run / "tree.json").read_text())["phases"]
scores = json.loads((run / "evaluation.json").read_text())["tree"]
frames = json.loads((data / "truth.json").read_text())["frames"]
NEAR_MM = 1.0


def seen(c_arm, points):
    """Places at the isocentre, mm: angles as DICOM has them."""
    a, b = np.radians([c_arm["primary_deg"], c_arm["secondary_deg"]])
    across = np.array([np.cos(a), np.sin(a), 0])
    down = np.array([np.sin(a) * np.sin(b), -np.cos(a) * np.sin(b), -np.cos(b)])
    beam = np.array([np.sin(a) * np.cos(b), -np.cos(a) * np.cos(b), np.sin(b)])
    depth = points @ beam + c_arm["sod_mm"]
    return np.stack([points @ across, points @ down], axis=1) * (c_arm["sod_mm"] / depth)[:, None]


def reprojection(row, split):
    """Of data whose geometry is as stated: both trees are seen alike."""
    ours = np.concatenate([finely(np.array(b["points_mm"]), b["radius_mm"])[:, :3] for b in row["branches"]])
    true = np.concatenate([finely(true_points[row["phase"]][b], true_radii[b])[:, :3] for b in true_branches])
    images = [f for f in frames if f["split"] == split and f["phase"] == row["phase"]]
    away = [cKDTree(seen(f["geometry"], true)).query(seen(f["geometry"], ours))[0].mean() for f in images]
    return np.mean(away)


def motion_error(row):
    def dense(points_of):
        share = np.linspace(0, 1, 20, endpoint=False)[:, None]
        return np.concatenate([p[i] + share * (p[i + 1] - p[i]) for p in points_of for i in range(len(p) - 1)])

    rest, now = ([np.array(b["points_mm"]) for b in r["branches"]] for r in (tree[0], row))
    true_rest, true_now = ([true_points[p][b] for b in true_branches] for p in (0, row["phase"]))
    begin, end, true_begin, true_end = map(dense, (rest, now, true_rest, true_now))
    away, nearest = cKDTree(true_begin).query(begin)
    errors = np.linalg.norm(end - begin - (true_end - true_begin)[nearest], axis=1)
    # Points of our lines are evenly apart, so that all weigh the same.
    return errors[away <= NEAR_MM].mean()


def within_doubt(row):
    """Share of the points whose nearest true place is inside their interval."""
    true = np.concatenate([finely(true_points[row["phase"]][b], true_radii[b])[:, :3] for b in true_branches])
    inside = []
    for branch in row["branches"]:
        points, directions = np.array(branch["points_mm"]), np.array(branch["doubt_direction"])
        off = ((true[cKDTree(true).query(points)[1]] - points) * directions).sum(axis=1)
        inside += list(abs(off) <= branch["doubt_mm"])
    return np.mean(inside)


def check_directions(row):
    """The least certain direction has the least information of all directions across the vessel, by the sources of the C-arms."""
    sources = []
    for f in frames:
        if f["split"] == "train" and f["phase"] == row["phase"]:
            a, b = np.radians([f["geometry"]["primary_deg"], f["geometry"]["secondary_deg"]])
            beam = np.array([np.sin(a) * np.cos(b), -np.cos(a) * np.cos(b), np.sin(b)])
            sources.append(-f["geometry"]["sod_mm"] * beam)
    for branch in row["branches"]:
        points = np.array(branch["points_mm"])
        for i in range(3, len(points) - 3, 7):
            along = points[i + 2] - points[i - 2]
            along /= np.linalg.norm(along)
            u = np.linalg.svd(along[None])[2][1:]
            seen_across = [np.cross(points[i] - s, along) / np.linalg.norm(points[i] - s) for s in sources]
            information = lambda d: sum((n @ d) ** 2 for n in seen_across)
            angles = np.radians(np.arange(0, 180, 0.5))
            least = min(information(np.cos(t) * u[0] + np.sin(t) * u[1]) for t in angles)
            stated = np.array(branch["doubt_direction"][i])
            assert abs(stated @ along) < 0.01 and information(stated) <= 1.01 * least + 1e-6, (i, stated, information(stated), least)


def close(name, found, wanted, within):
    print(f"  {name}: {found:.4f}, SciPy {wanted:.4f}")
    assert abs(found - wanted) <= within, (name, found, wanted)


assert [row["phase"] for row in scores["phases"]] == [row["phase"] for row in tree]
for row, found in zip(tree, scores["phases"]):
    wanted = compare(truth, row["phase"], row["branches"], NEAR_MM)
    print(f"phase {row['phase']}")
    close("true centreline found", found["true_centreline_found"], wanted["true_near"], 0.005)
    close("our centreline true", found["our_centreline_true"], wanted["ours_near"], 0.005)
    close("distance to true, mm", found["ours_to_true_mm"], wanted["ours_to_true_mm"], 0.005)
    close("radius error, mm", found["radius_error_mm"], wanted["radius_bias_mm"], 0.005)
    close("radius RMSE, mm", found["radius_rmse_mm"], wanted["radius_rmse_mm"], 0.005)
    close("components", found["components"], wanted["components"], 0)
    close("training images, mm", found["reprojection_training_mm"], reprojection(row, "train"), 0.01)
    close("unseen images, mm", found["reprojection_unseen_mm"], reprojection(row, "validation"), 0.01)
    # Between points the program takes the nearer one's interval, the script only the points.
    close("within doubt", found["within_doubt"], within_doubt(row), 0.08)
    check_directions(row)
    if row is tree[0]:
        assert found["motion_error_mm"] is None, "nothing has moved since the phase that motion is counted from"
    else:
        close("motion error, mm", found["motion_error_mm"], motion_error(row), 0.03)
for name, mean in scores["mean"].items():
    values = [row[name] for row in scores["phases"] if row[name] is not None]
    close(f"mean {name}", mean, np.mean(values), 1e-9)
