"""The benchmarks that need a GPU to say something run on the CPU, too, with tiny settings."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from tests.scenes import photo_tar, shifted_pairs
from trainers import run_folder
from trainers.models import load_trained

ROOT = Path(__file__).resolve().parents[2]


def run(script, *arguments):
    command = [sys.executable, f"benchmarks/{script}.py", *map(str, arguments)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def test_the_speed_of_the_matchers_is_measured_by_plain_float32_and_by_tf32(tmp_path):
    sizes = "--height 64 --width 64 --iterations 1 --inference-iterations 1 --repeats 1 --warm-up 1 --models igev".split()
    shown = run("matchers", *sizes, "--ways", "bf16+channels_last", "tf32", "--json", tmp_path / "out" / "matchers.json")
    report = json.loads((tmp_path / "out" / "matchers.json").read_text())
    rows = {row["way"]: row for row in report["rows"]}
    assert list(rows) == ["float32", "tf32", "bf16+channels_last"] and all(f"igev {way}" in shown for way in rows)
    for way, row in rows.items():
        for part in ("step", "inference"):
            assert row[f"{part}_seconds"] > 0 and row[f"{part}_peak_gib"] > 0
            for other in ("float32", *(() if way == "float32" else ("tf32",))):
                ratio = rows[other][f"{part}_seconds"] / row[f"{part}_seconds"]
                assert row[f"{part}_x_{other}"] == ratio and f"{ratio:.2f}" in shown
    assert report["loss_ms"] > 0 and report["sizes"]["height"] == 64


def test_what_ten_minutes_teach_is_told_pair_by_pair_beside_sgbm(tmp_path):
    shifted_pairs(tmp_path / "pairs")
    tar, output = photo_tar(tmp_path / "photos.tar", 4), tmp_path / "output"
    tiny = "--size 32 64 --batch-size 1 --iterations 1 --evaluation-iterations 1 --workers 0 --tracker none --hidden-dims 8 8 8".split()
    tiny += "--corr-levels 2 --n-downsample 3 --shared-backbone".split()
    common = ("--model", "raft", "--sources", tar, "--stereo", tmp_path / "pairs", "--output", output)
    shown = run("ten_minutes", *common, "--minutes", 0.01, "--pace-steps", 2, "--", *tiny)
    report = json.loads((output / "scores.json").read_text())
    first, last = report["evaluations"][0], report["evaluations"][-1]
    assert first["step"] == 0 and last["step"] == report["steps"] >= 2
    table = shown[shown.index("bad-2, %") :].splitlines()
    for name, pairs in report["sgbm"].items():
        for pair, value in pairs.items():
            (line,) = [line for line in table if line.startswith(pair if pair == name else f"{name}/{pair} ")]
            expected = [value, first["bad_2_by_pair"][name][pair], last["bad_2_by_pair"][name][pair]]
            assert line.split()[-3:] == [f"{100 * score:.2f}" for score in expected]
    assert set(report["sgbm"]["pairs"]) == {"near", "far"} and "pairs, mean over pairs (2)" in shown
    assert load_trained(run_folder.newest(output / "run"), "raft_stereo")
