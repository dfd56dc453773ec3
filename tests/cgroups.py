"""A tree of cgroups as a kernel shows it, written to files."""

from pathlib import Path


class Machine:
    """A tree of cgroups in a folder, and the /proc folder of one process in it."""

    def __init__(self, folder: Path) -> None:
        self.proc, self.sys = folder / "proc", folder / "cgroup"
        self.proc.mkdir()
        self._own: list[str] = []
        self._mounts: list[str] = ["31 23 0:28 / /sys/fs/cgroup rw,relatime - tmpfs tmpfs rw,mode=755"]

    def process(self, controllers: str, path: str) -> None:
        """Put the process into the group `path` of these controllers."""
        self._own.append(f"{len(self._own)}:{controllers}:{path}\n")
        (self.proc / "cgroup").write_text("".join(self._own))

    def mount(self, name: str, kind: str, options: str = "rw", *, root: str = "/") -> Path:
        """Mount a hierarchy of groups; returns its folder."""
        point = self.sys / name
        point.mkdir(parents=True)
        self._mounts.append(f"32 31 0:29 {root} {point} rw,relatime shared:7 - {kind} cgroup {options}")
        (self.proc / "mountinfo").write_text("\n".join(self._mounts) + "\n")
        return point

    @staticmethod
    def write(folder: Path, **files: str) -> Path:
        """Write files of a group. The first underscore of a name stands for a dot."""
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in files.items():
            (folder / name.replace("_", ".", 1)).write_text(text)
        return folder
