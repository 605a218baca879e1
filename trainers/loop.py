"""The training loop: batches from the stream, predictions from a matcher, one optimizer step each. Any matcher, any loss."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from accelerate import Accelerator
from torch import Tensor
from tqdm import tqdm

from trainers import run_folder
from trainers.evaluate import evaluate, mean_scores, table
from trainers.models import Matcher, load_checkpoint
from trainers.pairs_on_disk import StereoPair
from zsdata import StereoBatch, ZeroStereoStream

LossFunction = Callable[[Tensor | None, list[Tensor], StereoBatch], tuple[Tensor, dict[str, Any]]]

LOG_EVERY_STEPS = 10
# RAFT-Stereo's schedule: a linear one-cycle that warms up for 1 % of the steps and is 100 steps longer than the training.
WARM_UP_SHARE = 0.01
SPARE_SCHEDULE_STEPS = 100


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """How a matcher is trained; the defaults are the paper's (section "Implementation Details") and RAFT-Stereo's."""

    steps: int = 200_000
    batch_size: int = 8  # pairs per step on each rank, and before accumulation
    iterations: int = 22
    evaluation_iterations: int = 32
    learning_rate: float = 2e-4
    weight_decay: float = 1e-5
    clip_norm: float = 1.0
    accumulate: int = 1  # batches per optimizer step
    workers: int = 4
    mixed_precision: str | None = None  # "no", "bf16", "fp16"; None takes what `accelerate launch` was told
    save_every: int = 5_000
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("steps", "batch_size", "iterations", "evaluation_iterations", "accumulate", "save_every"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is 1 or more; got {getattr(self, name)}")
        if self.learning_rate <= 0 or self.clip_norm <= 0:
            raise ValueError(f"learning_rate and clip_norm are above 0; got {self.learning_rate} and {self.clip_norm}")


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
    pairs: list[StereoPair] | None = None,
    tracker: str | None = "tensorboard",
) -> list[dict[str, Any]]:
    """Trains `matcher` on the stream and returns its score on each of `pairs` (empty without pairs).

    Every rank reads its own share of the stream, in step with the others. A run that is resumed sees exactly the batches that the unbroken
    run would have seen.

    Args:
        loss_function: (initial prediction, sequence of predictions, batch) -> (loss, metrics).
        output: the run's folder: checkpoints, tracker logs, log.jsonl, evaluation.json.
        model_config: {"model": name, "options": {...}}, saved with the weights.
        arguments: what the run was started with, saved with its state.
        resume: a run's folder or one of its checkpoints.
        pairs: stereo pairs with ground truth for the final evaluation.
        tracker: any of Accelerate's, or None.
    """
    accelerator = Accelerator(
        cpu=not torch.accelerator.is_available(),  # without it, ranks that torchrun starts on a CPU do not find each other
        mixed_precision=config.mixed_precision,
        gradient_accumulation_steps=config.accumulate,
        log_with=tracker,
        project_dir=str(output),
    )
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
    )
    output.mkdir(parents=True, exist_ok=True)
    step = 0
    if resume is not None:
        checkpoint = run_folder.newest(resume)
        load_checkpoint(matcher, checkpoint / "model.safetensors")
        training, state = run_folder.load(checkpoint)
        optimizer.load_state_dict(training["optimizer"])
        schedule.load_state_dict(training["schedule"])
        loader.load_state_dict(state["stream"])
        step = state["step"]
        accelerator.print(f"resumed from {checkpoint} at step {step}")
    model, optimizer = accelerator.prepare(matcher, optimizer)
    if resume is not None and accelerator.scaler is not None and training["scaler"]:
        accelerator.scaler.load_state_dict(training["scaler"])
    if tracker is not None:
        accelerator.init_trackers(output.name or "run", {name: value for name, value in asdict(config).items() if value is not None})

    def save() -> None:
        if accelerator.is_main_process:
            run_folder.save(
                output,
                step,
                matcher,
                model_config,
                {
                    "optimizer": optimizer.state_dict(),
                    "schedule": schedule.state_dict(),
                    "scaler": accelerator.scaler.state_dict() if accelerator.scaler is not None else {},
                },
                {"stream": loader.state_dict(), "world_size": accelerator.num_processes, "arguments": arguments},
            )
        accelerator.wait_for_everyone()

    model.train()
    progress = tqdm(total=config.steps, initial=step, unit="step", disable=not accelerator.is_main_process, dynamic_ncols=True)
    mark = _Mark(step, loader.stats()["seconds"].get("wait", 0.0))
    saved = step
    while step < config.steps:
        for batch in loader:
            with accelerator.accumulate(model):
                with accelerator.autocast():
                    initial, sequence = model(batch.left, batch.right, iterations=config.iterations)
                loss, metrics = loss_function(initial, sequence, batch)
                if not math.isfinite(loss.item()):
                    ids = [(meta["epoch"], meta["index"], meta["key"]) for meta in batch.meta]
                    raise RuntimeError(
                        f"the loss is {loss.item()} at step {step}; samples (epoch, index, key): {ids}. stream.replay shows them"
                    )
                accelerator.backward(loss)
                if accelerator.sync_gradients:
                    accelerator.clip_grad_norm_(model.parameters(), config.clip_norm)
                optimizer.step()
                optimizer.zero_grad()
            if not accelerator.sync_gradients:
                continue
            schedule.step()
            step += 1
            progress.update()
            if step % LOG_EVERY_STEPS == 0 or step == config.steps:
                values = {
                    "loss": loss.item(),
                    **{name: float(value) for name, value in metrics.items()},
                    "learning_rate": schedule.get_last_lr()[0],
                }
                pairs_seen = (step - mark.step) * config.batch_size * config.accumulate * accelerator.num_processes
                wait = loader.stats()["seconds"].get("wait", 0.0)
                values |= mark.rates(pairs_seen, wait)
                mark = _Mark(step, wait)
                progress.set_postfix_str(
                    f"loss {values['loss']:.2f}, EPE {values['epe']:.2f} px, {values['pairs_per_second']:.1f} pairs/s, "
                    f"waiting {values['wait_share']:.0%}"
                )
                if accelerator.is_main_process:
                    with (output / "log.jsonl").open("a") as log:
                        place = loader.state_dict()
                        log.write(json.dumps({"step": step, "epoch": place["epoch"], "samples": place["samples"], **values}) + "\n")
                accelerator.log(values, step=step)
            if step % config.save_every == 0:
                save()
                saved = step
            if step == config.steps:
                break
    progress.close()
    if saved != step:
        save()

    scores: list[dict[str, Any]] = []
    if pairs and accelerator.is_main_process:
        scores = evaluate(
            lambda left, right: matcher.predict(left, right, iterations=config.evaluation_iterations), pairs, device=accelerator.device
        )
        (output / "evaluation.json").write_text(json.dumps({"mean": mean_scores(scores), "pairs": scores}, indent=2) + "\n")
        accelerator.print(table(scores))
    accelerator.wait_for_everyone()
    loader.close()
    accelerator.end_training()
    return scores


class _Mark:
    """A moment in the run, to count from."""

    def __init__(self, step: int, wait_seconds: float) -> None:
        self.step = step
        self._time = time.perf_counter()
        self._wait_seconds = wait_seconds

    def rates(self, pairs: int, wait_seconds: float) -> dict[str, float]:
        elapsed = time.perf_counter() - self._time
        return {"pairs_per_second": pairs / elapsed, "wait_share": (wait_seconds - self._wait_seconds) / elapsed}
