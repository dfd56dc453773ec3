"""The images of the Docker testbed: builds them with Docker Compose, as docker-compose.yml describes them."""

import subprocess
from collections.abc import Iterable
from pathlib import Path

from offboard.common.errors import ConfigError, OffloadError
from offboard.loadgen.progress import progress

FILE = Path("docker-compose.yml")
VERSION = ("docker", "compose", "version")
BUILD = ("docker", "compose", "--progress", "quiet", "-f", str(FILE), "build")
ASK_S = 30.0
BUILD_S = 1800.0


def check_compose() -> None:
    """ConfigError if images cannot be built here."""
    if not FILE.is_file():
        raise ConfigError(f"--testbed: docker: {FILE} not found; run this in a checkout of Offboard")
    try:
        asked = subprocess.run(VERSION, capture_output=True, text=True, timeout=ASK_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise ConfigError(f"--testbed: docker cannot be run: {error}") from error
    if asked.returncode != 0:
        message = (asked.stderr.strip() or "no message").splitlines()[-1]
        raise ConfigError(f"--testbed: docker: `{' '.join(VERSION)}` failed: {message}")


def build_images(services: Iterable[str]) -> None:
    """Build the images of these Compose services; Docker skips what has not changed."""
    build = (*BUILD, *services)
    try:
        with progress("building images"):
            code = subprocess.run(build, timeout=BUILD_S, check=False).returncode
    except subprocess.TimeoutExpired as error:
        raise OffloadError(f"`{' '.join(build)}` has not ended after {BUILD_S:g} s") from error
    if code != 0:
        raise OffloadError(f"`{' '.join(build)}` failed with exit code {code}")
