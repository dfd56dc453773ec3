"""The contract of executors, on the two nodes of a real Ray cluster."""

import numpy as np
import pytest

from offboard.cloud_server.executors import Executor
from tests.executor_tasks import WAIT_S, call, run, value
from tests.integration.executors.test_executors import (
    test_a_failing_unpack_is_a_fault_of_the_server,
    test_a_kind_that_packs_gets_its_arguments_unpacked,
    test_a_malformed_body_is_a_fault_of_the_server,
    test_a_raising_run_is_repeated_one_by_one,
    test_a_task_runs_and_its_result_comes_back,
    test_an_unwanted_task_stops_early,
    test_calls_that_run_together_have_their_own_outcomes,
    test_done_is_called_once_for_every_task,
    test_the_outcome_has_the_cpu_time,
    test_used_cpu_time_includes_the_workers,
    test_warm_workers_run_tasks_in_parallel,
    test_what_a_task_raises_is_its_outcome,
)

pytestmark = [pytest.mark.integration, pytest.mark.timeout(120)]

__all__ = [
    "test_a_failing_unpack_is_a_fault_of_the_server",
    "test_a_kind_that_packs_gets_its_arguments_unpacked",
    "test_a_malformed_body_is_a_fault_of_the_server",
    "test_a_raising_run_is_repeated_one_by_one",
    "test_a_task_runs_and_its_result_comes_back",
    "test_an_unwanted_task_stops_early",
    "test_calls_that_run_together_have_their_own_outcomes",
    "test_done_is_called_once_for_every_task",
    "test_the_outcome_has_the_cpu_time",
    "test_used_cpu_time_includes_the_workers",
    "test_warm_workers_run_tasks_in_parallel",
    "test_what_a_task_raises_is_its_outcome",
]


def test_a_worker_gets_a_blob_once(executor: Executor) -> None:
    """It is the same array each time, also after another worker had it, until blobs exceed their limit."""
    same = call("exec_where", np.ones(50_000))
    pairs = [value(executor.submit(same, lambda _: None).result(WAIT_S))[::2] for _ in range(6)]
    assert len({identity for _, identity in pairs}) == len({pid for pid, _ in pairs})
    for number in range(3):
        assert value(run(executor, "exec_sum", np.full(100_000, number, float))) == 100_000 * number


def test_a_task_does_not_run_in_the_calling_thread(executor: Executor) -> None:
    """`run` returns None and does not run `meanwhile`."""
    done = list[int]()
    assert executor.run(call("exec_exit"), meanwhile=lambda: done.append(1)) is None
    assert done == []


def test_the_outcome_has_the_load_of_its_node(executor: Executor) -> None:
    """Load and capacity are shares of the CPU of the computer that ran the task."""
    load, capacity = run(executor, "exec_echo", 1).load or (-1.0, -1.0)
    assert 0 <= load <= 1
    assert 0 < capacity <= 1
    assert executor.load() is not None


def test_places_name_the_computers_of_the_workers(executor: Executor) -> None:
    """Both workers are up, on this computer."""
    assert sum(executor.places().values()) == executor.up == 2
