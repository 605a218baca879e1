import json

import pytest
import torch

from tests.scenes import grey_fill, layered_depth, photo_tar
from zsdata import AugmentConfig, ImageSource, ZeroStereoStream
from zsdata.cli import main
from zsdata.sources import parse_sources
from zsdata.statistics import source_statistics


@pytest.fixture
def sources(tmp_path):
    return {
        "wide": photo_tar(tmp_path / "wide.tar", 3, height=60, width=200),
        "tall": photo_tar(tmp_path / "tall.tar", 2, height=90, width=70),
    }


def open_stream(sources):
    return ZeroStereoStream(sources, size=None, depth=layered_depth, inpaint=grey_fill, augmentation=AugmentConfig.none())


def test_statistics_are_those_of_the_pairs(sources):
    rows = source_statistics(open_stream(sources), 5)
    assert list(rows) == ["tall", "wide"] and (rows["tall"].pairs, rows["wide"].pairs) == (2, 3)
    for name, row in rows.items():
        pairs = [pair for pair in open_stream(sources) if pair.meta["source"] == name]
        disparity = torch.cat([pair.disparity.flatten() for pair in pairs])
        assert row.mean_px == pytest.approx(disparity.mean().item(), rel=1e-4) and row.max_px == disparity.max().item()
        assert row.max_share == pytest.approx(row.max_px / pairs[0].disparity.shape[-1])
        assert row.hidden == pytest.approx(torch.stack([~pair.masks.nonocclusion for pair in pairs]).double().mean().item())
        assert row.invented == pytest.approx(torch.stack([pair.masks.inpaint for pair in pairs]).double().mean().item())
        assert 0 < row.abs_err < 0.5 and 0 < row.ssim < 1 and 0 < row.photometric < 0.5


def test_fewer_pairs_than_the_epoch_has_can_be_looked_at(sources):
    rows = source_statistics(open_stream(sources), 2)
    assert sum(row.pairs for row in rows.values()) == 2


@pytest.mark.filterwarnings("ignore:The built-in depth")
def test_the_command_prints_a_row_per_source(sources, tmp_path, capsys):
    command = ["stats", "--sources", *(f"{name}={path}" for name, path in sources.items()), "--json", str(tmp_path / "stats.json")]
    assert main(command) == 0
    out = capsys.readouterr().out
    assert [line.split()[:2] for line in out.splitlines()[2:]] == [["tall", "2"], ["wide", "3"]]
    figures = json.loads((tmp_path / "stats.json").read_text())
    assert figures["wide"]["pairs"] == 3 and 0 < figures["wide"]["mean_px"] < figures["wide"]["max_px"]


def test_sources_on_a_command_line():
    assert parse_sources(["a.tar", "s3://b/c=d.tar"]) == ["a.tar", "s3://b/c=d.tar"]
    assert parse_sources(["in=a.tar@0.7", "out=b.tar"]) == {"in": ImageSource("a.tar", 0.7), "out": ImageSource("b.tar")}
    for wrong in (["in=a.tar", "b.tar"], ["=a.tar"], ["in=a.tar", "in=b.tar"]):
        with pytest.raises(ValueError, match="got"):
            parse_sources(wrong)
