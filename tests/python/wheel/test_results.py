"""What goes in comes out as it should."""

import json
import logging
import subprocess
import threading
from pathlib import Path
from typing import Any

import nertca_vk
import numpy as np
import pytest
from nertca_vk import CArm, Context, Grid, Reconstruction
from scene import PHASES, SIZE, VIEWS, drawn, empty, endless, filled, frames, geometry, pixels


@pytest.fixture(scope="module")
def trained(context: Context) -> Any:
    with filled(context) as made:
        made.train()
        yield made


def test_training_tells_how_far_it_is(context: Context) -> None:
    told: list[nertca_vk.Progress] = []
    with filled(context) as made:
        assert made.progress().state == "idle" and made.progress().step == 0
        assert made.train(20, progress=lambda progress: told.append(progress)) == 20
        assert made.train(progress=lambda progress: progress.step >= 45) == 25, "a true result ends it"
        assert made.progress().step == 45
        assert made.train() == 15 and made.train() == 0
    assert [progress.step for progress in told] == sorted({progress.step for progress in told})
    assert told[-1].step == 20 and told[-1].iterations == 60 and told[-1].frames == VIEWS * PHASES
    assert all(np.isfinite(progress.loss) and progress.iterations_per_s > 0 for progress in told)


def test_training_in_pieces_in_the_background_and_from_bytes_is_one_training(context: Context, tmp_path: Path) -> None:
    with filled(context) as whole, filled(context) as pieces, filled(context) as background:
        whole.train()
        pieces.train(25)
        pieces.save(tmp_path / "checkpoint.safetensors")
        with filled(context) as resumed, filled(context) as from_file:
            resumed.load_bytes(pieces.save_bytes())
            from_file.load(tmp_path / "checkpoint.safetensors")
            assert resumed.train() == from_file.train() == 35
            background.start()
            assert background.wait() and background.progress().state == "finished"
            wanted = whole.save_bytes()
            assert resumed.save_bytes() == from_file.save_bytes() == background.save_bytes() == wanted


def test_frames_are_the_same_in_every_form(context: Context) -> None:
    def trained_on(change: Any, **options: Any) -> bytes:
        with empty(context) as made:
            for number, (view, phase, image) in enumerate(frames()):
                assert made.add_frame(change(image), geometry(view), phase=phase, **options) == number
            made.train(5)
            return made.save_bytes()

    def read_only(image: Any) -> Any:
        image.flags.writeable = False
        return image

    wanted = trained_on(lambda image: image)
    assert trained_on(lambda image: image * 0.99) != wanted
    assert trained_on(np.asfortranarray) == wanted
    assert trained_on(lambda image: np.repeat(np.repeat(image, 2, 0), 3, 1)[::2, ::3]) == wanted
    assert trained_on(lambda image: image[::-1, ::-1].copy()[::-1, ::-1]) == wanted
    assert trained_on(lambda image: image.astype(">f4")) == wanted
    assert trained_on(lambda image: image.astype(np.float64)) == wanted
    assert trained_on(read_only) == wanted
    assert trained_on(lambda image: image.tolist()) == wanted
    codes = [(10_000 * image).astype(np.uint16) for _, _, image in frames()]
    in_code = iter(codes)
    wanted = trained_on(lambda image: next(in_code), intensity=nertca_vk.Integral(scale=1e-4))
    in_code = iter(codes)
    assert trained_on(lambda image: next(in_code).astype(">u2"), intensity=nertca_vk.Integral(scale=1e-4)) == wanted


def test_detectors_mean_what_they_say(context: Context) -> None:
    """All forms draw nearly the same: a wrong scale or sign is far off."""

    def reconstructed(change: Any, intensity: nertca_vk.Intensity) -> Any:
        with empty(context) as made:
            for view, phase, image in frames():
                made.add_frame(change(image), geometry(view), phase=phase, intensity=intensity)
            made.train(20)
            return drawn(made)

    wanted = reconstructed(lambda image: image, nertca_vk.Integral())
    for change, intensity in (
        (lambda image: 3.0 * image + 1.0, nertca_vk.Integral(scale=1 / 3, offset=-1 / 3)),
        (lambda image: 7.0 - 2.0 * image, nertca_vk.Logarithmic(i0=7.0, scale=0.5)),
        (lambda image: 5.0 * np.exp(-image), nertca_vk.Linear(i0=5.0)),
    ):
        assert np.abs(reconstructed(change, intensity) - wanted).max() < 1e-2


def test_views_are_drawn_as_they_were_taken(trained: Reconstruction) -> None:
    image = drawn(trained)
    assert image.shape == (SIZE, SIZE) and image.dtype == np.float32
    assert np.abs(image - pixels(0, 0)).mean() < 0.15
    parts = drawn(trained, component="static") + drawn(trained, component="dynamic")
    np.testing.assert_allclose(parts, image, atol=1e-5)
    assert drawn(trained, projection="mip").max() < 0.2, "1/mm"
    out = np.full((SIZE, SIZE), np.nan, np.float32)
    assert drawn(trained, out=out) is out
    np.testing.assert_array_equal(out, image)
    # Rows and columns are not mixed up, and a matrix says what angles say.
    wide = trained.render(geometry(0), (7, 31), quality="exact")
    assert wide.shape == (7, 31)
    correction = trained.correction(0)
    assert correction.matrix.shape == (3, 4)
    if correction.kind == "stated":
        by_matrix = trained.render(correction.matrix, (SIZE, SIZE), quality="exact")
        np.testing.assert_allclose(by_matrix, image, atol=1e-4)


def test_volumes_are_indexed_superior_posterior_left(trained: Reconstruction) -> None:
    grid = Grid(origin_mm=(-20.0, -15.0, -10.0), spacing_mm=(8.0, 9.0, 10.0), points=(5, 4, 3))
    values = trained.volume(grid, phase=1, component="total")
    assert values.shape == (3, 4, 5) and len(np.unique(values)) > 50
    for k, j, i in ((0, 0, 0), (2, 1, 3), (1, 3, 0), (0, 2, 4)):
        at = (-20.0 + 8.0 * i, -15.0 + 9.0 * j, -10.0 + 10.0 * k)
        alone = trained.volume(Grid(at, (1.0, 1.0, 1.0), (1, 1, 1)), phase=1, component="total")
        assert alone.item() == pytest.approx(values[k, j, i], rel=1e-4, abs=1e-7)
    out = np.empty((3, 4, 5), np.float32)
    assert trained.volume(grid, phase=1, component="total", out=out) is out
    np.testing.assert_array_equal(out, values)
    cube = Grid.around_isocentre(5.0, 2.0)
    assert cube.points == (5, 5, 5) and cube.origin_mm == (-4.0, -4.0, -4.0)


def test_frames_for_validation_are_scored(context: Context) -> None:
    with filled(context) as made:
        made.train(20)
        with pytest.raises(nertca_vk.DataError, match="validation"):
            made.evaluate()
        vessels = pixels(1, 1) > 1.1
        made.add_frame(pixels(1, 1), geometry(1), phase=1, split="validation", mask=vessels)
        scores = made.evaluate()
        assert scores.images == 1 and scores.step == 20 and 5 < scores.psnr_db < 60 and 0 <= scores.dice_dynamic <= 1
        assert scores.threshold_per_mm == pytest.approx(0.002)
        assert made.evaluate(0.03).threshold_per_mm == pytest.approx(0.03)


def test_scores_in_3d_know_the_true_vessels(context: Context) -> None:
    grid = Grid.around_isocentre(20.0, 2.0)
    with filled(context) as made:
        made.train()
        made.add_frame(pixels(1, 1), geometry(1), phase=1, split="validation", mask=pixels(1, 1) > 1.1)
        assert made.evaluate().volume_phases == 0 and np.isnan(made.evaluate().chamfer_mm)
        ours = made.volume(grid, phase=1)
        threshold = float(np.quantile(ours, 0.98))
        # What was reconstructed is its own truth; moved by a voxel to the left, it is off by as much.
        inside = ours > threshold
        made.set_true_vessels(inside, grid, phase=1)
        same = made.evaluate(threshold)
        assert (same.volume_phases, same.volume_dice, same.chamfer_mm, same.hausdorff95_mm) == (1, 1.0, 0.0, 0.0)
        assert same.components == same.true_components and same.cl_dice == 1.0
        first = (grid.origin_mm[0] + 2.0, *grid.origin_mm[1:])
        made.set_true_vessels(inside.astype(np.uint8), Grid(first, grid.spacing_mm, grid.points), phase=1)
        moved = made.evaluate(threshold)
        assert 0 < moved.volume_dice < 1 and 0 < moved.chamfer_mm <= 2.0
        made.set_true_vessels(None, grid, phase=1)
        assert made.evaluate(threshold).volume_phases == 0
        with pytest.raises(nertca_vk.ArgumentError, match="inside"):
            made.set_true_vessels(inside[:-1], grid, phase=1)
        with pytest.raises(nertca_vk.ArgumentError, match="inside"):
            made.set_true_vessels(inside.astype(np.float32), grid, phase=1)
        with pytest.raises(nertca_vk.ArgumentError, match="phase"):
            made.set_true_vessels(inside, grid, phase=PHASES)


def test_a_tree_is_its_own_truth(context: Context) -> None:
    with filled(context) as made:
        made.train()
        made.add_frame(pixels(1, 1), geometry(1), phase=1, split="validation")
        threshold = float(np.quantile(made.volume(Grid.around_isocentre(20.0, 1.0)), 0.98))
        tree = made.tree(threshold_per_mm=threshold)
        for branch in tree.branches:
            assert branch.doubt_mm.shape == branch.existence.shape == branch.radius_mm.shape
            assert branch.gap_mm >= 0.0
            assert (branch.doubt_mm > 0).all() and (0 < branch.existence).all() and (branch.existence < 1).all()
        at_rest = nertca_vk.Tree(tree.threshold_per_mm, False, tree.at(0))
        made.set_true_tree(at_rest)
        scores = made.evaluate(threshold)
        assert (scores.tree_phases, scores.tree_true_centreline_found, scores.tree_our_centreline_true) == (1, 1.0, 1.0)
        assert abs(scores.radius_rmse_mm) < 1e-9 and scores.tree_ours_to_true_mm < 1e-9
        made.set_true_tree(None)
        assert made.evaluate(threshold).tree_phases == 0
        late = [nertca_vk.Branch(1, None, branch.points_mm, branch.radius_mm) for branch in tree.at(0)]
        with pytest.raises(nertca_vk.ArgumentError, match="phase 0"):
            made.set_true_tree(nertca_vk.Tree(0.0, False, late))
        short = [nertca_vk.Branch(0, None, branch.points_mm[:-1], branch.radius_mm) for branch in tree.at(0)]
        with pytest.raises(nertca_vk.ArgumentError, match="points_mm"):
            made.set_true_tree(nertca_vk.Tree(0.0, False, short))


def test_radii_of_followed_points_come_from_the_frames(context: Context) -> None:
    with filled(context, **{"gaussians.form": "deformable"}) as made:
        made.train()
        threshold = float(np.quantile(made.volume(Grid.around_isocentre(20.0, 1.0)), 0.98))
        tree = made.tree(threshold_per_mm=threshold)
        assert tree.followed and tree.radii_from_images


def test_phases_come_from_r_peaks(context: Context) -> None:
    # In the middle of phases, which are even parts of a beat of this length.
    beat_s = 0.31 / 0.35
    with empty(context) as by_time, filled(context) as by_phase:
        for view, phase, image in frames():
            by_time.add_frame(image, geometry(view), time_s=10.0 + beat_s * (phase + 0.5) / PHASES)
        with pytest.raises(nertca_vk.NotReadyError):
            by_time.train(5)
        by_time.set_r_peaks([10.0, 10.0 + beat_s])
        assert by_time.train(5) == by_phase.train(5) == 5
        assert by_time.save_bytes() == by_phase.save_bytes()


def test_geometry_can_be_stated_anew(context: Context) -> None:
    with empty(context) as late, filled(context) as right:
        for view, phase, image in frames():
            late.add_frame(image, CArm(0.0, 0.0, 1000.0, 600.0, (6.0, 6.0)), phase=phase)
        for number, (view, _, _) in enumerate(frames()):
            late.set_geometry(number, geometry(view))
        late.train(5), right.train(5)
        assert late.save_bytes() == right.save_bytes()


def test_a_phantoms_vessels_become_a_tree(tmp_path: Path) -> None:
    """The program of the wheel makes a phantom and trains on it; the package finds the tree in its checkpoint."""
    run = tmp_path / "run"

    def program(*arguments: object) -> None:
        subprocess.run(["nertca-vk", *map(str, arguments)], check=True, capture_output=True)

    program("phantom", tmp_path / "phantom", "--size", 64, "--phases", 4)
    program("train", tmp_path / "phantom", "--out", run, "--no-eval")
    (checkpoint,) = sorted(run.rglob("*.safetensors"))[-1:]
    with Context() as context, Reconstruction.from_checkpoint(checkpoint, context=context) as loaded:
        tree = loaded.tree()
        assert np.isnan(tree.branches[0].doubt_mm).all(), "a checkpoint has no frames to compare with"
        program("tree", run, "--out", tmp_path / "beat.json")
        truth = json.loads((tmp_path / "beat.json").read_text())
        assert tree.followed == truth["tracked"] and tree.threshold_per_mm > 0
        assert not tree.radii_from_images, "a checkpoint has no frames to measure radii in"
        for phase, row in enumerate(truth["phases"]):
            found = tree.at(phase)
            assert len(found) == len(row["branches"])
            for ours, theirs in zip(found, row["branches"]):
                np.testing.assert_allclose(ours.points_mm, theirs["points_mm"], atol=0.01)
                assert abs(ours.gap_mm - theirs.get("gap_mm", 0.0)) < 0.01
                np.testing.assert_allclose(ours.radius_mm, theirs["radius_mm"], atol=0.01)
        wanted = [(row["phase"], lesion) for row in truth["phases"] for lesion in row["lesions"]]
        assert len(tree.lesions) == len(wanted)
        for ours, (phase, theirs) in zip(tree.lesions, wanted):
            assert ours.phase == phase and tree.branches[ours.branch].phase == phase and ours.point == theirs["point"]
            assert abs(ours.stenosis_percent - theirs["stenosis_percent"]) < 0.2
        ends = [tree.branches[branch.parent].points_mm[-1] for branch in tree.branches if branch.parent is not None]
        starts = [branch.points_mm[0] for branch in tree.branches if branch.parent is not None]
        assert len(ends) > 0
        np.testing.assert_array_equal(ends, starts)


def test_messages_go_to_the_logger(context: Context, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, "nertca_vk"), filled(context) as made:
        made.train(1)
    assert any("training on 9 frames" in record.message for record in caplog.records)
    assert {record.name for record in caplog.records} == {"nertca_vk"}


def test_background_training_is_held_and_goes_on(context: Context) -> None:
    with endless(context) as made:
        made.start()
        made.pause()
        made.resume()
        assert made.wait(0.0) is False
        with pytest.raises(nertca_vk.BusyError):
            made.start()
        made.stop()
        assert made.progress().state == "idle"


def test_devices_are_listed() -> None:
    found = nertca_vk.devices()
    assert len(found) >= 1 and all(device.name and len(device.uuid) == 32 for device in found)
    assert any(device.unusable is None for device in found)


def test_frames_tell_their_phase_view_and_use(context: Context) -> None:
    with filled(context) as made:
        status = made.frame_status(4)
        assert (status.usage, status.view, status.phase, status.after_phase, status.taken_in) == ("training", 1, 1, 0.0, False)
        better = CArm(50.0, -10.0, sid_mm=1000.0, sod_mm=600.0, pixel_mm=120.0 / SIZE)
        made.set_geometry(4, better)
        assert made.frame_status(4).usage == "one_phase"
        made.set_view_geometry(4, geometry(1))
        assert made.frame_status(4) == status
        added = made.add_frame(pixels(0, 0), geometry(0), time_s=1.0)
        assert (made.frame_status(added).usage, made.frame_status(added).phase) == ("no_phase", None)
        made.set_r_peaks([1.0, 2.0])
        assert (made.frame_status(added).phase, made.frame_status(added).after_phase) == (0, -0.5)
        assert made.beat_phase(1.0) == PHASES - 0.5
        made.set_r_peaks([])
        with pytest.raises(nertca_vk.NotReadyError):
            made.beat_phase(1.0)
        made.remove_frame(added)
        with pytest.raises(nertca_vk.ArgumentError, match="was removed"):
            made.frame_status(added)
        made.train(1)
        assert made.frame_status(4).taken_in
        with pytest.raises(nertca_vk.NotReadyError):
            made.drawn()
        made.render(geometry(0), (SIZE, SIZE))
        assert made.drawn() == nertca_vk.Drawn(frames=VIEWS * PHASES, step=1)


def test_pictures_between_phases(context: Context) -> None:
    with filled(context, **{"gaussians.form": "deformable"}) as made:
        made.train()
        live = [made.render(geometry(0), (SIZE, SIZE), phase, component="dynamic") for phase in (0, 0.5, 1)]
        assert np.abs(live[1] - live[0]).max() > 1e-3 and np.abs(live[1] - live[2]).max() > 1e-3
        assert np.array_equal(live[0], made.render(geometry(0), (SIZE, SIZE), 0.0, component="dynamic"))


def test_long_work_can_be_cancelled(context: Context) -> None:
    with filled(context) as made:
        made.add_frame(pixels(0, 0), geometry(0), phase=0, split="validation")
        made.train(1)
        ended: list[BaseException] = []

        def evaluate() -> None:
            try:
                while True:
                    made.evaluate()
            except nertca_vk.CancelledError as error:
                ended.append(error)

        worker = threading.Thread(target=evaluate)
        worker.start()
        while worker.is_alive():
            made.cancel()
        assert len(ended) == 1
        assert made.evaluate().images == 1
