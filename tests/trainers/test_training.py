import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from accelerate.state import AcceleratorState
from safetensors.torch import load_file

from tests.scenes import grey_fill, layered_depth, photo_tar
from trainers import run_folder
from trainers.loop import TrainConfig, train
from trainers.models import load_matcher
from trainers.raft import sequence_loss
from zsdata import AugmentConfig, StereoBatch, ZeroStereoStream

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


def open_stream(tar, **options):
    return ZeroStereoStream(tar, **{"size": (64, 96), "depth": layered_depth, "inpaint": grey_fill, **options})


def run_training(tar, output, config, resume=None, loss=sequence_loss, **options):
    torch.manual_seed(config.seed)
    matcher = load_matcher("raft_stereo", **SMALL)
    matcher.freeze_bn()
    stream = open_stream(tar, **options)
    train(
        matcher,
        loss,
        stream,
        config,
        output=output,
        model_config={"model": "raft_stereo", "options": SMALL},
        arguments={},
        resume=resume,
        tracker=None,
    )
    return matcher


def recorder(seen):
    def loss(initial, sequence, batch):
        seen.append([(meta["epoch"], meta["index"]) for meta in batch.meta])
        return sequence_loss(initial, sequence, batch)

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

    def close(self):
        pass


def test_a_small_matcher_overfits_a_handful_of_pairs(tar, tmp_path):
    torch.manual_seed(0)
    matcher = load_matcher("raft_stereo", **SMALL)
    matcher.freeze_bn()
    handful = Handful(open_stream(tar, augmentation=AugmentConfig.none()), 4)
    settings = config(steps=80, iterations=4, learning_rate=5e-4, save_every=1000)
    train(matcher, sequence_loss, handful, settings, output=tmp_path, model_config={}, arguments={}, tracker=None)
    epes = [json.loads(line)["epe"] for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    before = handful.batch.disparity.mean().item()  # of a matcher that sees nothing
    assert epes[-1] < 0.5 * epes[0] and epes[-1] < 0.5 * before


@pytest.mark.parametrize("accumulate", [1, 2])
@pytest.mark.parametrize("workers", [0, 2])
def test_a_resumed_run_equals_the_unbroken_one(tar, tmp_path, accumulate, workers):
    whole, broken, resumed = [], [], []
    settings = config(steps=6, accumulate=accumulate, workers=workers)
    unbroken = run_training(tar, tmp_path / "unbroken", settings, loss=recorder(whole))

    def fails_in_step_five(initial, sequence, batch):
        if len(broken) == 4 * accumulate:
            raise RuntimeError("power cut")
        return recorder(broken)(initial, sequence, batch)

    with pytest.raises(RuntimeError, match="power cut"):
        run_training(tar, tmp_path / "broken", settings, loss=fails_in_step_five)
    AcceleratorState._reset_state(reset_partial_state=True)
    after = run_training(tar, tmp_path / "broken", settings, resume=tmp_path / "broken", loss=recorder(resumed))
    assert broken + resumed == whole
    for name, weight in unbroken.state_dict().items():
        assert torch.equal(after.state_dict()[name], weight), name


def test_a_run_folder_holds_what_evaluation_and_resume_need(tar, tmp_path):
    matcher = run_training(tar, tmp_path / "run", config(steps=9))
    folder = run_folder.newest(tmp_path / "run")
    assert folder.name == "step-00000009"
    weights = load_file(folder / "model.safetensors")
    assert all(torch.equal(weights[name], value) for name, value in matcher.state_dict().items())
    assert json.loads((folder / "config.json").read_text())["model"] == "raft_stereo"
    assert len(list((tmp_path / "run" / "checkpoints").iterdir())) == run_folder.KEPT_CHECKPOINTS


def test_an_unfinished_checkpoint_is_not_resumed_from(tar, tmp_path):
    run_training(tar, tmp_path / "run", config(steps=2))
    unfinished = tmp_path / "run" / "checkpoints" / ".step-00000004.123"
    unfinished.mkdir()
    (unfinished / "state.json").write_text("{}")
    assert run_folder.newest(tmp_path / "run").name == "step-00000002"
    with pytest.raises(FileNotFoundError, match="no checkpoint to resume from"):
        run_folder.newest(tmp_path)


def test_a_loss_that_is_not_finite_names_the_samples(tar, tmp_path):
    def broken(initial, sequence, batch):
        loss, metrics = sequence_loss(initial, sequence, batch)
        return loss * float("nan"), metrics

    with pytest.raises(RuntimeError, match=r"the loss is nan at step 0; samples \(epoch, index, key\): \[\(0, 0, '0000"):
        run_training(tar, tmp_path / "run", config(steps=2), loss=broken)


def launch(arguments, processes, script="trainers/raft.py"):
    command = [
        str(Path(sys.executable).with_name("accelerate")),
        "launch",
        "--cpu",
        "--num_processes",
        str(processes),
        "--num_machines",
        "1",
    ]
    command += ["--mixed_precision", "no", "--dynamo_backend", "no"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.run([*command, script, *map(str, arguments)], cwd=ROOT, capture_output=True, text=True, env=environment, timeout=240)


def arguments_for(tar, output, *more):
    return [
        "--sources",
        tar,
        "--size",
        64,
        96,
        "--batch-size",
        1,
        "--iterations",
        2,
        "--workers",
        1,
        "--output",
        output,
        *SMALL_ARGUMENTS,
        *more,
    ]


def test_two_ranks_train_on_disjoint_samples_in_equal_steps(tar, tmp_path):
    output = tmp_path / "run"
    done = launch(arguments_for(tar, output, "--steps", 4, "--save-every", 4), 2, script="tests/trainers/record_samples.py")
    assert done.returncode == 0, done.stderr[-3000:]
    assert len(list(output.glob("samples-*.jsonl"))) == 2
    ranks = [[tuple(json.loads(line)) for line in (output / f"samples-{rank}.jsonl").read_text().splitlines()] for rank in range(2)]
    assert len(ranks[0]) == len(ranks[1]) == 4
    assert ranks[0] == [(0, 0), (0, 2), (0, 4), (0, 6)] and ranks[1] == [(0, 1), (0, 3), (0, 5), (0, 7)]
    assert (output / "checkpoints" / "step-00000004" / "model.safetensors").is_file()


def test_the_command_trains_evaluates_and_resumes(tar, tmp_path):
    output = tmp_path / "run"
    done = launch(arguments_for(tar, output, "--steps", 2, "--evaluate", "motorcycle", "--evaluation-iterations", 1), 1)
    assert done.returncode == 0, done.stderr[-3000:]
    scores = json.loads((output / "evaluation.json").read_text())["pairs"]
    assert scores[0]["name"] == "motorcycle" and 0 < scores[0]["all"]["epe"] < 1000
    assert list(output.glob("**/events.out.tfevents.*")), "no TensorBoard log"
    done = launch(arguments_for(tar, output, "--steps", 3, "--resume", output), 1)
    assert done.returncode == 0, done.stderr[-3000:]
    assert "resumed from" in done.stdout and (output / "checkpoints" / "step-00000003").is_dir()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["--sources", "nowhere.tar"], "nowhere.tar"),
        (["--resume", "nothing-here"], "no checkpoint to resume from"),
        (["--steps", "0"], "steps is 1 or more"),
        (["--sources", "a=@0.5"], "NAME=URL"),
        (["--evaluate", "nowhere"], "nowhere"),
    ],
)
def test_a_wrong_argument_is_one_line_in_words(tar, tmp_path, change, message):
    done = subprocess.run(
        [sys.executable, "trainers/raft.py", *map(str, arguments_for(tar, tmp_path / "run", "--tracker", "none")), *change],
        cwd=ROOT, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert done.returncode != 0 and message in done.stderr and "Traceback" not in done.stderr
