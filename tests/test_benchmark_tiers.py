"""The benchmark of the tiers runs on small networks, so that it will on large ones."""

import json

import pytest

pytest.importorskip("diffusers")

from benchmarks.tiers import main


def test_the_smoke_run_measures_every_tier(tmp_path, capsys):
    main(["--smoke", "--json", str(tmp_path / "figures.json")])
    figures = json.loads((tmp_path / "figures.json").read_text())
    tiers = [(row["steps"], row.get("autoencoder")) for row in figures["inpainting"]]
    assert tiers == [(0, None), (1, "full"), (4, "full"), (1, "tiny"), (4, "tiny")]
    assert all(row["pairs_per_second"] > 0 for row in figures["inpainting"])
    assert figures["depth"][0]["photos_per_second"] > 0
    assert "4 steps" in capsys.readouterr().out
