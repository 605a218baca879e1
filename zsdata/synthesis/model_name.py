"""The names of models: folders, Hub ids, and Hub ids at a commit ("owner/name@commit")."""

from __future__ import annotations

import os
import re

AT_REVISION = re.compile(r"([\w.-]+(?:/[\w.-]+)?)@([\w./-]+)")  # a Hub id and a branch, tag or commit; a path otherwise


def split_revision(name: str, revision: str | None) -> tuple[str, str | None]:
    """A name and its revision; "owner/name@revision" says both.

    Raises:
        ValueError: there are two revisions.
    """
    both = None if os.path.isdir(name) else AT_REVISION.fullmatch(name)
    if both is None:
        return name, revision
    if revision is not None:
        raise ValueError(f'"{name}" names a revision, and revision="{revision}" another; leave one of them out')
    return both[1], both[2]
