"""The units of deploy/systemd under a real systemd, installed by the commands of docs/deployment.md."""

import json
import os
import re
import subprocess
from collections.abc import Callable, Iterator

import pytest

from tests.compose.conftest import ROOT, docker
from tests.prometheus import until

pytestmark = [pytest.mark.compose, pytest.mark.timeout(600)]

STARTED = {"running", "degraded"}  # degraded: a unit that is not ours failed
NAME, IMAGE = "offboard-test-systemd", "offboard-systemd"
# /opt/offboard of the server's image has all that the two units start.
DOCKERFILE = """
FROM offboard-cloud AS cloud
FROM python:3.13-slim
RUN apt-get update -qq && apt-get install -qq --no-install-recommends systemd > /dev/null
COPY --from=cloud /opt/offboard /opt/offboard
COPY deploy/systemd /src/deploy/systemd
COPY --chmod=755 maps /opt/offboard/robot
WORKDIR /src
STOPSIGNAL SIGRTMIN+3
CMD ["/lib/systemd/systemd"]
"""
# systemd mounts and makes namespaces; the profile of Docker forbids both.
RIGHTS = (
    "--cap-add",
    "SYS_ADMIN",
    "--security-opt",
    "seccomp=unconfined",
    "--security-opt",
    "apparmor=unconfined",
)
PROGRAM = """
import json, time
from offboard import Offloader
from offboard.common.planning.map_files import read_map
from offboard.common.planning.planner import Point, Pose, plan_path
from offboard.robot_client.settings import Settings

grid, home = read_map("willow-full-0.05.yaml"), "/var/lib/offboard"
settings = Settings(memory=f"{home}/memory.json")
more = {"timeout_s": 60, "keys": f"{home}/robot-keys", "settings": settings}
with Offloader.connect("tcp://127.0.0.1:5555", policy="cloud", **more) as offload:
    missing = offload.wait_for_sites(plan_path, 30)
    plan = offload(plan_path, grid, None, Pose(29.18, 3.32), Point(47.03, 40.78), 0.15)
    print(json.dumps({"missing": missing, "used": offload.last.used, "status": plan.status}))
    time.sleep(600)
"""
# A task that shows whether its worker was left alone, and a robot that calls it.
TASK = """
import time
from offboard import task

@task("nap", size=lambda seconds: seconds)
def nap(seconds: float) -> float:
    time.sleep(seconds)
    return seconds
"""
SLEEPER = """
import json
from naps import nap
from offboard import Offloader

keys = "/var/lib/offboard/robot-keys"
with Offloader.connect("tcp://127.0.0.1:5555", policy="cloud", timeout_s=60, keys=keys) as offload:
    assert offload.wait_for_sites(nap, 30) == {}
    offload(nap, 6.0)
    print(json.dumps({"used": offload.last.used}))
"""
RUNNING = """
import json, urllib.request as u
token = open("/var/lib/offboard/token").read().strip()
asked = u.Request("http://127.0.0.1:8000/health", headers={"Authorization": "Bearer " + token})
print(json.load(u.urlopen(asked, timeout=2))["running"])
"""


@pytest.fixture(scope="module")
def run(engine: None) -> Iterator[Callable[..., str]]:  # noqa: ARG001 - skips without an engine
    """Runs a shell script as root in a container whose first process is systemd; returns what it prints."""
    docker("build", "--target", "cloud", "--tag", "offboard-cloud", ".")
    built = subprocess.run(
        ["docker", "build", "--tag", IMAGE, "--file", "-", "."],
        cwd=ROOT, input=DOCKERFILE, capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    assert built.returncode == 0, built.stderr
    docker("rm", "--force", NAME)  # of a run that was killed
    docker("run", "--detach", "--name", NAME, "--cgroupns", "private", "--tmpfs", "/run", *RIGHTS, IMAGE)

    def script(text: str, check: bool = True) -> str:
        command = ["docker", "exec", "--interactive", NAME, "sh", "-eu"]
        done = subprocess.run(command, input=text, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0 or not check, f"{text}\n{done.stdout}{done.stderr}"
        return done.stdout.strip()

    try:
        try:
            until(lambda: script("systemctl is-system-running", check=False) in STARTED, "systemd runs")
        except AssertionError:
            if os.environ.get("CI") == "true":
                raise
            said = script("systemctl is-system-running", check=False) or "nothing"
            pytest.skip(f"systemd does not start in a container of this machine: it says {said}")
        yield script
    finally:
        docker("rm", "--force", "--volumes", NAME)


def test_the_server_starts_as_the_page_says(run: Callable[..., str]) -> None:
    """The commands of the page install and start the server, and it becomes ready with all restrictions."""
    run(commands("A server"))
    until(lambda: ready(run), "the server is ready")
    status = run("cat /proc/$(systemctl show --value -p MainPID offboard-cloud)/status")
    found = dict(re.findall(r"^(\w+):\s*(.*)$", status, re.MULTILINE))
    assert (found["NoNewPrivs"], found["Seccomp"], int(found["CapEff"], 16)) == ("1", "2", 0)
    assert found["Uid"].split() == [run("id -u offboard")] * 4


def test_a_robot_program_plans_on_the_server_and_saves_its_memory(run: Callable[..., str]) -> None:
    """A program in the robot's unit gets its plan from the server, and saves what it learnt at its stop."""
    run(commands("A robot"))
    exchange = "cp keys/server.key robot-keys/ && cp robot-keys/robot.key keys/robots/arm-1.key"
    run(f"cd /var/lib/offboard && {exchange} && chown -R offboard: .")
    run(f"cat > /opt/offboard/robot/patrol.py <<'END'\n{PROGRAM}END")
    run("systemctl start offboard-robot@patrol")
    said = "journalctl --quiet --output cat --unit offboard-robot@patrol --grep missing"
    until(lambda: run(said, check=False) != "", "the program has its plan")
    assert json.loads(run(said)) == {"missing": {}, "used": "cloud", "status": "NONE"}
    run("systemctl stop offboard-robot@patrol; test -s /var/lib/offboard/memory.json")
    assert run("systemctl show --value -p Result offboard-robot@patrol") == "success"


def test_a_server_that_is_killed_starts_again(run: Callable[..., str]) -> None:
    """After SIGKILL systemd starts the server again, and it becomes ready."""
    run("systemctl kill --signal=KILL offboard-cloud")
    until(lambda: run("systemctl show --value -p NRestarts offboard-cloud") == "1", "it starts again")
    until(lambda: ready(run), "the server is ready")


def test_wrong_settings_are_not_tried_again(run: Callable[..., str]) -> None:
    """A server whose settings are wrong ends with exit code 2, and systemd leaves it."""
    run("mkdir -p /etc/offboard; echo CLOUD_QUEUE_MAX=none > /etc/offboard/cloud.env")
    run("systemctl restart offboard-cloud")
    until(lambda: run("systemctl is-failed offboard-cloud", check=False) == "failed", "it failed")
    assert shown(run, "ExecMainStatus", "NRestarts") == {"ExecMainStatus": "2", "NRestarts": "0"}


def test_stopping_drains_the_server(run: Callable[..., str]) -> None:
    """`systemctl stop` lets a worker process finish its task, and the robot gets the answer."""
    run(f"cd /opt/offboard/robot; cat > naps.py <<'END'\n{TASK}END\ncp naps.py /var/lib/offboard")
    run(f"cat > /opt/offboard/robot/sleeper.py <<'END'\n{SLEEPER}END")
    run("printf 'CLOUD_EXECUTOR=processes\nCLOUD_TASKS=naps\n' > /etc/offboard/cloud.env")
    run("systemctl restart offboard-cloud")
    until(lambda: ready(run), "the server is ready")
    run("systemctl start offboard-robot@sleeper")
    until(lambda: running(run), "the task runs")
    run("systemctl stop offboard-cloud")
    assert shown(run, "Result", "ExecMainStatus") == {"Result": "success", "ExecMainStatus": "0"}
    assert "every accepted request was answered" in run("journalctl --unit offboard-cloud --lines 20")
    said = "journalctl --quiet --output cat --unit offboard-robot@sleeper --grep used"
    until(lambda: run(said, check=False) != "", "the robot has its answer")
    assert json.loads(run(said)) == {"used": "cloud"}


def running(run: Callable[..., str]) -> bool:
    """True while the server runs a task."""
    return run(f"python3 -c '{RUNNING}'", check=False) == "1"


def commands(heading: str) -> str:
    """The block of commands below a heading of docs/deployment.md."""
    page = (ROOT / "docs" / "deployment.md").read_text()
    found = re.search(rf"^### {heading}\n.*?^```sh\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    assert found is not None, heading
    return found[1]


def shown(run: Callable[..., str], *properties: str) -> dict[str, str]:
    """Properties of the server's unit."""
    lines = run(f"systemctl show -p {','.join(properties)} offboard-cloud").splitlines()
    return dict(line.split("=", 1) for line in lines)


def ready(run: Callable[..., str]) -> bool:
    ask = "import urllib.request as u; print(u.urlopen('http://127.0.0.1:8000/ready', timeout=2).status)"
    return run(f'python3 -c "{ask}" 2>/dev/null', check=False) == "200"
