"""Runs the programs of the pages as their reader would: by a Python of their own."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
RUN_S = 60


def output_of(program: Path) -> str:
    """What a program prints that runs in its folder. AssertionError, with what it says, if it fails."""
    done = subprocess.run(
        [sys.executable, program.name],
        cwd=program.parent,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=RUN_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout
