"""The limits that `docs/limits.md` names: for each row of the table, the constants behind its numbers.

`unit/test_limits.py` compares them with the table.
"""

from dataclasses import fields
from typing import Any

from offboard.cloud_server import (
    authorisation,
    connections,
    failures,
    http_api,
    rate_limit,
    robot_socket,
    server,
)
from offboard.cloud_server.config import ServerConfig
from offboard.cloud_server.executors import worker, worker_pool
from offboard.common import logs, task_call, task_states, tasks
from offboard.common.live import live_port
from offboard.common.planning import maps, planner
from offboard.common.security import bounded_http, plain_files
from offboard.common.source import comparison, covers
from offboard.common.wire import channel, item_count, messages, values
from offboard.loadgen.compare import recordings
from offboard.loadgen.relay import control_api, link_schedule
from offboard.loadgen.relay.link import link, recording_file
from offboard.loadgen.relay.tcp import forwarder, link_record
from offboard.loadgen.relay.toxiproxy import toxiproxy_api
from offboard.loadgen.relay.wan import WanConfig
from offboard.loadgen.robot import run, workload
from offboard.loadgen.robot.config import RobotConfig
from offboard.loadgen.scenario import event_timeline, scenario
from offboard.loadgen.table import measured_rows
from offboard.loadgen.testbed import docker_engine
from offboard.robot_client import lifetime, task_runs
from offboard.robot_client.cloud import cloud_runner, cloud_socket, connection
from offboard.robot_client.discovery import present_sites, roster, server_lists
from offboard.robot_client.execution import placement
from offboard.robot_client.learning import store
from offboard.robot_client.policies import allowance
from offboard.robot_client.predictors import base, window
from offboard.robot_client.records import trace
from offboard.robot_client.sites import absence, conversation, onboard, runner
from offboard.robot_client.streams import asking, counts


def default(config: type, name: str) -> Any:
    """The default of a setting."""
    return next(field.default for field in fields(config) if field.name == name)


def most(config: type, name: str) -> Any:
    """The largest value that a setting may have."""
    return next(field.metadata["maximum"] for field in fields(config) if field.name == name)


def same(*numbers: float) -> float:
    """The number that several constants have in common."""
    (number,) = set(numbers)
    return number


ROBOT = {
    "tasks of one process; the name of a task; the numbers of a size": [
        tasks.KINDS_MAX,
        tasks.NAME_LENGTH_MAX,
        tasks.SIZE_NUMBERS_MAX,
    ],
    "what a task, or one of its variants, covers; one file of it": [
        covers.COVERS_MAX,
        covers.FILE_BYTES_MAX,
        covers.PIECE_BYTES,
    ],
    "helpers that `robot-client check` names": [comparison.HELPERS_SHOWN],
    "arguments, or the result, of one task": [
        values.VALUE_BYTES_MAX,
        item_count.ITEMS_MAX,
        values.ARRAYS_MAX,
        values.BLOBS_MAX,
        values.BLOB_BYTES_MIN,
        values.NESTING_MAX,
        values.DATACLASS_LEVELS,
        values.DIMENSIONS_MAX,
    ],
    "one message: the arguments, the result, or one large argument": [
        default(ServerConfig, "message_mib"),
        cloud_socket.MESSAGE_BYTES_MAX,
    ],
    "calls in a row whose values cannot be sent": [
        absence.PAUSE_AFTER,
        absence.PAUSE_S,
        2 * absence.PAUSE_S,
        absence.PAUSE_MAX_S,
    ],
    "waiting for the answer of a server": [runner.TIMEOUT_S, runner.TIMEOUT_MAX_S],
    "sends of one task, if the server has forgotten large arguments": [cloud_runner.ATTEMPTS_MAX],
    "tasks in flight to one server; of a batch": [
        conversation.IN_FLIGHT_MAX,
        placement.SERVER_IN_FLIGHT_MAX,
    ],
    "an attempt to connect; unacknowledged bytes": [
        cloud_socket.CONNECT_MS / 1e3,
        cloud_socket.UNACKNOWLEDGED_MS / 1e3,
        cloud_socket.RECONNECT_MS / 1e3,
        cloud_socket.RECONNECT_MAX_MS / 1e3,
    ],
    "free files and threads for `connect`": [channel.FILES, channel.THREADS],
    "cancelled onboard runs that go on": [onboard.ABANDONED_MAX],
    "calls of `Offloader.run` and `Offloader.submit` at a time": [lifetime.ASYNC_CALLS_MAX],
    "calls with a deadline that still run, in time or late": [lifetime.ASYNC_CALLS_MAX],
    "a setup that raised": [task_states.SETUP_AGAIN_S],
    "`--in-flight`: tasks of a run that were not answered yet": [
        default(RobotConfig, "in_flight"),
        most(RobotConfig, "in_flight"),
    ],
    "tasks and inputs that are made ahead of their time": [
        run.MADE_MAX,
        run.MADE_FIRST_MAX,
        run.LARGE_MADE_MAX,
    ],
    "second runs saved up, or owed": [allowance.DUPLICATES_MAX],
    "observations of a kind on a site": [window.WINDOW_MAX, base.REMEMBERED],
    "late executions that the next record names": [task_runs.LATE_MAX],
    "records that wait for the disk of `trace`": [trace.WAITING_MAX, trace.ROOM_WAIT_S],
    "`close`: runs onboard; each server; trace; memory": [
        onboard.CLOSE_WAIT_S,
        cloud_runner.CLOSE_WAIT_S,
        trace.CLOSE_WAIT_S,
        store.WRITE_WAIT_S,
        2 * store.WRITE_WAIT_S,
    ],
    "the memory file": [store.FILE_BYTES_MAX],
    "log lines about bad messages; about the connection to a server": [
        logs.PAUSE_S,
        connection.LOG_LINES_MAX,
        logs.PAUSE_S,
    ],
    "messages that are read at once from a server": [cloud_runner.READ_MAX],
    "the file of `--sites`": [server_lists.FILE_BYTES_MAX, server_lists.SERVERS_MAX, server_lists.GROUPS_MAX],
    "addresses of a name": [server_lists.ADDRESSES_MAX],
    "servers of a group that are used at a time": [roster.KNOWN_MAX],
    "sites that a task is remembered on": [base.REMEMBERED],
    "a server that left the list, and still has tasks": [present_sites.LEAVING_MAX_S],
    "arrays of one task that are sent compressed inside the request": [values.DECOMPRESSED_BYTES_MAX],
    "rows of a CSV file of sizes, or of a dataset": [same(workload.ROWS_MAX, measured_rows.ROWS_MAX)],
}

SERVER = {
    "log lines about robots with another version of Offboard": [connections.VERSIONS_MAX],
    "requests waiting": [default(ServerConfig, "queue_max")],
    "large arguments kept": [default(ServerConfig, "blob_mib")],
    "one message": [default(ServerConfig, "message_mib")],
    "bytes that a robot sends": [
        default(ServerConfig, "robot_mib_s"),
        rate_limit.MESSAGE_BYTES,
        default(ServerConfig, "robot_mib_s") * 2**20 / rate_limit.MESSAGE_BYTES,
        rate_limit.BUSY_A_S,
    ],
    "bytes that a robot sends beyond that": [rate_limit.EXCESS_S, rate_limit.CUT_OFF_S],
    "bytes sent but not yet read by the server": [connections.MESSAGES_UNREAD],
    "replies that a robot does not read": [robot_socket.PEER_MESSAGES_MAX],
    "robots that a server knows": [authorisation.ROBOTS_MAX],
    "a handshake": [robot_socket.HANDSHAKE_S],
    "a connection that ended": [connections.LOOK_S + server.POLL_S, connections.KEPT],
    "a robot that vanished silently": [
        connections.SILENT_S,
        robot_socket.KEEPALIVE_IDLE_S + robot_socket.KEEPALIVE_EVERY_S * robot_socket.KEEPALIVE_PROBES,
    ],
    "free files and threads at the start": [channel.FILES, channel.THREADS],
    "a key file; the token": [plain_files.PRIVATE_BYTES_MAX, plain_files.TOKEN_CHARS_MIN],
    "HTTP connections": [
        bounded_http.CONNECTIONS_MAX,
        http_api.CONNECTIONS_A_S,
        http_api.CONNECTIONS_AT_ONCE,
        bounded_http.REQUEST_S,
    ],
    "worker processes": [
        worker_pool.SPARES,
        worker.RESTART_PAUSE_S,
        worker.FAILED_PAUSE_S,
        worker.START_S_MAX,
    ],
    "memory of a worker process": [default(ServerConfig, "worker_memory") * 2**20],
    "a task in a worker process": [worker.OVERTIME_S],
    "workers that one request costs": [failures.CRASHES_MAX],
    "the text of an error; its traceback": [messages.ERROR_LENGTH_MAX, task_call.TRACEBACK_LENGTH_MAX],
    "log lines about bad messages, and about refused robots": [logs.PAUSE_S],
    "time to finish tasks after SIGTERM": [default(ServerConfig, "drain_s")],
}

BENCH = {
    "a map": [round(maps.CELLS_MAX, -6)],
    "a scan; the radius of a robot": [planner.BEAMS_MAX, planner.RADIUS_CELLS_MAX],
    "maps that the planner keeps ready": [planner.PREPARED_MAX, round(planner.PREPARED_CELLS_MAX, -6)],
    "connections of the relay": [default(WanConfig, "connections_max")],
    "bytes in the relay": [default(WanConfig, "buffer_bytes"), forwarder.CHUNKS_MAX],
    "a request to the relay": [control_api.BODY_BYTES_MAX, toxiproxy_api.BODY_BYTES_MAX],
    "events of a schedule or a scenario; samples of a delay": [
        same(event_timeline.EVENTS_MAX, link_schedule.EVENTS_MAX),
        link.SAMPLES_MAX,
    ],
    "rows of a recorded link; recordings of a comparison": [
        recording_file.ROWS_MAX,
        recordings.RECORDINGS_MAX,
    ],
    "the record of the link": [link_record.WAITING_BYTES_MAX],
    "robots of a scenario": [scenario.ROBOTS_MAX],
    "Docker": [docker_engine.ANSWER_S, docker_engine.BUILD_S],
}

CONSTANTS = ROBOT | SERVER | BENCH

# Why there is no constant.
WITHOUT = {
    "a stream: `hz`; `horizon`; chunks under way; time of a chunk": (asking.HZ_MAX, asking.HORIZON_MAX),
    "streams that metrics count one by one": (counts.STREAMS_MAX,),
    "connections that wait at the port of `--metrics`": (live_port.WAITING_MAX,),
    "tasks that run onboard at a time": "the runner of the robot has one worker thread",
    "`trace` and `memory`": "it is a kind of file, not a number",
    "connections of robots": "the kernel sets this limit",
}
