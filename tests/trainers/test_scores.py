from __future__ import annotations

import csv
import json

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from tests.oracles_scores import NAMES, plain_edges, plain_scores
from trainers.pairs_on_disk import StereoPair
from trainers.scores import METRICS, all_means, mean_scores, score, table, write_csv
from zsdata.metrics import bad_pixel_rate, d1, disparity_edges, end_point_error


def broken_pair(seed: int, name: str = "broken", *, group: str = "", seen: float | None = 0.6, known: float = 0.7):
    """A pair whose ground truth has holes, infinities and NaN, and a prediction that is off by up to some 8 px."""
    rng = np.random.default_rng(seed)
    stored = np.kron(rng.permutation([8.3, 27.1, 54.6, 81.9]).reshape(2, 2), np.ones((20, 24))).astype(np.float32)
    stored[rng.random(stored.shape) > known] = 0
    stored[rng.random(stored.shape) < 0.05] = np.inf
    stored[rng.random(stored.shape) < 0.05] = np.nan
    prediction = np.where(np.isfinite(stored), stored, 1000) + rng.normal(0, 2.5, stored.shape)
    valid = np.isfinite(stored) & (stored > 0)
    image = np.zeros((*stored.shape, 3), np.uint8)
    nonoccluded = None if seen is None else rng.random(stored.shape) < seen
    pair = StereoPair(name, image, image, np.where(valid, stored, 0).astype(np.float32), valid, nonoccluded, group)
    return pair, stored, prediction.astype(np.float32)


@pytest.mark.parametrize("seed", range(4))
def test_every_region_is_scored_as_counted_pixel_by_pixel(seed):
    pair, stored, prediction = broken_pair(seed)
    scores = score(torch.from_numpy(prediction), pair, below_px=(40, 12.5))
    edges = plain_edges(stored, pair.valid)
    counted = {"": np.ones_like(edges), "_edges": edges, "_below_40": stored < 40, "_below_12.5": stored < 12.5}
    assert list(scores) == [f"{seen}{part}" for part in counted for seen in ("all", "noc")]
    assert 0 < (edges & pair.valid).sum() < pair.valid.sum()
    for part, mask in counted.items():
        assert scores[f"all{part}"] == pytest.approx(plain_scores(prediction, stored, mask), rel=1e-9)
        assert scores[f"noc{part}"] == pytest.approx(plain_scores(prediction, stored, mask & pair.nonoccluded), rel=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_the_scores_are_those_of_the_metrics_to_the_last_bit(seed):
    pair, _, prediction = broken_pair(seed)
    maps = torch.from_numpy(prediction), torch.from_numpy(pair.disparity)
    valid, seen = torch.from_numpy(pair.valid), torch.from_numpy(pair.nonoccluded)
    scores = score(maps[0], pair, below_px=(54.6,))
    regions = {"": valid, "_edges": valid & disparity_edges(maps[1], valid), "_below_54.6": valid & (maps[1] < 54.6)}
    for name, region in regions.items():
        for kind, counted in (("all", region), ("noc", region & seen)):
            bad = {f"bad_{limit:g}": bad_pixel_rate(*maps, counted, threshold_px=limit) for limit in (0.5, 1, 2, 3)}
            expected = {"epe": end_point_error(*maps, counted), **bad, "d1": d1(*maps, counted)}
            assert scores[kind + name] == {"pixels": int(counted.sum()), **expected}


class CountsConversions(TorchDispatchMode):
    """To float64, of which a pass over the errors needs one of the prediction and one of the truth."""

    count = 0

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        self.count += function is torch.ops.aten._to_copy.default and (kwargs or {}).get("dtype") is torch.float64
        return function(*args, **(kwargs or {}))


def test_the_errors_are_computed_once_for_all_scores_of_all_regions():
    pair, _, prediction = broken_pair(0)
    with CountsConversions() as conversions:
        score(torch.from_numpy(prediction), pair, below_px=(20, 40))
    assert conversions.count == 2


def test_a_pair_without_a_mask_or_a_pixel_has_no_scores():
    pair, _, prediction = broken_pair(0, seen=None)
    scores = score(torch.from_numpy(prediction), pair, below_px=(1,))
    assert scores["noc"] is None and scores["noc_edges"] is None and scores["noc_below_1"] is None
    assert scores["all_below_1"] == {"pixels": 0, **dict.fromkeys(METRICS)}


def test_what_is_predicted_where_nothing_counts_does_not_matter():
    pair, _, prediction = broken_pair(1)
    before = score(torch.from_numpy(prediction), pair)
    prediction[~pair.valid] = np.nan
    assert score(torch.from_numpy(prediction), pair) == before
    prediction[pair.valid] = np.nan
    with pytest.raises(ValueError, match="prediction is not finite"):
        score(torch.from_numpy(prediction), pair)


def results_of(*pairs) -> list[dict]:
    return [{"name": pair.name, "group": pair.group, **score(torch.from_numpy(prediction), pair)} for pair, _, prediction in pairs]


def test_means_are_over_pairs_or_over_pixels():
    pairs = [broken_pair(2, known=0.9), broken_pair(3, known=0.2), broken_pair(4, seen=None), broken_pair(5, known=0)]
    results = results_of(*pairs)
    plain = [plain_scores(prediction, stored) for _, stored, prediction in pairs]
    assert [scores["pixels"] == 0 for scores in plain] == [False, False, False, True]
    by_pair, by_pixel = mean_scores(results), mean_scores(results, over_pixels=True)
    assert by_pair["all"]["pairs"] == by_pixel["all"]["pairs"] == 3 and by_pair["noc"]["pairs"] == 2
    pixels = sum(scores["pixels"] for scores in plain)
    for name in NAMES:
        assert by_pair["all"][name] == pytest.approx(sum(scores[name] for scores in plain[:3]) / 3)
        assert by_pixel["all"][name] == pytest.approx(sum(scores[name] * scores["pixels"] for scores in plain[:3]) / pixels)
        assert abs(by_pair["all"][name] - by_pixel["all"][name]) > 1e-6


def test_nothing_to_count_has_no_mean():
    results = results_of(broken_pair(5, known=0, seen=None))
    assert mean_scores(results)["all"] == {"pairs": 0, **dict.fromkeys(METRICS)}
    assert mean_scores([])["noc"] == {"pairs": 0, **dict.fromkeys(METRICS)}
    json.dumps(results, allow_nan=False)


def test_groups_have_means_of_their_own():
    results = results_of(broken_pair(0, group="rainy"), broken_pair(1, group="foggy"), broken_pair(2, group="rainy"))
    means = all_means(results)
    assert list(means) == ["mean over pairs", "mean over pixels", "foggy, mean over pairs", "rainy, mean over pairs"]
    assert means["rainy, mean over pairs"] == mean_scores([results[0], results[2]])
    assert means["foggy, mean over pairs"]["all"]["epe"] == results[1]["all"]["epe"]
    assert list(all_means(results[::2])) == ["mean over pairs", "mean over pixels"]


def test_the_table_shows_pixels_and_percent():
    image, wall = np.zeros((10, 20, 3), np.uint8), np.full((10, 20), 6, np.float32)
    pair = StereoPair("wall", image, image, wall, np.ones((10, 20), bool), np.ones((10, 20), bool))
    lines = table(results_of((pair, wall, wall + np.float32(1.25)))).splitlines()
    assert [line.split() for line in lines[1:]] == [
        ["wall", "all", "1.25", "100.00", "100.00", "0.00", "0.00", "0.00"],
        ["wall", "noc", "1.25", "100.00", "100.00", "0.00", "0.00", "0.00"],
        ["mean", "over", "pairs", "(1)", "all", "1.25", "100.00", "100.00", "0.00", "0.00", "0.00"],
        ["mean", "over", "pairs", "(1)", "noc", "1.25", "100.00", "100.00", "0.00", "0.00", "0.00"],
        ["mean", "over", "pixels", "(1)", "all", "1.25", "100.00", "100.00", "0.00", "0.00", "0.00"],
        ["mean", "over", "pixels", "(1)", "noc", "1.25", "100.00", "100.00", "0.00", "0.00", "0.00"],
    ]
    assert len({len(line) for line in lines}) == 1
    empty = pair._replace(valid=np.zeros((10, 20), bool))
    assert table(results_of((empty, wall, wall))).splitlines()[1].split() == ["wall", "all", *"------"]


def test_many_pairs_are_shown_by_their_means_only():
    results = results_of(*[broken_pair(0, f"pair-{i}") for i in range(41)])
    assert "pair-40" not in table(results) and "mean over pairs (41)" in table(results)
    assert "pair-39" in table(results[:40])


def test_the_csv_file_holds_every_score(tmp_path):
    results = results_of(broken_pair(0, "one", group="rainy"), broken_pair(1, "two", group="foggy", seen=None))
    write_csv(tmp_path / "scores.csv", results)
    with (tmp_path / "scores.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["name"], row["region"]) for row in rows[:6]] == [
        *[("one", region) for region in ("all", "noc", "all_edges", "noc_edges")],
        *[("two", region) for region in ("all", "all_edges")],
    ]
    assert rows[0]["group"] == "rainy" and int(rows[0]["pixels"]) == results[0]["all"]["pixels"]
    assert {name: float(rows[5][name]) for name in METRICS} == {name: results[1]["all_edges"][name] for name in METRICS}
    (mean,) = [row for row in rows if (row["name"], row["region"]) == ("mean over pairs", "all")]
    assert float(mean["epe"]) == mean_scores(results)["all"]["epe"] and mean["pixels"] == ""
