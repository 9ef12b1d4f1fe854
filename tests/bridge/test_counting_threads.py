"""Counters are asked for by one thread while another, which reads the link, finds new sensors."""

import sys
import threading

import pytest
from server_samples import message, sensor_entry

from firmware_bridge.can.slcan import CanFrame
from firmware_bridge.scans.can_id_maps import USPA44_MAP
from firmware_bridge.scans.scan_assembler import ScanAssembler
from firmware_bridge.scans.xela_server_messages import MOST_SENSORS
from firmware_bridge.scans.xela_server_scans import ServerScans

FOUND = {
    ServerScans: [message(number, **{str(number): sensor_entry()}) for number in range(MOST_SENSORS)],
    ScanAssembler: [CanFrame(can_id, bytes(8)) for can_id in USPA44_MAP.taxels],
}


@pytest.fixture(autouse=True)
def _threads_by_turns():
    interval_s = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(interval_s)


@pytest.mark.parametrize("stage", FOUND)
def test_counters_are_asked_for_while_sensors_are_found(stage):
    for _ in range(5):
        scans = stage()
        feed = scans.feed if stage is ServerScans else scans.feed_frame
        feeding = [lambda one=one, feed=feed: feed(one, 1) for one in FOUND[stage]]
        reader = threading.Thread(target=lambda feeding=feeding: [feed() for feed in feeding])
        reader.start()
        while reader.is_alive():
            scans.counters()
        reader.join()
