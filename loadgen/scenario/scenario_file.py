"""Scenario files: finds a scenario by name or path, reads the TOML file and checks every value in it.

What the values mean is in `scenario`.
"""

import re
from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from offboard.common.config import from_table
from offboard.common.errors import ConfigError, DataError, MissingExtra, OffloadError
from offboard.common.toml_file import line_of, read_toml, unknown, unknown_key
from offboard.loadgen.relay.link.link_settings import LinkFlags
from offboard.loadgen.robot.config import STREAM_TASK, Streaming
from offboard.loadgen.scenario.event_timeline import ON, parse_events
from offboard.loadgen.scenario.pass_fail_check import parse_checks
from offboard.loadgen.scenario.random_faults import Chaos
from offboard.loadgen.scenario.scenario import CloudPart, RobotPart, Scenario, Workload, parts_of
from offboard.robot_client.sites.runner import ONBOARD

_HERE = Path(__file__).resolve().parents[1]  # in a checkout, not by the link in offboard/
SHIPPED = _HERE / "scenarios"
LINKS = _HERE / "links"  # recordings, and the scenarios that are played over them
NAME = r"[A-Za-z0-9][A-Za-z0-9_-]*"
WORKLOAD_FLAG = re.compile(rf"--({'|'.join(f.name.replace('_', '-') for f in fields(Workload))})\b")
LINK_KEYS = tuple(f.name for f in fields(LinkFlags))
STREAM, STREAM_PREFIX = "stream", "stream_"
FILES = ("samples", "recording")  # ends of the names of link conditions that are files


def read_scenario(path: Path) -> Scenario:
    """The scenario in a TOML file; DataError names the file and the wrong key."""
    table = read_toml(path)
    keys = {"events": "event", "checks": "check", "servers": "cloud"}
    known = [keys.get(f.name, f.name) for f in fields(Scenario)]
    for key in table:
        if key not in known:
            raise unknown_key(path, key, known)
    name, seed = table.get("name"), table.get("seed", 1)
    if not isinstance(name, str) or not re.fullmatch(NAME, name):
        wrong = (
            f"name = {name!r} may contain only letters, digits, _ and -, and starts with a letter or digit"
        )
        raise DataError(f"{path}: {wrong}" if name else f"{path}: name is missing")
    if type(seed) is not int or seed < 0:
        raise DataError(f"{path}: seed = {seed!r} is not a whole number of at least 0")
    workload = _workload(_table(table, "workload", path), path)
    link, servers = _recorded_on(_table(table, "link", path), _servers(table, path), path)
    links = {one.name: from_table(LinkFlags, {**link, **one.link}, path, "link").link for one in servers}
    found: dict[str, Any] = {
        "name": name,
        "seed": seed,
        "workload": workload,
        "about": str(table.get("about", "")).strip(),
        "robot": from_table(RobotPart, _table(table, "robot", path), path, "robot"),
        "servers": servers,
        "link": link,
        "events": parse_events(table, path, parts=parts_of(list(links), workload), links=links),
        "checks": parse_checks(
            table,
            path,
            tasks=workload.tasks,
            known=workload.known(),
            sites=(ONBOARD, *(one.site for one in servers)),
        ),
        "chaos": _chaos(table, workload, path),
    }
    try:
        return Scenario(**found)
    except ConfigError as error:
        raise DataError(f"{path}: {error}") from None


def check_calls(scenario: Scenario, path: Path) -> None:
    """Import the task that a scenario calls, and make its first arguments; DataError names file and line."""
    if scenario.workload.task is None:
        return
    from offboard.loadgen.robot.work import make_work  # --help does not need it

    try:
        make_work(scenario.workload.robot(scenario.seed))
    except MissingExtra:
        raise
    except OffloadError as error:
        raise _workload_error(error, path) from error


def find_scenario(name: str) -> Path:
    """The path of a scenario: `name` is a file, or the name of a shipped scenario."""
    for path in (Path(name), SHIPPED / f"{name}.toml", LINKS / f"{name}.toml"):
        if path.is_file():
            return path
    if name.endswith(".toml"):
        raise DataError(f"{name}: no such file")
    raise DataError(unknown("scenario", name, known_names()))


def known_names() -> tuple[str, ...]:
    return (*shipped(), *shipped(LINKS))


def shipped(folder: Path = SHIPPED) -> tuple[str, ...]:
    """The names of the scenarios that come with Offboard, or of those in LINKS."""
    return tuple(sorted(path.stem for path in folder.glob("*.toml")))


def _table(table: Mapping[str, Any], section: str, path: Path) -> Mapping[str, Any]:
    found = table.get(section, {})
    if not isinstance(found, dict):
        raise DataError(f"{path}: {section} is not a table")
    return found


def _workload(table: Mapping[str, Any], path: Path) -> Workload:
    try:
        workload = from_table(Workload, _streaming(table, path), path, "workload")
    except DataError as error:
        raise DataError(str(error).replace(f".{STREAM_PREFIX}", f".{STREAM}.")) from error
    try:
        workload.robot(seed=0)
    except ConfigError as error:
        raise _workload_error(error, path) from None
    workload = replace(workload, sizes=_sizes(workload.sizes, path))
    if workload.map is None:
        return workload
    place = (path.parent / workload.map).resolve()
    if not place.is_file():
        raise DataError(f"{path}: workload.map: {place}: no such file")
    return replace(workload, map=place)


def _streaming(table: Mapping[str, Any], path: Path) -> Mapping[str, Any]:
    """The keys of `[workload.stream]` under the names of their settings, and its policy if none is named."""
    if STREAM not in table:
        return table
    stream = _table(table, STREAM, path)
    known = [f.name.removeprefix(STREAM_PREFIX) for f in fields(Streaming)]
    for key in stream:
        if key not in known:
            raise unknown_key(path, key, known)
    if "hz" not in stream:
        raise DataError(f"{path}: workload.stream.hz is missing")
    named = {f"{STREAM_PREFIX}{key}": value for key, value in stream.items()}
    return {"task": STREAM_TASK, **{key: one for key, one in table.items() if key != STREAM}, **named}


def _workload_error(error: OffloadError, path: Path) -> DataError:
    """An error about flags of the robot, as one about the keys of the scenario that they come from."""
    keys = [flag.replace("-", "_") for flag in WORKLOAD_FLAG.findall(str(error))]
    if not keys:
        return DataError(f"{path}: workload: {error}")
    text = WORKLOAD_FLAG.sub(lambda flag: _key_of(flag[1].replace("-", "_")), str(error))
    table, _, key = _key_of(keys[0]).rpartition(".")
    line = line_of(path.read_text().splitlines(), table, 1, key)
    return DataError(f"{path}:{line}: {text}")


def _key_of(name: str) -> str:
    """The key of a setting of the workload, with its table."""
    if name.startswith(STREAM_PREFIX):
        return f"workload.{STREAM}.{name.removeprefix(STREAM_PREFIX)}"
    return f"workload.{name}"


def _sizes(texts: tuple[str, ...], path: Path) -> tuple[str, ...]:
    """The sizes, with the full path if they come from a file. Such a file cannot be combined with others."""
    files = [text for text in texts if text.endswith(".csv")]
    if not files:
        return texts
    place = (path.parent / files[0]).resolve()
    if len(texts) > 1 or not place.is_file():
        wrong = (
            "no such file" if len(texts) == 1 else "a file gives the sizes of all tasks; remove the others"
        )
        raise DataError(f"{path}: workload.sizes: {files[0]}: {wrong}")
    return (str(place),)


def _servers(table: Mapping[str, Any], path: Path) -> tuple[CloudPart, ...]:
    """The server in [cloud], or the servers in [[cloud]]; each of these may have a table `link`."""
    given = table.get("cloud", {})
    if not isinstance(given, list):
        return (from_table(CloudPart, _table(table, "cloud", path), path, "cloud"),)
    found = []
    for number, one in enumerate(given, 1):
        if not isinstance(one, dict):
            raise DataError(f"{path}: cloud is not a table, nor a list of tables, each under [[cloud]]")
        own = {key: value for key, value in one.items() if key != "link"}
        part = from_table(CloudPart, own, path, f"cloud {number}")
        found.append(replace(part, link=_link(_table(one, "link", path), path)))
    return tuple(found)


def _chaos(table: Mapping[str, Any], workload: Workload, path: Path) -> Chaos | None:
    if "chaos" not in table:
        return None
    if workload.rate is None:
        raise DataError(
            f"{path}: chaos: random faults come by the clock; workload.arrivals must not be closed"
        )
    return from_table(Chaos, _table(table, "chaos", path), path, "chaos")


def _recorded_on(
    table: Mapping[str, Any], servers: tuple[CloudPart, ...], path: Path
) -> tuple[Mapping[str, Any], tuple[CloudPart, ...]]:
    """The link of all servers, and the servers; with `on`, that server alone plays the recording."""
    link = _link({key: value for key, value in table.items() if key != ON}, path)
    if ON not in table:
        return link, servers
    names = [server.name for server in servers]
    if table[ON] not in names:
        raise DataError(f"{path}: link.on: {table[ON]!r} is not one of {', '.join(names)}")
    own = {key: value for key, value in link.items() if "recording" in key}
    if not own:
        raise DataError(f"{path}: link.on: {table[ON]!r} needs link.recording")
    others = {key: value for key, value in link.items() if key not in own}
    return others, tuple(
        replace(one, link={**own, **one.link}) if one.name == table[ON] else one for one in servers
    )


def _link(table: Mapping[str, Any], path: Path) -> Mapping[str, Any]:
    for key in table:
        if key not in LINK_KEYS:
            raise unknown_key(path, key, LINK_KEYS)
    table = {
        key: (path.parent / str(value)).resolve() if key.endswith(FILES) else value
        for key, value in table.items()
    }
    from_table(LinkFlags, table, path, "link")
    return table
