from __future__ import annotations

import json
import math
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from tests.oracles_scores import plain_edges, plain_scores
from tests.scenes import SHARED
from tests.trainers.benchmark_folders import write_benchmark
from trainers import evaluate as command
from trainers.benchmarks_on_disk import BENCHMARKS
from trainers.evaluate import evaluate
from trainers.models import load_matcher, load_trained, save_checkpoint
from trainers.pairs_on_disk import StereoPair, motorcycle
from trainers.sgbm import sgbm

REPOSITORY = Path(__file__).resolve().parents[2]
SHARED_PAIRS = SHARED / "data" / "stereo"
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
        time.sleep(0.01)
        seen.append((left, right))
        prediction = torch.full_like(left[:, :1], 7.5)
        prediction[..., :6] = 16.0
        return prediction

    (result,) = evaluate(predict, [pair])
    left, right = seen[0]
    assert left.dtype == torch.float32 and left.shape == (1, 3, 40, 96)
    assert torch.equal(left[0], torch.from_numpy(pair.left).permute(2, 0, 1).float())
    assert torch.equal(right[0], torch.from_numpy(pair.right).permute(2, 0, 1).float())
    truth, everywhere = pair.disparity, np.ones((40, 96), bool)
    prediction = np.where(np.arange(96) < 6, 16.0, 7.5) * np.ones((40, 1))
    assert result["name"] == "wall" and result["seconds"] >= 0.01
    assert result["all"] == pytest.approx(plain_scores(prediction, truth, everywhere))
    assert result["noc"] == pytest.approx(plain_scores(prediction, truth, pair.nonoccluded))
    assert result["noc"]["epe"] == 1.5 and result["noc"]["bad_2"] == 0


def test_a_pair_that_does_not_fit_is_told_what_helps():
    def full(left, right):
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 42 GiB")

    def host_is_full(left, right):
        raise RuntimeError("[enforce fail at alloc_cpu.cpp:127] . DefaultCPUAllocator: can't allocate memory: you tried to allocate 42")

    def broken(left, right):
        raise RuntimeError("expected scalar type Half but found Float")

    for predict in (full, host_is_full):
        with pytest.raises(MemoryError, match=r"wall, 96 x 40 px, does not fit into the memory of cpu: --tile-rows 512 .*alt.*bf16"):
            evaluate(predict, [textured_pair()])
    with pytest.raises(RuntimeError, match="expected scalar type"):
        evaluate(broken, [textured_pair()])


def test_pictures_show_the_disparity_and_the_error(tmp_path):
    pair = textured_pair()
    pair.valid[:10] = False
    evaluate(constant(3.0), [pair], pictures=tmp_path / "new" / "pictures")
    disparity = cv2.imread(str(tmp_path / "new" / "pictures" / "wall_disparity.png"))
    error = cv2.imread(str(tmp_path / "new" / "pictures" / "wall_error.png"))
    assert disparity.shape == error.shape == (40, 96, 3)
    assert (error[:10] == 0).all() and error[10:].any()
    half = cv2.applyColorMap(np.full((1, 1), 128, np.uint8), cv2.COLORMAP_TURBO)
    assert (disparity == half).all(), "half as near as the nearest point in truth"


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
    ("arguments", "message"),
    [
        (["--device", "banana"], "argument --device: banana cannot be used here"),
        (["--device", "cuda:99"], "argument --device: cuda:99 cannot be used here"),
        (["--iterations", "0"], "argument --iterations: 1 or more was expected, got 0"),
        (["--below", "0"], "argument --below: a disparity above 0 px was expected, got 0"),
    ],
)
def test_a_value_out_of_range_is_refused_with_its_option(monkeypatch, capsys, arguments, message):
    with pytest.raises(SystemExit):
        run(monkeypatch, "--model", "sgbm", "--dataset", "motorcycle", *arguments)
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--model", "raft", "--dataset", "motorcycle"], "--model raft needs --checkpoint"),
        (["--model", "sgbm", "--dataset", "folder"], "--dataset folder needs --root"),
        (["--model", "sgbm", "--dataset", "eth3d"], "--dataset eth3d needs --root"),
        (["--model", "sgbm", "--dataset", "motorcycle", "--checkpoint", "x"], "sgbm has no weights"),
        (["--model", "sgbm", "--dataset", "motorcycle", "--variant", "H"], "motorcycle has no variants"),
        (["--model", "sgbm", "--dataset", "motorcycle", "--tile-rows", "8"], "at least 256 rows high; got 8"),
    ],
)
def test_arguments_that_do_not_fit_are_refused(monkeypatch, arguments, message):
    with pytest.raises(ValueError, match=message):
        run(monkeypatch, *arguments)


# What the made-up images stand for: the disparity that a matcher reads out of their left red channel.
RED_MATCHER = "def predict(left, right):\n    return left[:, 0] / 4 + 0.5\n"
LAYOUTS = [(name, variant) for name, benchmark in BENCHMARKS.items() for variant in benchmark.variants or ("",)]


@pytest.mark.parametrize(("name", "variant"), LAYOUTS)
def test_a_benchmark_in_its_official_layout_is_scored_as_counted_pixel_by_pixel(monkeypatch, tmp_path, capsys, name, variant):
    pairs = write_benchmark(name, tmp_path / "data", variant)
    (tmp_path / "red_matcher.py").write_text(RED_MATCHER)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", sys.path[:])
    out, lines = tmp_path / "scores.json", tmp_path / "scores.csv"
    run(
        monkeypatch,
        *["--model", "red_matcher:predict", "--dataset", name, "--root", "data", "--device", "cpu", "--json", out, "--csv", lines],
        *(["--variant", variant] if variant else []),
        *(["--below", 30, 50] if name == "middlebury" else []),
    )
    monkeypatch.delitem(sys.modules, "red_matcher")
    report = json.loads(out.read_text())
    assert [scores["name"] for scores in report["pairs"]] == list(pairs)
    limits = {"middlebury": (30, 50), "sceneflow": (192,)}.get(name, ())
    plain: dict[str, list[dict]] = {}
    for scores, pair in zip(report["pairs"], pairs.values(), strict=True):
        prediction = pair.left[..., 0] / 4 + 0.5
        valid = np.isfinite(pair.truth) & (pair.truth > 0)
        parts = {"": valid, "_edges": plain_edges(pair.truth, valid), **{f"_below_{limit}": pair.truth < limit for limit in limits}}
        for part, counted in parts.items():
            expected = plain_scores(prediction, pair.truth, counted)
            assert scores[f"all{part}"] == pytest.approx(expected, rel=1e-6)
            plain.setdefault(f"all{part}", []).append(expected)
            if pair.nonoccluded is None:
                assert scores[f"noc{part}"] is None
            else:
                expected = plain_scores(prediction, pair.truth, counted & pair.nonoccluded)
                assert scores[f"noc{part}"] == pytest.approx(expected, rel=1e-6)
                plain.setdefault(f"noc{part}", []).append(expected)
    for region, both in plain.items():
        assert report["mean"][region]["bad_2"] == pytest.approx((both[0]["bad_2"] + both[1]["bad_2"]) / 2, rel=1e-6)
        pixels = both[0]["pixels"] + both[1]["pixels"]
        expected = sum(scores["bad_3"] * scores["pixels"] for scores in both) / pixels
        assert report["means"]["mean over pixels"][region]["bad_3"] == pytest.approx(expected, rel=1e-6)
    weathers = [title for title in report["means"] if title not in ("mean over pairs", "mean over pixels")]
    assert weathers == (["foggy, mean over pairs", "rainy, mean over pairs"] if name == "drivingstereo" else [])
    assert report["complete"] is False and (report["variant"] or "") == variant
    shown = capsys.readouterr()
    assert f"only 2 of the {BENCHMARKS[name].pairs} pairs of {name} are there" in shown.err
    assert all(title in shown.out for title in pairs) and lines.read_text().count("mean over pairs") >= len(plain)


@pytest.mark.skipif(not SHARED_PAIRS.is_dir(), reason="no development data")
def test_sgbm_is_fair_on_all_real_pairs(monkeypatch, tmp_path):
    common = ["--model", "sgbm", "--dataset", "folder", "--root", SHARED_PAIRS]
    run(monkeypatch, *common, "--json", tmp_path / "scores.json", "--pictures", tmp_path / "pictures")
    report = json.loads((tmp_path / "scores.json").read_text())
    assert len(report["pairs"]) == 12 and len(list((tmp_path / "pictures").iterdir())) == 24
    assert report["mean"]["all"]["bad_2"] < 0.11 and report["mean"]["noc"]["bad_2"] < 0.05
    assert report["mean"]["all_edges"]["bad_2"] > 2 * report["mean"]["all"]["bad_2"]
    assert all(pair["all"]["bad_2"] < 0.2 for pair in report["pairs"])


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
    for word in ("--checkpoint", "--n-gru-layers", "mask_left.png", "disp_noc_0", "EPE", "package.module:callable"):
        assert word in help_text
    failed = run_script("--model", "raft", "--dataset", "motorcycle", "--checkpoint", "missing.pth")
    assert failed.returncode == 1 and failed.stderr.strip().splitlines()[-1] == "evaluate.py: no checkpoint file missing.pth"
    assert "Traceback" not in failed.stderr
