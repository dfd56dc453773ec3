"""The names of policies on the test bench: POLICY, POLICY+OBJECTIVE (`default+p95`), or a rule of streams."""

from offboard.common.errors import ConfigError
from offboard.loadgen.rivals.stream_rules import RULES
from offboard.robot_client import policies
from offboard.robot_client.policies.objectives import OBJECTIVES


def split_objective(name: str, where: str) -> tuple[str, str | None]:
    """The policy and the objective of this name; None: it names no objective.

    ConfigError if one of them is unknown, or if the policy weighs no costs. `where` names the flag or key.
    """
    if name in RULES:
        return name, None
    policy, plus, objective = name.partition("+")
    policies.check_name(policy, where)
    if not plus:
        return policy, None
    if objective not in OBJECTIVES:
        raise ConfigError(f"{where}: {name!r}: {objective!r} is not one of {', '.join(OBJECTIVES)}")
    if not policies.weighs_cost(policy):
        raise ConfigError(f"{where}: {name!r}: an objective changes nothing with {policy}")
    return policy, objective
