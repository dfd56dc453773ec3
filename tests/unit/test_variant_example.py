"""The variants of docs/own_task.md and of `examples/variants.py`: they run, and their quality is measured."""

import importlib
import itertools
import re
from pathlib import Path

import numpy as np
import pytest

from offboard.common.task_states import TaskStates
from offboard.common.tasks import kind_of
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

PAGE = (Path(__file__).parents[2] / "docs" / "own_task.md").read_text(encoding="utf-8")
FRAMES = 8
TOLERANCE = 0.1

pytestmark = [
    pytest.mark.filterwarnings("default::DeprecationWarning", "default::SyntaxWarning"),  # of pupil_apriltags
]


def test_the_page_shows_a_task_that_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Onboard runs the rough function with the small model, and every server the decorated one."""
    found = re.search(r"```python\n# cups\.py\n(.*?)```", PAGE, re.DOTALL)
    assert found is not None
    (tmp_path / "cups.py").write_text(found[1])
    monkeypatch.syspath_prepend(tmp_path)
    kind, states = kind_of(importlib.import_module("cups").find_cups), TaskStates(workers=1)
    frame = np.full((4, 4), 250, np.uint8)
    assert states.call(kind.at(ONBOARD), (frame,)) == {"cups": 1, "weights": 64}
    assert states.call(kind.at(CLOUD), (frame,)) == {"cups": 16, "weights": 4096}
    assert kind.at(ONBOARD).quality == 0.8


def test_the_quality_of_the_example_is_measured() -> None:
    """It is the share of the tags of both resolutions that the variant of onboard finds."""
    pytest.importorskip("pupil_apriltags", reason="needs the extra 'apriltags'")
    variants = importlib.import_module("examples.variants")
    kind, states = kind_of(variants.find_tags), TaskStates(workers=1)
    found = {ONBOARD: 0, CLOUD: 0}
    for args in itertools.islice(variants.inputs(5), FRAMES):
        tags = {site: states.call(kind.at(site), args) for site in found}
        for site, those in tags.items():
            found[site] += len(those)
        for tag in tags[ONBOARD]:
            assert any(nearby(tag, other) for other in tags[CLOUD]), "no tag is made up"
    share = found[ONBOARD] / found[CLOUD]
    print(f"onboard finds {found[ONBOARD]} of {found[CLOUD]} tags: {share:.2f}")
    assert share == pytest.approx(kind.at(ONBOARD).quality, abs=TOLERANCE)
    assert kind.at(CLOUD).quality == 1.0


def nearby(tag: dict, other: dict) -> bool:
    return tag["id"] == other["id"] and np.allclose(tag["center"], other["center"], atol=4.0)
