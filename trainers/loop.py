"""The training loop: batches from the stream, predictions from a matcher, one optimizer step each. Any matcher, any loss."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, is_dataclass
from pathlib import Path
from typing import Any, cast

import torch
from accelerate.tracking import GeneralTracker
from accelerate.utils import gather_object
from torch import Tensor

from trainers import run_folder
from trainers.accelerated import load_optimizer_state, open_accelerator, optimizer_state
from trainers.evaluate import mean_scores, table
from trainers.memory import out_of_memory_is_cured_by
from trainers.models import Matcher, load_checkpoint
from trainers.models.checkpoint import WEIGHTS_FILE
from trainers.provenance import provenance
from trainers.ranks import mean_over_ranks
from trainers.step_guard import StepGuard
from trainers.termination import Terminated, Termination, end
from trainers.validation import BEST_BY, EvaluationSet, Validation
from trainers.weight_average import WeightAverage, weights_of
from zsdata import StereoBatch, ZeroStereoStream
from zsdata.metrics import reconstruction_error
from zsdata.position import require_one_place
from zsdata.progress import Progress

LossFunction = Callable[[Tensor | None, list[Tensor], StereoBatch], tuple[Tensor, dict[str, Any]]]

LOG_EVERY_STEPS = 10
RECONSTRUCT_EVERY_STEPS = 100  # how well the pairs and their labels fit together, into the log
# RAFT-Stereo's schedule: a linear one-cycle that warms up for 1 % of the steps and is 100 steps longer than the training.
WARM_UP_SHARE = 0.01
SPARE_SCHEDULE_STEPS = 100
SAME_NUMBERS = ("corr_implementation",)  # options of a matcher that change its memory and nothing else


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """How a matcher is trained; the defaults are the paper's (section "Implementation Details") and RAFT-Stereo's."""

    steps: int = 200_000
    batch_size: int = 8  # pairs per step on each rank, and before accumulation
    iterations: int = 22
    evaluation_iterations: int = 32
    learning_rate: float = 2e-4
    weight_decay: float = 1e-5  # RAFT-Stereo's; the paper names none, and its released code leaves torch's default, 1e-2
    clip_norm: float = 1.0
    accumulate: int = 1  # batches per optimizer step
    workers: int = 4
    mixed_precision: str | None = None  # "no", "bf16", "fp16"; None takes what `accelerate launch` was told
    compile: bool = False
    channels_last: bool = False
    ema: float | None = None  # decay of an average of the weights, which is then what is saved and judged
    save_every: int = 5_000
    evaluate_every: int | None = None  # steps; None: at the end only
    evaluate_first: bool = False  # also before the first step
    best_by: str = BEST_BY
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("steps", "batch_size", "iterations", "evaluation_iterations", "accumulate", "save_every", "evaluate_every"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"{name} is 1 or more; got {value}")
        if self.learning_rate <= 0 or self.clip_norm <= 0:
            raise ValueError(f"learning_rate and clip_norm are above 0; got {self.learning_rate} and {self.clip_norm}")
        if self.ema is not None and not 0 < self.ema < 1:
            raise ValueError(f"ema is a decay in (0, 1), such as 0.999; got {self.ema}")


@out_of_memory_is_cured_by(
    "lower --batch-size (and raise --accumulate by as much), add --mixed-precision bf16, or lower --size or --iterations"
)
def train(
    matcher: Matcher,
    loss_function: LossFunction,
    stream: ZeroStereoStream,
    config: TrainConfig,
    *,
    output: Path,
    model_config: dict[str, Any],
    arguments: dict[str, Any],
    resume: Path | None = None,
    sets: Sequence[EvaluationSet] = (),
    tracker: str | GeneralTracker | None = "tensorboard",
) -> dict[str, list[dict[str, Any]]]:
    """Trains `matcher` on the stream and returns its last scores on each pair of each of `sets`.

    Every rank reads its own share of the stream, in step with the others. A run that is resumed sees exactly the batches that the unbroken
    run would have seen. A step whose loss or gradient is not finite, or explodes, is skipped; see `trainers.step_guard`.

    Args:
        loss_function: (initial prediction, sequence of predictions, batch) -> (loss, metrics). Where it is a dataclass, a run is only
            resumed with one of the same fields.
        output: the run's folder: checkpoints, best, tracker logs, log.jsonl, skipped.jsonl, evaluations.jsonl, evaluation.json. Refused
            where it holds the checkpoints of another run.
        model_config: {"model": name, "options": {...}}, saved with the weights.
        arguments: what the run was started with, saved with its state.
        resume: a run's folder or one of its checkpoints; `output` itself may still be without any.
        sets: what to judge by at the end, every `config.evaluate_every` steps, and first of all where `config.evaluate_first`. Each time
            a checkpoint is saved before, and copied to OUTPUT/best when it is the best so far, see `Validation.is_best`. A run that was
            stopped in between begins with judging when it is resumed.
        tracker: any of Accelerate's by name, one of your own, or None.
    Raises:
        ValueError, ImportError, OSError: options, a tracker or a checkpoint that cannot be used, or a rank that has other photos.
        MemoryError: the device's memory is too small; says what to lower.
        TrainingDiverged: too many steps in a row had to be skipped.
        Terminated: a rank got SIGTERM; the checkpoint of this step is saved.
    """
    checkpoint = run_folder.check_output(output, resume)
    accelerator = open_accelerator(config.mixed_precision, tracker, output)
    accelerator.gradient_accumulation_steps = config.accumulate
    validation = Validation(sets, config.best_by, config.evaluation_iterations)
    if config.channels_last:
        matcher.use_channels_last()
    if config.compile:
        matcher.compile_parts()
    optimizer = torch.optim.AdamW(matcher.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay, eps=1e-8)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer,
        config.learning_rate,
        config.steps + SPARE_SCHEDULE_STEPS,
        pct_start=WARM_UP_SHARE,
        cycle_momentum=False,
        anneal_strategy="linear",
    )
    loader = stream.loader(
        config.batch_size,
        num_workers=config.workers,
        device=accelerator.device,
        rank=accelerator.process_index,
        world_size=accelerator.num_processes,
        multiprocessing_context="fork",  # a fork server, Python's choice from 3.14 on, ends by a SIGTERM to all processes, and they with it
    )
    pairs_per_step = config.batch_size * config.accumulate * accelerator.num_processes
    output.mkdir(parents=True, exist_ok=True)
    options = _options_of_a_run(config, model_config, loss_function)
    step, training, state = 0, None, {}
    if checkpoint is not None:
        training, state = run_folder.load(checkpoint)
        run_folder.require_options(checkpoint, state, options, f"--initial-weights {checkpoint / WEIGHTS_FILE}")
        load_checkpoint(matcher, checkpoint / WEIGHTS_FILE)
    elif resume is not None:
        accelerator.print(f"no checkpoint in {resume} yet: the run begins")
    average = None if config.ema is None else WeightAverage(matcher, config.ema)
    if checkpoint is not None and training is not None:
        if training["weights"]:  # what was saved for use is the average
            matcher.load_state_dict(training["weights"])
        loader.load_state_dict(state["stream"])
        validation.load_state_dict(state["validation"])
        step = state["step"]
        accelerator.print(f"resumed from {checkpoint} at step {step}")
        before = state.get("pairs_per_step", pairs_per_step)
        if before != pairs_per_step:
            accelerator.print(
                f"a step was of {before} pairs and is of {pairs_per_step} from here on ({config.batch_size} a batch, {config.accumulate} "
                f"accumulated, {accelerator.num_processes} ranks): the learning rate goes on as it was; to go on as before, "
                "change --batch-size or --accumulate"
            )
        if validation.best is not None and accelerator.is_main_process:
            there = run_folder.restore_best(checkpoint, output, validation.best["step"])
            if sets and not there:
                validation.best = None  # or OUTPUT/best would be of no checkpoint until a better one comes
    require_one_place(gather_object([loader.state_dict()]))
    model, optimizer = accelerator.prepare(matcher, optimizer)
    model.train()
    guard = StepGuard(accelerator, matcher, output / "skipped.jsonl")
    if training is not None:
        load_optimizer_state(training, optimizer, schedule, accelerator)
        guard.load_state_dict(state["guard"])
    if average is not None:
        average.to(accelerator.device)
    if tracker is not None:
        accelerator.init_trackers(output.name or "run", {name: value for name, value in asdict(config).items() if value is not None})

    termination = Termination()

    def save() -> Path:
        folder = run_folder.folder_of(output, step)
        if checkpoint is not None and checkpoint.resolve() == folder.resolve():
            return folder  # the run was resumed from it
        if accelerator.is_main_process:
            with weights_of(average, matcher) as weights:
                run_folder.save(
                    output,
                    step,
                    matcher,
                    model_config,
                    {"weights": weights, **optimizer_state(optimizer, schedule, accelerator)},
                    {
                        "stream": loader.state_dict(),
                        "validation": validation.state_dict(),
                        "guard": guard.state_dict(),
                        "options": options,
                        "world_size": accelerator.num_processes,
                        "pairs_per_step": pairs_per_step,
                        "arguments": arguments,
                        "provenance": provenance(stream, arguments),
                    },
                )
        accelerator.wait_for_everyone()
        return folder

    def is_to_be_judged() -> bool:
        """Whether it is this step's turn, the last one's aside."""
        every = config.evaluate_every
        return bool(validation.sets) and (config.evaluate_first if step == 0 else every is not None and step % every == 0)

    def judge(saved: Path) -> dict[str, list[dict[str, Any]]]:
        """Scores of this step's checkpoint, written down; if it is the best so far, it is kept."""
        try:
            with termination.at_once(), weights_of(average, matcher):
                results = validation.judge(
                    lambda left, right: matcher.predict(left, right, iterations=config.evaluation_iterations),
                    device=accelerator.device,
                    rank=accelerator.process_index,
                    world_size=accelerator.num_processes,
                    out_of_memory=f"{saved} is saved, and trainers/evaluate.py --tile-rows 512 can judge it; --resume {output} goes on "
                    "with --corr-implementation alt (RAFT-Stereo), with smaller images for --evaluate, or without it",
                )
        except Terminated:
            end(accelerator, saved, output)
        best = validation.is_best(results, step)
        if accelerator.is_main_process:
            _write_scores(output, step, results, validation)
            run_folder.amend(saved, validation=validation.state_dict())
            if best:
                run_folder.keep_best(saved, output)
        accelerator.wait_for_everyone()
        means = {name: mean_scores(scores)["all"] for name, scores in results.items()}
        values = {f"{name}/{metric}": value for name, mean in means.items() for metric, value in mean.items() if value is not None}
        accelerator.log(values, step=step)
        for name, scores in results.items():
            accelerator.print(f"step {step}, {name}{', the best so far' if best else ''}:\n{table(scores)}")
        return results

    def mark_here() -> _Mark:
        return _Mark(step, loader.stats()["seconds"].get("wait", 0.0))

    results: dict[str, list[dict[str, Any]]] = {}
    with (
        termination,
        loader,
        Progress(total=config.steps, initial=step, unit="step", disable=not accelerator.is_main_process, dynamic_ncols=True) as progress,
    ):
        if step < config.steps and is_to_be_judged() and validation.judged_step != step:
            results = judge(save())
        mark = mark_here()
        while step < config.steps:
            for batch in loader:
                with accelerator.accumulate(model):
                    with accelerator.autocast():
                        initial, sequence = model(batch.left, batch.right, iterations=config.iterations)
                    loss, metrics = loss_function(initial, sequence, batch)
                    guard.watch(loss, batch)
                    accelerator.backward(loss)
                    refused = False
                    if accelerator.sync_gradients:
                        norm = accelerator.clip_grad_norm_(model.parameters(), config.clip_norm)
                        refused = guard.refuses(step, cast(Tensor, norm))
                        if refused:
                            optimizer.zero_grad()  # a step without gradients changes nothing
                    optimizer.step()
                    optimizer.zero_grad()
                if not accelerator.sync_gradients:
                    continue
                schedule.step()
                step += 1
                if average is not None and not refused:
                    average.update(matcher, step)
                progress.update()
                if step % LOG_EVERY_STEPS == 0 or step == config.steps:
                    if step % RECONSTRUCT_EVERY_STEPS == 0:
                        metrics |= _reconstruction(batch)
                    names, numbers = list(metrics), torch.stack([torch.as_tensor(value).float() for value in metrics.values()])
                    values = {
                        "loss": guard.loss,
                        **dict(zip(names, mean_over_ranks(numbers).tolist(), strict=True)),
                        "gradient_norm": guard.gradient_norm,
                        "skipped_steps": guard.skipped,
                        "learning_rate": schedule.get_last_lr()[0],
                    }
                    here = mark_here()
                    values |= mark.rates((step - mark.step) * pairs_per_step, here)
                    mark = here
                    progress.set_postfix_str(
                        f"loss {values['loss']:.2f}, EPE {values['epe']:.2f} px, {values['pairs_per_second']:.1f} pairs/s, "
                        f"waiting {values['wait_share']:.0%}"
                    )
                    if accelerator.is_main_process:
                        place = loader.state_dict()
                        run_folder.append(
                            output / "log.jsonl", {"step": step, "epoch": place["epoch"], "samples": place["samples"], **values}
                        )
                    accelerator.log(values, step=step)
                if step == config.steps:
                    break
                if termination.asked(accelerator.device):
                    end(accelerator, save(), output)
                if is_to_be_judged():
                    results = judge(save())
                elif step % config.save_every == 0:
                    save()
                else:
                    continue
                mark = mark_here()  # what they took is not the training's
        progress.close()
        saved = save()
        if validation.sets:
            results = judge(saved)
    accelerator.end_training()
    return results


def _options_of_a_run(config: TrainConfig, model_config: dict[str, Any], loss_function: LossFunction) -> dict[str, Any]:
    """What cannot change when a run is resumed, in plain JSON."""
    network = {name: value for name, value in model_config.get("options", {}).items() if name not in SAME_NUMBERS}
    kept = {name: getattr(config, name) for name in ("steps", "iterations", "learning_rate", "weight_decay", "ema")}
    fields = asdict(loss_function) if is_dataclass(loss_function) and not isinstance(loss_function, type) else {}
    loss = {f"the loss's {name}": value for name, value in fields.items()}
    return json.loads(json.dumps({"model": model_config.get("model"), **network, **kept, **loss}))


def _reconstruction(batch: StereoBatch) -> dict[str, Tensor]:
    """How well the pairs and their labels fit together, as in the paper's table: every pixel counts."""
    errors = reconstruction_error(batch.left_clean, batch.right_clean, batch.disparity)
    return {f"reconstruction_{name}": error.mean() for name, error in errors._asdict().items()}


def _write_scores(output: Path, step: int, results: dict[str, list[dict[str, Any]]], validation: Validation) -> None:
    sets = {name: {"mean": mean_scores(scores), "pairs": scores} for name, scores in results.items()}
    (output / "evaluation.json").write_text(json.dumps({"step": step, "best": validation.best, "sets": sets}, indent=2) + "\n")
    means = {name: one["mean"] for name, one in sets.items()}
    by_pair = {name: {one["name"]: one["all"][validation.best_by] for one in scores} for name, scores in results.items()}
    line = {"step": step, validation.best_by: validation.value(results), "means": means, f"{validation.best_by}_by_pair": by_pair}
    run_folder.append(output / "evaluations.jsonl", line)


class _Mark:
    """A moment in the run, to count from."""

    def __init__(self, step: int, wait_seconds: float) -> None:
        self.step = step
        self._time = time.perf_counter()
        self._wait_seconds = wait_seconds

    def rates(self, pairs: int, until: _Mark) -> dict[str, float]:
        elapsed = until._time - self._time
        return {"pairs_per_second": pairs / elapsed, "wait_share": (until._wait_seconds - self._wait_seconds) / elapsed}
