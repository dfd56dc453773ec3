"""Resuming a comparison: which finished runs are used, and which runs are played again."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from offboard.loadgen.compare.runs import played_before
from offboard.loadgen.play.play_scenario import judge, write_summary
from offboard.loadgen.play.run_digest import digests, of_scenario, of_software
from offboard.loadgen.play.run_files import SUMMARY
from offboard.loadgen.robot.answers import of_value
from offboard.loadgen.scenario.hash_tasks import hash_rounds
from offboard.loadgen.scenario.pass_fail_check import Check
from offboard.loadgen.scenario.scenario import RobotPart, Scenario, Workload
from offboard.loadgen.scenario.scenario_file import find_scenario, read_scenario

TASKS = 3
SCENARIO = Scenario(
    "small",
    1,
    Workload(
        task="offboard.loadgen.scenario.hash_tasks:hash_rounds",
        sizes=("constant:5",),
        tasks=TASKS,
        obstacles=0,
    ),
)


def answer(i: int) -> str:
    fields = {"v": 1, "i": i, "id": f"a-{i}", "due_s": i, "began_s": i, "ended_s": i + 0.5, "error": None}
    return json.dumps({**fields, "answer": of_value(hash_rounds(5), ())}) + "\n"


@pytest.fixture
def finished(tmp_path: Path) -> Path:
    """The folder of a finished run, written by the code that writes one."""
    (tmp_path / "answers.jsonl").write_text("".join(map(answer, range(TASKS))))
    about = {"testbed": "local", **digests(SCENARIO)}
    played = replace(judge(SCENARIO, tmp_path, {"robot": 0}), stolen_percent=12.0)
    write_summary(tmp_path, played, about)
    return tmp_path


def used(scenario: Scenario, out: Path, testbed: str = "local") -> tuple[bool, list[str]]:
    said: list[str] = []
    return played_before(scenario, out, testbed, say=said.append) is not None, said


def test_a_finished_run_is_used_and_judged_from_its_files(finished: Path) -> None:
    """All its tasks are read and verified, and a line says where they come from."""
    said: list[str] = []
    played = played_before(SCENARIO, finished, "local", say=said.append)
    assert played is not None
    assert [one.response_s for one in played.outcome.answered] == [0.5] * TASKS
    assert [one.wrong for one in played.outcome.answered] == [None] * TASKS
    assert said == [f"using the finished run in {finished}"]


def test_a_run_that_the_host_disturbed_is_played_again(finished: Path) -> None:
    """If the host took 12 % of the CPU time, the run is used with a limit of 12 %, but not with 11 %."""
    said: list[str] = []
    played = played_before(SCENARIO, finished, "local", say=said.append, stolen_max=12.0)
    assert played is not None
    assert played.stolen_percent == 12.0
    assert played_before(SCENARIO, finished, "local", say=said.append, stolen_max=11.0) is None
    again, why = (
        f"playing the run in {finished} again",
        "the host took 12 % of the CPU time that the run asked for",
    )
    assert said[1] == f"{again}: {why}"


@pytest.mark.parametrize(
    ("scenario", "testbed"),
    [
        (replace(SCENARIO, seed=2), "local"),
        (SCENARIO.changed(tasks=TASKS - 1), "local"),
        (SCENARIO.changed(policy="cloud"), "local"),
        (SCENARIO.changed(predictor="least-squares"), "local"),
        (SCENARIO.changed(reference=1), "local"),
        (replace(SCENARIO, robot=RobotPart(cpus=0.3)), "local"),
        (replace(SCENARIO, link={"delay_ms": 16}), "local"),
        (SCENARIO, "docker"),
    ],
)
def test_a_different_run_is_played_again(finished: Path, scenario: Scenario, testbed: str) -> None:
    """Another seed, workload, policy, predictor, part, link or testbed is another run; a line says why."""
    found, said = used(scenario, finished, testbed)
    assert not found
    why = "another testbed" if testbed == "docker" else "scenario or settings were different"
    assert why in said[0]


def _stop(out: Path) -> None:
    (out / SUMMARY).unlink()


def _tear(out: Path) -> None:
    (out / SUMMARY).write_text((out / SUMMARY).read_text()[:-20])


def _lose_answers(out: Path) -> None:
    (out / "answers.jsonl").write_text(answer(0))


def _change(**fields: object) -> Callable[[Path], None]:
    def change(out: Path) -> None:
        (out / SUMMARY).write_text(json.dumps(json.loads((out / SUMMARY).read_text()) | fields))

    return change


@pytest.mark.parametrize(
    ("spoil", "why"),
    [
        (_stop, "it was not played to its end"),
        (_tear, "summary.json cannot be read"),
        (_lose_answers, "lost is 2 in its files, but 0 in summary.json"),
        (_change(software_sha256="0" * 64), "its software was different"),
        (_change(exit_codes={"robot": 1}), "robot ended with exit code 1"),
    ],
)
def test_an_incomplete_run_is_played_again(finished: Path, spoil: Callable[[Path], None], why: str) -> None:
    """A stopped, damaged or failed run, or a run of other software, is played again; a line says why."""
    spoil(finished)
    found, said = used(SCENARIO, finished)
    assert not found
    assert why in said[0]


def test_a_new_run_is_played_without_a_message(tmp_path: Path) -> None:
    """If the folder does not exist, the run is simply played."""
    assert used(SCENARIO, tmp_path / "new") == (False, [])


def test_texts_and_checks_do_not_make_a_run_different() -> None:
    """A changed text or check does not change what was played."""
    same = replace(SCENARIO, about="Other words.", checks=(Check(figure="lost", at_most=0),))
    assert of_scenario(same) == of_scenario(SCENARIO)


def test_files_count_by_their_content(tmp_path: Path) -> None:
    """A moved map is the same run, a map with a changed cell is not; the same holds for files of delays."""
    outage = read_scenario(find_scenario("outage"))
    place = outage.workload.map
    assert place is not None
    for name in ("depot.yaml", "depot.pgm"):
        (tmp_path / name).write_bytes(place.with_name(name).read_bytes())
    moved = replace(outage, workload=replace(outage.workload, map=tmp_path / "depot.yaml"))
    assert of_scenario(moved) == of_scenario(outage)
    image = bytearray((tmp_path / "depot.pgm").read_bytes())
    image[-1] ^= 0xFF
    (tmp_path / "depot.pgm").write_bytes(image)
    assert of_scenario(moved) != of_scenario(outage)
    delays = tmp_path / "delays.txt"
    delays.write_text("1\n2\n")
    sampled = replace(SCENARIO, link={"samples": delays})
    before = of_scenario(sampled)
    delays.write_text("1\n3\n")
    assert of_scenario(sampled) != before


def test_the_software_includes_the_module_of_the_task() -> None:
    """The module of the scenario's task counts; a missing module is left to the parts, which refuse it."""
    planner = read_scenario(find_scenario("outage"))
    assert of_software(planner) != of_software(SCENARIO)
    absent = replace(SCENARIO, workload=Workload(task="no_such_module:task", sizes=("constant:1",)))
    assert of_software(absent) == of_software(planner)


def test_without_references_the_checks_that_need_them_are_removed() -> None:
    """--reference 0 removes the checks that need reference runs, and keeps the others."""
    outage, calm = (read_scenario(find_scenario(name)) for name in ("outage", "calm"))
    assert any(one.figure == "time_over_oracle" for one in calm.checks)
    quick = calm.changed(reference=0)
    assert quick.workload.reference == 0
    assert not any(one.figure == "time_over_oracle" for one in quick.checks)
    assert outage.changed(reference=0).checks == outage.checks
