"""The benchmarks of the tiers run on small networks, so that they will on large ones."""

import importlib
import json
import sys
from pathlib import Path

import pytest
import torch

pytest.importorskip("diffusers")

from benchmarks.tiers import main


def test_the_smoke_run_measures_every_tier(tmp_path, capsys):
    main(["--smoke", "--json", str(tmp_path / "figures.json")])
    figures = json.loads((tmp_path / "figures.json").read_text())
    tiers = [(row["steps"], row.get("autoencoder")) for row in figures["inpainting"]]
    assert tiers == [(0, None), (1, "full"), (4, "full"), (1, "tiny"), (4, "tiny")]
    assert all(row["pairs_per_second"] > 0 for row in figures["inpainting"])
    assert figures["depth"][0]["photos_per_second"] > 0
    one, four = (row["tflop"] for row in figures["inpainting"][1:3])
    assert 0 < one < four < 4 * one  # three steps more, encoding and decoding the same
    assert "4 steps" in capsys.readouterr().out


@pytest.fixture
def inpainting_memory(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "benchmarks")
    yield importlib.import_module("inpainting_memory")
    for name in ("inpainting_memory", "tiers"):
        sys.modules.pop(name)


def test_memory_is_counted_while_a_tensor_lives_and_once_for_all_its_views(inpainting_memory):
    given = torch.zeros(1000)
    with inpainting_memory.LiveBytes() as live:
        given.view(10, 100).add_(1)
        assert live.peak == 0
        made = given + 1
        assert live.peak == 4000
        halves = made[:500], made[500:]
        doubled = made * 2
        assert live.peak == 8000
        del made, doubled
        other = torch.zeros(500)  # the halves keep theirs alive
        assert live.peak == 8000
        del halves, other
        torch.zeros(2000)
        assert live.peak == 8000
        torch.zeros(2001)
        assert live.peak == 8004


def test_the_smoke_run_counts_the_memory_of_every_stage(inpainting_memory, capsys):
    inpainting_memory.main(["--smoke", "--size", "64", "96", "--micro-batch", "2"])
    header, full, tiny = (line.split() for line in capsys.readouterr().out.splitlines()[-3:])
    assert header == ["autoencoder", "weights", "encode", "denoise", "decode", "all", "process", "target"]
    assert [full[0], tiny[0]] == ["full", "tiny"]
    if sys.platform == "linux":
        assert float(full[6]) > 0.1 and float(tiny[6]) > 0.1  # torch alone takes more
