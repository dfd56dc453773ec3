"""deploy/kubernetes and deploy/systemd: valid, and in agreement with the server that they start."""

import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from offboard.cloud_server.config import ServerConfig
from offboard.cloud_server.http_api import STOP_S
from offboard.cloud_server.server import SEND_LAST_S
from tests.manifests import FOLDER, RESOURCES, Pod, resource

ROOT = Path(__file__).parents[2]
UNITS = ROOT / "deploy" / "systemd"
SERVICES = ("offboard-cloud.service", "offboard-robot@.service")
PROGRAMS = "/opt/offboard/bin"
CLOSING_S = 2 * STOP_S + SEND_LAST_S  # of a server, after the drain time
OLDEST, NEWEST = "1.25", "1.37"  # releases of Kubernetes
EXPOSURE_MAX = {"offboard-cloud.service": 20, "offboard-robot@.service": 40}  # tenths, as systemd counts


@pytest.mark.parametrize("version", [OLDEST, NEWEST])
@pytest.mark.parametrize("name", RESOURCES)
def test_manifests_are_valid(name: str, version: str) -> None:
    """The strict schemas of an old and a new release of Kubernetes accept each manifest."""
    kubernetes_validate = pytest.importorskip("kubernetes_validate")
    assert kubernetes_validate.validate(resource(name), version, strict=True) == version


def test_a_misspelt_field_is_not_valid() -> None:
    """The validator refuses a field that Kubernetes does not know."""
    kubernetes_validate = pytest.importorskip("kubernetes_validate")
    deployment = resource("deployment.yaml")
    (container,) = deployment["spec"]["template"]["spec"]["containers"]
    container["readynessProbe"] = container.pop("readinessProbe")
    with pytest.raises(kubernetes_validate.ValidationError, match="readynessProbe"):
        kubernetes_validate.validate(deployment, NEWEST, strict=True)


def test_manifests_agree() -> None:
    """Service and budget select the pods of the Deployment, and ports have the names that are used."""
    deployment, service, budget = (resource(name) for name in RESOURCES)
    labels = deployment["spec"]["template"]["metadata"]["labels"]
    assert deployment["spec"]["selector"]["matchLabels"] == labels
    assert service["spec"]["selector"] == labels
    assert budget["spec"]["selector"]["matchLabels"] == labels
    assert service["spec"]["clusterIP"] == "None", "an address would not balance ZMQ connections"
    server = Pod.read().server
    ports = {port["name"]: port["containerPort"] for port in server["ports"]}
    assert {port["targetPort"]: port["port"] for port in service["spec"]["ports"]} == ports
    probes = [server[name]["httpGet"]["port"] for name in ("startupProbe", "readinessProbe", "livenessProbe")]
    assert set(probes) <= set(ports)


def test_the_server_accepts_the_settings_of_the_pod() -> None:
    """The arguments and variables of the pod are settings of the server, and fit ports and limits."""
    pod = Pod.read()
    config = server_config(pod.environment(pod.server), pod.server["args"])
    ports = [port["containerPort"] for port in pod.server["ports"]]
    assert [int(config.listen.rpartition(":")[2]), config.http_address[1]] == ports
    assert str(config.workers) == pod.server["resources"]["limits"]["cpu"]
    assert config.drain_s + CLOSING_S <= pod.spec["terminationGracePeriodSeconds"]
    volumes = {volume["name"] for volume in pod.spec["volumes"]}
    assert {mount["name"] for one in (pod.server, pod.copier) for mount in one["volumeMounts"]} == volumes


def test_the_pod_fits_the_image() -> None:
    """The pod runs as the user of the image, and can write to the cache of compiled code."""
    pod, image = Pod.read(), (ROOT / "Dockerfile").read_text()
    user, group = pod.user.split(":")
    assert f"--uid {user} " in image
    assert f"--gid {group} " in image
    cache = re.search(r"NUMBA_CACHE_DIR=(\S+)", image)
    assert cache is not None
    assert cache[1] in [mount["mountPath"] for mount in pod.server["volumeMounts"]]


def test_no_secret_is_in_the_repository() -> None:
    """No manifest and no unit holds a Secret or a key."""
    for path in (ROOT / "deploy").rglob("*"):
        assert not path.is_file() or not re.search(r"kind: Secret|secret-key *=", path.read_text()), path


def test_kustomize_renders_all_manifests() -> None:
    """`kubectl kustomize` finds the three manifests."""
    assert [one["kind"] for one in kubectl("kustomize", str(FOLDER))] == [
        *("Service", "Deployment", "PodDisruptionBudget")
    ]


def test_the_gpu_component_patches_what_is_there() -> None:
    """It names the Deployment and the container, replaces a variable that they have, and asks for one GPU."""
    patch = yaml.safe_load((FOLDER / "gpu" / "deployment.yaml").read_text())
    component = yaml.safe_load((FOLDER / "gpu" / "kustomization.yaml").read_text())
    assert (component["kind"], component["patches"]) == ("Component", [{"path": "deployment.yaml"}])
    deployment = resource("deployment.yaml")
    assert patch["metadata"]["name"] == deployment["metadata"]["name"]
    (changed,) = patch["spec"]["template"]["spec"]["containers"]
    (container,) = deployment["spec"]["template"]["spec"]["containers"]
    assert changed["name"] == container["name"]
    assert {one["name"] for one in changed["env"]} <= {one["name"] for one in container["env"]}
    assert changed["resources"] == {"limits": {"nvidia.com/gpu": 1}}


def test_kubectl_renders_the_gpu_component(tmp_path: Path) -> None:
    """With `components: [gpu]`, the server has one worker and one GPU."""
    folder = tmp_path / "kubernetes"
    shutil.copytree(FOLDER, folder)
    with (folder / "kustomization.yaml").open("a") as file:
        file.write("components: [gpu]\n")
    rendered = [one for one in kubectl("kustomize", str(folder)) if one["kind"] == "Deployment"]
    (container,) = rendered[0]["spec"]["template"]["spec"]["containers"]
    assert {"name": "CLOUD_WORKERS", "value": "1"} in container["env"]
    assert container["resources"]["limits"]["nvidia.com/gpu"] == 1


def test_the_documented_commands_make_what_the_pod_mounts(tmp_path: Path) -> None:
    """The commands of docs/deployment.md make the Secret and the ConfigMap that the pod asks for."""
    kubernetes_validate = pytest.importorskip("kubernetes_validate")
    lines = (ROOT / "docs" / "deployment.md").read_text().splitlines()
    creating = [line.split()[1:] for line in lines if line.startswith("kubectl create ")]
    for name in ("server.key_secret", "token", "robots/arm-1.key"):
        path = tmp_path / "keys" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("not a real one")
    made = {}
    for arguments in creating:
        (one,) = kubectl(*arguments, "--dry-run=client", "--output=yaml", folder=tmp_path)
        one["metadata"].pop("creationTimestamp", None)  # null, which servers accept
        kubernetes_validate.validate(one, NEWEST, strict=True)
        made[one["kind"], one["metadata"]["name"]] = set(one["data"])
    pod = Pod.read()
    volumes = {volume["name"]: volume for volume in pod.spec["volumes"]}
    copied = {Path(each).name for each in pod.copier["command"] if each.startswith("/secret/")}
    assert made == {
        ("Secret", volumes["secret"]["secret"]["secretName"]): copied,
        ("ConfigMap", volumes["robots"]["configMap"]["name"]): {"arm-1.key"},
    }


@pytest.mark.parametrize("name", SERVICES)
def test_systemd_accepts_the_units(name: str, tmp_path: Path) -> None:
    """`systemd-analyze verify` has nothing to say about a unit, once its program is installed."""
    done = systemd_analyze("verify", str(installed(name, tmp_path)))
    assert (done.returncode, done.stdout + done.stderr) == (0, "")


@pytest.mark.parametrize("name", SERVICES)
def test_units_are_hardened(name: str, tmp_path: Path) -> None:
    """`systemd-analyze security` finds that a unit exposes little."""
    level = f"--threshold={EXPOSURE_MAX[name]}"
    done = systemd_analyze("security", "--offline=true", level, str(installed(name, tmp_path)))
    assert done.returncode == 0, done.stdout


def test_a_misspelt_line_of_a_unit_is_noticed(tmp_path: Path) -> None:
    """`systemd-analyze verify` names a key that systemd does not know."""
    unit = installed(SERVICES[0], tmp_path)
    unit.write_text(unit.read_text().replace("ProtectSystem", "ProtectSistem"))
    assert "ProtectSistem" in systemd_analyze("verify", str(unit)).stderr


def test_the_server_accepts_the_settings_of_its_unit() -> None:
    """The variables of the unit are settings of the server, and it drains sooner than systemd kills it."""
    unit = (UNITS / SERVICES[0]).read_text()
    lines = re.findall(r"^Environment=(.*)$", unit, re.MULTILINE)
    environ = dict(pair.split("=", 1) for line in lines for pair in line.split())
    config = server_config(environ, [])
    stop_s = re.search(r"^TimeoutStopSec=(\d+)$", unit, re.MULTILINE)
    assert stop_s is not None
    assert config.drain_s + CLOSING_S <= int(stop_s[1])
    assert environ["NUMBA_CACHE_DIR"] == "/var/cache/offboard"
    assert "MemoryDenyWriteExecute=yes" not in unit, "numba writes code and runs it"


def server_config(environ: dict[str, str], argv: list[str]) -> ServerConfig:
    """The settings of a server; every CLOUD_ variable must be one of them."""
    from offboard.cloud_server.__main__ import DESCRIPTION
    from offboard.common.command_line import load

    names = {f"CLOUD_{name.upper()}" for name in ServerConfig.__dataclass_fields__}
    assert {name for name in environ if name.startswith("CLOUD_")} <= names
    return load(
        ServerConfig, argv, prog="cloud-server", description=DESCRIPTION, environ=environ, prefix="CLOUD"
    )


def kubectl(*arguments: str, folder: Path = ROOT) -> list[dict[str, Any]]:
    """The resources that kubectl prints; without kubectl the test is skipped. No cluster is asked."""
    if shutil.which("kubectl") is None:
        pytest.skip("no kubectl")
    command = ["kubectl", *arguments]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=30)
    assert done.returncode == 0, done.stderr
    return list(yaml.safe_load_all(done.stdout))


def systemd_analyze(*arguments: str) -> "subprocess.CompletedProcess[str]":
    if shutil.which("systemd-analyze") is None:
        pytest.skip("no systemd-analyze; remedy: apt-get install systemd")
    command = ["systemd-analyze", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=30)


def installed(name: str, folder: Path) -> Path:
    """The unit, with the programs of this environment in place of /opt/offboard."""
    unit, programs = folder / name, Path(sys.executable).parent
    text = (UNITS / name).read_text()
    assert f"ExecStart={PROGRAMS}/" in text
    unit.write_text(text.replace(PROGRAMS, str(programs)))
    return unit
