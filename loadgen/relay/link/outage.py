"""What an outage and a hang stop: bytes, new connections, resets.

Pure. The rules are applied by the forwarder and the connection of the relay, in `relay/tcp`.

              outage (the link is silent)           hang (the receiving side is frozen)
    read      no: bytes wait in the sender          yes: bytes are read and lost
    deliver   no: bytes come after the outage       no
    connect   waits for the end of the outage       waits while the cloud hangs
    reset     waits for the end of the outage       at once

An outage goes first: while it lasts, a hang reads nothing.
"""

from offboard.loadgen.relay.link.link import Link, LinkConditions


def delivers(conditions: LinkConditions) -> bool:
    """Whether bytes that are due come out of this direction."""
    return not conditions.outage


def swallows(conditions: LinkConditions) -> bool:
    """Whether bytes of this direction are read and lost."""
    return conditions.hang and not conditions.outage


def connects(link: Link) -> bool:
    """Whether a new connection gets through to the cloud."""
    return not (link.up.outage or link.down.outage or link.up.hang)


def resets(link: Link) -> bool:
    """Whether a reset gets through: it is a message too."""
    return not (link.up.outage or link.down.outage)
