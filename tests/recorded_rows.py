"""Rows as the tasks of a dataset that holds nothing else."""

from offboard.loadgen.replay.recorded_tasks import RecordedTask
from offboard.loadgen.table.measured_rows import Rows
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Execution


def of_rows(rows: Rows) -> list[RecordedTask]:
    times = zip(rows.size.tolist(), rows.onboard_s.tolist(), rows.cloud_s.tolist(), strict=True)
    return [
        RecordedTask(size, {ONBOARD: Execution(ONBOARD, onboard_s), CLOUD: Execution(CLOUD, cloud_s)})
        for size, onboard_s, cloud_s in times
    ]
