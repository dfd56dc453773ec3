"""A process that attacks a server with half a core.

`python -m benchmarks.attackers NAME ENDPOINT HTTP_PORT KEYS` continues until its input ends, and then prints
the number of its steps. The attacker has the keys of a robot that the server knows, because an attacker
without keys gets less far.
"""

import itertools
import random
import select
import sys
import time
from collections.abc import Callable, Generator
from pathlib import Path

from benchmarks.attack_connections import SEED, claims, endless, http, idle, slow, strangers
from benchmarks.attack_messages import bombs, mutate, plan_body, request, valid_messages
from benchmarks.attack_target import Target, dealer, say
from offboard.common.wire import messages as wire

SHARE = 0.5  # of a core

Attack = Callable[[Target], Generator[None]]


def main() -> None:
    name, endpoint, http_port, keys = sys.argv[1:]
    target = Target(endpoint, int(http_port), Path(keys) if keys else None)
    attack, steps = ATTACKS[name](target), 0
    began, used = time.monotonic(), time.process_time()
    for _ in attack:
        steps += 1
        ahead = time.process_time() - used - SHARE * (time.monotonic() - began)
        if select.select([sys.stdin], [], [], max(0.0, ahead / SHARE))[0]:
            break
    attack.close()
    print(steps, flush=True)


def garbage(target: Target) -> Generator[None]:
    """Frames of random bytes."""
    rng = random.Random(SEED)
    with dealer(target) as client:
        while True:
            say(client, [rng.randbytes(rng.choice((0, 1, 20, 2_000))) for _ in range(rng.randint(1, 4))])
            yield


def mutated(target: Target) -> Generator[None]:
    """Valid messages with random changes."""
    rng = random.Random(SEED)
    good = valid_messages()
    with dealer(target) as client:
        while True:
            say(client, mutate(rng.choice(good), rng))
            yield


def bombing(target: Target) -> Generator[None]:
    """All bombs, again and again."""
    with dealer(target) as client:
        for frames in itertools.cycle(bombs().values()):
            say(client, frames)
            yield


def flood(target: Target) -> Generator[None]:
    """Valid requests and pings, as fast as possible."""
    plan, ping = request(plan_body()), list(wire.pack(wire.Ping(1)))
    with dealer(target) as client:
        while True:
            say(client, plan)
            say(client, ping)
            yield


def blobs(target: Target) -> Generator[None]:
    """Large arguments that no request uses, each of them different."""
    data = bytearray(1 << 20)
    with dealer(target) as client:
        for n in itertools.count():
            data[:8] = n.to_bytes(8, "little")
            say(client, list(wire.pack(wire.Blob(bytes(data)))))
            yield


ATTACKS: dict[str, Attack] = {
    "garbage": garbage,
    "mutated": mutated,
    "bombs": bombing,
    "claims": claims,
    "endless": endless,
    "strangers": strangers,
    "slow": slow,
    "idle": idle,
    "http": http,
    "flood": flood,
    "blobs": blobs,
}


if __name__ == "__main__":
    main()
