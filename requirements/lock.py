"""Pins the dependencies of each image and of development, with hashes, for Python 3.11 and up (needs uv)."""

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
}

FOR_TESTS = ("openpi",)  # environments of their own; NAME.in holds what they need

OPTIONS = (
    *("--quiet", "--universal", "--python-version", "3.11", "--generate-hashes", "--upgrade"),
    *("--no-emit-index-url", "--no-emit-find-links", "--no-header", "--no-annotate"),
)

for name, extras in EXTRAS.items():
    chosen = [part for extra in extras for part in ("--extra", extra)]
    out = ("--output-file", str(HERE / f"{name}.txt"), str(HERE.parent / "pyproject.toml"))
    subprocess.run(["uv", "pip", "compile", *OPTIONS, *chosen, *out], check=True)
for name in FOR_TESTS:
    files = ("--output-file", str(HERE / f"{name}.txt"), str(HERE / f"{name}.in"))
    subprocess.run(["uv", "pip", "compile", *OPTIONS, *files], check=True)
