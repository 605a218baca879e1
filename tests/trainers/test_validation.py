from __future__ import annotations

import pytest
import torch

from tests.scenes import shifted_pairs
from tests.trainers.benchmark_folders import write_benchmark
from trainers.pairs_on_disk import PairFiles
from trainers.validation import EvaluationSet, Validation


def results(**values: float | None) -> dict:
    """One set for each value, of one pair with this EPE."""
    metrics = ("bad_0.5", "bad_1", "bad_2", "bad_3", "d1")
    return {
        name: [{"name": "pair", "all": {"pixels": 0 if value is None else 9, "epe": value, **dict.fromkeys(metrics, value)}, "noc": None}]
        for name, value in values.items()
    }


def test_a_spec_names_a_benchmark_its_variant_and_its_folder(tmp_path):
    write_benchmark("middlebury", tmp_path / "MiddEval3", "Q")
    write_benchmark("kitti2015", tmp_path / "kitti")
    quarter = EvaluationSet.parse(f"middlebury:Q={tmp_path / 'MiddEval3'}")
    assert (quarter.name, quarter.dataset, quarter.variant) == ("middlebury:Q", "middlebury", "Q")
    pairs, total = quarter.pairs()
    assert total == 2 and [pair.name for pair in pairs] == ["first", "second"]
    assert EvaluationSet.parse(f"kitti2015={tmp_path / 'kitti'}").pairs()[1] == 2
    assert EvaluationSet.parse("motorcycle").pairs()[1] == 1


@pytest.mark.parametrize(
    ("spec", "error", "message"),
    [
        ("kitti2015", ValueError, "kitti2015=DIR"),
        ("middlebury:X={root}", ValueError, "variants of middlebury are H, F, Q; got X"),
        ("middlebury:F={root}", FileNotFoundError, "no left image of middlebury"),
        ("motorcycle={root}", ValueError, "motorcycle.*no folder"),
        ("eth3d=nowhere", FileNotFoundError, "no folder nowhere"),
        ("folder=nowhere", FileNotFoundError, "no folder nowhere"),
        ("nowhere", FileNotFoundError, "no folder nowhere"),
        ("kitty=nowhere", ValueError, 'no data set is called "kitty"; there is motorcycle, kitti2012, .*, folder'),
    ],
)
def test_a_spec_that_cannot_be_opened_is_refused_at_once(tmp_path, spec, error, message):
    with pytest.raises(error, match=message):
        EvaluationSet.parse(spec.format(root=tmp_path))


def test_the_best_has_the_least_mean_over_the_sets():
    validation = Validation([], best_by="epe")
    assert validation.is_best(results(one=2.0, two=4.0), step=10)
    assert not validation.is_best(results(one=1.0, two=5.0), step=20), "as good is not better"
    assert validation.is_best(results(one=3.0, two=2.0), step=30)
    assert validation.best == {"step": 30, "value": 2.5, "by": "epe", "sets": [], "iterations": None}
    assert not validation.is_best({}, step=40)
    assert validation.value(results(one=3.0, empty=None)) == 3.0


def test_the_best_is_forgotten_when_another_measure_tells_it():
    first = Validation([], best_by="epe")
    first.is_best(results(one=2.0), step=10)
    same, other = Validation([], best_by="epe"), Validation([], best_by="d1")
    for validation in (same, other):
        validation.load_state_dict(first.state_dict())
    assert same.best == first.best and other.best is None


def test_the_best_is_forgotten_when_other_sets_or_iterations_tell_it_and_kept_where_none_do(tmp_path):
    write_benchmark("kitti2015", tmp_path / "kitti")
    here = EvaluationSet.parse(f"kitti2015={tmp_path / 'kitti'}")
    motorcycle = EvaluationSet.parse("motorcycle")
    first = Validation([here], iterations=8)
    first.is_best(results(kitti2015=2.0), step=10)
    for sets, iterations, known in (
        ([here], 8, True),
        ([], 8, True),
        ([motorcycle], 8, False),
        ([here, motorcycle], 8, False),
        ([here], 16, False),
    ):
        later = Validation(sets, iterations=iterations)
        later.load_state_dict(first.state_dict())
        assert later.best == (first.best if known else None), (sets, iterations)


def test_ranks_share_the_pairs_and_know_all_scores_and_the_first_shows_how_far_it_is(tmp_path, monkeypatch, capsys):
    write_benchmark("kitti2015", tmp_path)
    seen = []
    entries: list = []
    monkeypatch.setattr("trainers.validation.gather_object", lambda mine: entries.extend(mine) or entries)
    validation = Validation([EvaluationSet.parse(f"kitti2015={tmp_path}")])

    def predict(left, right):
        seen.append(left)
        return torch.ones_like(left[:, :1])

    for rank in (1, 0):
        scores = validation.judge(predict, device=torch.device("cpu"), rank=rank, world_size=2)["kitti2015"]
        assert ("evaluate: 100%" in capsys.readouterr().err) == (rank == 0)
    assert len(seen) == 2 and [score["name"] for score in scores] == ["000000_10", "000001_10"]


def test_a_rank_reads_no_pair_but_those_that_it_judges(tmp_path, monkeypatch):
    for i in range(4):
        for folder in shifted_pairs(tmp_path / str(i)).iterdir():
            folder.rename(tmp_path / f"{i}-{folder.name}")
        (tmp_path / str(i)).rmdir()
    read = PairFiles.read
    names: list[str] = []
    monkeypatch.setattr(PairFiles, "read", lambda files: names.append(files.name) or read(files))
    monkeypatch.setattr("trainers.validation.gather_object", lambda mine: mine)
    one = EvaluationSet.parse(str(tmp_path))
    for rank in range(4):
        names.clear()
        scores = Validation([one]).judge(lambda left, _: left[:, :1], device=torch.device("cpu"), rank=rank, world_size=4)[one.name]
        expected = [f"{i}-{name}" for i in range(4) for name in ("far", "near")][rank::4]
        assert names == [score["name"] for score in scores] == expected and len(names) == 2
    assert [len(list(EvaluationSet.parse("motorcycle").pairs(rank=rank, world_size=2)[0])) for rank in (0, 1)] == [1, 0]


def test_scene_flow_is_judged_below_192_px_too_as_published(tmp_path, monkeypatch):
    write_benchmark("sceneflow", tmp_path, "finalpass")
    monkeypatch.setattr("trainers.validation.gather_object", lambda mine: mine)
    one = EvaluationSet.parse(f"sceneflow={tmp_path}")
    scores = Validation([one]).judge(lambda left, _: left[:, :1], device=torch.device("cpu"), rank=0, world_size=1)["sceneflow"]
    assert all(0 < score["all_below_192"]["pixels"] < score["all"]["pixels"] for score in scores) and len(scores) == 2


def test_two_sets_of_one_name_and_an_unknown_measure_are_refused(tmp_path):
    one = EvaluationSet("pairs", "folder", tmp_path)
    with pytest.raises(ValueError, match="one name: pairs, pairs"):
        Validation([one, one])
    with pytest.raises(ValueError, match=r"best_by is one of epe, .*; got 'bad-2'"):
        Validation([one], best_by="bad-2")
