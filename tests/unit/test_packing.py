"""What is learned of making arguments smaller, and when it should save time."""

from typing import Any

import pytest

from offboard.common.tasks import kind_of, task
from offboard.robot_client import predictors
from offboard.robot_client.learning.kind import KindMemory
from offboard.robot_client.learning.packing import PackingMemory
from offboard.robot_client.policies import Outlook
from offboard.robot_client.policies.forecast import Packing
from offboard.robot_client.policies.probe import PROBE_EVERY
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, UNMEASURED, Execution, Packed, Sending

SIZE = 1_000_000
IMAGE = Sending(SIZE + 1000, ((0, SIZE),))
SLOW_S, FAST_S = 8 / 20e6, 8 / 10e9  # of a byte at 20 Mbit/s and at 10 Gbit/s
COMPRESS_S = 3e-9  # of a byte
RUN_S = 0.15


@task("packing_plain", size=lambda _: 1.0)
def packing_plain(_: Any) -> None:
    """A task whose argument may be compressed."""


@task("packing_own", size=lambda _: 1.0, pack=bytes, unpack=bytearray)
def packing_own(_: Any) -> None:
    """A task that packs its argument."""


def compressed(share: float, argument: int = 0, byte_s: float = COMPRESS_S) -> Execution:
    """A run whose argument was compressed to this share of its bytes."""
    one = Packed(argument, "zstd", SIZE, bytes=round(share * SIZE), seconds=byte_s * SIZE)
    return Execution(CLOUD, 1.0, packed=(one,))


def known(*shares: float) -> PackingMemory:
    of = PackingMemory(packs=False)
    for share in shares:
        of.learn(compressed(share))
    return of


def test_an_argument_is_tried_once_to_learn_what_it_gains() -> None:
    """The bytes are expected as they are; without a model of the link, nothing is tried."""
    fresh = PackingMemory(packs=False)
    assert fresh.plan(IMAGE, SLOW_S) == Packing((0,), IMAGE.bytes, IMAGE.bytes, 0.0)
    assert fresh.plan(IMAGE, None) is None
    assert fresh.plan(Sending(1000), SLOW_S) is None


@pytest.mark.parametrize(
    ("share", "link_s", "chosen"),
    [
        (0.1, SLOW_S, True),
        (0.5, SLOW_S, True),
        (0.98, SLOW_S, True),
        (1.0, SLOW_S, False),
        (0.99, SLOW_S, False),
        (0.1, FAST_S, False),
        (0.1, 8 / 1e9, True),
        (0.5, 8 / 1e9, False),
    ],
)
def test_it_is_chosen_where_the_link_saves_more_than_both_ends_take(
    share: float, link_s: float, chosen: bool
) -> None:
    """The saving is that of the bytes that vanish; the server is expected to take as long as the robot."""
    assert chosen == (link_s * (1 - share) > 2 * COMPRESS_S)
    packing = known(share, share).plan(IMAGE, link_s)
    assert (packing is not None) == chosen
    if packing is not None:
        assert packing.compress == (0,)
        assert packing.bytes == pytest.approx(1000 + share * SIZE)
        assert packing.seconds == pytest.approx(COMPRESS_S * SIZE)


def test_each_argument_is_learned_by_itself() -> None:
    """A map that shrinks is compressed, the noise next to it is not."""
    of = PackingMemory(packs=False)
    of.learn(compressed(1.0, 0))
    of.learn(compressed(0.1, 1))
    packing = of.plan(Sending(2 * SIZE, ((0, SIZE), (1, SIZE))), SLOW_S)
    assert packing is not None
    assert packing.compress == (1,)
    assert packing.bytes == pytest.approx(1.1 * SIZE)


def test_an_argument_that_did_not_shrink_is_tried_again_on_a_slow_link() -> None:
    """After PROBE_EVERY runs its content may have changed; on a fast link nothing could pay."""
    of = known(1.0)
    for _ in range(PROBE_EVERY - 1):
        of.learn(Execution(CLOUD, 1.0))
    assert of.plan(IMAGE, SLOW_S) is None
    of.learn(Execution(CLOUD, 1.0))
    assert of.plan(IMAGE, SLOW_S) is not None
    assert of.plan(IMAGE, FAST_S) is None
    of.learn(compressed(1.0))
    assert of.plan(IMAGE, SLOW_S) is None


def test_a_slower_cpu_ends_it() -> None:
    """The time is learned again with each run: at 200 ns a byte, 20 Mbit/s are fast enough."""
    of = known(0.5)
    assert of.plan(IMAGE, SLOW_S) is not None
    for _ in range(100):
        of.learn(compressed(0.5, byte_s=2e-7))
    assert of.plan(IMAGE, SLOW_S) is None


def test_the_own_packing_of_a_kind_is_predicted_on_every_link() -> None:
    """Its bytes and its time; a run that was packed for another site before says nothing of the time."""
    of = PackingMemory(packs=True)
    assert of.plan(Sending(SIZE), FAST_S) is None
    of.learn(Execution(CLOUD, 1.0, packed=(Packed(None, "pack", SIZE, bytes=SIZE // 10, seconds=0.02),)))
    of.learn(Execution(CLOUD, 1.0, packed=(Packed(None, "pack", SIZE, bytes=SIZE // 10, seconds=0.0),)))
    for link_s in (FAST_S, None):
        packing = of.plan(Sending(2 * SIZE), link_s)
        assert packing is not None
        assert packing.compress == ()
        assert packing.bytes == pytest.approx(0.2 * SIZE)
        assert packing.seconds == pytest.approx(0.04)
    assert of.plan(Sending(0), None) is None


def memory(predictor: str) -> KindMemory:
    return KindMemory(
        kind_of(packing_plain),
        lambda: predictors.make(predictor, 50),
        shared_work=False,
        measured=predictor == predictors.PARTS,
        s_per_quality=1.0,
    )


def outlook(of: KindMemory, packing: Packing | None) -> Outlook:
    return of.site(CLOUD).outlook(1.0, UNMEASURED, in_flight=0, sending=Sending(SIZE), packing=packing)


def taught(predictor: str, pack_s: float) -> KindMemory:
    """A memory of a server behind 20 Mbit/s that got 1 MB whole and half of it in turn."""
    one = memory(predictor)
    for n in range(40):
        share = 0.5 if n % 2 else 1.0
        packing = Packing((0,), SIZE, share * SIZE, pack_s) if n % 2 else None
        seconds = SLOW_S * share * SIZE + RUN_S + (pack_s if packing else 0.0)
        packed = (Packed(0, "zstd", SIZE, SIZE // 2, pack_s),) if packing else ()
        ran = Execution(
            CLOUD, seconds, queue_s=0.0, run_s=RUN_S, bytes_out=round(share * SIZE), packed=packed
        )
        one.site(CLOUD).learn(1.0, ran, outlook(one, packing), silent=False, size=1.0)
    return one


def test_the_time_of_packing_is_predicted_and_not_learned_as_the_link() -> None:
    """The prediction is the link for the bytes that are left, the run, and the packing; its interval too."""
    one = taught(predictors.PARTS, pack_s=0.1)
    whole, half = outlook(one, None), outlook(one, Packing((0,), SIZE, SIZE / 2, 0.1))
    assert whole.predicted_s == pytest.approx(SLOW_S * SIZE + RUN_S, rel=0.03)
    assert half.predicted_s == pytest.approx(SLOW_S * SIZE / 2 + RUN_S + 0.1, rel=0.03)
    assert half.low_s is not None
    assert half.high_s is not None
    assert half.low_s <= SLOW_S * SIZE / 2 + RUN_S + 0.1 <= half.high_s + 0.01


def test_a_plain_predictor_learns_the_whole_time() -> None:
    """The window of the published rule holds the time with its packing, so nothing is added to it."""
    one = taught(predictors.LEAST_SQUARES, pack_s=0.1)
    mean_s = (SLOW_S * SIZE + RUN_S + SLOW_S * SIZE / 2 + RUN_S + 0.1) / 2
    for packing in (None, Packing((0,), SIZE, SIZE / 2, 0.1)):
        assert outlook(one, packing).predicted_s == pytest.approx(mean_s, rel=0.01)


def test_only_the_parts_model_knows_what_a_byte_takes() -> None:
    """Onboard there is no link, and other predictors do not tell it from the rest."""
    assert memory(predictors.LEAST_SQUARES).site(CLOUD).model.byte_s is None
    one = taught(predictors.PARTS, pack_s=0.0)
    assert one.site(ONBOARD).model.byte_s is None
    assert one.site(CLOUD).model.byte_s == pytest.approx(SLOW_S, rel=0.1)
