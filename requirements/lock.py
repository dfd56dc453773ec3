"""Pins the dependencies of each image and of development, with hashes, for Python 3.10 and up (needs uv)."""

import subprocess
from pathlib import Path

HERE = Path(__file__).parent
EXTRAS = {
    "robot": ["planning"],
    "cloud": ["planning", "cloud", "live"],
    "bench": ["bench"],
    "dev": ["dev"],
    "peers": ["peers"],
    "examples": ["examples", "bench"],
    "docs": ["docs"],
}

PYTHON = "3.10"  # the oldest
NEWER = {"examples": "3.11"}  # gtsam has no wheels for 3.10

# Environments of tests, each with its oldest Python; NAME.in holds what they need.
FOR_TESTS = {"openpi": "3.11", "ray": "3.11", "ros2-kilted": "3.11", "ros2-jazzy": "3.12"}

OPTIONS = (
    *("--quiet", "--universal", "--generate-hashes", "--upgrade"),
    *("--no-emit-index-url", "--no-emit-find-links", "--no-header", "--no-annotate"),
)

for name, extras in EXTRAS.items():
    chosen = [part for extra in extras for part in ("--extra", extra)]
    out = ("--output-file", str(HERE / f"{name}.txt"), str(HERE.parent / "pyproject.toml"))
    python = ("--python-version", NEWER.get(name, PYTHON))
    subprocess.run(["uv", "pip", "compile", *OPTIONS, *python, *chosen, *out], check=True)
for name, python in FOR_TESTS.items():
    files = ("--output-file", str(HERE / f"{name}.txt"), str(HERE / f"{name}.in"))
    subprocess.run(["uv", "pip", "compile", *OPTIONS, "--python-version", python, *files], check=True)
