"""The benchmark of a stream: its figures fit together, and its advice names what they show. No test here knows how fast a machine is."""

import importlib
import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from zsdata import AugmentConfig, ZeroStereoStream, cli
from zsdata.bench import BenchReport, Run, advice, bench, feed, fill_depth_cache, leave_holes, samples_needed
from zsdata.export import export_pairs
from zsdata.exported import read_exported

from .scenes import grey_fill, jpeg, layered_depth, photo, photo_tar, write_tar

SIZE = (64, 96)


@pytest.fixture(scope="module")
def shard(tmp_path_factory):
    return photo_tar(tmp_path_factory.mktemp("bench") / "photos.tar", count=5)


def stream_of(shard, **options):
    return ZeroStereoStream(shard, **{"size": SIZE, "depth": layered_depth, "inpaint": grey_fill, **options})


def a_report(worker_ms, finish_ms, workers=2, waiting=0.9):
    runs = [Run(count, 8, 1.0, {"wait": waiting}, 0.0) for count in sorted({0, workers})]
    return BenchReport(1.0, worker_ms, finish_ms, tuple(runs))


def test_stages_add_up_to_the_time_of_a_pair(shard):
    report = bench(stream_of(shard), [0], batch_size=2, pairs=6)
    (run,) = report.runs
    whole = sum(report.worker_ms.values()) + sum(report.finish_ms.values())
    assert whole == pytest.approx(1e3 * run.seconds / run.pairs, rel=1e-6)
    assert {"read", "decode", "view", "depth", "disparity", "sharpen", "warp"} < report.worker_ms.keys()
    assert {"transfer", "inpaint", "augment"} < report.finish_ms.keys()
    assert min([*report.worker_ms.values(), *report.finish_ms.values(), report.decode_ms]) >= 0
    assert run.pairs == 6 and run.pairs_per_second == pytest.approx(6 / run.seconds)


def test_there_is_a_run_for_each_number_of_workers_and_one_without(shard):
    report = bench(stream_of(shard), [2, 1], batch_size=1, pairs=3)
    assert [(run.workers, run.pairs) for run in report.runs] == [(0, 3), (1, 3), (2, 4)]  # two batches from each worker at least
    assert all(0 <= run.waiting <= 1 and run.seconds > 0 for run in report.runs)


def test_a_benchmark_leaves_the_stream_where_it_is(shard):
    stream = stream_of(shard)
    next(iter(stream))
    before = stream.state_dict()
    bench(stream, [0], batch_size=2, pairs=2)
    assert stream.state_dict() == before


@pytest.mark.parametrize("workers", [0, 2])
def test_every_run_makes_the_same_pairs_within_one_epoch(shard, workers):
    needed = samples_needed([workers], batch_size=2, pairs=5)
    seen = []
    run = feed(
        stream_of(shard, epoch_size=needed),
        workers,
        batch_size=2,
        batches=max(3, 2 * workers),
        after_batch=lambda batch: seen.extend((meta["epoch"], meta["index"]) for meta in batch.meta),
    )
    assert seen == [(0, index) for index in range(len(seen))] and run.pairs < len(seen) <= needed


def test_a_filled_depth_cache_leaves_no_depth_to_estimate(shard, tmp_path):
    calls = []

    def estimator(images):
        calls.append(len(images))
        return layered_depth(images)

    estimator.cache_name = "counting"
    options = {"depth": estimator, "depth_cache": tmp_path, "epoch_size": samples_needed([0], batch_size=2, pairs=6)}
    fill_depth_cache(stream_of(shard, inpaint=leave_holes, augmentation=AugmentConfig.none(), **options), 0, options["epoch_size"])
    assert len(calls) == 2 * 5  # each photo and its mirror image
    bench(stream_of(shard, **options), [0], batch_size=2, pairs=6)
    assert len(calls) == 2 * 5


def test_bad_photos_are_replaced_and_not_decoded_for_the_reference(tmp_path):
    shard = write_tar(tmp_path / "photos.tar", {"0.jpg": b"<html>", "1.jpg": jpeg(photo(1)), "2.jpg": jpeg(photo(2))})
    report = bench(stream_of(shard), [0], batch_size=1, pairs=4)
    assert report.decode_ms > 0 and report.runs[0].pairs == 4


@pytest.mark.parametrize(
    ("report", "cached", "named"),
    [
        (
            a_report({"decode": 1.0, "depth": 8.0, "rest": 1.0}, {"augment": 3.0}),
            False,
            ["workers bound", "depth takes 80%", "--depth-cache DIR"],
        ),
        (a_report({"decode": 2.0, "depth": 8.0}, {"augment": 3.0}), True, ["depth takes 80%", "local disk"]),
        (a_report({"read": 6.0, "warp": 4.0}, {"augment": 3.0}), False, ["read takes 60%", "local disk"]),
        (a_report({"decode": 6.0, "warp": 4.0}, {"augment": 3.0}), False, ["decode takes 60%", "smaller photos"]),
        (
            a_report({"warp": 6.0}, {"augment": 3.0, "inpaint": 1.0}, waiting=0.1),
            False,
            ["training process bounds", "augment takes 75%", "cuda"],
        ),
        (a_report({"depth": 6.0}, {"augment": 3.0}, workers=0), False, ["one worker per core (4", "depth takes 100%"]),
    ],
)
def test_the_advice_names_what_bounds_the_stream_and_the_cure(report, cached, named):
    text = advice(report, device="cpu", cores=4, depth_cached=cached)
    assert all(words in text for words in named), text
    assert ("--depth-cache" in text) == (not cached and "depth takes" in text)


def test_the_advice_asks_for_more_workers_only_where_there_are_cores_for_them():
    report = a_report({"warp": 1.0}, {"augment": 1.0}, workers=4)
    assert "more of them" in advice(report, device="cpu", cores=8, depth_cached=False)
    assert "more of them" not in advice(report, device="cpu", cores=4, depth_cached=False)


def test_on_a_gpu_the_advice_does_not_send_the_work_to_a_gpu():
    report = a_report({"warp": 1.0}, {"finish on cuda": 9.0}, waiting=0.0)
    assert "--device cuda" not in advice(report, device="cuda", cores=4, depth_cached=True)


@pytest.fixture
def run(capsys):
    """Runs `zsdata bench` in this process: exit status, stdout, stderr."""

    def run(*arguments):
        status = cli.main(["bench", *(str(argument) for argument in arguments)])
        return (status, *capsys.readouterr())

    return run


@pytest.mark.filterwarnings("ignore:The built-in depth")
def test_the_command_prints_numbers_that_fit_together(run, shard, tmp_path):
    options = ["--size", 64, 96, "--batch-size", 2, "--pairs", 8, "--workers", 1, "--depth-cache", tmp_path / "depth"]
    status, out, _ = run("--sources", shard, *options)
    assert status == 0
    rows = dict(re.findall(r"^ *([a-z].*?) +([\d.]+ +[\d.]+% +[\d.]+)$", out, re.MULTILINE))
    ms, share, decodes = ({name: float(row.replace("%", "").split()[i]) for name, row in rows.items()} for i in range(3))
    decode_ms = float(re.search(r"a decode is ([\d.]+) ms", out)[1])
    assert share["both"] == 100 and share["a worker"] + share["the training process"] == pytest.approx(100, abs=0.1)
    stages = rows.keys() - {"both", "a worker", "the training process"}
    assert {"decode", "depth", "warp", "rest of a worker", "augment"} <= stages
    assert sum(share[name] for name in stages) == pytest.approx(100, abs=0.05 * len(stages))
    assert sum(ms[name] for name in stages) == pytest.approx(ms["both"], abs=0.005 * (len(stages) + 1))
    assert decodes["both"] == pytest.approx(ms["both"] / decode_ms, rel=0.05)
    table = re.findall(r"^ +(\d+) +([\d.]+) +([\d.]+) +(-|\d+%) +(-|[\d.]+)$", out, re.MULTILINE)
    assert [row[0] for row in table] == ["0", "1"]
    assert all(float(pairs) == pytest.approx(2 * float(batches), abs=0.1) for _, pairs, batches, _, _ in table)
    assert 1e3 / float(table[0][1]) == pytest.approx(ms["both"], rel=0.1)
    assert "bound" in out.splitlines()[-1]
    assert list((tmp_path / "depth").glob("depth-*")), "the cache lies where the user named it"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--device", "gpu"], "--device is"),
        (["--device", "cuda:99"], "GPUs? here; use --device cpu"),
        (["--size", 8, 8], "size is"),
        (["--depth", "no/such/folder/here"], "no/such/folder/here"),
    ],
)
def test_a_wrong_option_is_told_in_words(run, shard, options, message):
    status, out, error = run("--sources", shard, *options)
    assert (status, out) == (2, "")
    assert re.search(message, error) and error.startswith("zsdata: ") and error.count("\n") == 1


def test_a_missing_shard_is_told_before_anything_is_made(run, tmp_path):
    status, out, error = run("--sources", tmp_path / "none.tar")
    assert (status, out) == (2, "") and "none.tar" in error


def test_leave_holes_returns_the_right_view():
    right = torch.rand(1, 3, 4, 4)
    assert leave_holes(right, torch.ones(1, 1, 4, 4, dtype=torch.bool), []) is right


@pytest.mark.filterwarnings("ignore:The built-in depth")
def test_the_benchmark_of_pairs_prints_its_tables_and_writes_them_down(tmp_path, capsys, monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[1] / "benchmarks"))
    pairs = importlib.import_module("pairs")
    sizes = ((60, 80), (120, 160), (240, 320))  # in place of those of its tables
    for table in ("TARGETS", "PUBLISHED_DECODES"):
        monkeypatch.setattr(pairs, table, dict(zip(sizes, getattr(pairs, table).values(), strict=True)))
    monkeypatch.setattr(pairs, "SIZES", sizes)
    monkeypatch.setattr(pairs, "CROPS", (pairs.CROP,))
    monkeypatch.setattr(pairs, "BATCH_SIZE", 1)
    (tmp_path / "photos").mkdir()
    for seed in range(3):
        (tmp_path / "photos" / f"{seed}.jpg").write_bytes(jpeg(photo(seed)))
    (tmp_path / "photos" / "notes.txt").write_text("not a photo")
    options = ["--quick", "--workers", "1", "--photos", str(tmp_path / "photos"), "--json", str(tmp_path / "figures.json")]
    monkeypatch.setattr(sys, "argv", ["pairs.py", *options])
    pairs.main()

    out, figures = capsys.readouterr().out, json.loads((tmp_path / "figures.json").read_text())
    assert "60x80: 2 photos" in out and "240x320: 2 photos" in out and out.count("2 of them enlarged") == 1
    for size in ("60x80", "120x160", "240x320"):
        stages, read = figures["stages"][size], figures["reading"][size]
        parts = ["read", "decode", "view", "depth, cached", "disparity", "sharpen", "warp", "other"]
        assert all(stages[part]["ms"] > 0 for part in [*parts, "total", "depth, built-in"])
        assert read["ms"]["worker"] == stages["total"]["ms"] and read["bytes_per_pair"] > 0
        assert read["over"][1] < read["over"][0]  # augmentation comes on top of reading
    assert figures["geometry"]["warp"]["growth"] > 0
    assert [run["workers"] for run in figures["end_to_end"][1:]] == [0, 1]
    assert all(run["pairs_per_second"] > 0 for run in figures["workers"])


def test_reading_as_published_gives_a_training_sample(tmp_path, shard, monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[1] / "benchmarks"))
    published_set = importlib.import_module("published_set")
    export_pairs(stream_of(shard, size=None, augmentation=AugmentConfig.none()), tmp_path / "pairs", pairs=1)
    (pair,) = read_exported(tmp_path / "pairs")
    made = [published_set.decode_and_augment(pair, np.random.RandomState(seed)) for seed in (0, 0, 1)]
    images = {"left", "right", "left_clean", "right_clean"}
    assert {name: tuple(values.shape) for name, values in made[0].items()} == {
        name: (3 if name in images else 1, 384, 512) for name in made[0]
    }
    assert all(torch.equal(made[0][name], made[1][name]) for name in made[0])
    assert not torch.equal(made[0]["left"], made[2]["left"])
    assert all(set(made[0][name].unique().tolist()) <= {0.0, 1.0} for name in ("nonocclusion", "inpaint", "valid"))
    assert 0 < made[0]["disparity"].min() and made[0]["left"].max() <= 255
