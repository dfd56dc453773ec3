"""Builds an environment with rclpy from PyPI, with `nav2_msgs` and `map_msgs` from our own interface files.

`python tests/ros2/build.py RELEASE FOLDER`, with the Python of that release. Nothing else may live in FOLDER:
the wheels of ROS restart Python at start, and bring libraries of their own.
"""

import os
import shutil
import subprocess
import sys
import venv
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).parent
INTERFACES = HERE / "interfaces"
PYTHONS = {"kilted": (3, 11), "jazzy": (3, 12)}


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
    wanted, found = PYTHONS[release], sys.version_info[:2]
    if found != wanted:
        sys.exit(f"build.py: {release} needs Python {wanted[0]}.{wanted[1]}, not {found[0]}.{found[1]}")
    if not (folder / "pyvenv.cfg").exists():
        venv.create(folder, with_pip=True)
    python = folder / "bin" / "python"
    requirements = HERE.parents[1] / "requirements" / f"ros2-{release}.txt"
    run([python, "-m", "pip", "install", "--quiet", "--require-hashes", "-r", requirements], os.environ)
    correct_paths(folder)
    for package in PACKAGES:
        generate(package, folder)


def generate(package: Package, folder: Path) -> None:
    """Generate, compile and install one interface package into the environment."""
    build = folder / "build" / package.name
    shutil.rmtree(build, ignore_errors=True)
    source = build / "source"
    shutil.copytree(INTERFACES / package.name, source)
    shutil.copy(INTERFACES / "CMakeLists.txt", source)
    environ = os.environ | {
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
        for line in [line for line in text.splitlines() if "/opt/python/" in line]:
            corrected = line
            for word in line.split('"')[1].split(";"):
                if word.startswith("/opt/python/"):
                    corrected = corrected.replace(word, of_numpy if "numpy" in word else include)
            text = text.replace(line, corrected)
        path.write_text(text)


def run(command: list[object], environ: "os._Environ[str] | dict[str, str]") -> None:
    done = subprocess.run(list(map(str, command)), env=environ, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"build.py: {' '.join(map(str, command))}\n{done.stdout}{done.stderr}")


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]).resolve())
