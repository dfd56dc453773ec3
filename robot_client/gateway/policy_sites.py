"""Several policy servers and an onboard policy, which answer one observation after the other.

The drop-in clients of `offboard.policy_client` and the gateway stand on it.
"""

import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from offboard.common.errors import CloudBroken, ConfigError, OffloadError, TaskFailed
from offboard.common.tasks import task
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.policy_servers.groot import GROOT, observation_of
from offboard.robot_client.policy_servers.protocol import Raw
from offboard.robot_client.records.record import Record
from offboard.robot_client.settings import Settings
from offboard.robot_client.sites.absence import SiteView
from offboard.robot_client.sites.endpoint import is_policy_server
from offboard.robot_client.sites.runner import ONBOARD, TIMEOUT_S

QUALITY_ONBOARD = 0.5  # unless the user says it: the policy of a server is the one that the robot should have
NO_ONBOARD_S = 1000.0  # a server that takes longer than this is worse than no answer
LOOK_S = 0.02  # between two looks whether a server is there

Onboard = Callable[[Any], Any]

_lock = threading.Lock()
_tasks: dict[tuple[Onboard | None, float], Callable[[Any], Any]] = {}


class PolicySites:
    """Answers observations, each by one of `sites` or onboard.

    groot: whether the client speaks the protocol of GR00T, or else that of openpi. Sites of the other
    protocol need an entry in `settings.convert`.
    onboard: maps an observation to an action; without it an observation that no server answers raises
    OffloadError. quality: of its actions, where those of the servers have 1.
    deadline_s: until which an answer should be there; onboard starts in time for that.
    keys: folder with NAME.token, what the server of a site wants to see.
    observers: called with the record of each observation.
    """

    def __init__(
        self,
        sites: Mapping[str, str],
        *,
        groot: bool = False,
        onboard: Onboard | None = None,
        quality: float = QUALITY_ONBOARD,
        deadline_s: float | None = None,
        keys: Path | str | None = None,
        settings: Settings | None = None,
        observers: Iterable[Callable[[Record], None]] = (),
    ) -> None:
        for site, endpoint in sites.items():
            if not is_policy_server(endpoint):
                raise ConfigError(f"{site}: {endpoint!r} is no policy server (ws://, wss:// or groot://)")
        own = settings or Settings()
        for site, endpoint in sites.items():
            if endpoint.startswith(GROOT) != groot and site not in own.convert:
                needs = f"{GROOT}, as the client does" if groot else "ws:// or wss://, as the client does"
                raise ConfigError(f"{site}: {endpoint!r} does not speak {needs}; give a `convert` for it")
        if onboard is None:
            own = replace(own, s_per_quality=NO_ONBOARD_S, duplicates=0.0)
        self._has_onboard, self._deadline_s = onboard is not None, deadline_s
        self._only = next(iter(sites)) if len(sites) == 1 else None
        self._converted = own.convert.keys()
        self._task = _task_of(onboard, 0.0 if onboard is None else quality)
        self.offload = Offloader.connect(
            sites=sites,
            keys=keys,
            settings=own,
            observers=observers,
        )

    @property
    def task(self) -> Callable[[Any], Any]:
        """The task that a stream plays."""
        return self._task

    def wait(self, timeout_s: float) -> bool:
        """Wait for a first server, at most this long. Returns whether one is there."""
        until_s = time.monotonic() + timeout_s
        while not self._present() and time.monotonic() < until_s:
            time.sleep(LOOK_S)
        return bool(self._present())

    def call(self, item: Any) -> Any:
        """The action for an observation; for a raw one, the message of its answer."""
        return self._call(item)[0]

    def ask_all(self, call: Any, what: str) -> Any:
        """Send this request to each server that is there and needs no conversion; the last answer."""
        answer = None
        for site in self._present().keys() - self._converted:
            answer, record = self._call(call, where=site)
            if record.used != site:
                raise CloudBroken(f"{what}: {record.happened}")
        if answer is None:
            raise CloudBroken(f"{what}: no policy server is there")
        return answer

    def metadata(self) -> dict[Any, Any]:
        """What the first server that is there says about itself."""
        return next((dict(view.metadata) for view in self._present().values()), {})

    def close(self) -> None:
        self.offload.close()

    def _present(self) -> dict[str, SiteView]:
        return {
            site: view
            for site, view in self.offload.sites.items()
            if view.endpoint is not None and view.connected
        }

    def _call(self, item: Any, where: str | None = None) -> tuple[Any, Record]:
        if self._has_onboard:
            return self.offload.call(self._task, item, where=where, timeout_s=self._patience_s(item))
        until_s, said = time.monotonic() + (self._deadline_s or TIMEOUT_S), []
        for site in [where] if where is not None else self._soonest_first(item):
            try:
                left_s = max(LOOK_S, until_s - time.monotonic())
                return self.offload.call(self._task, item, where=site, timeout_s=left_s)
            except TaskFailed as error:  # of the onboard policy, which is none
                runs = () if error.record is None else error.record.executions
                said += [f"{one.site}: {one.error}" for one in runs if one.site != ONBOARD]
        raise CloudBroken(f"no policy server has answered: {'; '.join(said) or 'none is there'}")

    def _patience_s(self, item: Any) -> float:
        """How long a server has, so that onboard can still answer in time, if it ever can."""
        deadline_s = self._deadline_s
        if deadline_s is None:
            return TIMEOUT_S
        onboard = self.offload.expect(self._task, item)[ONBOARD]
        own_s = onboard.interval[1] if onboard.interval is not None else onboard.seconds
        if own_s is None:
            own_s = 0.5 * deadline_s
        return deadline_s - own_s if own_s < deadline_s else deadline_s

    def _soonest_first(self, item: Any) -> list[str]:
        """The servers that are there, by their predictions; those that are not known come first."""
        if self._only is not None:
            return [self._only]
        present = list(self._present())
        expected = self.offload.expect(self._task, item)
        seconds = {site: one.seconds for site, one in expected.items() if one.seconds is not None}
        return sorted(present, key=lambda site: seconds.get(site, 0.0))


def _task_of(onboard: Onboard | None, quality: float) -> Callable[[Any], Any]:
    """The task of this onboard policy; one for each, as the number of tasks is limited."""
    with _lock:
        key = onboard, quality
        if key not in _tasks:

            @task(
                f"policy_{len(_tasks)}",
                policy_server=True,
                size=lambda _: 1.0,
                variants={"cloud": None},
                quality={"onboard": quality, "cloud": 1.0},
            )
            def policy(item: Any) -> Any:
                if onboard is None:
                    raise OffloadError("there is no onboard policy")
                if not isinstance(item, Raw):
                    return onboard(observation_of(item))
                answer = onboard(item.client.read_request(item.data))
                return Raw(item.client.pack_answer(answer), item.client)

            _tasks[key] = policy
        return _tasks[key]
