"""Variants: which function a site runs, what is refused when they are registered, what a hello compares."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import pytest

from offboard.common import tasks
from offboard.common.errors import ConfigError, UnknownTask
from offboard.common.source.comparison import difference
from offboard.common.task_states import TaskStates
from offboard.common.tasks import Kind, hashes, kind_named, kind_of, task
from offboard.common.variants import SITE_LENGTH_MAX
from offboard.robot_client.check.network import StepFailed
from offboard.robot_client.check.task_comparison import compare
from offboard.robot_client.sites.runner import CLOUD, ONBOARD
from tests.variant_tasks import grade, grade_roughly, only_there, sort_on_the_edge, sort_onboard, sort_out

EDGE, FOG = "edge", "fog"
GRADES = {"onboard": 0.8, "cloud": 1.0}


@dataclass(frozen=True)
class Mark:
    value: int


def small(number: int) -> int:
    return number


def large(number: int, /) -> int:
    return number


def scaled(number: int, scale: int = 2) -> int:
    return number * scale


def doubled(number: int, scale: int = 3) -> int:
    return number * scale


def with_model(model: str, number: int) -> int:
    return len(model) * number


def no_parameter() -> int:
    return 1


async def later(number: int) -> int:
    return number


HERE = {"onboard": small}


def register(
    function: Callable[..., Any] = small, *, variants: Any = None, quality: Any = None, **options: Any
) -> None:
    """Register a task that is refused, so that its name is free again."""
    task("never_registered", size=float, variants=variants, quality=quality, **options)(function)


def test_each_site_runs_its_variant() -> None:
    """Onboard and servers run the function of their name; a server without a variant runs that of `cloud`."""
    kind = kind_of(sort_out)
    assert [kind.at(site).function(7) for site in (ONBOARD, EDGE, CLOUD, FOG)] == [
        "onboard 7",
        "edge 7",
        "cloud 7",
        "cloud 7",
    ]
    assert [kind.at(site).quality for site in (ONBOARD, EDGE, CLOUD, FOG)] == [0.5, 0.75, 1.0, 1.0]
    assert sort_out(7) == "called 7"


def test_a_site_without_a_function_of_its_own_runs_the_decorated_one() -> None:
    """Here the cloud does, with its own setup."""
    kind, states = kind_of(grade), TaskStates(workers=1)
    assert kind.at(CLOUD).function is grade
    assert kind.at(ONBOARD).function is grade_roughly
    assert states.call(kind.at(ONBOARD), (1,))[:3] == ["small", "rough", 1]
    assert states.call(kind.at(CLOUD), (1,))[:3] == ["large", "fine", 1]
    assert kind.bind((), {"number": 3}) == (3,)


def test_a_kind_without_variants_is_its_own() -> None:
    """It is the same on every site, and nothing is lost."""
    kind = Kind("plain", small, float)
    assert kind.at(ONBOARD) is kind.at(EDGE) is kind
    assert kind.on_servers() == (kind,)
    assert kind.quality == 1.0


def test_servers_run_all_variants_but_that_of_onboard() -> None:
    """A request names the variant; neither the task itself nor what this computer lacks can be asked for."""
    assert [one.name for one in kind_of(sort_out).on_servers()] == ["sort_out@edge", "sort_out@cloud"]
    assert kind_named("sort_out@edge").function is sort_on_the_edge
    assert kind_of(only_there).on_servers() == ()
    for name in ("sort_out", "sort_out@onboard", "only_there@cloud", "sort_out@fog"):
        assert tasks.find_kind(name) is None
        with pytest.raises(UnknownTask, match=f"no task named '{name}'"):
            kind_named(name)


def test_a_hello_names_each_variant_of_servers() -> None:
    """The hash of the task covers what all variants have in common, that of a variant its source."""
    said, kind = hashes(), kind_of(sort_out)
    assert said["sort_out"] == kind.source_hash
    assert said["sort_out@edge"] == kind.at(EDGE).source_hash != said["sort_out@cloud"]
    assert not {"sort_out@onboard", "only_there@cloud"} & said.keys()
    # `only_there` and `sort_out` have the same parameters, and other functions.
    assert said["only_there"] == said["sort_out"]


CHANGED = "f" * 64
SHARED = (
    "the parameters, dataclasses, packing, version or covered functions of task sort_out differ on the server"
)


@pytest.mark.parametrize(
    ("function", "site", "change", "said"),
    [
        (sort_out, EDGE, {}, None),
        (sort_out, FOG, {}, None),
        (sort_out, FOG, {"sort_out@edge": CHANGED}, None),
        (
            sort_out,
            EDGE,
            {"sort_out@edge": CHANGED},
            "the source of sort_out@edge, a variant of task sort_out, differs on the server",
        ),
        (
            sort_out,
            EDGE,
            {"sort_out@edge": None},
            "the server does not have sort_out@edge, a variant of task sort_out",
        ),
        (
            sort_out,
            CLOUD,
            {"sort_out": CHANGED},
            SHARED,
        ),
        (
            sort_out,
            CLOUD,
            {"sort_out": CHANGED, "sort_out@edge": None, "sort_out@cloud": None},
            "task sort_out has no variants on the server",
        ),
        (sort_out, CLOUD, {"sort_out": None}, "the server has no task sort_out"),
        # The robot lacks this variant, so any source fits.
        (only_there, CLOUD, {"only_there@cloud": CHANGED}, None),
        (only_there, CLOUD, {}, "the server does not have only_there@cloud, a variant of task only_there"),
    ],
)
def test_a_difference_is_one_clear_line(
    function: Callable[..., Any], site: str, change: Mapping[str, str | None], said: str | None
) -> None:
    """Parameters are always compared, and the source of the variant of this site if both sides have it."""
    there = {name: hash for name, hash in (hashes() | change).items() if hash is not None}
    assert difference(kind_of(function), site, there) == said


def test_a_server_of_another_version_keeps_a_task_with_variants_onboard() -> None:
    """It knows the task as one function, with another hash. The same holds for a robot of another version."""
    plain = Kind("sort_out", sort_onboard, float, source_hash="a" * 64)
    assert difference(plain, CLOUD, hashes()) == "the source of task sort_out differs on the server"
    there = {"sort_out": "a" * 64}
    assert difference(kind_of(sort_out), CLOUD, there) == "task sort_out has no variants on the server"


def test_check_compares_the_variant_of_the_cloud() -> None:
    """`robot-client check` passes, or names the difference and a remedy."""
    kind = kind_of(sort_out)
    assert "the same on both sides: sort_out; not compared: " in compare([kind], hashes(), chosen=True)
    with pytest.raises(StepFailed, match=r"the source of sort_out@cloud, .* differs on the server; remedy: "):
        compare([kind], hashes() | {"sort_out@cloud": CHANGED}, chosen=True)
    with pytest.raises(StepFailed, match="the server has no task sort_out; it has none; remedy: "):
        compare([kind], {"sort_in@cloud": CHANGED}, chosen=True)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"variants": HERE}, "quality= is None; a task with variants needs variants= and quality="),
        ({"quality": GRADES}, "variants= is None; a task with variants needs variants= and quality="),
        ({"variants": {}, "quality": GRADES}, "variants= is {}; a task with variants needs"),
        ({"variants": HERE, "quality": 0.8}, "quality= is 0.8; a task with variants needs"),
        ({"variants": [small], "quality": GRADES}, r"variants= is \[.*; a task with variants needs"),
        (
            {"variants": {"onbord": small}, "quality": GRADES},
            "quality= has no 'onbord'; it needs onboard, cloud and each site of variants=",
        ),
        ({"variants": {"onboard": small}, "quality": {"onboard": 0.8}}, "quality= has no 'cloud'"),
        (
            {"variants": {"onboard": small}, "quality": GRADES | {"edge": 0.9}},
            "quality= names 'edge', which has no variant in variants=",
        ),
        (
            {"variants": {"onboard": small, 7: small}, "quality": GRADES | {7: 0.9}},
            f"quality= names 7, which is not the name of a site, 1 to {SITE_LENGTH_MAX} characters",
        ),
        ({"variants": HERE, "quality": GRADES | {"cloud": 1.1}}, "quality of 'cloud' is 1.1; it must be"),
        ({"variants": HERE, "quality": GRADES | {"cloud": -1}}, "quality of 'cloud' is -1; it must be"),
        ({"variants": HERE, "quality": GRADES | {"cloud": math.nan}}, "is nan; it must be a number 0 to 1"),
        ({"variants": HERE, "quality": GRADES | {"cloud": True}}, "quality of 'cloud' is True; it must be"),
        ({"variants": HERE, "quality": GRADES | {"cloud": "1"}}, "quality of 'cloud' is '1'; it must be"),
        ({"variants": {"onboard": 3}, "quality": GRADES}, "variants= has 3 for 'onboard', no function"),
        (
            {"variants": {"onboard": scaled}, "quality": GRADES},
            r"the variant of 'onboard', scaled, takes \(number, scale=2\), but the task takes \(number\)",
        ),
        ({"variants": {"cloud": large}, "quality": GRADES}, r"large, takes \(number, /\), but the task"),
        ({"variants": {"onboard": later}, "quality": GRADES}, "variant later is a coroutine or generator"),
        ({"variants": {"onboard": max}, "quality": GRADES}, "the variant of 'onboard' has no signature"),
        (
            {"variants": {"onboard": small}, "quality": GRADES, "work": float},
            "work= cannot be used with variants=, which may do different work",
        ),
        ({"setup": {"onboard": no_parameter, "cloud": no_parameter}}, "setup= by site needs variants="),
    ],
)
def test_what_does_not_fit_together_is_refused(options: dict[str, Any], said: str) -> None:
    """One line names the task, the option and what is allowed; nothing is registered."""
    with pytest.raises(ConfigError, match=f"^task never_registered: .*{said}") as caught:
        register(**options)
    assert "\n" not in str(caught.value)
    assert not any(name.startswith("never_registered") for name in hashes())


def test_defaults_belong_to_the_parameters() -> None:
    """The robot fills in the defaults of the decorated function, so another default would never be used."""
    said = r"takes \(number, scale=3\), but the task takes \(number, scale=2\)"
    with pytest.raises(ConfigError, match=said):
        register(scaled, variants={"onboard": doubled}, quality=GRADES)


@pytest.mark.parametrize(
    ("variant", "setup", "said"),
    [
        (with_model, {"onboard": no_parameter}, "must have one function for each of onboard, cloud"),
        (with_model, {"onboard": no_parameter, "cloud": None}, "setup= by site must have one function for"),
        (no_parameter, no_parameter, "setup= needs a function whose first parameter takes its result"),
        (small, no_parameter, r"small, takes \(\), but the task takes \(number\)"),
    ],
)
def test_every_variant_takes_what_its_setup_made(variant: Callable[..., Any], setup: Any, said: str) -> None:
    """With a setup, the first parameter of each function is for its result."""
    with pytest.raises(ConfigError, match=f"^task never_registered: .*{said}"):
        register(with_model, variants={"onboard": variant}, quality=GRADES, setup=setup)


def test_the_name_of_a_variant_fits_into_a_message() -> None:
    """The names of task and site together have a limit."""
    with pytest.raises(ConfigError, match=r"'x{60}@onboard' has over 64 characters"):
        task("x" * 60, size=float, variants={"onboard": small}, quality=GRADES)(small)


def test_each_variant_counts_as_a_task(monkeypatch: pytest.MonkeyPatch) -> None:
    """All names of a process fit into one `hello`; a task that is registered again counts once."""
    count = sum(1 + len(kind.variants) for kind in tasks.kinds())
    monkeypatch.setattr(tasks, "KINDS_MAX", count + 2)
    said = f"has at most {count + 2} tasks, and each variant counts as one more"
    with pytest.raises(ConfigError, match=said):
        register(small, variants=HERE, quality=GRADES)
    for _ in range(2):
        task("counted_once", size=float)(small)
        task("counted_too", size=float)(large)


def test_dataclasses_are_common_to_all_variants() -> None:
    """They are part of what is always compared."""
    kinds = []
    for name, types in (("marked", (Mark,)), ("unmarked", ())):
        task(name, size=float, variants={"onboard": small}, quality=GRADES, types=types)(small)
        kinds.append(tasks._kinds[name])
    assert kinds[0].source_hash != kinds[1].source_hash
    assert kinds[0].at(CLOUD).types == (Mark,)


def test_a_variant_that_is_not_here_says_so() -> None:
    """If it runs after all, as onboard, the error names what is missing."""
    kind = kind_of(only_there).at(CLOUD)
    assert not kind.present
    with pytest.raises(UnknownTask, match="this computer does not have the function of this variant"):
        kind.function(1)


def test_a_module_that_is_loaded_again_keeps_its_variants() -> None:
    """Other source of a variant under the same name is refused, as for a task without variants."""

    def again(variant: Callable[..., Any]) -> None:
        task("loaded_again", size=float, variants={"onboard": variant}, quality=GRADES)(small)

    again(sort_onboard)
    again(sort_onboard)
    with pytest.raises(ConfigError, match="task loaded_again is registered twice, with different source"):
        again(sort_on_the_edge)
