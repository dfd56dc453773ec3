"""Where the tasks of a server run: the executors by name. Each is loaded when it is made."""

from collections.abc import Callable, Sequence
from typing import Any

from offboard.cloud_server.executors.executor import Executor

__all__ = ["EXECUTORS", "Executor"]


def _threads(workers: int, *_: object, **__: object) -> Executor:
    from offboard.cloud_server.executors.thread_executor import ThreadExecutor

    return ThreadExecutor(workers)


def _processes(
    workers: int, modules: Sequence[str], blob_bytes_max: int, *memory_bytes_max: int, **_: object
) -> Executor:
    from offboard.cloud_server.executors.worker_pool import WorkerPool

    return WorkerPool(workers, modules, blob_bytes_max, *memory_bytes_max)


def _ray(*settings: Any, **of_ray: Any) -> Executor:
    from offboard.cloud_server.executors.ray_executor import make

    return make(*settings, **of_ray)


EXECUTORS: dict[str, Callable[..., Executor]] = {"threads": _threads, "processes": _processes, "ray": _ray}
