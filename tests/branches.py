"""Branch coverage without a package: which way each conditional jump of some modules goes while tests run.

    python -m tests.branches zsdata/source/tar.py zsdata/source/png.py -- tests/source -m "not slow"

As `coverage` counts them: from the line of a condition or loop to each of the lines where it may lead. The way of a jump in the bytecode
is seen by tracing instructions. Left out are the ways of an exception: past an `except` that does not fit, and out of a `with`.
Python 3.11; a test may run fifty times slower.
"""

from __future__ import annotations

import dis
import sys
import threading
from collections import defaultdict
from itertools import pairwise
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import pytest


class Branches:
    """The ways that were taken, and all that there are."""

    def __init__(self, files: list[str]) -> None:
        self._files = set(files)
        self._jumps: dict[CodeType, dict[int, set[int]]] = {}
        self._before: dict[FrameType, int] = {}
        self.taken: dict[str, set[tuple[str, int, int]]] = defaultdict(set)

    def pytest_runtest_setup(self) -> None:
        """Once more for every test: others set traces too, and leave none behind."""
        sys.settrace(self.trace)

    def trace(self, frame: FrameType, event: str, argument: Any) -> Any:
        if frame.f_code.co_filename not in self._files:
            return None
        if event == "call":
            frame.f_trace_opcodes = True
        elif event == "opcode":
            code = frame.f_code
            if code not in self._jumps:
                self._jumps[code] = conditional_jumps(code)
            before = self._before.pop(frame, None)
            if before is not None:
                self.taken[code.co_filename].add((code.co_qualname, before, frame.f_lasti))
            if frame.f_lasti in self._jumps[code]:
                self._before[frame] = frame.f_lasti
        elif event in ("return", "exception"):
            self._before.pop(frame, None)
        return self.trace


def lines_of(code: CodeType) -> dict[int, int]:
    """Line by offset of each instruction."""
    lines, line = {}, code.co_firstlineno
    for instruction in dis.get_instructions(code):
        line = instruction.positions.lineno or line if instruction.positions else line
        lines[instruction.offset] = line
    return lines


def conditional_jumps(code: CodeType) -> dict[int, set[int]]:
    """Where each jump with two ways out may lead, by its offset."""
    instructions = list(dis.get_instructions(code))
    jumps, start, before = {}, 0, ""
    for instruction, behind in pairwise(instructions):
        start = instruction.offset if start < 0 else start  # of the instruction with its EXTENDED_ARG, which is what a trace sees
        if instruction.opname == "EXTENDED_ARG":
            continue
        conditional = ("JUMP" in instruction.opname and "_IF_" in instruction.opname) or instruction.opname == "FOR_ITER"
        if conditional and before not in ("WITH_EXCEPT_START", "CHECK_EXC_MATCH"):
            jumps[start] = {instruction.argval, behind.offset}
        start, before = -1, instruction.opname
    return jumps


def all_code(code: CodeType) -> list[CodeType]:
    return [code, *(inner for constant in code.co_consts if isinstance(constant, CodeType) for inner in all_code(constant))]


def report(path: str, taken: set[tuple[str, int, int]]) -> str:
    possible: set[tuple[str, int, int]] = set()
    seen: set[tuple[str, int, int]] = set()
    for code in all_code(compile(Path(path).read_text(), path, "exec")):
        if code.co_name == "<module>":
            continue
        lines, name = lines_of(code), code.co_qualname
        for jump, ways in conditional_jumps(code).items():
            if len({lines[way] for way in ways}) > 1:
                possible |= {(name, lines[jump], lines[way]) for way in ways}
                seen |= {(name, lines[jump], lines[way]) for way in ways if (name, jump, way) in taken}
    missing = ", ".join(f"{start}->{end}" for _, start, end in sorted(possible - seen, key=lambda way: way[1:]))
    share = 100 * len(seen) / max(len(possible), 1)
    return f"{Path(path).name:16} {len(seen):4} of {len(possible):4} branches {share:6.1f} %   not taken: {missing or '-'}"


def main(arguments: list[str]) -> int:
    cut = arguments.index("--")
    files = [str(Path(name).resolve()) for name in arguments[:cut]]
    branches = Branches(files)
    threading.settrace(branches.trace)
    sys.settrace(branches.trace)
    status = pytest.main(["-p", "no:cacheprovider", *arguments[cut + 1 :]], plugins=[branches])
    sys.settrace(None)
    for path in files:
        sys.stdout.write(report(path, branches.taken[path]) + "\n")
    return int(status)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
