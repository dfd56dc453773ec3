"""Finding the cgroup with the CPU quota of a process, and reading its usage file."""

from pathlib import Path

import pytest

from offboard.common.cpu_time import parse_usage, usage_file
from tests.cgroups import Machine

DOCKER = "/docker/48d9"


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


def test_version_2_counts_the_group_with_the_quota(machine: Machine) -> None:
    """If the process's own group has a quota, its usage file is the one to read."""
    point = machine.mount("", "cgroup2")
    machine.process("", "/user.slice/robot")
    machine.write(point / "user.slice", cpu_max="max 100000\n")
    own = machine.write(point / "user.slice/robot", cpu_max="20000 100000\n")
    assert usage_file(machine.proc) == own / "cpu.stat"


def test_a_group_without_a_quota_is_not_counted(machine: Machine) -> None:
    """If no group around the process has a quota, there is no usage file."""
    point = machine.mount("", "cgroup2")
    machine.process("", "/user.slice/session")
    machine.write(point / "user.slice", cpu_max="max 100000\n")
    machine.write(point / "user.slice/session", cpu_max="max 100000\n")
    assert usage_file(machine.proc) is None


def test_the_quota_of_an_outer_group_counts(machine: Machine) -> None:
    """If only outer groups have quotas, the innermost of them is counted."""
    point = machine.mount("", "cgroup2")
    machine.process("", "/pod/container/init")
    machine.write(point / "pod", cpu_max="90000 100000\n")
    limited = machine.write(point / "pod/container", cpu_max="2000 10000\n")
    machine.write(point / "pod/container/init", cpu_max="max 10000\n")
    assert usage_file(machine.proc) == limited / "cpu.stat"


@pytest.mark.parametrize("path", [DOCKER, "/"], ids=["path on the host", "path in the namespace"])
def test_in_a_container_the_group_is_the_mount(machine: Machine, path: str) -> None:
    """The mount shows the container's group, even if /proc/self/cgroup names a path on the host."""
    machine.process("cpuacct", path)
    machine.process("cpu", path)
    machine.process("name=systemd", path)
    machine.process("", path)
    machine.mount("unified", "cgroup2", root=path)
    limited = machine.mount("cpu", "cgroup", "rw,cpu", root=path)
    counted = machine.mount("cpuacct", "cgroup", "rw,cpuacct", root=path)
    machine.write(limited, cpu_cfs_quota_us="2000\n")
    assert usage_file(machine.proc) == counted / "cpuacct.usage"
    machine.write(limited, cpu_cfs_quota_us="-1\n")
    assert usage_file(machine.proc) is None


def test_version_1_with_both_controllers_in_one_hierarchy(machine: Machine) -> None:
    """In a hierarchy `cpu,cpuacct`, quota and usage are in the same folder."""
    point = machine.mount("cpu,cpuacct", "cgroup", "rw,cpu,cpuacct")
    machine.process("cpu,cpuacct", "/offboard-1-2")
    group = machine.write(point / "offboard-1-2", cpu_cfs_quota_us="2000\n")
    machine.write(point, cpu_cfs_quota_us="-1\n")
    assert usage_file(machine.proc) == group / "cpuacct.usage"


def test_version_1_with_a_quota_but_no_usage_of_that_group(machine: Machine) -> None:
    """If quota and usage have different paths, the usage is of other processes and is not read."""
    limited = machine.mount("cpu", "cgroup", "rw,cpu")
    machine.mount("cpuacct", "cgroup", "rw,cpuacct")
    machine.process("cpuacct", "/")
    machine.process("cpu", "/offboard-1-2")
    machine.write(limited / "offboard-1-2", cpu_cfs_quota_us="2000\n")
    assert usage_file(machine.proc) is None


@pytest.mark.parametrize("text", ["", "nonsense\n", "0::/elsewhere\n"])
def test_an_unreadable_proc_folder_means_no_group(machine: Machine, text: str) -> None:
    """If /proc shows no cgroups, or shows them in another form, there is no usage file."""
    machine.write(machine.mount("", "cgroup2", root="/docker"), cpu_max="2000 10000\n")
    assert usage_file(machine.proc) is None
    (machine.proc / "cgroup").write_text(text)
    assert usage_file(machine.proc) is None


def test_the_usage_files_of_both_versions_are_read() -> None:
    """Version 2 counts microseconds, version 1 nanoseconds; anything else is a ValueError."""
    assert parse_usage(b"usage_usec 1500000\nuser_usec 1\nsystem_usec 2\n") == 1.5
    assert parse_usage(b"2500000000\n") == 2.5
    for text in (b"", b"user_usec 5\n", b"usage_usec\n", b"usage_usec "):
        with pytest.raises(ValueError, match="invalid literal"):
            parse_usage(text)
