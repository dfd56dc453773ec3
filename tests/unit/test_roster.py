"""Which servers of changing lists a robot uses."""

import pytest

from offboard.common.errors import ConfigError
from offboard.robot_client.discovery.roster import LOOK_EVERY, LOOK_S, SPARED_S, TRY_EVERY, Roster, Server


def servers(*sites: str) -> list[Server]:
    return [Server(site, f"tcp://{n}.test:5555") for n, site in enumerate(sites)]


def group(count: int) -> list[Server]:
    return servers(*(f"planners/{n:03}" for n in range(count)))


def test_all_servers_of_a_list_are_used_until_the_list_names_them_no_more() -> None:
    """A server is in use from the list that names it until the list that does not."""
    roster = Roster()
    roster.follow(servers("gpu", "edge"))
    assert roster.in_use.keys() == {"gpu", "edge"}
    roster.follow(servers("gpu"), source="another")
    roster.follow(servers("edge"))
    assert roster.in_use.keys() == {"gpu", "edge"}
    roster.follow([], source="another")
    assert roster.in_use.keys() == {"edge"}


def test_a_server_that_moved_is_another_server() -> None:
    """With another endpoint or key, the server in use is the new one."""
    roster = Roster()
    roster.follow([Server("gpu", "tcp://a.test:1", b"one")])
    roster.follow([Server("gpu", "tcp://a.test:1", b"two")])
    assert roster.in_use["gpu"].key == b"two"


def test_of_a_large_group_few_are_known_and_robots_spread_out() -> None:
    """Of 100 servers a robot uses `known`, the same ones for the same seed, others for another seed."""
    chosen = []
    for seed in (1, 1, 2):
        roster = Roster(known=4, seed=seed)
        roster.follow([*group(100), *servers("gpu")])
        chosen.append(set(roster.in_use))
    assert [len(one) for one in chosen] == [5, 5, 5]
    assert chosen[0] == chosen[1] != chosen[2]


def test_a_list_that_changes_little_keeps_what_is_known() -> None:
    """A server that leaves is replaced, and the others stay in use."""
    roster = Roster(known=4, seed=1)
    roster.follow(group(100))
    gone = sorted(roster.in_use)[0]
    before = set(roster.in_use)
    roster.follow([one for one in group(100) if one.site != gone])
    assert len(roster.in_use) == 4
    assert before - set(roster.in_use) == {gone}


def test_the_best_is_kept_and_the_others_are_tried_in_time() -> None:
    """With looks that go on, a robot comes to the best of 100 servers and then keeps it."""
    roster = Roster(known=4, seed=1)
    roster.follow(group(100))
    takes_s = {one.site: 0.1 + n / 1000 for n, one in enumerate(group(100))}
    best = "planners/000"
    found, looks = None, 0
    for looks in range(1, 6_000):
        used = set(roster.in_use)
        roster.look({site: takes_s[site] for site in used}, now_s=looks * LOOK_S)
        assert len(used - set(roster.in_use)) == (looks % TRY_EVERY == 0)
        if min(used, key=takes_s.__getitem__) in roster.in_use and best in roster.in_use:
            found = found or looks
        assert found is None or best in roster.in_use
    assert found is not None
    assert found < looks


def test_a_server_that_cannot_take_tasks_is_replaced_at_the_next_look() -> None:
    """A server without a predicted finish leaves for another one; a small group has none to offer."""
    roster = Roster(known=4, seed=1)
    roster.follow([*group(5), *servers("gpu")])
    dead = next(site for site in roster.in_use if site != "gpu")
    roster.look({}, now_s=0.0)
    roster.look({site: 0.1 for site in roster.in_use if site != dead}, now_s=SPARED_S)
    assert len(roster.in_use) == 5
    assert dead not in roster.in_use
    assert "gpu" in roster.in_use


def test_a_server_that_takes_other_tasks_stays() -> None:
    """Three servers cannot take the task of the look, but have taken others since the last one."""
    roster = Roster(known=4, seed=1)
    roster.follow(group(100))
    roster.look({}, now_s=0.0)
    before = set(roster.in_use)
    one = min(before)
    roster.count_task(before, now_s=SPARED_S)
    roster.look({one: 0.1}, now_s=SPARED_S)
    assert set(roster.in_use) == before
    roster.look({one: 0.1}, now_s=2 * SPARED_S)
    assert before & set(roster.in_use) == {one}


def test_a_server_has_time_to_connect() -> None:
    """On a slow link, servers that are not up yet stay for SPARED_S, though another one is up."""
    roster = Roster(known=4, seed=1)
    roster.follow(group(100))
    before = set(roster.in_use)
    up = {min(before): 0.1}
    for now_s in (0.0, SPARED_S / 2, SPARED_S - 0.1):
        roster.look(up, now_s)
        assert set(roster.in_use) == before
    roster.look(up, SPARED_S)
    assert before & set(roster.in_use) == set(up)
    after = set(roster.in_use)
    roster.look(up, SPARED_S + LOOK_S)
    assert set(roster.in_use) == after


def test_an_outage_of_the_robot_does_not_cost_it_its_servers() -> None:
    """If no server of a group can take tasks, they stay in use, and only one is replaced now and then."""
    roster = Roster(known=4, seed=1)
    roster.follow(group(100))
    before = set(roster.in_use)
    for looks in range(1, 2 * TRY_EVERY):
        roster.look({}, now_s=looks * LOOK_S)
        assert len(before - set(roster.in_use)) == looks // TRY_EVERY


def test_a_look_is_due_after_tasks_and_time() -> None:
    """Neither many fast tasks nor a long time alone make a look due."""
    roster = Roster()
    roster.look({}, now_s=0.0)
    assert not any(roster.count_task([], LOOK_S - 0.1) for _ in range(10 * LOOK_EVERY))
    assert roster.count_task([], LOOK_S)
    roster.look({}, now_s=LOOK_S)
    assert [roster.count_task([], 1000.0) for _ in range(LOOK_EVERY)] == [False] * (LOOK_EVERY - 1) + [True]


def test_two_choices_need_two_servers() -> None:
    """A robot must know at least two servers of a group."""
    with pytest.raises(ConfigError, match="known 1: must be at least 2 servers"):
        Roster(known=1)
