"""The code that a GPU runs, on a machine without one."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.pretended_gpu.build import environment

ROOT = Path(__file__).parents[1]


@pytest.mark.timeout(900)
def test_what_runs_on_a_gpu(tmp_path):
    try:
        pretending = environment(tmp_path)
    except RuntimeError as error:
        pytest.skip(f"no GPU can be pretended here: {error}")
    checks = [sys.executable, "-m", "pytest", "tests/pretended_gpu/checks.py"]
    done = subprocess.run(checks, env=pretending, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
