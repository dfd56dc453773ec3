"""Keeps one Ray actor alive: gives it tasks, notices its death, and starts the next one.

`ray_executor` decides which worker gets a task; `ray_actor` is what runs in the actor.

    RayWorker  --- run(number, kind, frames, new blobs) -->  RayActor, on any node
               <-- Ran -----------------------------------
               --- stop(number), look() -- next to a task ->
"""

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from functools import partial
from typing import Any

from offboard.cloud_server.executors import ray_cluster
from offboard.cloud_server.executors.executor import Outcome
from offboard.cloud_server.executors.ray_actor import NOTHING, ActorSetup, Measured, Ran, Started
from offboard.cloud_server.executors.ray_cluster import RayCluster
from offboard.cloud_server.executors.worker import FAILED_PAUSE_S, OVERTIME_S
from offboard.cloud_server.executors.worker_set import Assignment, Died
from offboard.common import VERSION, tasks
from offboard.common.errors import ConfigError, TaskFailed, describe

LOOK_EVERY_S = 1.0  # between two looks at the load of an actor and at whether it lives
SILENT_S_MAX = 10.0  # until an idle actor that does not answer counts as dead


class RayWorker:
    """A place for one actor. Any thread may call `give`, only the thread of the executor the rest.

    `post` runs a function in that thread. `free` is called whenever the actor can take a task, and `died`
    when an actor is dead.
    """

    def __init__(
        self,
        cluster: RayCluster,
        setup: ActorSetup,
        *,
        post: Callable[[Callable[[], None]], None],
        free: Callable[["RayWorker"], None],
        died: Callable[["RayWorker", Died], None],
    ) -> None:
        self.host = ""
        self.pid = 0
        self.load = (0.0, 1.0)
        self.known: set[bytes] = set()  # the blobs that the actor has
        self._cluster = cluster
        self._setup = setup
        self._post = post
        self._free = free
        self._died = died
        self._actor: Any = None
        self._number = 0
        self._stopped = NOTHING  # the last run that was asked to stop
        self._assignment: Assignment | None = None
        self._began_s = 0.0
        self._begin_at_s = 0.0
        self._looked_at_s = self._answered_at_s = 0.0
        self._used_s = self._used_before_s = 0.0

    @property
    def running(self) -> bool:
        return self._assignment is not None

    @property
    def used_s(self) -> float:
        """CPU seconds of this actor and of those before it."""
        return self._used_before_s + self._used_s

    def give(
        self, assignment: Assignment, references: Mapping[bytes, Any], kept: Callable[[bytes], bool]
    ) -> None:
        """Run this call, whose blobs have these references. Called once after `free`, not after `died`.

        `kept`: whether a blob is kept. The actor forgets the others in the same call, so that none that it
        needs is forgotten too late.
        """
        self._number += 1
        self._began_s, self._assignment = time.monotonic(), assignment
        task = assignment.call
        dropped = [digest for digest in self.known if not kept(digest)]
        self.known.difference_update(dropped)
        new = [digest for digest in references if digest not in self.known]
        self.known.update(new)
        blobs = [references[digest] for digest in new]
        named: dict[str, Any] = {"digests": list(task.blobs), "new": new, "dropped": dropped}
        if task.more:
            named["more"] = [([*map(bytes, one.frames)], list(one.blobs), one.budget_s) for one in task.more]
        frames = [bytes(frame) for frame in task.frames]
        self._call("run", self._ran, *blobs, number=self._number, kind=task.kind, frames=frames, **named)

    def tend(self, siblings: Sequence[int]) -> None:
        """Do what is due: start an actor, end a run that is not wanted or too long, look at the actor.

        `siblings`: the processes of the other workers on the same computer.
        """
        now_s = time.monotonic()
        if self._actor is None:
            if now_s >= self._begin_at_s:
                self._begin()
            return
        assignment = self._assignment
        if assignment is not None:
            self._check(assignment, now_s - self._began_s)
        if self._actor is None or not self.pid or now_s - self._looked_at_s < LOOK_EVERY_S:
            return
        if assignment is None and self._looked_at_s > self._answered_at_s + SILENT_S_MAX:
            self.lose("silent", f"did not answer for {SILENT_S_MAX:g} s")
            return
        self._looked_at_s = now_s
        self._call("look", self._measured, list(siblings), control=True)

    def lose(self, reason: str, text: str, failure: TaskFailed | ConfigError | None = None) -> None:
        """This actor is dead, or has to die; another one takes its place."""
        if self._actor is None:
            return
        died = Died(reason, text, server_fault=True, failure=failure)
        self._died(self, died)  # from now on nobody calls `give`
        self._begin_at_s = time.monotonic() + (0.0 if self.pid else FAILED_PAUSE_S)
        self.end()
        self.host, self.pid, self.known = "", 0, set()
        self._used_before_s, self._used_s = self.used_s, 0.0
        self._answer(died)

    def end(self) -> None:
        """Kill the actor. Its run gets no answer."""
        actor, self._actor = self._actor, None
        if actor is not None:
            ray_cluster.end(actor)

    def abandon(self) -> None:
        """Answer the run, if there is one: the executor closes."""
        self._answer(Died("closed", "was ended with the server", server_fault=True))

    def _begin(self) -> None:
        try:
            self._actor = self._cluster.new_actor()
        except Exception as error:  # noqa: BLE001 - of Ray, for example because its head is lost
            self._begin_at_s = time.monotonic() + FAILED_PAUSE_S
            self._died(self, Died("start", f"did not start: {describe(error)}", server_fault=True))
            return
        self._call("start", self._started, self._setup)

    def _call(
        self, method: str, then: Callable[[Any], None], *args: Any, control: bool = False, **named: Any
    ) -> None:
        """Call the actor; `then` gets the answer in the thread of the executor, if there is one.

        If Ray refuses the call, the actor counts as dead.
        """
        actor = self._actor

        def answered(future: "Future[Any]") -> None:
            self._post(partial(self._take, actor, then, future))

        try:
            ray_cluster.call(getattr(actor, method), *args, then=answered, control=control, **named)
        except Exception as error:  # noqa: BLE001 - of Ray: a task must be answered all the same
            refused: Future[Any] = Future()
            refused.set_exception(error)
            answered(refused)

    def _take(self, actor: Any, then: Callable[[Any], None], future: "Future[Any]") -> None:
        if actor is not self._actor:
            return
        error = future.exception()
        if error is None:
            then(future.result())
        else:
            reason, text = ray_cluster.why(error)
            known = ConfigError(f"the Ray nodes do not have this Offboard: a worker {text}")
            self.lose(reason, text, known if reason == "start" else None)

    def _started(self, said: Started) -> None:
        failure: TaskFailed | ConfigError | None = None
        if said.error and said.of_task:
            failure = TaskFailed(said.error, said.traceback)
        elif said.error:
            failure = ConfigError(f"a Ray node cannot load the tasks: {said.error}")
        elif said.version != VERSION:
            versions = f"{said.host} runs Offboard {said.version}, this server {VERSION}"
            failure = ConfigError(f"the Ray node {versions}; install the same version on all nodes")
        elif differing := [name for name, one in said.hashes if tasks.hashes().get(name) != one]:
            others = f"{said.host} has another source of the task {differing[0]}"
            failure = ConfigError(f"the Ray node {others}; install the same version of it on all nodes")
        if failure is not None:
            self.lose("start", f"did not start: {failure}", failure)
            return
        self.host, self.pid = said.host, said.pid
        self._looked_at_s, self._answered_at_s = 0.0, time.monotonic()
        self._free(self)

    def _ran(self, ran: Ran) -> None:
        assignment, self._assignment = self._assignment, None
        assert assignment is not None
        self._heard(ran.used_s, ran.outcome.load)
        if ran.full:
            self.lose("memory", "kept too much memory")
        else:
            self._free(self)  # before the answer, whose callback may bring the next task
        assignment.answer.set_result(ran.outcome)

    def _measured(self, measured: Measured) -> None:
        self._heard(measured.used_s, (measured.load, measured.capacity))

    def _heard(self, used_s: float, load: tuple[float, float] | None) -> None:
        self._answered_at_s, self._used_s = time.monotonic(), max(used_s, self._used_s)
        self.load = load or self.load

    def _check(self, assignment: Assignment, ran_s: float) -> None:
        over_s = ran_s - assignment.call.budget_s
        if over_s > OVERTIME_S:
            self.lose("budget", f"was killed {OVERTIME_S:g} s after the budget was over")
        elif self._stopped != self._number and (over_s > 0 or not assignment.call.wanted()):
            self._stopped = self._number
            self._call("stop", lambda _: None, self._number, control=True)

    def _answer(self, died: Died) -> None:
        assignment, self._assignment = self._assignment, None
        if assignment is not None:
            error, run_s = f"the worker {died} while this task ran", time.monotonic() - self._began_s
            assignment.answer.set_result(Outcome("failed", error, run_s, server_fault=True, crashed=True))
