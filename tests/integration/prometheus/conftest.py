"""Debian's promtool and Prometheus, and a Prometheus that runs our rules."""

import os
import re
import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.prometheus import Prometheus, until

ROOT = Path(__file__).parents[3]
RULES = ROOT / "deploy" / "prometheus"
UNPACKED = ROOT / ".cache" / "prometheus" / "usr" / "bin"  # by `make prometheus`
CONFIG = """
global: {{scrape_interval: 1s, evaluation_interval: 1s}}
rule_files: [{rules}/recording.rules.yml, {rules}/alert.rules.yml]
scrape_configs:
"""
JOB = "  - {{job_name: {name}, static_configs: [{{targets: ['{address}']}}]}}\n"


def find(program: str) -> str:
    """The path of a program of Prometheus; without it the test is skipped, and in CI it fails."""
    path = shutil.which(program) or shutil.which(UNPACKED / program)
    if path is None and os.environ.get("CI") == "true":
        pytest.fail(f"CI has no {program}; remedy: make prometheus")
    if path is None:
        pytest.skip(f"no {program}; remedy: make prometheus")
    return path


@pytest.fixture(scope="session")
def promtool() -> Callable[..., "subprocess.CompletedProcess[str]"]:
    """Runs promtool with arguments, and with text on its standard input."""
    path = find("promtool")

    def run(*args: str, text: str = "") -> "subprocess.CompletedProcess[str]":
        return subprocess.run([path, *args], input=text, capture_output=True, text=True, timeout=60)

    return run


@pytest.fixture
def prometheus(tmp_path: Path) -> Iterator[Callable[..., Prometheus]]:
    """Factory: a Prometheus with our rules that scrapes an address for each job, once a second."""
    path = find("prometheus")
    with ExitStack() as stack:

        def start(**jobs: str) -> Prometheus:
            config, log = tmp_path / "prometheus.yml", tmp_path / "prometheus.log"
            named = {name.replace("_", "-"): address for name, address in jobs.items()}
            lines = [JOB.format(name=name, address=address) for name, address in named.items()]
            config.write_text(CONFIG.format(rules=RULES) + "".join(lines))
            command = [path, f"--config.file={config}", f"--storage.tsdb.path={tmp_path}/data"]
            process = stack.enter_context(
                subprocess.Popen(
                    [*command, "--web.listen-address=127.0.0.1:0"],
                    stderr=stack.enter_context(log.open("w")),
                    stdout=subprocess.DEVNULL,
                )
            )
            stack.callback(process.kill)
            until(lambda: "Server is ready" in log.read_text() or process.poll() is not None, "Prometheus")
            found = re.search(r'"Listening on".* address=(127\.0\.0\.1:\d+)', log.read_text())
            assert found is not None, log.read_text()
            return Prometheus(found[1])

        yield start
