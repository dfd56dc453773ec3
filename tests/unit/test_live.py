"""The page `/live`: what a viewer gets, its files, and how a run's folder is followed. No socket."""

import json
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest

from offboard.cloud_server.metrics import RobotUses
from offboard.common.errors import MissingExtra
from offboard.common.live.live_files import PATHS, page_file
from offboard.common.live.look import KEPT_MAX, TASKS_MAX, VIEWERS_MAX, Look, RobotLive, Viewers, encode
from offboard.loadgen.play.run_files import EVENTS, SUMMARY
from offboard.loadgen.play.watch import GrowingFile, RunLive


def decoded(look: Look) -> Any:
    raw = encode(look)
    assert raw.startswith(b"data: ")
    assert raw.endswith(b"\n\n")
    return json.loads(raw[len(b"data: ") :])


def task_at(live: RobotLive[dict[str, Any]], i: int, at: datetime) -> None:
    """A task that starts then, as the metrics of a robot note it."""
    if at >= live.due_at:
        live.keep({"i": i, "kind": "no such kind"}, at)


def records(live: RobotLive[dict[str, Any]], *numbers: int) -> None:
    """Tasks of a robot that somebody looks at."""
    next(live.looks())
    for i in numbers:
        task_at(live, i, datetime.now(timezone.utc))


def test_a_look_is_json_without_infinity() -> None:
    """Browsers refuse Infinity, so an endless budget is null; everything else stays."""
    look = Look("robot", 1.5, [{"i": 1}], budget={"duplicates": 2.0, "bytes_left": float("inf")})
    assert decoded(look)["budget"] == {"duplicates": 2.0, "bytes_left": None}
    assert decoded(look)["tasks"] == [{"i": 1}]


def test_a_viewer_gets_each_record_once() -> None:
    """The first look has all records that are kept, each further look those that came since."""
    live = RobotLive[dict[str, Any]](dict)
    records(live, 0, 1, 2)
    looks = live.looks()
    assert [task["i"] for task in next(looks).tasks] == [0, 1, 2]
    assert list(next(looks).tasks) == []
    records(live, 3)
    assert [task["i"] for task in next(looks).tasks] == [3]
    assert [task["i"] for task in next(live.looks()).tasks] == [0, 1, 2, 3]


def test_a_robot_keeps_a_limited_number_of_records() -> None:
    """Beyond KEPT_MAX the oldest ones go; a slow viewer, whose last record is gone, goes on all the same."""
    live = RobotLive[dict[str, Any]](dict)
    records(live, *range(2 * KEPT_MAX))
    looks = live.looks()
    assert [task["i"] for task in next(looks).tasks] == list(range(KEPT_MAX, 2 * KEPT_MAX))
    records(live, *range(2 * KEPT_MAX))
    assert len(next(looks).tasks) == TASKS_MAX


def test_a_busy_robot_sends_few_tasks() -> None:
    """After the first look, a look has the newest TASKS_MAX tasks and tells how many are left out."""
    live = RobotLive[dict[str, Any]](dict)
    records(live, 0)
    looks = live.looks()
    next(looks)
    records(live, *range(1, TASKS_MAX + 4))
    look = next(looks)
    assert [task["i"] for task in look.tasks] == list(range(4, TASKS_MAX + 4))
    assert look.left_out == 3


def test_records_are_read_only_for_viewers() -> None:
    """While nobody looks, no line is made of any record."""
    made: list[int] = []

    def line(record: dict[str, Any]) -> dict[str, Any]:
        made.append(record["i"])
        return record

    live = RobotLive[dict[str, Any]](line)
    records(live, *range(10))
    assert made == []
    next(live.looks())
    assert made == list(range(10))


def test_while_nobody_looks_few_records_are_kept() -> None:
    """Then it is one a second, so that tasks cost as much as without a page; a viewer gets all again."""
    live = RobotLive[dict[str, Any]](dict)
    now, step = datetime.now(timezone.utc), timedelta(seconds=0.1)
    for i in range(30):
        task_at(live, i, now + (i - 30) * step)
    looks = live.looks()
    assert [task["i"] for task in next(looks).tasks] == [0, 10, 20]
    for i in range(30, 35):
        task_at(live, i, now + (i - 30) * step)
    assert [task["i"] for task in next(looks).tasks] == [30, 31, 32, 33, 34]


def test_robots_are_counted_until_nobody_looks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each use counts while a look is recent; the first use after that forgets all of them."""
    uses = RobotUses()
    assert not uses.counting
    uses.look()
    for _ in range(2):
        assert uses.counting
        uses.of(b"robot").tasks += 1
    assert uses.counted()[b"robot"]["tasks"] == 2
    monkeypatch.setattr("offboard.cloud_server.metrics.COUNTED_S", -1.0)
    uses.look()
    uses.of(b"robot").tasks += 1
    assert uses.counted() == {}
    assert not uses.counting


def test_viewers_are_limited() -> None:
    """VIEWERS_MAX viewers fill a port; one that leaves makes room, and its looks are closed."""
    viewers = Viewers()
    live = RobotLive[dict[str, Any]](dict)
    opened = []
    for _ in range(VIEWERS_MAX):
        assert not viewers.full
        looks = live.looks()
        opened.append((viewers.one(looks), looks))
        opened[-1][0].__enter__()
    assert viewers.full
    context, looks = opened.pop()
    context.__exit__(None, None, None)
    assert not viewers.full
    assert next(looks, None) is None
    for context, _ in opened:
        context.__exit__(None, None, None)


@pytest.mark.parametrize("path", PATHS)
def test_every_file_of_the_pages_is_there(path: str) -> None:
    """Each path leads to a file in our package, or in that of plotly."""
    file = page_file(path)
    assert file.path.stat().st_size > 0
    assert file.content_type.partition(";")[0] in ("text/html", "text/css", "text/javascript")


def test_without_plotly_the_page_names_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    """One line says what to install; /docs needs no extra."""
    monkeypatch.setattr("offboard.common.live.live_files.find_spec", lambda _: None)
    with pytest.raises(MissingExtra, match=r"the page /live needs the extra 'live': run pip install"):
        page_file("/live")
    assert page_file("/docs").path.exists()


def test_a_growing_file_is_read_once(tmp_path: Path) -> None:
    """Whole lines are returned once; half a line waits for its end; a new shorter file starts again."""
    path = tmp_path / "trace.jsonl"
    file = GrowingFile(path)
    assert file.new_lines() == []
    path.write_bytes(b'{"i": 0}\n{"i": 1}\n{"i"')
    assert file.new_lines() == [{"i": 0}, {"i": 1}]
    with path.open("ab") as more:
        more.write(b': 2}\nbad line\n{"i": 3}\n')
    assert file.new_lines() == [{"i": 2}, {"i": 3}]
    path.write_bytes(b'{"i": 9}\n')
    assert file.new_lines() == [{"i": 9}]


def test_the_page_of_a_run_follows_its_folder(tmp_path: Path) -> None:
    """Tasks come as they are written, events with their time, several robots by name, and the end is told."""
    looks = RunLive(tmp_path).looks()
    assert list(next(looks).tasks) == []
    line = {"i": 0, "started_at": "2026-01-01T00:00:10+00:00"}
    (tmp_path / "trace.jsonl").write_text(json.dumps(line) + "\n")
    (tmp_path / "trace.alone.jsonl").write_text(json.dumps(line) + "\n")
    events = [{"link": {"outage": True}, "happened_s": 2.5}, {"kill": "cloud", "happened_s": None}]
    (tmp_path / EVENTS).write_text("".join(json.dumps(event) + "\n" for event in events))
    look = next(looks)
    assert list(look.tasks) == [line]
    assert [event["at_s"] for event in look.events] == [1_767_225_612.5]
    (tmp_path / "trace-2.jsonl").write_text(json.dumps(line) + "\n")
    assert [task["robot"] for task in next(looks).tasks] == ["robot-2"]
    assert not next(looks).over
    (tmp_path / SUMMARY).write_text("{}")
    assert next(looks).over
