"""Schedulers of diffusers, by short name or by class name, on the noise schedule that a U-Net was trained with."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Mapping
from typing import Any

# Short names of the schedulers that people use; any other scheduler of diffusers goes by its class name.
SCHEDULERS = {
    "ddim": "DDIMScheduler",
    "dpm++": "DPMSolverMultistepScheduler",
    "euler": "EulerDiscreteScheduler",
    "lcm": "LCMScheduler",
    "tcd": "TCDScheduler",
}


PREDICTIONS = ("epsilon", "v_prediction", "sample")
# A run begins with pure noise. Where its first step stands lower in the noise schedule than this share, the network takes a part of that
# noise for the image: "leading" timesteps of 1 step begin at the very end, those of 600 of 1000 at 600.
FIRST_STEP = 0.7
EVEN = 0.99  # of the noise schedule: what steps of equal, whole length must cover


def make_scheduler(name: str, config: Mapping[str, Any], steps: int) -> Any:
    """The named scheduler, set to `steps`, with the noise schedule of `config`, whatever scheduler that was saved by.

    Its timesteps are spaced as `config` says, as in the published code. Where these would not begin with noise, as "leading" ones of one
    to three steps, they are "trailing" (Lin et al. 2024, "Common Diffusion Noise Schedules and Sample Steps Are Flawed").

    Raises:
        ValueError: no such scheduler, one that does not denoise what an inpainting U-Net was trained on, a `config` without a noise
            schedule, or a number of steps that the scheduler does not have.
    """
    import diffusers

    class_name = SCHEDULERS.get(name, name)
    scheduler_class: Any = getattr(diffusers, class_name, None) if class_name.endswith("Scheduler") else None
    if scheduler_class is None:
        raise ValueError(f'scheduler is one of {", ".join(SCHEDULERS)} or a scheduler class of diffusers by name; got "{name}"')
    options = inspect.signature(scheduler_class.__init__).parameters
    step = inspect.signature(getattr(scheduler_class, "step", scheduler_class)).parameters
    inputs = [key for key, value in step.items() if value.default is value.empty]
    # Inverse schedulers add noise, and CogVideoX's changes the schedule.
    other_way = "Inverse" in class_name or "snr_shift_scale" in options
    if other_way or "beta_schedule" not in options or inputs != ["self", "model_output", "timestep", "sample"]:
        raise ValueError(f'scheduler "{name}" is made for another kind of model: it does not denoise what this U-Net was trained on')
    if "noise_sampler_seed" in options:
        raise ValueError(
            f'scheduler "{name}" draws its noise from one seed for all samples, and the same pair would differ from run to run; '
            'take "EulerAncestralDiscreteScheduler" for one that adds noise'
        )
    _check_noise_schedule(config)
    # Latents are not bounded by -1..1; but schedulers that were made with no word of it say that they clip to that.
    unclipped = {"clip_sample": False} if "clip_sample" in options else {}
    said = ""
    for spacing in ({}, {"timestep_spacing": "trailing"}):
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="__array", category=DeprecationWarning)  # what diffusers does to NumPy 2
            scheduler = scheduler_class.from_config({**config, **unclipped, **spacing})
            try:
                scheduler.set_timesteps(steps)
            except (ValueError, IndexError) as error:
                said = said or f": {error}"
                continue
        first, most = float(scheduler.timesteps[0]), scheduler.config.num_train_timesteps
        # DDIM takes every step to be most // steps long, however they are spaced.
        if FIRST_STEP * most <= first < most and (not spacing or steps * (most // steps) > EVEN * most):
            return scheduler
        said = said or f": the first would stand at {first:g} of {most}, where less noise is expected than it begins with"
    raise ValueError(f'scheduler "{name}" cannot make {steps} steps{said}; take another number of steps, or another scheduler')


def _check_noise_schedule(config: Mapping[str, Any]) -> None:
    """Raises ValueError unless the configuration says with which noise a U-Net was trained; a class's defaults would be guesses."""
    lacks = [key for key in ("beta_start", "beta_end", "beta_schedule") if config.get(key) is None]
    if lacks and config.get("trained_betas") is None:
        raise ValueError(
            f"the pipeline's scheduler_config.json lacks {', '.join(lacks)}: the noise that its U-Net was trained with. "
            f"It was saved by {config.get('_class_name', 'an unknown class')}; Stable Diffusion's are 0.00085, 0.012 and scaled_linear"
        )
    prediction = config.get("prediction_type", "epsilon")
    if prediction not in PREDICTIONS or config.get("use_flow_sigmas"):
        has = "use_flow_sigmas" if prediction in PREDICTIONS else f"prediction_type {prediction!r}"
        raise ValueError(f"the pipeline's scheduler_config.json has {has}; what its U-Net predicts must be one of {', '.join(PREDICTIONS)}")
