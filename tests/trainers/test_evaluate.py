from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from trainers import evaluate as command
from trainers.evaluate import evaluate, mean_scores, table
from trainers.models import load_matcher, load_trained, save_checkpoint
from trainers.pairs_on_disk import StereoPair, motorcycle
from trainers.sgbm import sgbm

REPOSITORY = Path(__file__).resolve().parents[2]
SMALL = {"hidden_dims": (16, 16, 16), "corr_levels": 2, "corr_radius": 2}


def textured_pair(name: str = "wall", disparity: int = 6, size: tuple[int, int] = (40, 96)) -> StereoPair:
    """A wall seen from two places; the left edge is out of the right camera's sight."""
    rng = np.random.default_rng(0)
    wall = rng.integers(0, 256, (size[0], size[1] + disparity, 3), dtype=np.uint8)
    truth = np.full(size, disparity, np.float32)
    nonoccluded = np.broadcast_to(np.arange(size[1]) >= disparity, size)
    return StereoPair(name, wall[:, :-disparity].copy(), wall[:, disparity:].copy(), truth, np.ones(size, bool), nonoccluded.copy())


def constant(value: float):
    return lambda left, right: torch.full_like(left[:, :1], value)


def test_scores_are_those_of_all_and_of_visible_pixels():
    pair = textured_pair(disparity=6)
    seen = []

    def predict(left, right):
        seen.append((left, right))
        prediction = torch.full_like(left[:, :1], 7.5)
        prediction[..., :6] = 16.0
        return prediction

    (result,) = evaluate(predict, [pair])
    left, right = seen[0]
    assert left.dtype == torch.float32 and left.shape == (1, 3, 40, 96)
    assert torch.equal(left[0], torch.from_numpy(pair.left).permute(2, 0, 1).float())
    assert torch.equal(right[0], torch.from_numpy(pair.right).permute(2, 0, 1).float())
    share = 6 / 96
    assert result["name"] == "wall" and result["seconds"] >= 0
    assert result["all"] == pytest.approx(
        {"pixels": 40 * 96, "epe": 1.5 + share * 8.5, "bad_1": 1.0, "bad_2": share, "bad_3": share, "d1": share}
    )
    assert result["noc"] == {"pixels": 40 * 90, "epe": 1.5, "bad_1": 1.0, "bad_2": 0.0, "bad_3": 0.0, "d1": 0.0}


def test_the_mean_is_over_pairs_and_leaves_out_those_without_a_pixel():
    small, large = textured_pair("small", 6, (8, 16)), textured_pair("large", 10, (40, 96))
    empty = small._replace(name="empty", valid=np.zeros((8, 16), bool))
    unmasked = large._replace(name="unmasked", nonoccluded=None)
    results = evaluate(constant(7.0), [small, large, empty, unmasked])
    means = mean_scores(results)
    assert means["all"]["pairs"] == 3 and means["all"]["epe"] == pytest.approx((1 + 3 + 3) / 3)
    assert means["noc"]["pairs"] == 2 and means["noc"]["epe"] == pytest.approx(2.0)
    assert results[2]["all"] == {"pixels": 0, "epe": None, "bad_1": None, "bad_2": None, "bad_3": None, "d1": None}
    json.dumps(results, allow_nan=False)
    nothing = mean_scores(results[2:3])
    assert nothing["all"] == {"pairs": 0, "epe": None, "bad_1": None, "bad_2": None, "bad_3": None, "d1": None}


def test_the_table_shows_pixels_and_percent():
    results = evaluate(constant(9.5), [textured_pair()])
    lines = [line.split() for line in table(results).splitlines()]
    assert lines[1] == ["wall", "all", "3.50", "100.00", "100.00", "100.00", "100.00"]
    assert lines[-1][:5] == ["mean", "of", "1", "noc", "3.50"]
    assert "-" in table(evaluate(constant(9.5), [textured_pair()._replace(valid=np.zeros((40, 96), bool))]))


def test_pictures_show_the_disparity_and_the_error(tmp_path):
    pair = textured_pair()
    pair.valid[:10] = False
    evaluate(constant(6.0), [pair], pictures=tmp_path / "new" / "pictures")
    disparity = cv2.imread(str(tmp_path / "new" / "pictures" / "wall_disparity.png"))
    error = cv2.imread(str(tmp_path / "new" / "pictures" / "wall_error.png"))
    assert disparity.shape == error.shape == (40, 96, 3)
    assert (error[:10] == 0).all() and error[10:].any()
    assert (disparity == disparity[0, 0]).all()


def test_a_prediction_that_is_no_answer_is_named():
    with pytest.raises(ValueError, match=r"wall: predicted \[1, 1, 40, 95\]"):
        evaluate(lambda left, right: left[:, :1, :, 1:], [textured_pair()])
    with pytest.raises(ValueError, match="wall: prediction is not finite"):
        evaluate(constant(math.nan), [textured_pair()])


def test_sgbm_finds_a_wall_and_fills_what_it_cannot_see():
    pairs = [textured_pair(disparity=6), textured_pair(disparity=11)]
    left, right = (
        torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2).float() for images in zip(*[pair[1:3] for pair in pairs], strict=True)
    )
    disparity = sgbm(left, right)
    assert disparity.shape == (2, 1, 40, 96) and disparity.dtype == torch.float32
    for found, pair in zip(disparity, pairs, strict=True):
        assert (found[0] - torch.from_numpy(pair.disparity)).abs().mean() < 0.1


def test_sgbm_is_fair_on_a_real_pair():
    (result,) = evaluate(sgbm, [motorcycle()])
    assert result["all"]["epe"] < 2 and result["all"]["bad_3"] < 0.1


def test_sgbm_of_nothing_is_zero():
    assert (sgbm(torch.zeros(1, 3, 32, 64), torch.full((1, 3, 32, 64), 255.0)) >= 0).all()


@pytest.fixture
def folder(tmp_path):
    pair = textured_pair()
    root = tmp_path / "pairs" / "wall"
    root.mkdir(parents=True)
    for name, image in (("left", pair.left), ("right", pair.right)):
        assert cv2.imwrite(str(root / f"{name}.png"), image[..., ::-1])
    assert cv2.imwrite(str(root / "disp.png"), (pair.disparity * 256).astype(np.uint16))
    return root.parent


@pytest.fixture
def checkpoint(tmp_path):
    matcher = load_matcher("raft_stereo", n_gru_layers=2, **SMALL)
    path = tmp_path / "step-00000010"
    path.mkdir()
    save_checkpoint(matcher, path / "model.safetensors")
    (path / "config.json").write_text(json.dumps({"model": "raft_stereo", "options": {**SMALL, "n_gru_layers": 2}}))
    return path, matcher


def run(monkeypatch, *arguments: object) -> None:
    monkeypatch.setattr(sys, "argv", ["evaluate.py", *map(str, arguments)])
    command.main()


def test_a_trained_folder_is_evaluated_with_its_own_options(monkeypatch, tmp_path, capsys, folder, checkpoint):
    path, matcher = checkpoint
    out = tmp_path / "results" / "scores.json"
    common = ["--model", "raft", "--dataset", "folder", "--root", folder, "--iterations", 2, "--device", "cpu", "--json", out]
    run(monkeypatch, *common, "--checkpoint", path, "--pictures", tmp_path / "pictures")
    report = json.loads(out.read_text())
    (expected,) = evaluate(lambda left, right: matcher.predict(left, right, iterations=2), [textured_pair()])
    assert report["pairs"][0]["all"] == pytest.approx(expected["all"], rel=1e-5)
    assert report["mean"]["all"]["epe"] == pytest.approx(expected["all"]["epe"], rel=1e-5)
    assert report["iterations"] == 2 and report["dataset"] == "folder"
    assert {file.name for file in (tmp_path / "pictures").iterdir()} == {"wall_disparity.png", "wall_error.png"}
    assert "EPE px" in capsys.readouterr().out

    run(monkeypatch, *common, "--checkpoint", path, "--corr-implementation", "alt")
    assert json.loads(out.read_text())["pairs"][0]["all"]["epe"] == pytest.approx(expected["all"]["epe"], rel=1e-4)

    flags = ["--hidden-dims", 16, 16, 16, "--corr-levels", 2, "--corr-radius", 2, "--n-gru-layers", 2]
    run(monkeypatch, *common, "--checkpoint", path / "model.safetensors", *flags)
    assert json.loads(out.read_text())["pairs"][0]["all"]["epe"] == pytest.approx(expected["all"]["epe"], rel=1e-5)


def test_sgbm_and_the_motorcycle_need_no_files(monkeypatch, tmp_path):
    run(monkeypatch, "--model", "sgbm", "--dataset", "motorcycle", "--json", tmp_path / "scores.json")
    report = json.loads((tmp_path / "scores.json").read_text())
    assert report["model"] == "sgbm" and report["checkpoint"] is None and report["iterations"] is None
    assert [pair["name"] for pair in report["pairs"]] == ["motorcycle"]


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        (["--model", "raft", "--dataset", "motorcycle"], ValueError, "--model raft needs --checkpoint"),
        (["--model", "sgbm", "--dataset", "folder"], ValueError, "--dataset folder needs --root"),
        (["--model", "sgbm", "--dataset", "eth3d"], ValueError, "--dataset eth3d needs --root"),
        (["--model", "sgbm", "--dataset", "motorcycle", "--checkpoint", "x"], ValueError, "sgbm has no weights"),
        (["--model", "sgbm", "--dataset", "motorcycle", "--corr-levels", "2"], ValueError, "sgbm has no weights"),
    ],
)
def test_arguments_that_do_not_fit_are_refused(monkeypatch, arguments, error, message):
    with pytest.raises(error, match=message):
        run(monkeypatch, *arguments)


def test_checkpoints_that_do_not_fit_are_named(tmp_path, checkpoint):
    path, _ = checkpoint
    with pytest.raises(ValueError, match="does not fit RAFTStereo"):
        load_trained(path, "raft_stereo", n_gru_layers=3)
    with pytest.raises(FileNotFoundError, match=r"config\.json; a checkpoint folder"):
        load_trained(tmp_path, "raft_stereo")
    (path / "config.json").write_text('{"model": "igev_stereo", "options": {}}')
    with pytest.raises(ValueError, match="holds a igev_stereo, not a raft_stereo"):
        load_trained(path, "raft_stereo")
    (path / "config.json").write_text("[]")
    with pytest.raises(ValueError, match=r"config\.json is to hold"):
        load_trained(path, "raft_stereo")


def test_the_command_runs_from_the_repository_and_fails_in_one_line():
    def run_script(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run([sys.executable, "trainers/evaluate.py", *arguments], cwd=REPOSITORY, capture_output=True, text=True)

    help_text = run_script("--help").stdout
    for word in ("--checkpoint", "--n-gru-layers", "mask_left.png", "kitti2015", "EPE"):
        assert word in help_text
    failed = run_script("--model", "raft", "--dataset", "motorcycle", "--checkpoint", "missing.pth")
    assert failed.returncode == 1 and failed.stderr.strip().splitlines()[-1] == "evaluate.py: no checkpoint file missing.pth"
    assert "Traceback" not in failed.stderr
