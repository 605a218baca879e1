"""What may be skipped, and how often."""

from __future__ import annotations


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
