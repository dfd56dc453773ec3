"""What is known of making the arguments of one kind smaller, and whether that should save time.

`sites/outgoing.py` does it, and measures what it takes.
"""

from offboard.robot_client.policies.forecast import Packing
from offboard.robot_client.policies.probe import PROBE_EVERY
from offboard.robot_client.predictors.line import RunningMean
from offboard.robot_client.sites.runner import Execution, Packed, Sending


class PackingMemory:
    """The memory of one kind, for all sites: the packing takes place on the robot.

    `packs`: the kind packs all its arguments itself, so none is compressed.
    """

    def __init__(self, *, packs: bool) -> None:
        self._packs = packs
        self._learnt: dict[int | None, _Learnt] = {}  # by the number of the argument; None: all of them

    def plan(self, sending: Sending, link_s: float | None) -> Packing | None:
        """What to make smaller if each byte takes `link_s` on the link (None: unknown); None: nothing."""
        if self._packs:
            return self._all(sending)
        if link_s is None or not sending.large:
            return None
        chosen, left, seconds = [], float(sending.bytes), 0.0
        for argument, size in sending.large:
            learnt = self._learnt.get(argument)
            if learnt is None:  # the first time tells
                chosen.append(argument)
            elif learnt.pays(link_s):
                chosen.append(argument)
                left -= size * (1.0 - learnt.share.value)
                seconds += size * learnt.byte_s.value
        return Packing(tuple(chosen), sending.bytes, left, seconds) if chosen else None

    def learn(self, execution: Execution) -> None:
        """Learn what was made smaller for a run on a server."""
        for learnt in self._learnt.values():
            learnt.age += 1
        for one in execution.packed:
            self._learnt.setdefault(one.argument, _Learnt()).learn(one)

    def _all(self, sending: Sending) -> Packing | None:
        learnt, size = self._learnt.get(None), sending.bytes
        if learnt is None or not size:
            return None
        return Packing((), size, learnt.share.value * size, learnt.byte_s.value * size)


class _Learnt:
    """The packing of one argument: what share of its bytes is left, and how long each byte takes."""

    __slots__ = ("age", "byte_s", "share")

    def __init__(self) -> None:
        self.age = 0  # runs since it was last packed
        self.share = RunningMean()
        self.byte_s = RunningMean()

    def learn(self, one: Packed) -> None:
        size = max(1, one.raw_bytes)
        self.age = 0
        self.share.add(one.bytes / size)
        if one.seconds:  # not done for another site before
            self.byte_s.add(one.seconds / size)

    def pays(self, link_s: float) -> bool:
        """Whether compressing should take less time than it saves.

        If its bytes did not shrink enough, an argument is tried again now and then, because its content may
        have changed. On a fast link not even an argument that vanished would pay.
        """
        cost_s = 2.0 * self.byte_s.value  # a server should not take longer to decompress
        saved_s = link_s * (1.0 - self.share.value)
        return saved_s > cost_s or (self.age >= PROBE_EVERY and link_s > cost_s)
