"""Finds measured figures that stand in a page without their commit.

Figures belong to docs/figures and to the blocks that `make figures` fills. Elsewhere a paragraph with a
measured figure must name its commit, or link to the results page or a page of figures. Settings, limits and
examples are no measured figures; the patterns below tell them apart by the words around a number.
"""

import re
from collections.abc import Iterator
from pathlib import Path

from benchmarks.figures.page import BLOCK

ROOT = Path(__file__).parents[1]
NUMBER = r"\d[\d,]*(?:\.\d+)?"
UNIT = r"(?:ms|s|us|microseconds|milliseconds|seconds|minutes|%|points|instructions|kB|MB|MiB|GB)"
AS_MUCH = "as (?:long|much|many|fast)|longer|faster|slower|less|more|fewer|shorter"
ABOUT = "(?:about |at most |only |up to )?"
MEASURED = re.compile(
    "|".join(
        [
            # 7 % longer, 1.8 times as many: whole numbers of times are settings too
            rf"{NUMBER} ?% (?:{AS_MUCH})|\d+\.\d+ times (?:{AS_MUCH}|the |that )",
            # took 12 ms, used 250 MiB, takes about 0.7 ms: "takes 30 ms" may be a setting
            rf"\b(?:took|used|cost|needed) {ABOUT}{NUMBER} ?{UNIT}(?![\w/])",
            rf"\b(?:takes?|adds?|needs?|uses?|costs?) {ABOUT}\d+\.\d+ ?{UNIT}(?![\w/])",
            # 90 ms instead of 520 ms, 12 / 59 / 481 ms, 0.7 [0.6, 0.8], 24 % less (17 to 30 %)
            rf"{NUMBER} ?{UNIT} instead of {NUMBER}",
            rf"{NUMBER} / {NUMBER} / {NUMBER}",
            rf"{NUMBER}(?: ?%)? [\[(]-?{NUMBER}(?:,| to) -?{NUMBER}",
            # P99 87 ms; the mean was 21 ms; the correlation is 0.98
            rf"\b(?:P9[59]|mean|median|correlation) (?:of |is |was |are |were )?{ABOUT}\d+\.\d+",
            rf"\b(?:P9[59]|mean|median) (?:of |is |was |are |were )?{ABOUT}{NUMBER} ?{UNIT}(?![\w/])",
        ]
    )
)
CELL = re.compile(rf"[-+]?{NUMBER} ?(?:{UNIT}|times)?")
CELLS = 2  # a table holds figures if a row has two cells with numbers, one of them with a fraction
COMMIT = re.compile(r"\b(?=[0-9a-f]*\d)(?=[0-9a-f]*[a-f])[0-9a-f]{7,12}\b")
FIGURES = re.compile(r"\]\((?:docs/)?(?:results|figures/\w+)\.md")
# What is printed there is no measurement of ours: the published table, and an example worked out by hand.
ALLOWED = {"docs/evaluation.md": ("The paper's own table", "Twelve rows by hand")}


def pages() -> list[Path]:
    """The pages for users; those of docs/figures are generated as a whole."""
    return sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), ROOT / "loadgen/datasets/README.md"])


def loose_figures(text: str, allowed: tuple[str, ...] = ()) -> Iterator[str]:
    """The paragraphs and tables of a page that hold a measured figure without its commit."""
    text = BLOCK.sub("", re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE))
    for section in re.split(r"^(?=##? )", text, flags=re.MULTILINE):
        if not section.startswith(tuple(f"## {title}\n" for title in allowed)):
            for paragraph in re.split(r"\n\s*\n|\n(?=- |#)", section):
                if not named(paragraph) and (MEASURED.search(paragraph) or is_figures(paragraph)):
                    yield paragraph.strip()


def named(paragraph: str) -> bool:
    """Whether a paragraph says where its figures come from."""
    return bool(FIGURES.search(paragraph) or COMMIT.search(paragraph))


def is_figures(paragraph: str) -> bool:
    """Whether a paragraph is a table of figures."""
    for line in paragraph.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")] if line.startswith("|") else []
        numbers = [cell for cell in cells if CELL.fullmatch(cell)]
        if len(numbers) >= CELLS and any("." in cell for cell in numbers):
            return True
    return False


if __name__ == "__main__":
    for page in pages():
        name = page.relative_to(ROOT).as_posix()
        for figure in loose_figures(page.read_text(), ALLOWED.get(name, ())):
            print(f"{name}: {figure[:300]!r}")
