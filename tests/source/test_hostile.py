"""Odd and hostile files: each gets what a sensible user expects, and none costs time, memory or control."""

import json
import os
import pickle
import subprocess
import sys
import zlib
from pathlib import Path

from .hostile_photos import EITHER, Canary, hostile_photos
from .hostile_tars import hostile_tars
from .measured import SHARD, photo_outcome, tar_outcome

MOST_BYTES = 400_000_000  # for one file
MOST_SECONDS = 20  # for one file, on a machine with other work
ROOT = Path(__file__).resolve().parents[2]


def measure(what, folder, files):
    """What a process of its own makes of the files, which it makes anew: {name: (outcome, seconds, peak bytes)}."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "ZSDATA_CACHE": str(folder / "cache")}
    child = subprocess.run(
        [sys.executable, "-m", "tests.source.measured", what], cwd=folder, env=environment, capture_output=True, text=True, timeout=280
    )
    assert child.returncode == 0, child.stderr[-2000:]
    assert list(folder.iterdir()) == [], "something was executed, or written where nobody asked for it"
    lines = [json.loads(line) for line in child.stdout.splitlines()]
    assert {name: checksum for name, checksum, *_ in lines} == {name: zlib.crc32(odd.data) for name, odd in files.items()}
    return {name: rest for name, _, *rest in lines}


def check_costs(measured):
    too_slow = {name: seconds for name, (_, seconds, _) in measured.items() if seconds > MOST_SECONDS}
    too_large = {name: peak for name, (_, _, peak) in measured.items() if peak > MOST_BYTES}
    assert not too_slow and not too_large


def test_there_are_as_many_as_promised():
    assert len({odd.data for odd in hostile_photos().values()}) >= 100
    assert len({odd.data for odd in hostile_tars().values()}) >= 70


def surprising_photos(outcomes):
    """Those with another outcome than what is expected."""
    photos, surprises = hostile_photos(), {}
    for name, outcome in outcomes.items():
        expected = photos[name].expected
        decoded = not isinstance(outcome, str)
        if expected == EITHER:
            good = not decoded or len(outcome) == 2
        elif isinstance(expected, str):
            good = not decoded and outcome.startswith(expected)
        else:
            good = decoded and tuple(outcome) == expected
        if not good:
            surprises[name] = (outcome, expected)
    return surprises


def surprising_tars(outcomes):
    tars, surprises = hostile_tars(), {}
    for name, (keys, problems) in outcomes.items():
        expected = tars[name]
        told = len(problems) == len(expected.problems) and all(map(str.__contains__, problems, expected.problems))
        if keys != expected.keys or not told:
            surprises[name] = (keys, problems[:5], expected.keys, expected.problems[:5])
    return surprises


def test_each_odd_photo_is_decoded_or_refused_as_expected(tmp_path):
    measured = measure("photos", tmp_path, hostile_photos())
    assert not surprising_photos({name: outcome for name, (outcome, *_) in measured.items()})
    check_costs(measured)


def test_each_odd_tar_yields_and_reports_what_is_expected(tmp_path):
    measured = measure("tars", tmp_path, hostile_tars())
    assert not surprising_tars({name: outcome for name, (outcome, *_) in measured.items()})
    check_costs(measured)


def is_large(odd):
    return isinstance(odd.expected, tuple) and odd.expected[0] * odd.expected[1] > 10**6


def test_the_small_ones_give_no_warning_either(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    photos = {name: odd.data for name, odd in hostile_photos().items() if len(odd.data) < 6_000_000 and not is_large(odd)}
    assert not surprising_photos({name: photo_outcome(data) for name, data in photos.items()})
    outcomes = {}
    for name, odd in hostile_tars().items():
        if len(odd.data) < 200_000 and not odd.length:
            (tmp_path / SHARD).write_bytes(odd.data)
            outcomes[name] = tar_outcome()
    assert len(photos) > 150 and len(outcomes) > 90 and not surprising_tars(outcomes)


def test_the_canary_sings_where_a_pickle_is_opened(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pickle.loads(pickle.dumps(Canary())).close()
    assert (tmp_path / "executed").exists()
