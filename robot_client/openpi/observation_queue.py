"""The observations that have no answer yet: which one is under way, and which ones wait for their turn.

Pure: times come in as arguments. Sending and receiving is left to `policy_server`.
"""

from collections import deque

from offboard.common.errors import CloudError
from offboard.robot_client.openpi.observation import Observation
from offboard.robot_client.sites.runner import Execution

QUEUE_MAX = 16  # observations without an answer; more are refused


class ObservationQueue:
    """One observation is under way at a time. If it is given up, its answer is still due.

    `add`, `full` and `owed_since_s` are for any thread, everything else for one thread only.
    """

    def __init__(self) -> None:
        self._unanswered: dict[int, Observation] = {}  # by task
        self._waiting: deque[Observation] = deque()
        self._under_way: Observation | None = None

    @property
    def full(self) -> bool:
        return len(self._unanswered) >= QUEUE_MAX

    @property
    def idle(self) -> bool:
        """Whether no answer is due."""
        return self._under_way is None

    @property
    def waits(self) -> bool:
        """Whether an observation waits for its turn."""
        return bool(self._waiting)

    @property
    def owed_since_s(self) -> float | None:
        """Since when an answer is due that nobody waits for; None: there is no such answer."""
        under_way = self._under_way
        return None if under_way is None else under_way.given_up_s

    def add(self, observation: Observation) -> None:
        self._unanswered[observation.task.id] = observation

    def find(self, task_id: int) -> Observation | None:
        """The observation of this task, if it has no answer yet."""
        return self._unanswered.get(task_id)

    def line_up(self, observation: Observation) -> None:
        """Let an observation that was added wait for its turn."""
        self._waiting.append(observation)

    def send_next(self, now_s: float) -> Observation | None:
        """The observation whose turn it is; it counts as sent now."""
        if self._under_way is not None or not self._waiting:
            return None
        self._under_way = self._waiting.popleft()
        self._under_way.sent_s = now_s
        return self._under_way

    def take_answered(self) -> Observation | None:
        """The observation that a message answers; None: it answers none."""
        observation, self._under_way = self._under_way, None
        return observation

    def end(self, observation: Observation, execution: Execution) -> None:
        """Give an observation its execution."""
        if observation.timer is not None:
            observation.timer.cancel()
        del self._unanswered[observation.task.id]
        observation.future.set_result(execution)

    def give_up(
        self, observation: Observation, failure: CloudError, now_s: float, *, censored: bool = False
    ) -> None:
        """End an observation without its answer."""
        if observation in self._waiting:
            self._waiting.remove(observation)
        self.end(observation, observation.gave_up(failure, now_s, censored=censored))

    def give_up_all(self, failure: CloudError, now_s: float) -> None:
        """The connection has ended."""
        for observation in list(self._unanswered.values()):
            self.give_up(observation, failure, now_s)
        self._under_way = None
