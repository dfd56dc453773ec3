"""The rules of deploy/prometheus, checked and tested with promtool."""

import re
from typing import Any

import pytest

from tests.integration.prometheus.conftest import RULES

pytestmark = pytest.mark.integration


def test_the_rules_are_valid(promtool: Any) -> None:
    """promtool finds no mistake in both files of rules, nor in the configuration of compose."""
    done = promtool("check", "rules", *map(str, sorted(RULES.glob("*.rules.yml"))))
    assert done.returncode == 0, done.stdout + done.stderr
    done = promtool("check", "config", "--syntax-only", str(RULES / "prometheus.yml"))
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_rules_do_what_they_say(promtool: Any) -> None:
    """On made-up series, each rule has the expected value, and each alert fires when it should."""
    done = promtool("test", "rules", str(RULES / "rules_test.yml"))
    assert done.returncode == 0, done.stdout + done.stderr


def test_each_rule_has_a_test() -> None:
    """Each recorded figure is compared with a value, and each alert is expected to fire at least once."""
    rules = "".join(path.read_text() for path in RULES.glob("*.rules.yml"))
    tests = (RULES / "rules_test.yml").read_text()
    recorded, alerts = re.findall(r"record: (\S+)", rules), re.findall(r"alert: (\S+)", rules)
    assert set(recorded) - set(re.findall(r"- expr: round\(([\w:]+)", tests)) == set()
    assert set(alerts) - set(re.findall(r"alertname: (\w+)\n +exp_alerts:\n", tests)) == set()
