"""The live page inside a file: what does not fit is left out, and the page says how much."""

import pytest

from offboard.common.live.look import Look
from offboard.loadgen.report import html_page


@pytest.mark.parametrize("count", [1, 3])
def test_tasks_that_never_fit_are_all_left_out(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    """Also a single task that is too large does not keep the report from ending."""
    monkeypatch.setattr(html_page, "LOOK_MAX", 10)
    tasks = [{"i": i} for i in range(count)]
    empty = html_page._packed(html_page.as_json(Look("report", 0.0, [], left_out=count)))
    assert html_page._fitting(Look("report", 0.0, tasks)) == empty
