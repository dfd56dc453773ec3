"""The Kubernetes manifests of deploy/, and the `docker run` that starts a container as their pod would.

A field of the manifest that is not translated here is an error, so that none is left out by mistake.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

FOLDER = Path(__file__).parents[1] / "deploy" / "kubernetes"
RESOURCES = ("deployment.yaml", "service.yaml", "disruption_budget.yaml")
# What Docker cannot do, or does by itself: when to pull, and what Kubernetes does around a container.
AROUND = {"name", "image", "imagePullPolicy", "ports", "startupProbe", "readinessProbe", "livenessProbe"}
TRANSLATED = {"command", "args", "env", "resources", "securityContext", "volumeMounts"}
CONTAINED = {
    "allowPrivilegeEscalation": False,
    "readOnlyRootFilesystem": True,
    "capabilities": {"drop": ["ALL"]},
}


def resource(name: str) -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load((FOLDER / name).read_text())
    return found


@dataclass(frozen=True, slots=True)
class Pod:
    """The pod of the Deployment."""

    spec: Mapping[str, Any]

    @classmethod
    def read(cls) -> "Pod":
        return cls(resource("deployment.yaml")["spec"]["template"]["spec"])

    @property
    def server(self) -> Mapping[str, Any]:
        (container,) = self.spec["containers"]
        return dict(container)

    @property
    def copier(self) -> Mapping[str, Any]:
        (container,) = self.spec["initContainers"]
        return dict(container)

    @property
    def user(self) -> str:
        return f"{self.spec['securityContext']['runAsUser']}:{self.spec['securityContext']['runAsGroup']}"

    @property
    def group(self) -> int:
        """The group of all volumes."""
        return int(self.spec["securityContext"]["fsGroup"])

    def environment(self, container: Mapping[str, Any]) -> dict[str, str]:
        """The variables of a container, with the values that Kubernetes computes."""
        found = {}
        for entry in container.get("env", ()):
            if "value" in entry:
                found[entry["name"]] = entry["value"]
                continue
            source = entry["valueFrom"]["resourceFieldRef"]
            assert source == {"containerName": container["name"], "resource": "limits.cpu", "divisor": "1"}
            found[entry["name"]] = container["resources"]["limits"]["cpu"]
        return found

    def docker_run(self, container: Mapping[str, Any], volumes: Mapping[str, str]) -> list[str]:
        """The last arguments of `docker run`; `volumes`: the Docker volume of each volume."""
        unknown = set(container) - AROUND - TRANSLATED
        assert not unknown, f"not translated: {unknown}"
        assert container["securityContext"] == CONTAINED
        limits = container["resources"]["limits"]
        cpus = float(limits["cpu"].removesuffix("m")) / (1000 if limits["cpu"].endswith("m") else 1)
        memory = limits["memory"].removesuffix("i").lower()
        arguments = [
            *("--user", self.user, "--group-add", str(self.group), "--read-only", "--cap-drop", "ALL"),
            *("--security-opt", "no-new-privileges:true"),
            *("--cpus", f"{cpus:g}", "--memory", memory, "--memory-swap", memory),
        ]
        for name, value in self.environment(container).items():
            arguments += ["--env", f"{name}={value}"]
        for mount in container.get("volumeMounts", ()):
            mode = ":ro" if mount.get("readOnly") else ""
            arguments += ["--volume", f"{volumes[mount['name']]}:{mount['mountPath']}{mode}"]
        command = [*container.get("command", ()), *container.get("args", ())]
        if "command" in container:
            arguments += ["--entrypoint", command.pop(0)]
        return [*arguments, container["image"], *command]
