"""The options of `Offloader.connect` that few robots need.

The common options are keywords of `Offloader.connect` itself.
"""

from dataclasses import dataclass
from pathlib import Path

from offboard.robot_client.policies.allowance import DUPLICATES, Allowance
from offboard.robot_client.policies.energy import Energy
from offboard.robot_client.policies.objectives import Mean, Objective


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Rare options of an offloader; the defaults suit most robots.

    `predictor`: how times are predicted, by name (None: the predictor that the policy is meant for). A name
    that begins with `work:` predicts seconds per unit of work, for tasks that tell their work.
    `objective`: what the policy makes small; see `policies.objectives`.
    `energy`: what computing, waiting and sending take from the battery, in watts and joules per byte.
    `duplicates`: second runs per task in the long run, from 0 to 1: probes, hedges, warm-up.
    `bytes_a_minute`: the most bytes that tasks may send and receive in a minute (None: no cap).
    `joules_a_minute`: the most joules that tasks may take in a minute (None: no cap).
    `memory`: the file in which what was learnt outlives the process (None: a new process knows nothing).
    `seed`: for policies and predictors that draw; the same seed draws the same numbers.
    """

    predictor: str | None = None
    objective: Objective = Mean()
    energy: Energy = Energy()
    duplicates: float = DUPLICATES
    bytes_a_minute: float | None = None
    joules_a_minute: float | None = None
    memory: Path | None = None
    seed: int = 0

    def allowance(self) -> Allowance:
        """A fresh allowance: what tasks may spend from now on."""
        return Allowance(self.duplicates, self.bytes_a_minute, self.joules_a_minute)
