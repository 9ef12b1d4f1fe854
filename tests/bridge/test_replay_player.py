import numpy as np
import pytest
from bridge_samples import make_counts, write_recording

from firmware_bridge.links.replay_player import FASTEST, JUMP_NS, PlayedReplay, Player

PERIOD_NS = 20_000_000


class Clock(Player):
    """Player on a clock that its waits move."""

    def __init__(self):
        super().__init__()
        self.now_ns = 0

    def wait(self, timeout_s):
        self.now_ns += round(timeout_s * 1e9)


@pytest.fixture
def played(tmp_path):
    paths = [write_recording(tmp_path / f"{name}.csv", make_counts(5, seed), 50) for seed, name in enumerate("ab")]
    player = Clock()
    return PlayedReplay(paths, player, clock=lambda: player.now_ns), player


def take(link, count):
    scans = []
    while len(scans) < count:
        scans += link.read(0.1)
    return scans


def test_it_waits_for_a_viewer_and_goes_round_with_times_and_numbers_that_go_on(played):
    link, player = played
    assert link.read(0.1) == [] and player.state.waiting and player.state.length_s == 0.08
    player.begin()
    scans = take(link, 14)
    assert [(scan.sensor, scan.number) for scan in scans] == [(name, number) for number in range(7) for name in "ab"]
    times_ns = [scan.time_ns for scan in scans[::2]]
    assert times_ns == [*range(0, 100_000_000, PERIOD_NS), *(80_000_000 + JUMP_NS + n * PERIOD_NS for n in range(2))]
    assert (scans[10].counts == scans[0].counts).all() and not link.ended and player.state.rounds == 1
    jumped = [(notice.kind, notice.text) for notice in link.notices()]
    assert jumped == [("back", "")], "earlier readings are old, and nobody has to be informed"


@pytest.mark.parametrize("speed", [0.25, 2.0])
def test_its_speed_changes_when_a_scan_comes_and_not_its_time(played, speed):
    link, player = played
    player.begin()
    take(link, 2)
    player.set_speed(speed)
    began_ns, scans = player.now_ns, take(link, 6)
    assert player.now_ns - began_ns == pytest.approx(2 * PERIOD_NS / speed, rel=0.01)
    assert np.diff([scan.time_ns for scan in scans[::2]]).tolist() == [PERIOD_NS] * 2
    player.set_speed(1000)
    assert player.state.speed == FASTEST


def test_paused_it_shows_the_scan_of_each_finger_where_it_is_scrubbed_to(played):
    link, player = played
    player.begin()
    take(link, 2)
    player.pause(on=True)
    assert [link.read(0.1) for _ in range(3)] == [[]] * 3
    player.jump(0.06)
    scans = take(link, 2)
    assert [scan.sensor for scan in scans] == ["a", "b"] and player.state.at_s == pytest.approx(0.06)
    assert link.read(0.1) == []
    player.jump(99)
    take(link, 2)
    assert player.state.at_s == pytest.approx(0.08)
    player.pause(on=False)
    assert take(link, 1)[0].sensor == "a" and player.state.at_s == 0
