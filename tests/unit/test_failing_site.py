"""A site that always fails: callers get the answers of the other site, and soon no longer wait for it."""

import threading
import time
from collections.abc import Callable, Iterator

import pytest

from offboard import Offloader, Settings
from offboard.common.errors import CloudError, CloudTimeout, TaskFailed
from offboard.common.tasks import Task, task
from offboard.robot_client.policies.probe import PROBE_EVERY
from offboard.robot_client.predictors.base import WARM_UP
from offboard.robot_client.records.record import Record
from offboard.robot_client.sites.onboard import OnboardRunner
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Execution
from tests.fakes import ScriptedRunner

PATIENCE_S = 30.0


class Bench:
    """Which sites fail, and what happened."""

    def __init__(self) -> None:
        self.cloud_fails = self.setup_fails = False
        self.setups = 0
        self.setup_s = 0.0
        self.setup_began = threading.Event()
        self.records: list[Record] = []

    def sites(self) -> list[tuple[str, ...]]:
        return [tuple(one.site for one in record.executions) for record in self.records]


bench = Bench()


def make_model() -> int:
    bench.setups += 1
    bench.setup_began.set()
    time.sleep(bench.setup_s)
    if bench.setup_fails:
        raise OSError("no model")
    return 1


@task("with_model", size=float, setup=make_model)
def with_model(model: int, number: int) -> int:
    return number + model


def answer(one: Task) -> Execution:
    if bench.cloud_fails:
        return Execution(CLOUD, 2.0, failure=CloudTimeout("late"), censored=True)
    return Execution(CLOUD, 0.001, one.args[0] + 1, run_s=0.001, queue_s=0.0, network_s=0.0)


@pytest.fixture
def make() -> Iterator[Callable[[str], Offloader]]:
    bench.__init__()  # type: ignore[misc]
    made: list[Offloader] = []

    def factory(policy: str) -> Offloader:
        settings = Settings()
        made.append(
            Offloader(
                [ScriptedRunner(CLOUD, answer), OnboardRunner()],
                policy=settings.make_policy(policy),
                memories=settings.make_memories(policy),
                observers=[bench.records.append],
            )
        )
        return made[-1]

    yield factory
    for one in made:
        one.close()
    bench.__init__()  # type: ignore[misc]  # servers of later tests run the setups of all kinds


def test_the_warm_up_ends_although_the_cloud_always_fails(make: Callable[[str], Offloader]) -> None:
    """After WARM_UP failures in a row, only probes run there; once it answers, it is used."""
    bench.cloud_fails = True
    offload = make("default")
    for number in range(60):
        assert offload(with_model, number) == number + 1
    sites = bench.sites()
    assert sites[:WARM_UP] == [(CLOUD, ONBOARD)] * WARM_UP
    probed = [n for n, used in enumerate(sites) if n >= WARM_UP and CLOUD in used]
    assert [record.decision.both for record in bench.records[WARM_UP:]] == [False] * (60 - WARM_UP)
    assert 1 <= len(probed) <= (60 - WARM_UP) / PROBE_EVERY
    bench.cloud_fails = False
    for number in range(40):
        assert offload(with_model, number) == number + 1
    assert any(record.decision.both for record in bench.records[60:])
    assert any(record.used == CLOUD for record in bench.records[60:])


def test_a_batch_ends_although_the_cloud_always_fails(make: Callable[[str], Offloader]) -> None:
    """After WARM_UP failures in a row, no task of the batch is sent there."""
    bench.cloud_fails = True
    assert make("default").map(with_model, range(30)) == list(range(1, 31))
    assert sum(CLOUD in used for used in bench.sites()) <= WARM_UP + 1


def test_a_setup_that_fails_after_the_answer_counts(make: Callable[[str], Offloader]) -> None:
    """A site whose setup fails only after the other site has answered is left after WARM_UP runs as well."""
    bench.setup_fails = True
    bench.setup_s = 0.05
    offload = make("default")
    for number in range(WARM_UP):
        assert offload(with_model, number) == number + 1
        time.sleep(2 * bench.setup_s)
    for number in range(PROBE_EVERY // 2):
        assert offload(with_model, number) == number + 1
    assert sum(ONBOARD in used for used in bench.sites()) <= WARM_UP


@pytest.mark.parametrize("policy", ["default", "paper"])
def test_the_cloud_answers_if_the_setup_onboard_always_fails(
    make: Callable[[str], Offloader], policy: str
) -> None:
    """No caller gets the error of the setup, which runs once and not in every call."""
    bench.setup_fails = True
    offload = make(policy)
    for number in range(60):
        assert offload(with_model, number) == number + 1
    bench.setup_began.wait(PATIENCE_S)  # on a busy machine, 60 answers may come before onboard gets the CPU
    assert bench.setups == 1
    if policy == "default":
        assert sum(ONBOARD in used for used in bench.sites()) <= WARM_UP + (60 - WARM_UP) / PROBE_EVERY
    bench.cloud_fails = True
    with pytest.raises((TaskFailed, CloudError), match=r"OSError: no model|late"):
        offload(with_model, 1)
