"""Builds an environment with rclpy from PyPI, with `nav2_msgs` and `map_msgs` from our own interface files.

`python tests/ros2/build.py RELEASE FOLDER`. Nothing else may live in FOLDER: the wheels of ROS restart Python
at start, and bring libraries of their own.
"""

import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).parent
INTERFACES = HERE / "interfaces"
PYTHONS = {"kilted": "3.11", "jazzy": "3.12"}  # for which PyPI has wheels
BUILDERS = "/opt/python/"  # a folder of the machine that built the wheels


@dataclass(frozen=True)
class Package:
    """An interface package that we generate."""

    name: str
    interface: str
    needs: tuple[str, ...]


PACKAGES = (
    Package(
        "nav2_msgs",
        "action/ComputePathToPose.action",
        ("action_msgs", "builtin_interfaces", "geometry_msgs", "nav_msgs"),
    ),
    Package("map_msgs", "msg/OccupancyGridUpdate.msg", ("std_msgs",)),
)


def main(release: str, folder: Path) -> None:
    base, python = python_of(release), folder / "bin" / "python"
    shutil.rmtree(folder, ignore_errors=True)
    if base is None:
        print(f"{release} is left out: there is no python{PYTHONS[release]} on the PATH")
        return
    requirements = HERE.parents[1] / "requirements" / f"ros2-{release}.txt"
    run([base, "-m", "venv", folder])
    run([python, "-m", "pip", "install", "--quiet", "--require-hashes", "-r", requirements])
    correct_paths(folder)
    for package in PACKAGES:
        generate(package, folder)


def python_of(release: str) -> str | None:
    """A Python of the version that the release needs: on the PATH, or of pyenv, which may hide it there."""
    version = PYTHONS[release]
    of_pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    for found in (shutil.which(f"python{version}"), *of_pyenv.glob(f"{version}.*/bin/python")):
        if found and subprocess.run([found, "--version"], capture_output=True, check=False).returncode == 0:
            return str(found)
    return None


def generate(package: Package, folder: Path) -> None:
    """Generate, compile and install one interface package into the environment."""
    build = folder / "build" / package.name
    source = build / "source"
    shutil.copytree(INTERFACES / package.name, source)
    shutil.copy(INTERFACES / "CMakeLists.txt", source)
    environ = {
        "PATH": f"{folder / 'bin'}{os.pathsep}{os.environ['PATH']}",
        "AMENT_PREFIX_PATH": str(folder),
        "PYTHONPATH": "",
    }
    settings = {
        "CMAKE_PREFIX_PATH": folder,
        "CMAKE_INSTALL_PREFIX": folder,
        "Python3_EXECUTABLE": folder / "bin" / "python",
        "PACKAGE": package.name,
        "INTERFACE": package.interface,
        "NEEDS": ";".join(package.needs),
        "BUILD_TESTING": "OFF",
    }
    flags = [f"-D{name}={value}" for name, value in settings.items()]
    run(["cmake", "-G", "Ninja", "-S", source, "-B", build, *flags], environ)
    run(["cmake", "--build", build, "--target", "install"], environ)


def correct_paths(folder: Path) -> None:
    """The wheels name include folders of the machine that built them."""
    code = "import numpy, sysconfig; print(sysconfig.get_path('include'), numpy.get_include())"
    done = subprocess.run([folder / "bin" / "python", "-c", code], capture_output=True, text=True, check=True)
    include, of_numpy = done.stdout.split()
    for path in (folder / "share").glob("*/cmake/*Export.cmake"):
        text = path.read_text()
        for line in [line for line in text.splitlines() if BUILDERS in line]:
            corrected = line
            for word in line.split('"')[1].split(";"):
                if word.startswith(BUILDERS):
                    corrected = corrected.replace(word, of_numpy if "numpy" in word else include)
            text = text.replace(line, corrected)
        path.write_text(text)


def run(command: list[object], environ: dict[str, str] | None = None) -> None:
    words = list(map(str, command))
    done = subprocess.run(
        words, env=os.environ | (environ or {}), capture_output=True, text=True, check=False
    )
    if done.returncode:
        sys.exit(f"build.py: {' '.join(words)}\n{done.stdout}{done.stderr}")


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]).resolve())
