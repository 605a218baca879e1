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


def test_each_odd_photo_is_decoded_or_refused_as_expected(tmp_path):
    photos = hostile_photos()
    measured = measure("photos", tmp_path, photos)
    surprises = {}
    for name, (outcome, _, _) in measured.items():
        expected = photos[name].expected
        decoded = isinstance(outcome, list)
        if expected == EITHER:
            good = not decoded or len(outcome) == 2
        elif isinstance(expected, str):
            good = not decoded and outcome.startswith(expected)
        else:
            good = decoded and tuple(outcome) == expected
        if not good:
            surprises[name] = (outcome, expected)
    assert not surprises
    check_costs(measured)


def test_each_odd_tar_yields_and_reports_what_is_expected(tmp_path):
    tars = hostile_tars()
    measured = measure("tars", tmp_path, tars)
    surprises = {}
    for name, ((keys, problems), _, _) in measured.items():
        expected = tars[name]
        told = len(problems) == len(expected.problems) and all(
            part in problem for part, problem in zip(expected.problems, problems, strict=True)
        )
        if keys != expected.keys or not told:
            surprises[name] = (keys, problems[:5], expected.keys, expected.problems[:5])
    assert not surprises
    check_costs(measured)


def test_the_canary_sings_where_a_pickle_is_opened(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pickle.loads(pickle.dumps(Canary())).close()
    assert (tmp_path / "executed").exists()
