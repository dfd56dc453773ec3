"""The images of the Docker testbed, built by Compose: docker-compose.yml is their one description."""

import subprocess
from pathlib import Path

from offboard.common.errors import ConfigError, OffloadError
from offboard.loadgen.testbed.testbed import CLOUD, ROBOT, WAN

FILE = Path("docker-compose.yml")
VERSION = ("docker", "compose", "version")
BUILD = ("docker", "compose", "--progress", "quiet", "-f", str(FILE), "build", CLOUD, WAN, ROBOT)
ASK_S = 30.0
BUILD_S = 1800.0


def check_compose() -> None:
    """ConfigError in one line where images cannot be built here."""
    if not FILE.is_file():
        raise ConfigError(f"--testbed: docker needs {FILE} of a checkout in the current folder")
    try:
        asked = subprocess.run(VERSION, capture_output=True, text=True, timeout=ASK_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise ConfigError(f"--testbed: docker cannot be asked: {error}") from error
    if asked.returncode != 0:
        said = (asked.stderr.strip() or "nothing").splitlines()[-1]
        raise ConfigError(f"--testbed: docker does not answer to `{' '.join(VERSION)}`: {said}")


def build_images() -> None:
    """Build what has changed."""
    try:
        code = subprocess.run(BUILD, timeout=BUILD_S, check=False).returncode
    except subprocess.TimeoutExpired as error:
        raise OffloadError(f"{' '.join(BUILD)}: not done after {BUILD_S:g} s") from error
    if code != 0:
        raise OffloadError(f"{' '.join(BUILD)}: exit code {code}")
