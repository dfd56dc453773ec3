"""The result of a comparison in one sentence: one policy next to the better constant policy.

The figures are those of the lines of `comparison_table`.
"""

from collections.abc import Sequence
from typing import Protocol

from offboard.loadgen.compare.compare_settings import CONSTANTS
from offboard.robot_client import policies

MISSING = f"Nothing is divided: name {' and '.join(CONSTANTS)} among --policies to compare with them."


class Figures(Protocol):
    """What the sentence says of a policy, as in `comparison_table.Line`."""

    @property
    def policy(self) -> str: ...
    @property
    def lost(self) -> int | None: ...
    @property
    def over_constant(self) -> float | None: ...
    @property
    def cost(self) -> float | None: ...
    @property
    def cost_over_constant(self) -> float | None: ...
    @property
    def quality(self) -> float | None: ...
    @property
    def late_percent(self) -> float | None: ...


def in_words(lines: Sequence[Figures], constant: str | None, *, by_cost: bool) -> str:
    """The sentence about `default`, or about the first policy that is no constant.

    `constant` is the better constant policy; None if the two constants were not both played.
    """
    of = {line.policy: line for line in lines}
    others = [name for name in of if name not in CONSTANTS]
    if constant is None:
        return MISSING
    if not others:
        return f"{constant} is the better constant."
    name = next((one for one in others if policies.full_name(one) == policies.DEFAULT), others[0])
    said = [f"{name}: {_ratio(of[name], of[constant], by_cost=by_cost)}", *_faults(of[name])]
    return "; ".join([", ".join(said), *_of_constants([of[one] for one in CONSTANTS])]) + "."


def _ratio(line: Figures, constant: Figures, *, by_cost: bool) -> str:
    ratio = line.cost_over_constant if by_cost else line.over_constant
    if ratio is not None:
        what = "cost" if by_cost else "mean time"
        return f"{ratio:.2f} of the better constant ({constant.policy}) in {what}"
    if line.cost is None or constant.cost is None:
        return f"no task in common with the better constant ({constant.policy})"
    return f"a cost of {line.cost:.4f}, and {constant.cost:.4f} of the better constant ({constant.policy})"


def _faults(line: Figures) -> list[str]:
    """Its late and lost tasks, and its quality, where they are known."""
    said = []
    if line.late_percent is not None:
        said.append(f"late in {line.late_percent:.3g} %" if line.late_percent else "no task late")
    if line.lost:
        said.append(f"{line.lost} tasks lost")
    if line.quality is not None:
        said.append(f"quality {line.quality:.2f}")
    return said


def _of_constants(lines: Sequence[Figures]) -> list[str]:
    """How late each constant policy was, if it was, and the quality of its answers."""
    said = [f"{one.policy} alone was late in {one.late_percent:.3g} %" for one in lines if one.late_percent]
    known = [f"{one.policy} alone {one.quality:.2f}" for one in lines if one.quality is not None]
    return [" and ".join(said)] * bool(said) + [f"quality of {' and of '.join(known)}"] * bool(known)
