"""The Hub's cache on a machine that has downloaded a model at two commits, and is offline now."""

import os
import subprocess
import sys

COMMITS = ["a" * 40, "b" * 40]


def save_to_hub(home, name, save):
    """`save(number, folder)` writes each of the COMMITS, of which "main" is the first; returns the file that says so."""
    repository = home / "hub" / f"models--{name.replace('/', '--')}"
    for number, commit in enumerate(COMMITS):
        save(number, repository / "snapshots" / commit)
    main = repository / "refs" / "main"
    main.parent.mkdir()
    main.write_text(COMMITS[0])
    return main


def run_offline(program, home):
    environment = {**os.environ, "HF_HOME": str(home), "HF_HUB_CACHE": str(home / "hub"), "HF_HUB_OFFLINE": "1"}
    result = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, timeout=200)
    assert result.returncode == 0, result.stderr
