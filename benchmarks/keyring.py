"""The keys of a server and of its robots, in one folder."""

import shutil
from pathlib import Path

from offboard.common.security.keys import ROBOT, SERVER, make_keys


class Keys:
    """The folder with the keys of the server, and a folder for each robot."""

    def __init__(self, folder: Path) -> None:
        self.server = folder / "server"
        self.robots = self.server / "robots"
        make_keys(self.server, SERVER)
        self.robots.mkdir()
        self._folder = folder

    def make(self, name: str) -> Path:
        """Make the keys of a robot that the server does not know yet; returns their folder."""
        folder = self._folder / name
        make_keys(folder, ROBOT)
        shutil.copy(self.server / "server.key", folder)
        return folder

    def add(self, name: str) -> Path:
        """Make the keys of a robot that the server knows; returns their folder."""
        folder = self.make(name)
        self.let_in(name)
        return folder

    def let_in(self, name: str) -> None:
        shutil.copy(self._folder / name / "robot.key", self.robots / f"{name}.key")

    def remove(self, name: str) -> None:
        (self.robots / f"{name}.key").unlink()
