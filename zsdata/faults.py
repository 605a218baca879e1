"""What may be skipped, and how often."""

from __future__ import annotations

import logging
import math
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass

from zsdata.field_types import check_types

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


class SampleFailed(RuntimeError):
    """A sample could not be made for want of a file, a package, memory or a right value; the message names the sample and what it lacks."""


class WorkerLost(RuntimeError):
    """A worker process was killed, ended or hangs; the message names the process and the sample that it was at."""


MENDED_BY_THE_USER = (ImportError, MemoryError, OSError, ValueError)
TOLD_IN_WORDS = (*MENDED_BY_THE_USER, BadShard, NoUsablePhoto, SampleFailed, TooManyFaults, WorkerLost)  # by commands, without a traceback


def in_words(error: Exception) -> str:
    """What an error says to whoever reads it without its traceback."""
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename and error.strerror else ""
        return where + (error.strerror or str(error))
    if isinstance(error, MemoryError):  # Python's own says nothing
        return str(error) or "memory ran out; fewer workers, smaller pairs or smaller photos need less"
    return str(error)


def failed(sample: str, error: Exception) -> RuntimeError:
    """What to raise from an error that a sample failed for: SampleFailed where whoever runs this can mend it."""
    kind = SampleFailed if isinstance(error, MENDED_BY_THE_USER) else RuntimeError
    return kind(f"{sample} failed: {in_words(error)}")


@dataclass(frozen=True, kw_only=True)
class FailureBudget:
    """How many photos may be refused before the run stops: more than `count` of them, over all workers and ranks, and more than `rate` of
    all that were tried.

    Only the last RECENT_PHOTOS that a rank has tried count, so that a bucket which breaks after a good week is noticed in minutes. Ranks
    do not ask each other, as one would then wait for another: samples are dealt out at random, so each tells from its own how many all of
    them have refused, and takes for a higher rate only what chance alone (CHANCE_DEVIATIONS) would not make of its few.
    """

    count: int = 100
    rate: float = 0.1

    def __post_init__(self) -> None:
        check_types(self)
        if self.count < 0 or not 0 <= self.rate <= 1:
            raise ValueError(f"a budget is a count >= 0 and a rate in 0..1; got {self.count} and {self.rate}")


RECENT_PHOTOS = 10_000  # or ten budgets, if that is more: so many that chance alone does not reach a rate that is well above the true one
CHANCE_DEVIATIONS = 4.0  # of 64 ranks, none takes 7 % bad photos for more than 10 %; of 15 % the first one knows after 30
MOST_REASONS = 100  # counted apart; a reason that names numbers must not fill the memory
OTHER_REASONS = "other reasons"


class FaultLog:
    """Counts what was refused, by reason, and stops the run once the budget is spent.

    Args:
        ranks: that share the budget's count.
        forgiven: reasons that are counted and spend no budget: what they tell belongs to the data, and is no failure.
    """

    EXAMPLES = 20  # kept for the summary
    LOG_LINES = 20  # at most, one for each reason

    def __init__(self, budget: FailureBudget, ranks: int = 1, forgiven: Sequence[str] = ()) -> None:
        self._budget = budget
        self._ranks = ranks
        self._forgiven = tuple(forgiven)
        self._recent: deque[tuple[int, int]] = deque()  # (tried, refused)
        self._tried = self._refused = 0
        self.made = 0
        self.by_reason: Counter[str] = Counter()
        self.examples: list[tuple[str, str, str, str]] = []

    def add(self, made: int, rejected: Sequence[tuple[str, str, str, str]]) -> None:
        """Counts `made` good samples and the photos refused on the way to them: (source, shard, key, reason).

        Raises:
            TooManyFaults: with a summary, once the budget is spent.
        """
        self.made += made
        for reject in rejected:
            self._count(reject)
        self._spend(made + len(rejected), sum(_reason(reject) not in self._forgiven for reject in rejected))

    def _count(self, reject: tuple[str, str, str, str]) -> None:
        reason = _reason(reject)
        if reason not in self.by_reason:
            if len(self.by_reason) < self.LOG_LINES:
                logger.warning('photo "%s" in %s skipped: %s (further ones of this kind are only counted)', reject[2], reject[1], reject[3])
            elif len(self.by_reason) >= MOST_REASONS:
                reason = OTHER_REASONS
        self.by_reason[reason] += 1
        if len(self.examples) < self.EXAMPLES:
            self.examples.append(reject)

    def _spend(self, tried: int, refused: int) -> None:
        self._recent.append((tried, refused))
        self._tried += tried
        self._refused += refused
        while self._tried - self._recent[0][0] >= max(RECENT_PHOTOS, 10 * self._budget.count):
            tried, refused = self._recent.popleft()
            self._tried -= tried
            self._refused -= refused
        rate = self._budget.rate
        by_chance = CHANCE_DEVIATIONS * math.sqrt(rate * (1 - rate) * self._tried) if self._ranks > 1 else 0.0
        if self._refused * self._ranks > self._budget.count and self._refused > rate * self._tried + by_chance:
            reasons = ", ".join(f"{reason}: {count}" for reason, count in self.by_reason.most_common(10))
            ranks = f" over all {self._ranks} ranks" if self._ranks > 1 else ""
            examples = "; ".join(f"{key} in {shard}: {reason}" for _, shard, key, reason in self.examples[:3])
            raise TooManyFaults(
                f"{self._refused} of the last {self._tried} photos were refused, more than the failure budget allows "
                f"({self._budget.count}{ranks}, and {self._budget.rate:.0%}). Refused since the start: {reasons}; the first: {examples}. "
                "`zsdata verify` lists what is wrong with the shards"
            )


def _reason(reject: tuple[str, str, str, str]) -> str:
    """What it is counted by: without the detail."""
    return reject[3].split(":")[0]
