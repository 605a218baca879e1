"""An exponential moving average of a network's weights, which often paints better than the weights themselves."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn

WARM_UP_STEPS = 10  # the average follows closely at first: its decay is at most (1 + step) / (WARM_UP_STEPS + step)


class WeightAverage:
    """An exponential moving average of a network's weights."""

    def __init__(self, network: nn.Module, decay: float) -> None:
        self._decay = decay
        self.weights = [weight.detach().clone() for weight in network.parameters()]

    def to(self, device: torch.device) -> None:
        self.weights = [weight.to(device) for weight in self.weights]

    def update(self, network: nn.Module, step: int) -> None:
        decay = min(self._decay, (1 + step) / (WARM_UP_STEPS + step))
        blend = get_ema_multi_avg_fn(decay)  # all weights in a few kernels
        blend(self.weights, [weight.detach() for weight in network.parameters()], None)


@contextmanager
def weights_of(average: WeightAverage | None, network: nn.Module) -> Iterator[dict[str, Tensor]]:
    """The network holds the average meanwhile; gives its own weights, on the CPU, or nothing where there is no average."""
    if average is None:
        yield {}
        return
    own = {name: weight.detach().to("cpu", copy=True) for name, weight in network.state_dict().items()}
    try:
        with torch.no_grad():
            for weight, mean in zip(network.parameters(), average.weights, strict=True):
                weight.copy_(mean)
        yield own
    finally:
        network.load_state_dict(own)
