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


def make_scheduler(name: str, config: Mapping[str, Any], steps: int) -> Any:
    """The named scheduler, set to `steps`, with the noise schedule of `config`, whatever scheduler that was saved by.

    Raises:
        ValueError: no such scheduler, one that does not denoise what an inpainting U-Net was trained on, or more steps than it has.
    """
    import diffusers

    class_name = SCHEDULERS.get(name, name)
    scheduler_class: Any = getattr(diffusers, class_name, None) if class_name.endswith("Scheduler") else None
    if scheduler_class is None:
        raise ValueError(f'scheduler is one of {", ".join(SCHEDULERS)} or a scheduler class of diffusers by name; got "{name}"')
    options = inspect.signature(scheduler_class.__init__).parameters
    step = inspect.signature(getattr(scheduler_class, "step", scheduler_class)).parameters
    inputs = [key for key, value in step.items() if value.default is value.empty]
    if "beta_schedule" not in options or inputs != ["self", "model_output", "timestep", "sample"]:
        raise ValueError(f'scheduler "{name}" is made for another kind of model: it does not denoise what this U-Net was trained on')
    # Latents are not bounded by -1..1, but some schedulers clip to it unless told otherwise.
    unclipped = {"clip_sample": False} if "clip_sample" in options else {}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="__array", category=DeprecationWarning)  # what diffusers does to NumPy 2
        scheduler = scheduler_class.from_config({**unclipped, **config})
        scheduler.set_timesteps(steps)
    return scheduler
