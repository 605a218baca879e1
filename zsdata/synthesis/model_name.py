"""The names of models: folders, Hub ids, and Hub ids at a commit ("owner/name@commit")."""

from __future__ import annotations

import os


def split_revision(name: str, revision: str | None) -> tuple[str, str | None]:
    """A name and its revision; "owner/name@revision" says both.

    Raises:
        ValueError: there are two revisions.
    """
    if "@" not in name or os.path.isdir(name):
        return name, revision
    plain, _, at = name.rpartition("@")
    if revision is not None:
        raise ValueError(f'"{name}" names a revision, and revision="{revision}" another; leave one of them out')
    return plain, at
