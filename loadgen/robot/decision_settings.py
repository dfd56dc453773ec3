"""The flags that say how a robot chooses a site: policy, predictor, objective and limits."""

from dataclasses import dataclass
from pathlib import Path

from offboard.common.config import setting
from offboard.common.errors import ConfigError
from offboard.robot_client import policies, predictors
from offboard.robot_client.policies import objectives
from offboard.robot_client.policies.allowance import DUPLICATES
from offboard.robot_client.policies.objectives import MEAN, OBJECTIVES, S_PER_QUALITY, Energy
from offboard.robot_client.predictors.window import WINDOW
from offboard.robot_client.settings import Settings

DECISIONS, OBJECTIVE, LIMITS = "decisions", "objective", "limits"
# The objectives that each setting belongs to; the first one cannot do without it.
USED_BY = {
    "deadline_s": ("deadline",),
    "s_per_joule": ("energy", "metered"),
    "s_per_megabyte": ("metered", "energy"),
}
POLICY_HELP = (
    f"{policies.HELP}. `default` stands for {policies.DEFAULT}: run a task where it should finish first, "
    "try the other site now and then, and start the task there as well if the first site is late"
)


@dataclass(frozen=True)
class DecisionSettings:
    """How the robot decides where a task runs."""

    policy: str = setting(
        policies.DEFAULT, f"rule that chooses the site: {POLICY_HELP}", group=DECISIONS, metavar="NAME"
    )
    window: int = setting(
        WINDOW, "executions remembered for each site", group=DECISIONS, minimum=2, maximum=1_000_000
    )
    predictor: str | None = setting(
        None,
        f"predictor to use instead of the one that the policy is meant for: {predictors.HELP}",
        group=DECISIONS,
        rare=True,
        metavar="NAME",
    )
    heartbeats: bool | None = setting(
        None,
        "ask each server that is used if it is there (default: unless the policy is meant to do without)",
        group=DECISIONS,
        rare=True,
    )
    memory: Path | None = setting(
        None, "file that keeps what the robot learns, and is read at start", group=DECISIONS, rare=True
    )
    objective: str = setting(
        MEAN,
        "what the policy minimises: mean time, the time that 95 % of the tasks stay below (p95), missed "
        "deadlines, or time plus what energy (energy) and data (metered) are worth",
        group=OBJECTIVE,
        rare=True,
        choices=OBJECTIVES,
    )
    deadline_s: float | None = setting(
        None,
        "with --objective deadline: time that a task may take, in seconds",
        group=OBJECTIVE,
        rare=True,
        name="deadline",
        minimum=0.001,
        maximum=3600,
    )
    s_per_joule: float | None = setting(
        None,
        "with --objective energy or metered: seconds that one joule is worth",
        group=OBJECTIVE,
        rare=True,
        minimum=0.0,
        maximum=1e6,
    )
    s_per_megabyte: float | None = setting(
        None,
        "with --objective metered or energy: seconds that a million bytes, sent or received, are worth",
        group=OBJECTIVE,
        rare=True,
        minimum=0.0,
        maximum=1e6,
    )
    s_per_quality: float = setting(
        S_PER_QUALITY,
        "for tasks with variants: seconds that the whole quality of an answer is worth",
        group=OBJECTIVE,
        rare=True,
        minimum=0.0,
        maximum=1e6,
    )
    compute_watts: float = setting(
        Energy().compute_w,
        "power that one busy core draws above idle, in watts",
        group=OBJECTIVE,
        rare=True,
        minimum=0.0,
        maximum=1e4,
    )
    idle_watts: float = setting(
        Energy().idle_w,
        "power drawn while waiting for an answer, in watts",
        group=OBJECTIVE,
        rare=True,
        minimum=0.0,
        maximum=1e4,
    )
    radio_joules_byte: float = setting(
        Energy().radio_j_byte,
        "energy to send or receive one byte, in joules",
        group=OBJECTIVE,
        rare=True,
        minimum=0.0,
        maximum=1.0,
    )
    duplicates: float = setting(
        DUPLICATES,
        "share of tasks that may run on two sites, as probes or hedges",
        group=LIMITS,
        rare=True,
        minimum=0.0,
        maximum=1.0,
        metavar="SHARE",
    )
    bytes_per_minute: float | None = setting(
        None,
        "bytes that may be sent and received in a minute; puts budget around the policy",
        group=LIMITS,
        rare=True,
        minimum=0.0,
        maximum=1e15,
    )
    joules_per_minute: float | None = setting(
        None,
        "joules that tasks may take from the battery in a minute; puts budget around the policy",
        group=LIMITS,
        rare=True,
        minimum=0.0,
        maximum=1e9,
    )

    def check_decisions(self) -> None:
        policies.check_name(self.policy, "--policy")
        if self.predictor is not None:
            predictors.check_name(self.predictor, "--predictor")
        for field, names in USED_BY.items():
            value, flag = getattr(self, field), field.removesuffix("_s").replace("_", "-")
            if self.objective == names[0] and value is None:
                raise ConfigError(f"--objective: {names[0]} needs --{flag}")
            if self.objective not in names and value is not None:
                raise ConfigError(f"--{flag}: {value:g} needs --objective {' or '.join(names)}")
        if self.objective != MEAN and not policies.weighs_cost(self.policy):
            raise ConfigError(f"--objective: {self.objective} changes nothing with --policy {self.policy}")
        by_deadline = self.objective == "deadline"
        if self.s_per_quality != S_PER_QUALITY and (by_deadline or not policies.weighs_cost(self.policy)):
            ignored_by = "--objective deadline" if by_deadline else f"--policy {self.policy}"
            raise ConfigError(f"--s-per-quality: {self.s_per_quality:g} changes nothing with {ignored_by}")

    def settings(self, seed: int) -> Settings:
        """The rare options of the offloader."""
        return Settings(
            predictor=self.predictor,
            window=self.window,
            heartbeats=self.heartbeats,
            objective=objectives.make(
                self.objective,
                deadline_s=self.deadline_s,
                s_per_joule=self.s_per_joule,
                s_per_megabyte=self.s_per_megabyte,
            ),
            s_per_quality=self.s_per_quality,
            energy=Energy(self.compute_watts, self.idle_watts, self.radio_joules_byte),
            duplicates=self.duplicates,
            bytes_a_minute=self.bytes_per_minute,
            joules_a_minute=self.joules_per_minute,
            memory=self.memory,
            seed=seed,
        )
