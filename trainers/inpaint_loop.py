"""The fine-tuning of an inpainting U-Net on warped views (paper, section "Fine-tuning Protocol"): only the U-Net learns, to predict noise.

A checkpoint is RUN/checkpoints/step-.../ with pipeline/, a whole pipeline in the diffusers format, training.pt and state.json. The last few
stay, and in RUN/best/ the best. A checkpoint is judged after it is saved, so its state.json tells the best of those before it; a run that
is resumed begins by judging the one that it goes on from.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import torch
from accelerate import Accelerator
from accelerate.utils import gather_object
from torch import Tensor

from trainers import run_folder
from trainers.accelerated import load_optimizer_state, open_accelerator, optimizer_state
from trainers.hole_scores import HoleCase, hole_cases, mean_hole_scores, score_holes
from trainers.inpaint_data.batches import making, requests
from trainers.inpaint_data.sources import ExampleBatch, Examples
from trainers.inpaint_data.stored_maps import SPARSE_TRUTH
from trainers.memory import out_of_memory_is_cured_by
from trainers.noise_prediction import NoisePrediction
from trainers.pairs_on_disk import StereoPair
from trainers.pipeline_folder import UNET, frozen_digest, write_pipeline
from trainers.step_guard import StepGuard
from trainers.termination import Terminated, Termination, end
from trainers.weight_average import WeightAverage, weights_of
from zsdata.faults import FailureBudget, FaultLog
from zsdata.position import Position, require_one_place
from zsdata.progress import Progress
from zsdata.synthesis.inpaint import load_inpainter
from zsdata.synthesis.inpaint.diffusion_parts import CELL_PX, load_diffusion_parts
from zsdata.synthesis.inpaint.options import DiffusionNetwork

MODEL = "an inpainting U-Net"
PIPELINE = "pipeline"  # the folder in a checkpoint
LOG_EVERY_STEPS = 10
WARM_UP_SHARE = 0.01  # of the one-cycle, as published


@dataclass(frozen=True, kw_only=True)
class TuneConfig:
    """How the U-Net is tuned; the defaults are the paper's (section "Implementation Details") and, beyond it, the published code's."""

    steps: int = 50_000
    batch_size: int = 32  # examples per optimizer step, over all ranks
    micro_batch: int = 8  # examples at once on one rank; the rest is accumulated
    learning_rate: float = 2e-5  # peak of the one-cycle
    weight_decay: float = 1e-2
    ema: float | None = None  # decay of an average of the weights, which is then what is saved and judged
    gradient_checkpointing: bool = False  # less memory, a third more time
    mixed_precision: str | None = None  # "no", "bf16", "fp16"; None takes what `accelerate launch` was told
    workers: int = 8
    save_every: int = 5_000
    validation_steps: int = 50  # DDIM steps
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("steps", "batch_size", "micro_batch", "save_every", "validation_steps"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is 1 or more; got {getattr(self, name)}")
        if self.learning_rate <= 0:
            raise ValueError(f"learning_rate is above 0; got {self.learning_rate}")
        for name in ("workers", "seed"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} is 0 or more; got {getattr(self, name)}")
        if self.ema is not None and not 0 < self.ema < 1:
            raise ValueError(f"ema is a decay in (0, 1), such as 0.9999; got {self.ema}")

    def accumulate(self, ranks: int) -> int:
        """Batches per optimizer step and rank."""
        at_once = self.micro_batch * ranks
        if self.batch_size % at_once:
            raise ValueError(
                f"batch_size {self.batch_size} is no multiple of micro_batch {self.micro_batch} times {ranks} ranks; change one of them"
            )
        return self.batch_size // at_once


@out_of_memory_is_cured_by("lower --micro-batch, add --gradient-checkpointing or --mixed-precision bf16, or lower --size")
def tune(
    pipeline: Path,
    examples: Examples,
    config: TuneConfig,
    *,
    output: Path,
    arguments: dict[str, Any],
    subfolder: str = "",
    resume: Path | None = None,
    pairs: list[StereoPair] | None = None,
    tracker: str | None = "tensorboard",
) -> Path:
    """Tunes the U-Net of `pipeline` and returns the last checkpoint's pipeline folder, which `zsdata.load_inpainter` loads.

    The examples of a step, their noise and their timesteps are functions of (seed, step, index): a resumed run goes on as if it had never
    stopped, and other numbers of ranks or another micro_batch change it only by rounding.

    Args:
        pipeline: a local folder in the diffusers format, or one that holds it, with the card and the licence.
        examples: made for `config.seed` and `config.batch_size`.
        output: the run's folder: checkpoints, best, tracker logs, log.jsonl, skipped.jsonl, validation.jsonl. Refused where it holds
            those of another run.
        arguments: what the run was started with, saved with its state.
        subfolder: where in `pipeline` it lies.
        resume: a run's folder or one of its checkpoints; `output` itself may still be without any.
        pairs: stereo pairs with dense ground truth; their holes are filled and judged before the first step, at every checkpoint and on
            resume. The checkpoint of the highest mean PSNR is kept in OUTPUT/best.
        tracker: any of Accelerate's, or None.

    Raises:
        ValueError, ImportError, OSError: options, a tracker or a pipeline that cannot be used, an output that is another run's, a
            checkpoint of other data or options, or a rank that has other data.
        TrainingDiverged: too many steps in a row had to be skipped, because their loss was not finite or exploded.
        NoUsablePhoto, TooManyFaults, WorkerLost: examples cannot be made.
        MemoryError: the device's memory is too small; says what to lower.
        Terminated: a rank got SIGTERM; the checkpoint of this step is saved.
    """
    checkpoint = run_folder.check_output(output, resume)
    accelerator = open_accelerator(config.mixed_precision, tracker, output)
    accumulate = accelerator.gradient_accumulation_steps = config.accumulate(accelerator.num_processes)
    if any(side <= 0 or side % CELL_PX for side in examples.size):
        raise ValueError(f"crops are multiples of {CELL_PX} px high and wide, {CELL_PX} or more; got {examples.size}")
    parts = load_diffusion_parts(DiffusionNetwork(str(pipeline), subfolder=subfolder))
    prediction = NoisePrediction(parts, accelerator.device, config.seed)
    cases = _validation_cases(pairs, examples, accelerator)
    judged_by = {"pairs": [case.name for case in cases], "validation_steps": config.validation_steps}

    kept = {name: getattr(config, name) for name in ("steps", "learning_rate", "weight_decay", "ema")}
    options = {"model": MODEL, **kept, "the pipeline's digest": frozen_digest(pipeline / subfolder)}
    unet, step, training, state, refused_before = parts.unet, 0, None, {}, Counter[str]()
    if checkpoint is not None:
        training, state = run_folder.load(checkpoint)
        run_folder.require_options(checkpoint, state, options, f"--pipeline {checkpoint / PIPELINE}")
        step, refused_before = state["step"], Counter(state["refused"])
        judgeable = cases and checkpoint.resolve() == run_folder.folder_of(output, step).resolve()
        if step >= config.steps and not judgeable:  # a run may have been ended while its last checkpoint was judged
            raise ValueError(f"{checkpoint} has all of the {config.steps} steps already")
        Position.from_state(state["examples"], examples.position(step))
        unet = type(unet).from_pretrained(checkpoint / PIPELINE / UNET, use_safetensors=True)
        accelerator.print(f"resumed from {checkpoint} at step {step}")
    elif resume is not None:
        accelerator.print(f"no checkpoint in {resume} yet: the run begins")
    require_one_place(gather_object([examples.position(step).to_state()]))
    average = None if config.ema is None else WeightAverage(unet, config.ema)
    if training is not None and training["weights"]:
        unet.load_state_dict(training["weights"])
    unet.requires_grad_(True).train()
    if config.gradient_checkpointing:
        unet.enable_gradient_checkpointing()
    optimizer = torch.optim.AdamW(unet.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer,
        config.learning_rate,
        config.steps + 1,  # the last step too has a learning rate above 0
        pct_start=WARM_UP_SHARE,
        cycle_momentum=False,
        anneal_strategy="linear",
    )
    model, optimizer = accelerator.prepare(unet, optimizer)
    guard = StepGuard(accelerator, unet, output / "skipped.jsonl", hint="shard and key say where they lie")
    if training is not None:
        load_optimizer_state(training, optimizer, schedule, accelerator)
        guard.load_state_dict(state["guard"])
    if average is not None:
        average.to(accelerator.device)

    output.mkdir(parents=True, exist_ok=True)
    best: dict[str, Any] | None = state.get("best")  # {"step", "psnr", "by"}, of the checkpoints before this one
    if checkpoint is not None and best is not None and accelerator.is_main_process:
        there = run_folder.restore_best(checkpoint, output, best["step"])
        if cases and not (there and best["by"] == judged_by):
            best = None
    if tracker is not None:
        accelerator.init_trackers(output.name or "run", {name: value for name, value in asdict(config).items() if value is not None})

    faults = FaultLog(FailureBudget(), ranks=accelerator.num_processes, forgiven=[SPARSE_TRUTH])

    termination = Termination()

    def refused() -> dict[str, int]:
        """Pairs and photos that could not be used, by reason, of all ranks and since the run began."""
        return dict(sum(gather_object([faults.by_reason]), start=refused_before))

    def save() -> Path:
        refused_so_far = refused()
        if accelerator.is_main_process:
            with weights_of(average, unet) as raw:
                run_folder.write(
                    output,
                    step,
                    lambda folder: write_pipeline(folder / PIPELINE, unet, pipeline, subfolder),
                    {"weights": raw, **optimizer_state(optimizer, schedule, accelerator)},
                    {
                        "examples": examples.position(step).to_state(),
                        "options": options,
                        "refused": refused_so_far,
                        "best": best,
                        "guard": guard.state_dict(),
                        "world_size": accelerator.num_processes,
                        "arguments": arguments,
                    },
                )
        accelerator.wait_for_everyone()
        return run_folder.folder_of(output, step)

    def validate(checkpoint: Path | None) -> None:
        """Judges a checkpoint, which is kept if it is the best so far; or, with None, the pipeline that the run begins with."""
        nonlocal best
        if not cases:
            return
        try:
            with termination.at_once():
                scores = _validate(pipeline / subfolder if checkpoint is None else checkpoint / PIPELINE, cases, config, accelerator)
        except Terminated:
            end(accelerator, checkpoint, output)
        mean, note = mean_hole_scores(scores), ""
        if checkpoint is not None and mean["psnr"] > (-math.inf if best is None else best["psnr"]):
            best, note = {"step": step, "psnr": mean["psnr"], "by": judged_by}, ", the best so far"
            if accelerator.is_main_process:
                run_folder.keep_best(checkpoint, output)
        accelerator.log({f"hole_{name}": value for name, value in mean.items()}, step=step)
        accelerator.print(f"step {step}: holes of {len(scores)} pairs, PSNR {mean['psnr']:.2f} dB, SSIM {mean['ssim']:.3f}{note}")
        if accelerator.is_main_process:
            run_folder.append(output / "validation.jsonl", {"step": step, "mean": mean, "pairs": scores})

    with termination:
        validate(checkpoint)
    asked = requests(step, config.steps, config.batch_size, config.micro_batch, accelerator.process_index, accelerator.num_processes)
    progress = Progress(total=config.steps, initial=step, unit="step", disable=not accelerator.is_main_process, dynamic_ncols=True)
    with termination, making(examples, asked, config.workers, accelerator.device) as batches:
        mark, waited = (step, time.perf_counter()), 0.0
        while step < config.steps:
            skipped = False
            for _ in range(accumulate):
                begin = time.perf_counter()
                batch: ExampleBatch = next(batches)
                waited += time.perf_counter() - begin
                faults.add(len(batch.requests), batch.rejected)
                with accelerator.accumulate(model):
                    with accelerator.autocast():
                        loss = prediction.loss(model, batch)
                    guard.watch(loss, batch)
                    accelerator.backward(loss)
                    if accelerator.sync_gradients:
                        norm = accelerator.clip_grad_norm_(model.parameters(), math.inf)  # measures it, and clips nothing
                        skipped = guard.refuses(step, cast(Tensor, norm))
                        if skipped:
                            optimizer.zero_grad()  # a step without gradients changes nothing
                    optimizer.step()
                    optimizer.zero_grad()
            schedule.step()
            step += 1
            if average is not None and not skipped:
                average.update(unet, step)
            progress.update()
            if step % LOG_EVERY_STEPS == 0 or step == config.steps:
                elapsed = time.perf_counter() - mark[1]
                values = {
                    "loss": guard.loss,
                    "gradient_norm": guard.gradient_norm,
                    "skipped_steps": guard.skipped,
                    "learning_rate": schedule.get_last_lr()[0],
                    "examples_per_second": (step - mark[0]) * config.batch_size / elapsed,
                    "wait_share": waited / elapsed,
                }
                mark, waited = (step, time.perf_counter()), 0.0
                reasons = refused()
                progress.set_postfix_str(
                    f"loss {values['loss']:.4f}, {values['examples_per_second']:.1f} examples/s, waiting {values['wait_share']:.0%}"
                )
                if accelerator.is_main_process:
                    run_folder.append(output / "log.jsonl", {"step": step, **values, "refused": reasons})
                accelerator.log({**values, "refused": sum(reasons.values())}, step=step)
            if step < config.steps and termination.asked(accelerator.device):
                end(accelerator, save(), output)
            if step % config.save_every == 0 or step == config.steps:
                validate(save())
    progress.close()
    accelerator.print(_summary(refused()))
    folder = run_folder.folder_of(output, step) / PIPELINE
    accelerator.print(f"the pipeline is {folder}")
    if cases and best is not None:
        where = output / "best" / PIPELINE
        accelerator.print(f"the best pipeline is {where}, of step {best['step']}: PSNR {best['psnr']:.2f} dB in the holes")
    accelerator.end_training()
    return folder


def _validation_cases(pairs: list[StereoPair] | None, examples: Examples, accelerator: Accelerator) -> list[HoleCase]:
    cases, left_out = hole_cases(pairs or [], examples.size)
    if left_out:
        accelerator.print(f"not judged, for want of dense ground truth or of holes: {', '.join(left_out)}")
    if pairs and not cases:
        raise ValueError("none of the pairs to validate on has dense ground truth and holes to judge")
    return cases


def _validate(folder: Path, cases: list[HoleCase], config: TuneConfig, accelerator: Accelerator) -> list[dict[str, Any]]:
    """Scores of the saved pipeline, shared out over the ranks; loaded as a user loads it."""
    mine = list(enumerate(cases))[accelerator.process_index :: accelerator.num_processes]
    scores = []
    if mine:
        inpaint = load_inpainter(folder, accelerator.device, steps=config.validation_steps, micro_batch=1)  # one case at a time
        scores = [(number, score_holes(inpaint, case, number, config.seed)) for number, case in mine]
    return [score for _, score in sorted(gather_object(scores), key=lambda entry: entry[0])]


def _summary(refused: dict[str, int]) -> str:
    reasons = ", ".join(f"{reason}: {count}" for reason, count in refused.items())
    return f"refused, and replaced by others: {reasons}" if refused else "no pair and no photo was refused"
