"""What may be skipped, and how often."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

logger = logging.getLogger("zsdata")


class BadPhoto(Exception):
    """A photo that cannot become a pair; it is counted with its reason and replaced, never dropped in silence.

    Args:
        reason: a short phrase that faults are counted by ("truncated", "not an image", ...), optionally followed by ": " and detail.
        key: the photo's name, where it is known.
    """

    def __init__(self, reason: str, key: str | None = None) -> None:
        super().__init__(reason, key)
        self.reason = reason
        self.key = key

    def __str__(self) -> str:
        return f"{self.key}: {self.reason}" if self.key else self.reason


class BadShard(Exception):
    """A tar that is damaged: `shard` is its url, `offset` the byte where the damage begins, `reason` what is wrong."""

    def __init__(self, reason: str, shard: str, offset: int) -> None:
        super().__init__(reason, shard, offset)
        self.reason = reason
        self.shard = shard
        self.offset = offset

    def __str__(self) -> str:
        return f"{self.shard} at byte {self.offset:,}: {self.reason}"


class TooManyFaults(RuntimeError):
    """The failure budget is spent."""


class NoUsablePhoto(RuntimeError):
    """Neither a sample's photo nor any of its spares could be used."""


@dataclass(frozen=True, kw_only=True)
class FailureBudget:
    """How many photos may be refused before the run stops: more than `count` of them and more than `rate` of all that were tried."""

    count: int = 100
    rate: float = 0.1

    def __post_init__(self) -> None:
        if self.count < 0 or not 0 <= self.rate <= 1:
            raise ValueError(f"a budget is a count >= 0 and a rate in 0..1; got {self.count} and {self.rate}")


class FaultLog:
    """Counts what was refused, by reason, and stops the run once the budget is spent."""

    EXAMPLES = 20  # kept for the summary

    def __init__(self, budget: FailureBudget) -> None:
        self._budget = budget
        self.made = 0
        self.by_reason: Counter[str] = Counter()
        self.examples: list[tuple[str, str, str, str]] = []

    def add(self, made: int, rejected: Iterable[tuple[str, str, str, str]]) -> None:
        """Counts `made` good samples and the refused photos: (source, shard, key, reason).

        Raises:
            TooManyFaults: with a summary, once the budget is spent.
        """
        self.made += made
        for reject in rejected:
            reason = reject[3].split(":")[0]
            if not self.by_reason[reason]:
                logger.warning('photo "%s" in %s skipped: %s (further ones of this kind are only counted)', reject[2], reject[1], reject[3])
            self.by_reason[reason] += 1
            if len(self.examples) < self.EXAMPLES:
                self.examples.append(reject)
        refused = self.by_reason.total()
        if refused > self._budget.count and refused > self._budget.rate * (self.made + refused):
            reasons = ", ".join(f"{reason}: {count}" for reason, count in self.by_reason.most_common())
            raise TooManyFaults(
                f"{refused} of {self.made + refused} photos were refused ({reasons}), more than the failure budget allows "
                f"({self._budget.count} and {self._budget.rate:.0%}); `zsdata verify` lists what is wrong with the shards"
            )
