"""The conversation with a remote site, told of events without any socket: every request ends exactly once."""

from concurrent.futures import Future
from typing import Any

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from offboard.common.errors import CloudBroken, CloudBusy, CloudTimeout, Overtaken, ProtocolError
from offboard.common.tasks import Task, kind_of, task
from offboard.robot_client.sites.conversation import (
    IN_FLIGHT_MAX,
    IN_TURN_MAX,
    OWED_MAX_S,
    STORY_MAX,
    Cancel,
    Conversation,
    Finish,
    Instructions,
    PendingRequest,
    Ping,
    Reconnect,
    Send,
)
from offboard.robot_client.sites.heartbeat import Heartbeat, ServerReport
from offboard.robot_client.sites.runner import Execution


@task("conversed", size=len)
def conversed(text: str) -> str:
    return text


def request(published_s: float = 0.0, budget_s: float = 9.0) -> PendingRequest:
    return PendingRequest(
        site="gpu",
        task=Task(kind_of(conversed), ("",), 0),
        published_s=published_s,
        deadline_s=published_s + budget_s,
    )


def talking(*, in_turn: bool = False, heartbeat_s: float = 0.0) -> Conversation:
    """A conversation whose site is up."""
    one = Conversation(Heartbeat(heartbeat_s), in_turn=in_turn)
    one.up(0.0)
    return one


def sorts(instructions: Instructions) -> list[type]:
    return [type(one) for one in instructions]


class Talk(RuleBasedStateMachine):
    """Random events. The server answers only some of the requests."""

    def __init__(self) -> None:
        super().__init__()
        self.now_s = 0.0
        self.submitted: list[PendingRequest] = []
        self.finished: list[PendingRequest] = []
        self.server: list[PendingRequest] = []  # requests that it has, in order
        self.pings: list[int] = []
        self.in_turn = False

    @initialize(in_turn=st.booleans(), heartbeat_s=st.sampled_from([0.0, 0.5]))
    def begin(self, in_turn: bool, heartbeat_s: float) -> None:
        self.in_turn = in_turn
        self.conversation = Conversation(Heartbeat(heartbeat_s), in_turn=in_turn)

    def do(self, instructions: Instructions) -> None:
        for one in instructions:
            match one:
                case Send(sent):
                    assert self.conversation.connected
                    assert not sent.future.done(), "nobody waits for it"
                    self.server.append(sent)
                    assert not self.in_turn or len(self.server) == 1, "two at once"
                case Ping(number):
                    assert not (self.in_turn and self.server), "a heartbeat meets a busy server"
                    self.pings.append(number)
                case Cancel(unwanted):
                    self.server = [one for one in self.server if one is not unwanted]
                case Finish(ended, execution):
                    ended.future.set_result(execution)  # raises the second time
                    self.finished.append(ended)
                case Reconnect():
                    self.lose()

    @rule()
    def connect(self) -> None:
        if not (self.conversation.connected or self.conversation.closed):
            self.conversation.up(self.now_s)

    @rule()
    def lose(self) -> None:
        self.server, self.pings = [], []
        self.do(self.conversation.down("lost", self.now_s))

    @rule(budget_s=st.floats(0.0, 5.0))
    def submit(self, budget_s: float) -> None:
        one = request(self.now_s, budget_s)
        self.submitted.append(one)
        self.do(self.conversation.submit(one, self.now_s))

    @rule(seconds=st.floats(0.0, 3.0))
    def wait(self, seconds: float) -> None:
        self.now_s += seconds
        self.do(self.conversation.time(self.now_s))
        assert self.conversation.wakes_s > self.now_s, "it would be called again and again"

    @rule(which=st.integers(0, 20))
    def cancel(self, which: int) -> None:
        if self.submitted:
            one = self.submitted[which % len(self.submitted)]
            self.do(self.conversation.cancel(one.task.id, self.now_s))
            assert one.future.done()

    @rule()
    def hurry(self) -> None:
        self.conversation.hurry(self.now_s)

    @precondition(lambda self: self.pings)
    @rule()
    def pong(self) -> None:
        self.conversation.pong(self.pings.pop(0), self.now_s, ServerReport())

    @precondition(lambda self: self.server)
    @rule()
    def answer(self) -> None:
        one = self.server.pop(0)
        wanted = not one.future.done()
        asked = self.conversation.asked(None if self.in_turn else one.task.id)
        assert asked is (one if wanted else None)
        if asked is not None:
            execution = Execution("gpu", self.now_s - one.published_s)
            self.do([self.conversation.answered(asked, execution, self.now_s)])

    @precondition(lambda self: self.server)
    @rule()
    def refuse(self) -> None:
        one = self.server.pop(0)
        asked = self.conversation.asked(None if self.in_turn else one.task.id)
        if asked is not None:
            self.do([self.conversation.fail(asked, CloudBusy("full"), self.now_s, started=False)])

    @invariant()
    def none_is_forgotten(self) -> None:
        if hasattr(self, "conversation"):
            open_ones = sum([not one.future.done() for one in self.submitted])
            assert open_ones == self.conversation.in_flight

    @invariant()
    def what_can_be_sent_has_been(self) -> None:
        """After the time has come; only then does a server without numbers get its next request."""
        if self.submitted and self.conversation.connected and self.conversation.wakes_s > self.now_s:
            wanted = [one for one in self.submitted if not one.future.done()]
            assert set(wanted[:1] if self.in_turn else wanted) <= set(self.server) or self.conversation.owes

    def teardown(self) -> None:
        if hasattr(self, "conversation"):
            self.do(self.conversation.close(self.now_s))
            self.submit(1.0)
            assert len(self.finished) == len(self.submitted)
            assert {one.task.id for one in self.finished} == {one.task.id for one in self.submitted}
            assert self.conversation.in_flight == 0


TestTalk = pytest.mark.filterwarnings("error")(Talk.TestCase)
TestTalk.settings = settings(max_examples=100, stateful_step_count=40, deadline=None)


def test_requests_travel_together() -> None:
    """Each is sent at once, a heartbeat that is due soon goes first, and a late one is cancelled."""
    conversation = talking(heartbeat_s=0.5)
    first, second = request(), request(budget_s=5.0)
    assert sorts(conversation.submit(first, 0.0)) == [Ping, Send]
    assert sorts(conversation.submit(second, 0.0)) == [Send]
    assert conversation.wakes_s == pytest.approx(0.5, abs=0.1)
    late = conversation.time(5.0)
    assert sorts(late) == [Cancel, Finish, Ping]
    assert isinstance(late[1], Finish)
    assert isinstance(late[1].execution.failure, CloudTimeout)
    assert late[1].execution.censored
    assert conversation.asked(second.task.id) is None
    assert conversation.asked(first.task.id) is first


def test_one_is_under_way_at_a_time() -> None:
    """The next one has its turn when a message has come, and no heartbeat is sent before that."""
    conversation = talking(in_turn=True, heartbeat_s=0.5)
    first, second = request(), request()
    assert sorts(conversation.submit(first, 1.0)) == [Ping, Send]
    assert conversation.submit(second, 2.0) == []
    assert conversation.time(3.0) == []
    assert conversation.asked() is first
    conversation.answered(first, Execution("gpu", 1.0), 4.0)
    assert conversation.time(4.0)[-1] == Send(second)
    assert (first.sent_s, second.sent_s) == (1.0, 4.0)


def test_the_answer_to_one_that_was_given_up_is_still_due() -> None:
    """Until it has come, no other one has its turn; if it does not come, the connection ends."""
    conversation = talking(in_turn=True)
    first, second = request(), request(budget_s=999.0)
    conversation.submit(first, 1.0)
    conversation.submit(second, 1.0)
    (finish,) = conversation.cancel(first.task.id, 2.0)
    assert isinstance(finish, Finish)
    assert isinstance(finish.execution.failure, Overtaken)
    assert finish.execution.started
    assert conversation.owes
    assert conversation.time(3.0) == []
    assert conversation.wakes_s == 2.0 + OWED_MAX_S
    assert sorts(conversation.time(2.0 + OWED_MAX_S)) == [Reconnect]
    assert conversation.time(2.0 + OWED_MAX_S) == []
    assert conversation.asked() is None
    assert not conversation.owes
    assert conversation.time(99.0) == [Send(second)]


def test_a_late_request_makes_the_next_heartbeat_due() -> None:
    """So that the robot soon knows whether the site is still there."""
    conversation = talking(heartbeat_s=60.0)
    one = request()
    assert sorts(conversation.submit(one, 0.0)) == [Ping, Send]
    conversation.pong(1, 0.1, ServerReport())
    assert conversation.time(1.0) == []
    conversation.cancel(one.task.id, 2.0)
    assert sorts(conversation.time(2.0)) == [Ping]


def test_one_that_waits_can_be_given_up() -> None:
    """It never has its turn, and never began."""
    conversation = talking(in_turn=True)
    first, second = request(), request()
    conversation.submit(first, 0.0)
    conversation.submit(second, 0.0)
    (finish,) = conversation.cancel(second.task.id, 1.0)
    assert isinstance(finish, Finish)
    assert not finish.execution.started
    assert not conversation.owes
    conversation.asked()
    assert conversation.time(2.0) == []


def test_a_message_that_answers_nothing() -> None:
    """A server without numbers that speaks unasked breaks the protocol."""
    with pytest.raises(ProtocolError, match="no request asked for"):
        talking(in_turn=True).asked()


@pytest.mark.parametrize(("in_turn", "most"), [(False, IN_FLIGHT_MAX), (True, IN_TURN_MAX)])
def test_limits(in_turn: bool, most: int) -> None:
    """Beyond the limit nothing is kept; all end with the connection; a closed site takes none."""
    conversation = talking(in_turn=in_turn)
    ones = [request() for _ in range(most)]
    for one in ones:
        conversation.submit(one, 0.0)
    (refused,) = conversation.submit(request(), 0.0)
    assert isinstance(refused, Finish)
    assert isinstance(refused.execution.failure, CloudBusy)
    ended = conversation.down("lost", 1.0)
    assert [one.request for one in ended if isinstance(one, Finish)] == ones
    assert [one.execution.started for one in ended if isinstance(one, Finish)].count(True) == (
        1 if in_turn else most
    )
    conversation.close(2.0)
    (refused,) = conversation.submit(request(), 2.0)
    assert isinstance(refused, Finish)
    assert isinstance(refused.execution.failure, CloudBroken)


def test_the_story() -> None:
    """It tells what happened last, without the arguments of any task."""
    conversation = talking()
    for _ in range(STORY_MAX):
        one = request()
        conversation.submit(one, 1.0)
        conversation.answered(one, Execution("gpu", 1.0), 2.0)
    story: tuple[Any, ...] = conversation.story
    assert len(story) == STORY_MAX
    assert story[-3:] == (
        (1.0, "submit", one.task.id),
        (1.0, "send", one.task.id),
        (2.0, "answer", one.task.id),
    )
    assert not [part for happened in story for part in happened if isinstance(part, PendingRequest | Future)]
