from __future__ import annotations

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest
import torch
from accelerate import Accelerator, DistributedType
from accelerate.state import AcceleratorState
from accelerate.tracking import GeneralTracker
from safetensors.torch import load_file

from tests.scenes import grey_fill, layered_depth, photo_tar, shifted_pairs
from trainers import igev, loop, raft, run_folder
from trainers.accelerated import load_optimizer_state, optimizer_state
from trainers.arguments import add_training_arguments, leave_black, open_stream, run
from trainers.evaluate import evaluate
from trainers.loop import TrainConfig, train
from trainers.models import load_matcher, load_trained, save_checkpoint
from trainers.models.raft_stereo import RAFTStereo
from trainers.step_guard import MOST_SKIPPED_IN_A_ROW, TrainingDiverged
from trainers.training_loss import TrainingLoss
from trainers.validation import EvaluationSet, Validation
from trainers.weight_average import WeightAverage
from zsdata import AugmentConfig, StereoBatch, ZeroStereoStream
from zsdata.metrics import reconstruction_error
from zsdata.synthesis.backward_warp import backward_warp

pytestmark = pytest.mark.filterwarnings("ignore::zsdata.synthesis.depth.builtin.BuiltinDepthWarning")
PAPERS_LOSS = TrainingLoss()
ROOT = Path(__file__).resolve().parents[2]
SMALL = {"hidden_dims": (32, 32, 32), "n_downsample": 3, "n_gru_layers": 2, "shared_backbone": True, "corr_levels": 2}
SMALL_ARGUMENTS = "--hidden-dims 32 32 32 --n-downsample 3 --n-gru-layers 2 --shared-backbone --corr-levels 2".split()


@pytest.fixture(autouse=True)
def fresh_accelerator():
    yield
    AcceleratorState._reset_state(reset_partial_state=True)


@pytest.fixture(scope="module")
def tar(tmp_path_factory):
    return photo_tar(tmp_path_factory.mktemp("tar") / "photos.tar", 8)


def small_stream(tar, **options):
    return ZeroStereoStream(tar, **{"size": (64, 96), "depth": layered_depth, "inpaint": grey_fill, **options})


def run_training(tar, output, config, resume=None, loss=PAPERS_LOSS, sets=(), tracker=None, **options):
    torch.manual_seed(config.seed)
    matcher = load_matcher("raft_stereo", **SMALL)
    matcher.freeze_bn()
    stream = small_stream(tar, **options)
    train(
        matcher,
        loss,
        stream,
        config,
        output=output,
        model_config={"model": "raft_stereo", "options": SMALL},
        arguments={},
        resume=resume,
        sets=sets,
        tracker=tracker,
    )
    return matcher


def recorder(seen):
    def loss(initial, sequence, batch):
        seen.append([(meta["epoch"], meta["index"]) for meta in batch.meta])
        return PAPERS_LOSS(initial, sequence, batch)

    return loss


def config(**options):
    return TrainConfig(**{"batch_size": 2, "iterations": 2, "workers": 0, "save_every": 2, **options})


class Handful:
    """A few real pairs over and over, in the place of the stream: over-fitting needs the same ones each time."""

    def __init__(self, stream, count):
        self.batch = StereoBatch.stack([stream.replay(0, index) for index in range(count)])

    def loader(self, batch_size, **options):
        return self

    def __iter__(self):
        return iter([self.batch])

    def state_dict(self):
        return {"epoch": 0, "samples": 0}

    def stats(self):
        return {"seconds": {}}

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        pass


def test_a_small_matcher_overfits_a_handful_of_pairs(tar, tmp_path):
    torch.manual_seed(0)
    matcher = load_matcher("raft_stereo", **SMALL)
    matcher.freeze_bn()
    handful = Handful(small_stream(tar, augmentation=AugmentConfig.none()), 4)
    settings = config(steps=80, iterations=4, save_every=1000)
    train(matcher, PAPERS_LOSS, handful, settings, output=tmp_path, model_config={}, arguments={}, tracker=None)
    epes = [json.loads(line)["epe"] for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    disparity = handful.batch.disparity
    blind = (disparity - disparity.median()).abs().mean().item()  # of the best constant
    assert min(epes[-4:]) < 0.7 * blind  # 0.4 to 0.5 of it over several seeds: single steps jump


def fails_at_call(number, loss):
    """As `loss`, but the power goes out at its call `number`."""
    calls = iter(range(number))

    def failing(initial, sequence, batch):
        if next(calls, None) is None:
            raise RuntimeError("power cut")
        return loss(initial, sequence, batch)

    return failing


def test_a_run_that_fails_leaves_no_process_though_its_error_is_kept(tar, tmp_path):
    """As a notebook keeps the last one, with all that its frames know."""
    before = set(psutil.Process().children())
    with pytest.raises(RuntimeError, match="power cut") as kept:
        run_training(tar, tmp_path / "run", config(steps=4, workers=2), loss=fails_at_call(1, PAPERS_LOSS))
    assert set(psutil.Process().children()) <= before and kept.tb is not None


@pytest.mark.parametrize(("accumulate", "workers"), [(1, 2), (2, 0)])
def test_a_resumed_run_equals_the_unbroken_one(tar, tmp_path, accumulate, workers):
    whole, broken, resumed = [], [], []
    settings = config(steps=6, accumulate=accumulate, workers=workers)
    unbroken = run_training(tar, tmp_path / "unbroken", settings, loss=recorder(whole))
    with pytest.raises(RuntimeError, match="power cut"):
        run_training(tar, tmp_path / "broken", settings, loss=fails_at_call(4 * accumulate, recorder(broken)))
    AcceleratorState._reset_state(reset_partial_state=True)
    after = run_training(tar, tmp_path / "broken", settings, resume=tmp_path / "broken", loss=recorder(resumed))
    assert broken + resumed == whole
    for name, weight in unbroken.state_dict().items():
        assert torch.equal(after.state_dict()[name], weight), name


def terminated_at_call(number, loss):
    """As `loss`, but at its call `number` a cluster takes the machine back: all processes get SIGTERM."""
    calls = iter(range(number))

    def signalled(initial, sequence, batch):
        if next(calls, None) is None:
            psutil.Process().terminate()
            for child in psutil.Process().children():
                child.terminate()
        return loss(initial, sequence, batch)

    return signalled


@pytest.mark.parametrize(("accumulate", "workers"), [(1, 2), (2, 0)])
def test_a_run_that_is_asked_to_end_saves_the_step_it_is_at(tar, tmp_path, capsys, accumulate, workers):
    whole, ended, resumed = [], [], []
    settings, output = config(steps=6, accumulate=accumulate, workers=workers, save_every=100), tmp_path / "ended"
    unbroken = run_training(tar, tmp_path / "unbroken", settings, loss=recorder(whole))
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(SystemExit) as end:
        run_training(tar, output, settings, loss=terminated_at_call(2 * accumulate, recorder(ended)), resume=output)
    assert end.value.code == 143 and signal.getsignal(signal.SIGTERM) == before
    said = capsys.readouterr().out
    assert f"no checkpoint in {output} yet: the run begins" in said
    assert f"{output / 'checkpoints' / 'step-00000003'} is saved, and --resume {output} goes on from it" in said
    AcceleratorState._reset_state(reset_partial_state=True)
    after = run_training(tar, output, settings, resume=output, loss=recorder(resumed))
    assert ended + resumed == whole and len(ended) == 3 * accumulate
    for name, weight in unbroken.state_dict().items():
        assert torch.equal(after.state_dict()[name], weight), name


@contextmanager
def fork_server():
    """Python's own choice from 3.14 on."""
    before = multiprocessing.get_start_method()
    multiprocessing.set_start_method("forkserver", force=True)
    try:
        yield
    finally:
        multiprocessing.set_start_method(before, force=True)


def test_workers_are_forked_by_the_trainer_itself_as_a_server_would_end_by_a_signal_to_all_processes(tar, tmp_path):
    def loss(initial, sequence, batch):
        workers = psutil.Process().children(recursive=True)
        assert len(workers) >= 2 and set(workers) == set(psutil.Process().children())
        return PAPERS_LOSS(initial, sequence, batch)

    with fork_server():
        run_training(tar, tmp_path / "run", config(steps=1, workers=2), loss=loss)


@pytest.mark.parametrize("step", [2, 3])
def test_a_run_that_is_asked_to_end_while_it_is_judged_ends_at_once_and_is_judged_when_resumed(
    tar, tmp_path, pairs_folder, monkeypatch, capsys, step
):
    settings, output = config(steps=3, evaluate_every=2, evaluation_iterations=1), tmp_path / "run"
    sets, judged, predict = [EvaluationSet.parse(str(pairs_folder))], [], RAFTStereo.predict

    def ended(*arguments, **options):
        judged.append(int(run_folder.newest(output).name[-1]))
        if judged[-1] == step:
            psutil.Process().terminate()
        return predict(*arguments, **options)

    with monkeypatch.context() as patch, pytest.raises(SystemExit) as end:
        patch.setattr(RAFTStereo, "predict", ended)
        run_training(tar, output, settings, sets=sets, resume=output)
    assert end.value.code == 143 and judged.count(step) == 1
    assert f"step-0000000{step} is saved, and --resume {output} goes on from it" in capsys.readouterr().out
    AcceleratorState._reset_state(reset_partial_state=True)
    run_training(tar, output, settings, sets=sets, resume=output)
    assert [line["step"] for line in read_lines(output / "evaluations.jsonl")] == [2, 3]


def test_every_step_has_as_many_batches_wherever_an_epoch_ends(tar, tmp_path, monkeypatch):
    monkeypatch.setattr(loop, "LOG_EVERY_STEPS", 1)
    run_training(tar, tmp_path / "run", config(steps=4, accumulate=3), epoch_size=10)
    places = [(line["epoch"], line["samples"]) for line in read_lines(tmp_path / "run" / "log.jsonl")]
    assert [10 * epoch + samples for epoch, samples in places] == [6, 12, 18, 24]


def test_a_resumed_run_whose_steps_have_other_numbers_of_pairs_says_so(tar, tmp_path, capsys):
    run_training(tar, tmp_path / "run", config(steps=2))
    checkpoint = run_folder.newest(tmp_path / "run")
    for batch_size, accumulate, said in ((1, 2, False), (1, 1, True)):
        AcceleratorState._reset_state(reset_partial_state=True)
        capsys.readouterr()
        settings = config(steps=2, batch_size=batch_size, accumulate=accumulate)
        run_training(tar, tmp_path / f"accumulate {accumulate}", settings, resume=checkpoint)
        assert ("a step was of 2 pairs and is of 1 from here on" in capsys.readouterr().out) == said


def test_the_matcher_sees_the_augmented_pair_and_the_log_tells_how_well_the_clean_one_fits(tar, tmp_path, monkeypatch):
    seen, fits, forward = [], [], RAFTStereo.forward
    monkeypatch.setattr(loop, "RECONSTRUCT_EVERY_STEPS", 1)
    monkeypatch.setattr(
        RAFTStereo, "forward", lambda matcher, *images, **options: seen.extend(images) or forward(matcher, *images, **options)
    )

    def loss(initial, sequence, batch):
        assert torch.equal(seen[0], batch.left) and torch.equal(seen[1], batch.right)
        assert not torch.equal(batch.left, batch.left_clean) and not torch.equal(batch.right, batch.right_clean)
        fits.append(reconstruction_error(batch.left_clean, batch.right_clean, batch.disparity))
        return PAPERS_LOSS(initial, sequence, batch)

    run_training(tar, tmp_path, config(steps=1, batch_size=1, iterations=1), loss=loss)
    (line,) = read_lines(tmp_path / "log.jsonl")
    for name, errors in fits[0]._asdict().items():
        assert line[f"reconstruction_{name}"] == pytest.approx(errors.mean().item(), rel=1e-6)


def test_gradients_are_clipped_to_the_norm_that_is_asked_for(tar, tmp_path):
    """Adam takes steps of one length whatever the gradient's, but none where it is far below its epsilon."""
    torch.manual_seed(0)
    begin = load_matcher("raft_stereo", **SMALL).state_dict()["cnet.conv1.weight"]
    for clip_norm, moves in ((1e-20, False), (1.0, True)):
        after = run_training(tar, tmp_path / str(clip_norm), config(steps=1, batch_size=1, iterations=1, clip_norm=clip_norm)).state_dict()[
            "cnet.conv1.weight"
        ]
        assert ((after - begin).abs().max() > 1e-6) == moves


def test_the_schedule_is_that_of_raft_stereo_in_optimizer_steps(tar, tmp_path):
    """Linear, up in 1 % and down in the rest of 100 steps more than the training has; of AdamW with the weight decay that is asked for."""
    run_training(tar, tmp_path, config(steps=2, batch_size=1, iterations=1, accumulate=2, weight_decay=3e-4))
    last, highest, up = 2 + 100 - 1, 2e-4, 0.01 * 102 - 1
    expected = highest + (highest / 25 / 1e4 - highest) * (2 - up) / (last - up)
    assert json.loads((tmp_path / "log.jsonl").read_text())["learning_rate"] == pytest.approx(expected, rel=1e-6)
    training, _ = run_folder.load(run_folder.newest(tmp_path))
    (group,) = training["optimizer"]["param_groups"]
    assert group["weight_decay"] == 3e-4 and group["eps"] == 1e-8


@pytest.fixture
def pairs_folder(tmp_path):
    return shifted_pairs(tmp_path / "pairs")


def nan_in_step(number, loss):
    """As `loss`, but NaN at its call `number`, counted over what it is shared by."""
    calls = []

    def sometimes(initial, sequence, batch):
        value, metrics = loss(initial, sequence, batch)
        calls.append(batch)
        return (value * float("nan") if len(calls) == number else value), metrics

    return sometimes


def test_the_average_the_best_and_the_skipped_steps_come_back_on_resume(tar, tmp_path, pairs_folder, monkeypatch):
    settings = config(steps=7, ema=0.9, save_every=3, evaluate_first=True, evaluate_every=2, evaluation_iterations=2, best_by="epe")
    sets, averaged, update = [EvaluationSet.parse(str(pairs_folder))], [], WeightAverage.update
    monkeypatch.setattr(WeightAverage, "update", lambda average, network, step: averaged.append(step) or update(average, network, step))
    run_training(tar, tmp_path / "unbroken", settings, loss=nan_in_step(4, PAPERS_LOSS), sets=sets)
    assert averaged == [1, 2, 3, 5, 6, 7], "not the step that was skipped"
    loss = nan_in_step(4, PAPERS_LOSS)
    with pytest.raises(RuntimeError, match="power cut"):
        run_training(tar, tmp_path / "broken", settings, loss=fails_at_call(5, loss), sets=sets)
    AcceleratorState._reset_state(reset_partial_state=True)
    run_training(tar, tmp_path / "resumed", settings, resume=tmp_path / "broken", loss=loss, sets=sets)

    last, expected = (run_folder.newest(tmp_path / name) for name in ("resumed", "unbroken"))
    assert last.name == expected.name == "step-00000007"
    (training, state), (expected_training, expected_state) = run_folder.load(last), run_folder.load(expected)
    for name in ("stream", "validation", "guard"):
        assert state[name] == expected_state[name], name
    assert state["guard"]["skipped"] == 1 and state["validation"]["best"]["by"] == "epe"
    weights, average = expected_training["weights"], load_file(expected / "model.safetensors")
    assert any(not torch.equal(average[name], weights[name]) for name in weights), "the average is the weights"
    assert all(torch.equal(training["weights"][name], weight) for name, weight in weights.items())
    assert all(torch.equal(value, average[name]) for name, value in load_file(last / "model.safetensors").items())

    lines = [json.loads(line) for line in (tmp_path / "unbroken" / "evaluations.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [0, 2, 4, 6, 7]
    assert len({line["epe"] for line in lines}) == len(lines), "some weights were judged twice"
    for line in lines:
        by_pair = line["epe_by_pair"]["pairs"]
        assert list(by_pair) == ["far", "near"] and sum(by_pair.values()) / 2 == pytest.approx(line["epe"])
    best = min(lines, key=lambda line: line["epe"])
    for folder in (tmp_path / "unbroken" / "best", tmp_path / "resumed" / "best"):
        assert json.loads((folder / "state.json").read_text())["step"] == best["step"]
    scores = json.loads((tmp_path / "resumed" / "evaluation.json").read_text())["sets"]["pairs"]["pairs"]
    assert [one["name"] for one in scores] == ["far", "near"]
    expected_scores = json.loads((tmp_path / "unbroken" / "evaluation.json").read_text())["sets"]["pairs"]["pairs"]
    assert [one["all"] for one in scores] == [one["all"] for one in expected_scores]
    saved = partial(load_trained(expected, "raft_stereo").predict, iterations=2)
    assert [one["all"] for one in evaluate(saved, sets[0].pairs()[0])] == [one["all"] for one in scores], "the average is judged"
    assert [line["step"] for line in read_lines(tmp_path / "resumed" / "evaluations.jsonl")] == [6, 7], "4 was judged before"


def power_cut_at_call(number, function):
    """As `function`, but the power goes out at its call `number`, before it does anything."""
    calls = iter(range(1, number))

    def failing(*arguments, **options):
        if next(calls, None) is None:
            raise RuntimeError("power cut")
        return function(*arguments, **options)

    return failing


STOPS = [
    (Validation, "judge", 1),
    (Validation, "judge", 3),
    (run_folder, "amend", 2),
    (run_folder, "amend", 3),
    (run_folder, "keep_best", 1),
]


@pytest.mark.parametrize(("where", "name", "call"), STOPS, ids=[f"{name} {call}" for _, name, call in STOPS])
def test_a_step_is_saved_before_it_is_judged_and_a_run_that_stops_there_judges_it_when_resumed(
    tar, tmp_path, pairs_folder, monkeypatch, where, name, call
):
    settings = config(steps=5, ema=0.5, evaluate_every=2, evaluation_iterations=1, best_by="epe")
    sets, unbroken, broken = [EvaluationSet.parse(str(pairs_folder))], tmp_path / "unbroken", tmp_path / "broken"
    run_training(tar, unbroken, settings, sets=sets)
    steps = [2, 4, 5]
    assert [line["step"] for line in read_lines(unbroken / "evaluations.jsonl")] == steps
    AcceleratorState._reset_state(reset_partial_state=True)
    with monkeypatch.context() as patch, pytest.raises(RuntimeError, match="power cut"):
        patch.setattr(where, name, power_cut_at_call(call, getattr(where, name)))
        run_training(tar, broken, settings, sets=sets)
    assert run_folder.newest(broken) == run_folder.folder_of(broken, steps[call - 1])
    AcceleratorState._reset_state(reset_partial_state=True)
    run_training(tar, broken, settings, sets=sets, resume=broken)
    for step in steps:
        (_, expected), (_, found) = (run_folder.load(run_folder.folder_of(output, step)) for output in (unbroken, broken))
        assert found["validation"] == expected["validation"] and found["validation"]["judged_step"] == step
    best = [json.loads((output / "best" / "state.json").read_text()) for output in (unbroken, broken)]
    assert best[0]["step"] == best[1]["step"] == best[0]["validation"]["best"]["step"] == best[1]["validation"]["best"]["step"]
    judged = [{line["step"]: line["epe"] for line in read_lines(output / "evaluations.jsonl")} for output in (unbroken, broken)]
    assert judged[0] == judged[1]


def test_an_evaluation_that_does_not_fit_is_told_where_the_checkpoint_is_and_how_to_go_on(tar, tmp_path, pairs_folder, monkeypatch):
    def full(*arguments, **options):
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(RAFTStereo, "predict", full)
    with pytest.raises(MemoryError, match=r"far, 96 x 64 px, .*step-00000002 is saved, .*--tile-rows .*--resume .*run goes on") as error:
        run_training(tar, tmp_path / "run", config(steps=2), sets=[EvaluationSet.parse(str(pairs_folder))])
    assert "--mixed-precision" not in str(error.value), "which an evaluation does not heed"
    assert run_folder.newest(tmp_path / "run").name == "step-00000002"


def test_the_rates_in_the_log_leave_out_what_evaluations_and_checkpoints_take(tar, tmp_path, pairs_folder, monkeypatch):
    clock = SimpleNamespace(seconds=0.0)

    def takes(seconds, function):
        def taking(*arguments, **options):
            clock.seconds += seconds
            return function(*arguments, **options)

        return taking

    monkeypatch.setattr(loop, "time", SimpleNamespace(perf_counter=lambda: clock.seconds))
    monkeypatch.setattr(loop, "LOG_EVERY_STEPS", 2)
    monkeypatch.setattr(Validation, "judge", takes(1000, Validation.judge))
    monkeypatch.setattr(run_folder, "save", takes(100, run_folder.save))
    settings = config(steps=6, accumulate=2, save_every=2, evaluate_every=3, evaluate_first=True, evaluation_iterations=1)
    run_training(tar, tmp_path / "run", settings, loss=takes(0.5, PAPERS_LOSS), sets=[EvaluationSet.parse(str(pairs_folder))])
    rates = [line["pairs_per_second"] for line in read_lines(tmp_path / "run" / "log.jsonl")]
    assert rates == [settings.batch_size / 0.5] * 3


def test_the_share_of_waiting_is_that_of_the_time_since_the_last_line(monkeypatch):
    clock = iter([100.0, 104.0])
    monkeypatch.setattr(loop, "time", SimpleNamespace(perf_counter=lambda: next(clock)))
    before, here = loop._Mark(step=10, wait_seconds=50.0), loop._Mark(step=20, wait_seconds=51.0)
    assert before.rates(80, here) == {"pairs_per_second": 20.0, "wait_share": 0.25}


def test_the_best_of_another_folder_or_of_the_checkpoint_itself_is_restored(tar, tmp_path, pairs_folder):
    settings = config(steps=2, evaluation_iterations=1)
    run_training(tar, tmp_path / "run", settings, sets=[EvaluationSet.parse(str(pairs_folder))])
    checkpoint = run_folder.newest(tmp_path / "run")
    assert run_folder.restore_best(checkpoint, tmp_path / "elsewhere", 2)
    assert (tmp_path / "elsewhere" / "best" / "model.safetensors").is_file()
    assert not run_folder.restore_best(checkpoint, tmp_path / "elsewhere", 1)
    assert not list((tmp_path / "elsewhere").glob(".*"))


def test_where_the_best_is_gone_the_next_one_that_is_judged_takes_its_place(tar, tmp_path, pairs_folder):
    settings = config(steps=4, evaluate_every=2, evaluation_iterations=1, best_by="epe")
    sets = [EvaluationSet.parse(str(pairs_folder))]
    run_training(tar, tmp_path / "run", settings, sets=sets)
    checkpoint = run_folder.folder_of(tmp_path / "run", 2)
    state = json.loads((checkpoint / "state.json").read_text())
    state["validation"]["best"] |= {"step": 1, "value": 0.0}  # better than all that come
    moved = tmp_path / "moved" / checkpoint.name
    moved.parent.mkdir()
    checkpoint.rename(moved)
    (moved / "state.json").write_text(json.dumps(state))
    AcceleratorState._reset_state(reset_partial_state=True)
    run_training(tar, tmp_path / "resumed", settings, sets=sets, resume=moved)
    assert json.loads((tmp_path / "resumed" / "best" / "state.json").read_text())["step"] == 4
    assert json.loads((tmp_path / "resumed" / "evaluation.json").read_text())["best"]["step"] == 4


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["--steps", "4"], r"with steps 2, this one has 4; .*--initial-weights .*model.safetensors"),
        (["--learning-rate", "0.1"], "with learning_rate 0.0002, this one has 0.1"),
        (["--ema", "0.9"], "with ema None, this one has 0.9"),
        (["--corr-radius", "3"], "with corr_radius 4, this one has 3"),
        (["--iterations", "3"], "with iterations 2, this one has 3"),
        (["--loss", "l1"], "with the loss's name zero, this one has l1"),
        (["--corr-implementation", "alt"], None),
    ],
)
def test_what_a_run_cannot_change_on_its_way_is_refused_on_resume(tar, tmp_path, monkeypatch, change, message):
    run_command(monkeypatch, *arguments_for(tar, tmp_path / "run", "--steps", 2, "--save-every", 1))
    changed = arguments_for(tar, tmp_path / "new", "--steps", 2, *change, "--resume", tmp_path / "run" / "checkpoints" / "step-00000001")
    if message is None:
        run_command(monkeypatch, *changed)
    else:
        with pytest.raises(SystemExit, match=message):
            run_command(monkeypatch, *changed)


def test_a_run_of_other_supervised_disparities_is_not_resumed(tar, tmp_path):
    run_training(tar, tmp_path / "run", config(steps=2))
    AcceleratorState._reset_state(reset_partial_state=True)
    with pytest.raises(ValueError, match="with the loss's max_disparity 700, this one has 192"):
        run_training(tar, tmp_path / "run", config(steps=2), resume=tmp_path / "run", loss=TrainingLoss(max_disparity=192))


def test_a_run_of_another_matcher_is_not_resumed(tar, tmp_path, monkeypatch):
    run_training(tar, tmp_path / "run", config(steps=2))
    with pytest.raises(SystemExit, match="is of a run that trains raft_stereo; this one trains igev_stereo"):
        run_command(monkeypatch, *arguments_for(tar, tmp_path / "new", "--resume", tmp_path / "run", small=[]), trainer=igev)


def test_another_run_keeps_its_checkpoints_and_no_photo_is_read(tar, tmp_path, monkeypatch):
    run_training(tar, tmp_path / "run", config(steps=2))
    with pytest.raises(FileExistsError, match=r"holds the checkpoints of an earlier run, up to step 2: --resume .* another --output"):
        run_training(tar, tmp_path / "run", config(steps=1))
    assert run_folder.newest(tmp_path / "run").name == "step-00000002"
    with pytest.raises(SystemExit, match=r"^raft.py: .*checkpoints of an earlier run"):
        run_command(monkeypatch, *arguments_for("nowhere.tar", tmp_path / "run"))


def test_a_run_folder_holds_what_evaluation_and_resume_need(tar, tmp_path):
    matcher = run_training(tar, tmp_path / "run", config(steps=9))
    folder = run_folder.newest(tmp_path / "run")
    assert folder.name == "step-00000009"
    weights = load_file(folder / "model.safetensors")
    assert all(torch.equal(weights[name], value) for name, value in matcher.state_dict().items())
    assert json.loads((folder / "config.json").read_text())["model"] == "raft_stereo"
    state = json.loads((folder / "state.json").read_text())
    assert state["stream"]["samples"] == 2 and state["provenance"]["versions"]["torch"] == torch.__version__
    assert len(list((tmp_path / "run" / "checkpoints").iterdir())) == run_folder.KEPT_CHECKPOINTS


def test_an_unfinished_checkpoint_is_not_resumed_from(tar, tmp_path):
    run_training(tar, tmp_path / "run", config(steps=2))
    unfinished = tmp_path / "run" / "checkpoints" / ".step-00000004.123"
    unfinished.mkdir()
    (unfinished / "state.json").write_text("{}")
    assert run_folder.newest(tmp_path / "run").name == "step-00000002"
    with pytest.raises(FileNotFoundError, match="no checkpoint to resume from"):
        run_folder.newest(tmp_path)


def test_a_step_with_nan_changes_nothing_and_its_samples_are_written_down(tar, tmp_path):
    """The weights are those before the step, and so is what the optimizer remembers of them."""
    whole = run_training(tar, tmp_path / "run", config(steps=3, save_every=2), loss=nan_in_step(3, PAPERS_LOSS))
    before = run_folder.load(tmp_path / "run" / "checkpoints" / "step-00000002")
    after = run_folder.load(tmp_path / "run" / "checkpoints" / "step-00000003")
    weights = load_file(tmp_path / "run" / "checkpoints" / "step-00000002" / "model.safetensors")
    assert all(torch.equal(weights[name], value) for name, value in whole.state_dict().items())
    moments = [training["optimizer"]["state"] for training, _ in (before, after)]
    assert all(torch.equal(one[key], moments[0][i][key]) for i, one in moments[1].items() for key in one)
    (line,) = [json.loads(line) for line in (tmp_path / "run" / "skipped.jsonl").read_text().splitlines()]
    assert line["step"] == 2 and line["loss"] == "nan" and line["reason"].startswith("the loss is nan")
    assert [(sample["epoch"], sample["index"], sample["source"]) for sample in line["samples"]] == [(0, 4, "photos"), (0, 5, "photos")]
    assert all(sample["shard"] == tar and sample["key"].startswith("0000") for sample in line["samples"])
    (log,) = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert log["skipped_steps"] == 1 and log["loss"] is None


def test_too_many_skipped_steps_in_a_row_are_an_error_and_the_run_can_be_resumed(tar, tmp_path):
    def broken(initial, sequence, batch):
        loss, metrics = PAPERS_LOSS(initial, sequence, batch)
        return loss * float("inf"), metrics

    settings = config(steps=MOST_SKIPPED_IN_A_ROW + 1)
    with pytest.raises(TrainingDiverged, match=rf"the loss is inf at step {MOST_SKIPPED_IN_A_ROW - 1}.*skipped.jsonl.*replay"):
        run_training(tar, tmp_path / "run", settings, loss=broken)
    AcceleratorState._reset_state(reset_partial_state=True)
    matcher = run_training(tar, tmp_path / "run", settings, resume=tmp_path / "run", loss=recorder([]))
    assert all(torch.isfinite(weight).all() for weight in matcher.state_dict().values())


def test_a_device_that_is_too_small_is_an_error_that_says_what_to_lower(tar, tmp_path):
    def full(initial, sequence, batch):
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.")

    with pytest.raises(MemoryError, match=r"lower --batch-size .* CUDA out of memory"):
        run_training(tar, tmp_path / "run", config(steps=1), loss=full)


def test_mixed_precision_trains_and_judges_as_evaluate_does(tar, tmp_path, pairs_folder):
    sets = [EvaluationSet.parse(str(pairs_folder))]
    settings = config(steps=2, mixed_precision="bf16", channels_last=True, evaluation_iterations=3)
    run_training(tar, tmp_path / "run", settings, sets=sets)
    scores = json.loads((tmp_path / "run" / "evaluation.json").read_text())["sets"]["pairs"]["pairs"]
    matcher = load_trained(tmp_path / "run" / "best", "raft_stereo")
    pairs, _ = sets[0].pairs()
    again = evaluate(partial(matcher.predict, iterations=3), pairs)
    for one, other in zip(scores, again, strict=True):
        assert one["all"]["epe"] == pytest.approx(other["all"]["epe"], rel=1e-4)


def test_the_options_for_speed_reach_the_matcher(tar, tmp_path, monkeypatch):
    compiled = []
    monkeypatch.setattr(RAFTStereo, "compile_parts", lambda matcher: compiled.append(matcher))
    matcher = run_training(tar, tmp_path / "run", config(steps=1, compile=True, channels_last=True))
    assert compiled == [matcher] and matcher.cnet.conv1.weight.is_contiguous(memory_format=torch.channels_last)


class Notebook(GeneralTracker):
    name = "notebook"
    requires_logging_directory = False

    def __init__(self):
        super().__init__()
        self.logged = {}

    @property
    def tracker(self):
        return self.logged

    def store_init_configuration(self, values):
        self.logged["configuration"] = values

    def log(self, values, step=None, **kwargs):
        self.logged.setdefault(step, {}).update(values)


def test_a_tracker_gets_the_configuration_the_losses_and_the_scores(tar, tmp_path, pairs_folder, monkeypatch):
    monkeypatch.setattr(loop, "RECONSTRUCT_EVERY_STEPS", 10)
    notebook = Notebook()
    settings = config(steps=10, evaluation_iterations=1, save_every=100)
    run_training(tar, tmp_path / "run", settings, sets=[EvaluationSet.parse(str(pairs_folder))], tracker=notebook)
    assert notebook.logged["configuration"]["learning_rate"] == settings.learning_rate
    values = notebook.logged[10]
    assert values["loss"] > 0 and values["pairs/bad_2"] >= 0 and 0 < values["reconstruction_ssim"] <= 1


def test_a_tracker_that_is_not_installed_is_an_error(tar, tmp_path, monkeypatch):
    monkeypatch.setattr("accelerate.tracking.get_available_trackers", lambda: [])
    with pytest.raises(ImportError, match="tracker wandb is not installed: pip install wandb"):
        run_training(tar, tmp_path / "run", config(steps=1), tracker="wandb")


def test_a_network_in_shards_is_refused(tar, tmp_path, monkeypatch):
    monkeypatch.setattr(Accelerator, "distributed_type", property(lambda accelerator: DistributedType.FSDP))
    with pytest.raises(ValueError, match=r"was told to use FSDP; .* launch with --multi_gpu"):
        run_training(tar, tmp_path / "run", config(steps=1))


ACCELERATE = [Path(sys.executable).with_name("accelerate"), "launch", "--cpu", "--num_machines", "1", "--mixed_precision", "no"]
ACCELERATE += ["--dynamo_backend", "no", "--num_processes"]
TORCHRUN = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node"]


def launch(arguments, processes, script="trainers/raft.py", launcher=ACCELERATE, **variables):
    command = [*launcher, processes, script, *arguments]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", **variables}
    return subprocess.run([*map(str, command)], cwd=ROOT, capture_output=True, text=True, env=environment, timeout=240)


def arguments_for(tar, output, *more, small=SMALL_ARGUMENTS):
    given = ["--sources", tar, "--size", 64, 96, "--batch-size", 1, "--iterations", 2, "--workers", 0, "--output", output]
    return [*given, *small, *more]


def run_command(monkeypatch, *arguments, trainer=raft):
    """trainers/raft.py in this process, which logs every step; on one thread, as `launch` does it: the number of threads changes sums."""
    monkeypatch.setattr(sys, "argv", ["raft.py", *map(str, arguments), "--tracker", "none"])
    monkeypatch.setattr(loop, "LOG_EVERY_STEPS", 1)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        run(trainer.main)
    finally:
        torch.set_num_threads(threads)
    AcceleratorState._reset_state(reset_partial_state=True)


def read_lines(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


TERMS = ("loss", "epe", "disparity_term", "photometric_term")


def assert_equal_first_gradients(log, other):
    """Those of later steps jump where the loss has an edge, as soon as the weights differ by a rounding."""
    assert log[0]["gradient_norm"] == pytest.approx(other[0]["gradient_norm"], rel=1e-4)


def test_two_ranks_train_as_one_with_twice_the_batch_and_each_goes_on_where_the_other_stopped(tar, tmp_path, monkeypatch):
    two, one, one_resumed, two_resumed = (tmp_path / name for name in ("two", "one", "one-resumed", "two-resumed"))
    options = ("--steps", 4, "--save-every", 2)
    done = launch(arguments_for(tar, two, *options), 2, script="tests/trainers/record_samples.py")
    assert done.returncode == 0, done.stderr[-3000:]
    ranks = [[tuple(line) for line in read_lines(two / f"samples-{rank}.jsonl")] for rank in range(2)]
    assert ranks == [[(0, 0), (0, 2), (0, 4), (0, 6)], [(0, 1), (0, 3), (0, 5), (0, 7)]]

    run_command(monkeypatch, *arguments_for(tar, one, *options, "--batch-size", 2))
    resume = ("--resume", two / "checkpoints" / "step-00000002")
    run_command(monkeypatch, *arguments_for(tar, one_resumed, *options, "--batch-size", 2, *resume))
    resume = ("--resume", one / "checkpoints" / "step-00000002")
    done = launch(arguments_for(tar, two_resumed, *options, *resume), 2, "tests/trainers/record_samples.py", TORCHRUN)
    assert done.returncode == 0, done.stderr[-3000:]
    assert [read_lines(two_resumed / f"samples-{rank}.jsonl") for rank in range(2)] == [[[0, 4], [0, 6]], [[0, 5], [0, 7]]]
    logs = [read_lines(folder / "log.jsonl") for folder in (two, one, one_resumed, two_resumed)]
    assert [line["samples"] for line in logs[0]] == [line["samples"] for line in logs[1]] == [2, 4, 6, 0]
    for log in logs[2:]:
        assert [(line["step"], line["samples"]) for line in log] == [(3, 6), (4, 0)]
    assert_equal_first_gradients(logs[0], logs[1])
    for name in TERMS:
        curves = [[line[name] for line in log] for log in logs]
        assert curves[1] == pytest.approx(curves[0], rel=1e-5), name
        for curve in curves[2:]:
            assert curve == pytest.approx(curves[0][2:], rel=1e-5), name


def test_two_ranks_train_igev_stereo_as_one_with_twice_the_batch(tar, tmp_path, monkeypatch):
    """As its volumes are normalised by the pairs of both ranks. Small steps: AdamW makes whole ones of gradients that are mere rounding."""
    two, one = tmp_path / "two", tmp_path / "one"
    small = "--hidden-dims 16 16 16 --corr-radius 2 --max-disp 32 --n-gru-layers 2 --steps 4 --learning-rate 1e-5".split()
    done = launch(arguments_for(tar, two, small=small), 2, "tests/trainers/record_samples.py", TORCHRUN, TRAINER="igev")
    assert done.returncode == 0, done.stderr[-3000:]
    run_command(monkeypatch, *arguments_for(tar, one, "--batch-size", 2, small=small), trainer=igev)
    logs = [read_lines(folder / "log.jsonl") for folder in (two, one)]
    assert len(logs[0]) == 4
    assert_equal_first_gradients(*logs)
    for name in (*TERMS, "initial_term"):
        curves = [[line[name] for line in log] for log in logs]
        assert curves[1] == pytest.approx(curves[0], rel=1e-5), name


def test_a_nan_or_an_explosion_on_one_rank_skips_the_step_on_both(tar, tmp_path):
    output = tmp_path / "run"
    broken = {"BROKEN_RANK": "1", "BROKEN_BY": json.dumps({1: float("nan"), 2: 1e6})}
    arguments = arguments_for(tar, output, "--steps", 4, "--save-every", 1, "--ema", 0.5)
    done = launch(arguments, 2, "tests/trainers/record_samples.py", TORCHRUN, **broken)
    assert done.returncode == 0, done.stderr[-3000:]
    assert [line["skipped_steps"] for line in read_lines(output / "log.jsonl")] == [0, 1, 2, 2]
    lines = read_lines(output / "skipped.jsonl")
    assert [(line["step"], line["rank"]) for line in lines] == [(1, 1), (2, 1)]
    assert [[sample["index"] for sample in line["samples"]] for line in lines] == [[3], [5]]
    assert len(read_lines(output / "samples-0.jsonl")) == len(read_lines(output / "samples-1.jsonl")) == 4
    weights = [run_folder.load(output / "checkpoints" / f"step-0000000{step}")[0]["weights"] for step in (2, 3, 4)]
    assert all(torch.equal(weights[1][name], value) for name, value in weights[0].items())
    assert any(not torch.equal(weights[2][name], value) for name, value in weights[1].items())


def test_ranks_end_with_the_one_that_is_asked_to(tar, tmp_path):
    output = tmp_path / "run"
    done = launch(arguments_for(tar, output, "--steps", 9), 2, "tests/trainers/record_samples.py", TORCHRUN, ENDED_RANK="1")
    assert done.returncode != 0 and done.stdout.count("asked to end by SIGTERM") == 1
    assert len(read_lines(output / "samples-0.jsonl")) == len(read_lines(output / "samples-1.jsonl")) == 2
    assert run_folder.newest(output).name == "step-00000002" and run_folder.load(run_folder.newest(output))[1]["stream"]["samples"] == 4


def test_a_run_ends_with_the_launcher_that_started_it_alone(tar, tmp_path):
    """`accelerate launch` of one process does not hand SIGTERM on."""
    output = tmp_path / "run"
    command = [*ACCELERATE, 1, "trainers/raft.py", *arguments_for(tar, output, "--steps", 10**6, "--save-every", 1)]
    with subprocess.Popen([*map(str, command)], cwd=ROOT, stdout=subprocess.PIPE, text=True) as launcher:
        while not list((output / "checkpoints").glob("step-*")):
            assert launcher.poll() is None
            time.sleep(0.1)
        (trainer,) = psutil.Process(launcher.pid).children()
        launcher.terminate()
        try:
            said, _ = launcher.communicate(timeout=30)  # until nobody has the pipe open
        finally:
            if trainer.is_running():
                trainer.kill()
    assert f"{run_folder.newest(output)} is saved, and --resume {output} goes on from it" in said


def test_a_second_run_keeps_out_of_the_folder_of_one_that_is_at_work(tar, tmp_path, monkeypatch):
    monkeypatch.setattr(run_folder, "LOCK_SECONDS", 0)
    with run_folder.claimed(tmp_path), pytest.raises(SystemExit, match=rf"another run is at work in {tmp_path}, process {os.getpid()} on"):
        run_command(monkeypatch, *arguments_for(tar, tmp_path))


def test_the_command_trains_evaluates_and_resumes(tar, tmp_path, monkeypatch):
    output = tmp_path / "run"
    evaluation = ("--evaluate", "motorcycle", "--evaluation-iterations", 1)
    done = launch(arguments_for(tar, output, "--steps", 2, "--save-every", 1, *evaluation), 1)
    assert done.returncode == 0, done.stderr[-3000:]
    scores = json.loads((output / "evaluation.json").read_text())["sets"]["motorcycle"]["pairs"]
    assert scores[0]["name"] == "motorcycle" and 0 < scores[0]["all"]["epe"] < 1000
    assert list(output.glob("**/events.out.tfevents.*")), "no TensorBoard log"
    first = load_file(output / "best" / "model.safetensors")
    run_command(monkeypatch, *arguments_for(tar, tmp_path / "again", "--steps", 2, "--resume", output / "checkpoints" / "step-00000001"))
    again = load_file(run_folder.newest(tmp_path / "again") / "model.safetensors")
    assert all(torch.equal(again[name], value) for name, value in first.items())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["--sources", "nowhere.tar"], "nowhere.tar"),
        (["--resume", "nothing-here"], "no checkpoint to resume from"),
        (["--steps", "0"], "steps is 1 or more"),
        (["--ema", "1"], r"ema is a decay in \(0, 1\)"),
        (["--sources", "a=@0.5"], "NAME=URL"),
        (["--evaluate", "nowhere"], "nowhere"),
        (["--evaluate", "kitti2015"], "kitti2015=DIR"),
        (["--evaluate-every", "2"], "--evaluate-every needs --evaluate"),
        (["--evaluate-first"], "--evaluate-first needs --evaluate"),
        (["--size", "100", "128"], "--size is a height and a width in multiples of 32 px; got 100 128"),
        (["--initial-weights", "nothing.pth"], "no checkpoint file nothing.pth"),
    ],
)
def test_a_wrong_argument_is_one_line_in_words(tar, tmp_path, monkeypatch, change, message):
    with pytest.raises(SystemExit, match=rf"^raft.py: .*{message}"):
        run_command(monkeypatch, *arguments_for(tar, tmp_path / "run", *change))


def test_a_wrong_argument_ends_the_program_without_a_traceback(tmp_path):
    command = [sys.executable, "trainers/raft.py", *map(str, arguments_for("nowhere.tar", tmp_path / "run"))]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode != 0 and "nowhere.tar" in done.stderr and "Traceback" not in done.stderr


IGEV_ARGUMENTS = "--hidden-dims 16 16 16 --corr-radius 2 --max-disp 32 --n-gru-layers 2".split()


@pytest.mark.parametrize(("trainer", "small"), [(raft, SMALL_ARGUMENTS), (igev, IGEV_ARGUMENTS)], ids=["raft", "igev"])
def test_a_training_begins_with_the_weights_that_are_given_or_with_those_of_its_seed(tmp_path, monkeypatch, trainer, small):
    begun = []
    monkeypatch.setattr("trainers.arguments.train", lambda matcher, *others, **options: begun.append(matcher))
    monkeypatch.setattr("trainers.arguments.open_stream", lambda arguments: None)

    def weights_of_a_run(*words):
        torch.manual_seed(123)  # whatever was drawn before
        run_command(monkeypatch, "--sources", "a.tar", "--output", tmp_path / "run", *small, *words, trainer=trainer)
        assert begun[-1].batch_norm_frozen
        return begun[-1].state_dict()

    def equal(one, other):
        return all(torch.equal(value, other[name]) for name, value in one.items())

    first, second = weights_of_a_run("--seed", 1), weights_of_a_run("--seed", 2)
    assert equal(weights_of_a_run("--seed", 1), first) and not equal(first, second)
    save_checkpoint(begun[0], tmp_path / "model.safetensors")
    for path in (tmp_path, tmp_path / "model.safetensors"):
        assert equal(weights_of_a_run("--seed", 2, "--initial-weights", path), first)


@pytest.mark.parametrize("workers", [0, 1])
@pytest.mark.parametrize(("cause", "words"), [(OSError("no such model"), True), (KeyError("a bug"), False)])
def test_a_model_that_cannot_be_loaded_is_one_line_and_a_bug_is_a_traceback(monkeypatch, tmp_path, cause, words, workers):
    def depth(images):
        raise cause

    def main():
        stream = ZeroStereoStream(photo_tar(tmp_path / "a.tar", 1), size=(32, 48), depth=depth)
        with stream.loader(1, num_workers=workers, multiprocessing_context="fork") as loader:
            next(iter(loader))

    monkeypatch.setattr(sys, "argv", ["raft.py"])
    told = r"sample 0 of epoch 0 \(.*\) failed: "
    with pytest.raises(SystemExit, match=f"^raft.py: {told}no such model$") if words else pytest.raises(RuntimeError, match=told):
        run(main)


def parsed(*arguments):
    parser = raft.argparse.ArgumentParser()
    add_training_arguments(parser)
    return parser.parse_args([str(argument) for argument in ("--output", "run", *arguments)])


def test_the_switches_of_the_papers_ablations_reach_the_stream(tmp_path):
    tar = photo_tar(tmp_path / "wide.tar", 3, height=300, width=800)
    stream = open_stream(parsed("--sources", tar, "--size", 64, 96, "--disparity", "uniform", "--inpaint", "none", "--no-confidence"))
    pair = stream.replay(0, 1)
    hole = pair.masks.inpaint
    assert hole.any() and (pair.right_clean.masked_select(hole) == 0).all() and (pair.confidence == 1).all()
    other = open_stream(parsed("--sources", tar, "--size", 64, 96, "--inpaint", "background")).replay(0, 1)
    assert other.right_clean.masked_select(other.masks.inpaint).any() and (other.confidence < 1).any()
    assert not torch.equal(pair.disparity, other.disparity)


def test_no_label_leads_into_a_hole(tar):
    """So holes that are left black supervise nothing."""
    batch = StereoBatch.stack([small_stream(tar, inpaint=leave_black).replay(0, index) for index in range(4)])
    assert batch.masks.inpaint.any()
    assert not (backward_warp(batch.masks.inpaint, batch.disparity, mode="nearest", padding="zeros") & batch.masks.valid).any()


def test_each_loss_of_the_ablations_is_what_it_says(tar):
    batch = StereoBatch.stack([small_stream(tar).replay(0, index) for index in range(2)])
    batch = replace(batch, confidence=torch.full_like(batch.confidence, 0.5))
    sequence = [batch.disparity + 1, batch.disparity + 0.5]
    terms = {name: TrainingLoss(name=name)(None, sequence, batch)[1] for name in ("zero", "l1", "l1+lp")}
    assert len({float(metrics["disparity_term"]) for metrics in terms.values()}) == 1
    assert terms["l1"]["photometric_term"] == 0 < terms["zero"]["photometric_term"] < terms["l1+lp"]["photometric_term"]


def test_the_scale_of_half_precision_gradients_comes_back_on_resume():
    def parts(scale):
        optimizer = torch.optim.SGD(torch.nn.Linear(1, 1).parameters(), lr=1.0)
        schedule = torch.optim.lr_scheduler.ConstantLR(optimizer)
        return optimizer, schedule, SimpleNamespace(scaler=torch.amp.GradScaler("cpu", init_scale=scale))

    saved, resumed = parts(8.0), parts(65536.0)
    load_optimizer_state(optimizer_state(*saved), *resumed)
    assert resumed[-1].scaler.get_scale() == 8.0


def test_where_every_label_is_trusted_no_photometric_term_is_computed(tar, monkeypatch):
    batch = StereoBatch.stack([small_stream(tar).replay(0, index) for index in range(2)])
    batch.confidence.fill_(1)
    full, _ = TrainingLoss()(None, [batch.disparity + 1], batch)
    monkeypatch.setattr("zsdata.losses._photometric_loss", lambda *_: pytest.fail("computed"))
    assert torch.equal(TrainingLoss(trusted=True)(None, [batch.disparity + 1], batch)[0], full)
