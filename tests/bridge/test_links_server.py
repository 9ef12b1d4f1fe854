import json
import sys
import time

import numpy as np
import pytest
from bridge_samples import (
    REST_COUNTS,
    make_recording,
    read_scans,
    read_until_lost,
    stacked,
)
from server_samples import looping, wait_for
from xela_server_emulator import ServerEmulator
from xela_server_model import GARBAGE, VERSIONS, VendorServer

from edge.cli import main as cli
from firmware_bridge.errors import DeviceError, LinkLostError
from firmware_bridge.links.xela_server import XelaServerLink


@pytest.mark.parametrize("version", VERSIONS)
def test_every_scan_comes_once_and_in_order(version):
    recordings = [make_recording(30, seed=1), make_recording(30, seed=2)]
    with ServerEmulator(VendorServer(recordings, version=version)) as server, XelaServerLink(server.url) as link:
        scans = read_until_lost(link)
        assert server.lost_messages == 0 and link.version == f"{version}_emulated"
    for sensor, recording in zip(("1", "2"), recordings, strict=True):
        mine = [scan for scan in scans if scan.sensor == sensor]
        assert [scan.number for scan in mine] == list(range(30))
        assert (stacked(scans, sensor) == recording.tracks[0].counts).all()
        times = [scan.time_ns for scan in mine]
        assert times == sorted(times)
        assert all(scan.device_ns is not None and scan.device_ns <= scan.time_ns for scan in mine)
        assert all(scan.vendor_force_n is not None for scan in mine)
        has_temperature = [scan.vendor is not None and scan.vendor.temperature_k is not None for scan in mine]
        assert has_temperature == [version == "1.8.0"] * 30
    counters = {name: count for name, count in link.counters().items() if count and name != "received_bytes"}
    assert counters == {"messages": 31, "welcomes": 1, "scans": 60}


def test_what_it_says_about_itself():
    link = XelaServerLink("ws://robot")
    assert (link.name, link.kind, link.ended, link.url) == (
        "xela-server:ws://robot",
        "device",
        False,
        "ws://robot:5000",
    )
    with pytest.raises(ValueError, match="with statement"):
        link.read(0)
    with ServerEmulator(looping()) as server:
        link = XelaServerLink(server.url)
        with link as entered:
            assert entered is link and link.kind == "emulated"  # a server of ours does not pass for the vendor's


def test_garbage_costs_itself_alone():
    recording = make_recording(40)
    with ServerEmulator(VendorServer([recording]), garbage_every=2) as server, XelaServerLink(server.url) as link:
        scans = read_until_lost(link)
        counters = link.counters()
    assert (stacked(scans, "1") == recording.tracks[0].counts).all()
    assert counters["bad_json"] >= 5 and counters["bad_sequence"] >= 2 and counters["duplicate_keys"] >= 1
    assert counters["messages"] == 1 + 40 + 20 and len(GARBAGE) <= 20


def test_a_client_that_does_not_read_gets_what_is_old_and_is_told():
    with ServerEmulator(looping()) as server, XelaServerLink(server.url) as link:
        read_scans(link, 1)
        sent = server.sent_messages
        wait_for(lambda: server.sent_messages > sent + 30)
        while not server.lost_messages:
            server.say(" " * 200_000)  # fills what the kernel and the server keep
        wait_for(lambda: server.lost_messages > 30)
        end_s = time.monotonic() + 60
        while not link.counters()["missed_messages"]:
            link.read(0.1)
            assert time.monotonic() < end_s
        assert link.counters()["stale_scans"] > 0


def test_what_fails_while_it_is_opened_leaves_nothing_open(monkeypatch):
    def fail(link, timeout_s):
        raise LinkLostError("gone")

    monkeypatch.setattr(XelaServerLink, "_take", fail)
    with ServerEmulator(looping()) as server:
        with pytest.raises(LinkLostError):
            XelaServerLink(server.url).__enter__()
        wait_for(lambda: not server._server._clients)


# Sensors.


def test_sensors_of_other_shapes_are_left_out():
    with ServerEmulator(looping(others=[("uSPa46", 24)])) as server, XelaServerLink(server.url) as link:
        assert {scan.sensor for scan in read_scans(link, 5)} == {"1"}
        assert link.trouble == "sensor 2 is left out: 'uSPa46' with 24 taxels, expected 16"


def test_a_server_with_none_that_fits_is_an_error_not_silence():
    server = VendorServer([], others=[("uSPa46", 24)], loop=True)
    words = r"no sensor that can be used: sensor 1 is left out: 'uSPa46'"
    with (
        ServerEmulator(server) as emulator,
        pytest.raises(DeviceError, match=words) as refused,
        XelaServerLink(emulator.url) as link,
    ):
        read_scans(link, 1)
    assert not isinstance(refused.value, LinkLostError)  # another try would not help


def test_taxels_that_fall_silent_are_absent():
    vendor = looping()
    with ServerEmulator(vendor) as server, XelaServerLink(server.url) as link:
        read_scans(link, 3)
        vendor.silent = frozenset({2, 3})
        wait_for(lambda: any(not scan.complete for scan in link.read(0.05)))
        assert all(np.flatnonzero(~scan.fresh).tolist() == [2, 3] for scan in read_scans(link, 5))
        vendor.silent = frozenset(range(16))
        wait_for(lambda: not link.read(0.05) and not link.read(0.05))
        assert link.counters()["messages"] > 0 and link.trouble is None
        wait_for(lambda: not link.read(0.05) and link.trouble)
        assert link.trouble == "nothing arrives from sensor 1: check its cable and its power"
        vendor.silent = frozenset()
        wait_for(lambda: any(scan.whole for scan in link.read(0.05)))


# The whole program.


def test_edge_sr_reads_a_server(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(sys, "stdin", None)
    records = tmp_path / "records.jsonl"
    still = make_recording(130, rate_hz=200.0)
    still.tracks[0].counts[:] = REST_COUNTS + np.random.default_rng(1).integers(0, 5, still.tracks[0].counts.shape)
    with ServerEmulator(VendorServer([still], loop=True), message_hz=200) as server:
        code = cli.main(["--source", f"xela-server:{server.url}", "--sink", f"jsonl:{records}", "--duration-s", "2"])
    assert code == 0, capsys.readouterr().err
    lines = [json.loads(line) for line in records.read_text().splitlines()]
    assert {line["source"] for line in lines} == {"emulated"}
    # A machine that stands still for a moment reports a silent server: an event, of no sensor.
    assert {line["sensor"] for line in lines if line["state"] != "event"} == {"1"}
    idle = [line for line in lines if line["state"] == "idle"]
    assert idle and all(line["force_n"] == line["vendor_force_n"][2] for line in idle)
    assert {line["temperature_k"] for line in idle} == {302.5}
    assert any("missed_messages" in line.get("counters", ()) for line in idle)
