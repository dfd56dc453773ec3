"""One verdict for each claim of the paper, over all datasets.

Each claim has lines that decide it. It holds if more than half of them agree, in all datasets together. It
does not hold if more of them disagree than agree: what is claimed must show. Otherwise it cannot be told.
"""

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from offboard.common.wording import rounded
from offboard.loadgen.claims.claim import NO, UNCLEAR, YES, Claim
from offboard.loadgen.table.table_formats import UNDEFINED, Table, column, headings_of

DIGITS = 3
HOLDS, FAILS, OPEN, NOT_MEASURED = "holds", "does not hold", "cannot be told", "not measured"


@dataclass(frozen=True, slots=True)
class Judged:
    """A claim of the paper: its words, its figure, the lines that decide it, and one sentence why.

    `decided_by` matches the whole `claim` of a line. `shown` gives a label to the lines whose figures are
    shown, from the least to the greatest of all datasets.
    """

    number: int
    claim: str
    theirs: str
    decided_by: str
    shown: Sequence[tuple[str, str]]
    why: str


JUDGED = (
    Judged(
        1,
        "times correlate with sizes, p < 0.005",
        theirs="r 0.28 and 0.69",
        decided_by=r".*, all rows",
        shown=(("r cloud", "cloud: r, all rows"), ("r onboard", "onboard: r, all rows")),
        why="with some hundred rows nearly every r is significant, in short windows few are",
    ),
    Judged(
        2,
        "r does not depend on N",
        theirs="changes by 0.04",
        decided_by=r".*: r, N = .*",
        shown=(("cloud by", "cloud: r, N = .*"), ("onboard by", "onboard: r, N = .*")),
        why="so it is where nothing lasts; where a load lasts, short windows have a larger r",
    ),
    Judged(
        3,
        "r onboard is larger than r in the cloud",
        theirs="0.69 and 0.28",
        decided_by="r onboard - r cloud",
        shown=(("larger by", "r onboard - r cloud"),),
        why="the link adds to the cloud time what the size does not show",
    ),
    Judged(
        4,
        "the cloud time grows less with the size",
        theirs="–",  # noqa: RUF001
        decided_by="slope cloud / slope onboard",
        shown=(("slopes", "slope cloud / slope onboard"),),
        why="the server computes faster than the robot",
    ),
    Judged(
        5,
        "the last N tasks teach more than N random ones",
        theirs="–",  # noqa: RUF001
        decided_by="sequential - .*",
        shown=(
            ("r onboard by", "sequential - random: r onboard"),
            ("points", "sequential - random: accuracy"),
        ),
        why="it needs a load that lasts for many tasks",
    ),
    Judged(
        6,
        "the last N times capture exogenous factors",
        theirs="–",  # noqa: RUF001
        decided_by=r"time / better site, N = \d+, chosen",
        shown=(
            ("accuracy % at N = 10", "accuracy %, N = 10, chosen"),
            ("at N = 50", "accuracy %, N = 50, chosen"),
            ("time / better site", "time / better site, N = 50, chosen"),
        ),
        why="only the chosen site learns, so the times of the other one are those of a load that is over",
    ),
    Judged(
        7,
        "the error is 26, 14 and 4 % at N = 5, 10, 20 (cloud)",
        theirs="9, 2 and 1.5 % onboard",
        decided_by=r".* residual %, N = \d+, chosen",
        shown=(
            ("cloud % at N = 5", "cloud residual %, N = 5, .*"),
            ("onboard", "onboard residual %, N = 5, .*"),
        ),
        why="a site that is overestimated is not chosen, and its overestimate stays",
    ),
    Judged(
        8,
        "the error is below 2 % above N = 40",
        theirs="0.0 to 5.6 %",
        decided_by=r".* residual %, N = \d+, chosen",
        shown=(
            ("cloud % at N = 50", "cloud residual %, N = 50, chosen"),
            ("onboard", "onboard residual %, N = 50, chosen"),
        ),
        why="as at N = 5; the paper's own are above 3 % at N = 500 and with all data",
    ),
    Judged(
        9,
        "accuracy rises from 60 to 79 to 82 % at N = 5, 50, 500",
        theirs="60, 79, 82 %",
        decided_by=r"accuracy %, N = (5|50|500)|accuracy points, .*",
        shown=tuple((f"% at N = {n}", f"accuracy %, N = {n}") for n in (5, 50, 500)),
        why="with long windows it falls again where times bend or a load ends",
    ),
    Judged(
        10,
        "more than N = 50 brings little",
        theirs="3.1 points",
        decided_by="accuracy points, .*",
        shown=(("points", "accuracy points, .*"),),
        why="longer windows gain little, and sometimes lose",
    ),
    Judged(
        11,
        "83.3 % with all data",
        theirs="83.3 %",
        decided_by="accuracy %, N = full",
        shown=(("%", "accuracy %, N = full"),),
        why="it depends on how many tasks take about equally long on both sites",
    ),
    Judged(
        12,
        "more accurate than an LSTM",
        theirs="by 7.6 points",
        decided_by="ahead of lstm.*",
        shown=(("points", "ahead of lstm.*"),),
        why="an LSTM that stops training in time chooses as well; where times bend, better",
    ),
    Judged(
        13,
        "quicker to train and to predict than an LSTM",
        theirs="> 1",
        decided_by="(training|prediction), lstm.*",
        shown=(("training", "training, lstm.*"), ("prediction", "prediction, lstm.*")),
        why="sums are kept, and a line is read",
    ),
    Judged(
        14,
        "unreliable without correlation, sensitive to outliers",
        theirs="–",  # noqa: RUF001
        decided_by="(sizes shuffled|.* outliers): .*",
        shown=(
            ("points without it", "sizes shuffled: .*"),
            ("with outliers", ".* outliers: accuracy points"),
        ),
        why="a line through sizes that say nothing is noise, and one outlier turns it for N tasks",
    ),
)


@dataclass(frozen=True, slots=True)
class Verdict:
    """One line of the table: a claim of the paper, its figure and ours, and how many lines say what."""

    number: int = column("no.")
    claim: str = column("claim")
    theirs: str = column("theirs")
    ours: str = column("ours")
    verdict: str = column("verdict")
    lines: str = column("lines: yes, no, unclear")
    why: str = column("why, in the shipped datasets")
    note: str = ""


def verdicts(tables: Sequence[Table]) -> Table:
    """The verdicts over the tables of `loadgen claims`, one for each dataset."""
    found: list[Claim] = [line for table in tables for line in table.lines]
    sources = ", ".join(str(table.about["source"]) for table in tables)
    return Table(
        caption=f"The claims of the paper, judged by {sources}.",
        about={"source": sources},
        headings=headings_of(Verdict),
        lines=[_verdict(one, [line for line in found if line.number == one.number]) for one in JUDGED],
    )


def _verdict(judged: Judged, lines: Sequence[Claim]) -> Verdict:
    says = Counter(line.agrees for line in lines if re.fullmatch(judged.decided_by, line.claim))
    yes, no, unclear = (says[word] for word in (YES, NO, UNCLEAR))
    all_lines = yes + no + unclear
    return Verdict(
        number=judged.number,
        claim=judged.claim,
        theirs=judged.theirs,
        ours="; ".join(_ranges(judged, lines)) or UNDEFINED,
        verdict=_word(yes, no, all_lines),
        lines=f"{yes}, {no}, {unclear}",
        why=judged.why if all_lines else "",
    )


def _word(yes: int, no: int, all_lines: int) -> str:
    if not all_lines:
        return NOT_MEASURED
    return HOLDS if 2 * yes > all_lines else FAILS if no > yes else OPEN


def _ranges(judged: Judged, lines: Sequence[Claim]) -> Iterator[str]:
    for label, pattern in judged.shown:
        ours = [line.ours for line in lines if line.ours is not None and re.fullmatch(pattern, line.claim)]
        if ours:
            ends = dict.fromkeys(rounded(one, DIGITS) for one in (min(ours), max(ours)))
            yield f"{label} {' to '.join(ends)}"
