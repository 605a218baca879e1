"""The types of a configuration's fields, checked where it is made: Python itself checks none."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Any


def check_types(configuration: Any) -> None:
    """Holds the fields of a dataclass against their annotations, which are made of int, float, bool, str, None and Literals of text.

    An int may stand for a float; a bool for neither.

    Raises:
        TypeError: names the field, what it is and what it got.
        ValueError: a float is not finite.
    """
    for field in fields(configuration):
        value, wanted = getattr(configuration, field.name), [part.strip() for part in str(field.type).split("|")]
        kinds = ["str" if part.startswith("Literal[") else part for part in wanted]
        if not any(isinstance(value, _KINDS[kind]) and (kind == "bool" or not isinstance(value, bool)) for kind in kinds):
            raise TypeError(f"{field.name} is of type {' or '.join(wanted)}; got {value!r}")
        if isinstance(value, float) and not math.isfinite(value):
            raise ValueError(f"{field.name} is a finite number; got {value}")


_KINDS = {"int": (int,), "float": (int, float), "bool": (bool,), "str": (str,), "None": (type(None),)}
