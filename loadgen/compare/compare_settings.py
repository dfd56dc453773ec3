"""The settings of `loadgen compare`, and the policy names that it accepts."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from offboard.common.config import check, setting
from offboard.common.errors import ConfigError
from offboard.loadgen import rivals
from offboard.loadgen.play.play_scenario import TESTBEDS
from offboard.loadgen.policy_name import split_objective
from offboard.loadgen.scenario.outcome import Outcome
from offboard.loadgen.scenario.scenario import Scenario
from offboard.loadgen.table.table_columns import ColumnSettings, FormatSettings
from offboard.robot_client import policies
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

SEEDS_MAX = 1000
PLAYS_MAX = 5  # attempts to play one run while the host takes too much CPU time
JOBS_MAX = 256
SIMULATION = "simulation"
CONSTANTS = (ONBOARD, CLOUD)  # the policies that always choose one site; the better one is the divisor
NAMES = "NAME,NAME,.."
POLICIES = (
    f"policies to play: {policies.HELP}; POLICY@PREDICTOR uses another predictor than its own,"
    " and POLICY+OBJECTIVE, such as default+mean, decides by another objective than the scenario's"
)
OUT = (
    "folder for the runs, SCENARIO/SEED-POLICY; a finished run of the same software and settings is"
    " not played again"
)


@dataclass(frozen=True)
class RunsConfig(FormatSettings):
    """The settings that `compare` and `checks` share: which runs are played, and where."""

    policies: tuple[str, ...] = setting((policies.ALIAS,), POLICIES, metavar=NAMES)
    seeds: int = setting(
        3,
        "number of runs of each policy; the seeds count up from the scenario's seed",
        minimum=1,
        maximum=SEEDS_MAX,
    )
    testbed: str = setting(
        "local", "where to play: in local processes or in Docker containers", choices=tuple(TESTBEDS)
    )
    out: Path = setting(Path("out/checks"), OUT, metavar="DIR")
    simulate: bool = setting(
        False,
        "simulate the runs: virtual time and modelled sites, no processes are started; checks that need real"
        " processes are left out",
    )
    jobs: int | None = setting(
        None, "with --simulate: number of processes (default: one for each CPU)", minimum=1, maximum=JOBS_MAX
    )

    def __post_init__(self) -> None:
        check(self)
        for policy in self.policies:
            split_strategy(policy)
        if len(set(self.policies)) < len(self.policies):
            raise ConfigError(f"--policies: {','.join(self.policies)}: a policy is named twice")
        if self.jobs is not None and not self.simulate:
            raise ConfigError(
                f"--jobs: {self.jobs} needs --simulate: real runs are played one after the other"
            )
        if self.simulate and self.testbed != "local":
            raise ConfigError(f"--testbed: {self.testbed} cannot be combined with --simulate")

    @property
    def where(self) -> str:
        """The testbed that tables name."""
        return SIMULATION if self.simulate else self.testbed

    @property
    def place(self) -> str:
        """The same in a sentence."""
        return f"in {SIMULATION}" if self.simulate else f"on the {self.testbed} testbed"

    @property
    def count_of_seeds(self) -> str:
        return "1 seed" if self.seeds == 1 else f"{self.seeds} seeds"

    def seeded(self, scenario: Scenario) -> list[Scenario]:
        return [scenario.changed(seed=scenario.seed + n) for n in range(self.seeds)]

    def strategies(self) -> dict[str, dict[str, Any]]:
        """What each policy changes of a scenario, as arguments of `Scenario.changed`."""
        keys = ("policy", "predictor")
        return {name: dict(zip(keys, split_strategy(name), strict=True)) for name in self.policies}


@dataclass(frozen=True)
class CompareConfig(ColumnSettings, RunsConfig):
    """What is compared, and where the runs are played."""

    policies: tuple[str, ...] = setting((policies.ALIAS, *CONSTANTS, "paper"), POLICIES, metavar=NAMES)
    out: Path = setting(Path("out/compare"), OUT, metavar="DIR")
    tasks: int | None = setting(None, "number of tasks (default: as in the scenario)", minimum=1)
    reference: int | None = setting(
        None,
        "run every K-th task again on each site alone (default: as in the scenario); 0: none (faster)",
        minimum=0,
    )
    heartbeats: bool | None = setting(
        None,
        "whether the robots send heartbeats (default: as the scenario, or else each policy, says)",
        rare=True,
    )
    recordings: Path | None = setting(
        None,
        "play each scenario over every recorded link below this folder (CSV, or NAME.up with NAME.down),"
        " 300 tasks each, and compare by family, which is the folder of a recording",
        metavar="FOLDER",
    )
    rate: float | None = setting(
        None, "with --recordings: tasks per second, instead of one at a time", rare=True, minimum=0.001
    )
    from_task: int = setting(0, "first task that counts, for example the first one after warm-up", minimum=0)
    stolen_max: float | None = setting(
        None,
        "play a run again if the host of this virtual machine took more than this share of its CPU time,"
        f" up to {PLAYS_MAX} times; without it, the table reports the share",
        rare=True,
        minimum=0,
        maximum=100,
        metavar="PERCENT",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.simulate and self.stolen_max is not None:
            raise ConfigError(f"--stolen-max: {self.stolen_max:g} cannot be combined with --simulate")
        if self.recordings is None:
            if self.rate is not None:
                raise ConfigError(f"--rate: {self.rate:g} needs --recordings")
        elif not {ONBOARD, CLOUD} <= set(self.policies):
            named = ",".join(self.policies)
            raise ConfigError(f"--policies: {named}: --recordings needs {ONBOARD} and {CLOUD} among them")

    def counted(self, scenario: Scenario, runs: Mapping[str, Sequence[Outcome]]) -> dict[str, list[Outcome]]:
        """The outcomes by policy, only with the tasks that count."""
        robots = scenario.compared()
        return {name: [run.of(robots).between(self.from_task) for run in of] for name, of in runs.items()}


def split_strategy(name: str) -> tuple[str, str | None]:
    """The policy, with its objective if one is named, and the predictor of POLICY+OBJECTIVE@PREDICTOR.

    None: the predictor that the policy brings.
    """
    policy, at, predictor = name.partition("@")
    split_objective(policy, "--policies")
    if at:
        rivals.predictor(predictor, "--policies")
    return policy, predictor if at else None
