"""The rules of the server: it is killed, paused, restarted, replaced, and used again."""

from typing import Any

from hypothesis import strategies as st
from hypothesis.stateful import precondition, rule

from offboard import Offloader
from offboard.robot_client.sites.runner import CLOUD
from tests.state import served
from tests.state.run import Run
from tests.state.server import DOWN, OTHER, PAUSED, RUNNING, SAME

REACH_S = 10.0  # until a robot uses a server that runs again


class ServerRules(Run):
    """Calls go on meanwhile."""

    @precondition(lambda self: self.server.state != DOWN)
    @rule()
    def kill_server(self) -> None:
        self.server.kill()
        self.note("server killed")

    @precondition(lambda self: self.server.state == RUNNING)
    @rule()
    def pause_server(self) -> None:
        self.server.pause()
        self.note("server paused")

    @precondition(lambda self: self.server.state == PAUSED)
    @rule()
    def resume_server(self) -> None:
        self.server.resume()
        self.note("server resumed")

    @precondition(lambda self: self.server.state == DOWN)
    @rule(
        source=st.sampled_from([SAME, SAME, OTHER]),
        executor=st.sampled_from(["threads", "threads", "processes"]),
        wait=st.booleans(),
    )
    def start_server(self, source: str, executor: str, wait: bool) -> None:
        """Later calls come while it starts, or when it is ready."""
        self.server.start(source, executor, wait=wait)
        self.note(f"server started with {source}")

    @precondition(lambda self: self.server.state == RUNNING)
    @rule()
    def restart_server(self) -> None:
        """It may end its tasks before."""
        self.server.stop()
        self.server.start(SAME, "threads")
        self.note("server restarted")

    @precondition(lambda self: self.server.state == RUNNING)
    @rule()
    def replace_server(self) -> None:
        """A server with other source comes to the same address, or the first one comes back."""
        self.server.kill()
        self.server.start(SAME if self.server.source == OTHER else OTHER, "threads", wait=True)
        self.note("server replaced")

    @precondition(
        lambda self: self.offload is not None and self.server.state == RUNNING and self.server.source == SAME
    )
    @rule()
    def reach_server(self) -> None:
        """A server that runs is used again, soon after it is ready."""
        self.finish_all()
        self.server.heal()

        def act(do: Offloader) -> tuple[Any, ...]:
            absent = do.wait_for_sites(served.twice, REACH_S)
            answer = do(served.twice, 3, where=CLOUD, timeout_s=REACH_S)
            return dict(absent), answer, do.last and do.last.used

        self.begin("call of a server that runs", act, ({}, 6, CLOUD), wait=True)
