"""The contract of executors, which run the tasks of a server."""

from collections.abc import Callable
from concurrent.futures import Future
from typing import Protocol

from offboard.cloud_server.executors.task_run import Call, Outcome

THIS_COMPUTER = "localhost"  # the place of workers that are threads or processes of the server


class Executor(Protocol):
    """Runs tasks. Any thread may call `submit`, `run` and `used_s`; only the owner calls the rest."""

    name: str
    workers: int

    @property
    def up(self) -> int:
        """The workers that run a task or can take one. The others are being started again."""

    def places(self) -> dict[str, int]:
        """How many workers are up on which computer."""

    def load(self) -> tuple[float, float] | None:
        """Load and capacity of the computers of the workers, on average; None if that is this computer."""

    def warm(self, changed: Callable[[str], None] = lambda _: None) -> "Future[None]":
        """Start all workers, and run `setup` and `warm` of each kind in them. Called once; does not wait.

        From then on `changed` is called, in any thread, with one word for the reason when a worker dies, and
        with an empty text when a worker is up again.
        """

    def submit(self, call: Call, done: "Callable[[Future[Outcome]], None]") -> "Future[Outcome]":
        """Run a task now. Only called while fewer than `up` tasks run; the future never holds an exception.

        A task may end early if it notices that it is not wanted. A worker process is killed if its task runs
        much longer than its budget. `done` is called with the future: in the thread of the worker, or in this
        thread if no worker can take the task.
        """

    def run(self, call: Call, *, meanwhile: Callable[[], None] | None) -> Outcome | None:
        """Run a task in this thread while another thread runs `meanwhile`, if that is not None.

        Returns None, and runs nothing, if this executor does not run tasks in the calling thread.
        """

    def used_s(self) -> float:
        """CPU seconds used so far by this process and its workers, including those that died."""

    def close(self) -> None:
        """Abandon what runs, end the workers. Safe to call twice."""
