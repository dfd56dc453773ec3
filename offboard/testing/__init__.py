"""The test kit: users test their own programs in virtual time, without a server and without waiting.

`from offboard.testing import Bench`. The test bench `loadgen` builds its simulated sites on the same parts.
"""

from offboard.testing.bench import Bench
from offboard.testing.scripted_onboard import ScriptedOnboard
from offboard.testing.scripted_site import ScriptedSite
from offboard.testing.shared_clock import SharedClock

__all__ = ["Bench", "ScriptedOnboard", "ScriptedSite", "SharedClock"]
