"""A sensor that is well gives no finding but ok, each fault only its own, and all are on the page for users."""

import re

import numpy as np
import pytest
from doctor_samples import COUNTERS, REST, as_scans, healthy_counts, silenced, times_ns, watched
from edge_samples import ROOT

from edge.doctor.examine import judge
from edge.doctor.link_checks import Watched, check_baud, check_id_map, check_latency, check_link
from edge.doctor.taxel_checks import Samples
from firmware_bridge.scans.can_id_maps import ID_MAPS, USPA44_MAP, XR1944_MAP
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.zeroing.baseline import Baseline

FREE = Baseline.of("4", REST, created_unix_s=1000.0, scans=100, origin="file")


def faults(scans, **changes):
    """Return names and verdicts of the findings that are not ok, where every input is available."""
    changes.setdefault("references", {"4": FREE})
    found = judge(watched(scans, **changes), 0.0).findings
    return {finding.name: finding.verdict for finding in found if finding.verdict != "ok"}


def remedy_of(name, scans, **changes):
    findings = judge(watched(scans, **{"references": {"4": FREE}} | changes), 0.0).findings
    return next(finding.remedy for finding in findings if finding.name == name)


NEW = {"references": {}}  # of a pad without an earlier baseline
UNZEROED = {"baseline": "not known"}
STUCK, TORN = {"stuck taxels": "wrong"}, {"torn scans": "wrong"}
OLD = TORN | dict.fromkeys(("noise", "drift", "baseline"), "not known")
SEAM = np.stack([np.zeros((4, 4), dtype=np.int32)] * 2 + [REST[2] - 65_535])


def with_taxel(counts, taxel, readings):
    """Return readings (n, 3, 4, 4) with those of one taxel replaced."""
    counts = counts.copy()
    counts.reshape(*counts.shape[:2], 16)[:, :, taxel] = readings
    return counts


def pressed(counts_more, since=0):
    """Return a change that loads one taxel from a scan on."""

    def press(counts):
        counts[since:, 2, 1, 1] += counts_more
        return counts

    return press


def swaying(counts):
    counts[:, 2, 1, 1] += (20 * np.cos(np.arange(400) * np.pi / 50)).astype(np.int32)
    return counts


REVERSED = {"mountings": {"4": Mounting(signs=(1, 1, -1))}}


class TestSensor:
    def test_a_healthy_one_is_ok_in_every_line_and_may_be_zeroed(self):
        examined = judge(watched(as_scans(healthy_counts()), references={"4": FREE}), 5.0)
        assert {finding.verdict for finding in examined.findings} == {"ok"} and len(examined.findings) == 11
        assert not any(finding.remedy for finding in examined.findings)
        baseline = examined.baselines["4"]
        assert np.abs(baseline.counts - REST).max() <= 1 and baseline.created_unix_s == 5.0

    @pytest.mark.parametrize(("sigma", "verdict"), [(4.6, "look"), (9.0, "wrong")])
    def test_noise(self, sigma, verdict):
        counts = healthy_counts()
        counts[:, 0, 1, 1] += np.rint(np.random.default_rng(3).normal(0, sigma, len(counts))).astype(np.int32)
        # So loud a taxel cannot be zeroed, and the report shows that consequence.
        assert faults(as_scans(counts)) == {"noise": verdict, "baseline": "not known"}
        assert "taxel 5 alone is noisy" in remedy_of("noise", as_scans(counts))

    @pytest.mark.parametrize("sigma", [1.2, 2.0, 3.0])
    def test_noise_is_measured_right_and_creeping_is_none(self, sigma):
        counts = healthy_counts(2000, sigma=sigma) + np.linspace(0, 500, 2000).astype(np.int32)[:, None, None, None]
        noise = Samples(as_scans(counts, times_ns(2000))).noise_counts()
        rounding = 0.45  # of the readings, and of the creeping
        assert np.median(noise) == pytest.approx(np.hypot(sigma, rounding), rel=0.05)

    @pytest.mark.parametrize(
        ("change", "given", "expected", "words"),
        [
            (lambda counts: silenced(counts, [6]), {}, {"silent taxels": "wrong"} | UNZEROED, "makes up for"),
            (lambda counts: silenced(counts, [6], slice(0, 400, 10)), {}, TORN, "taxel 6 comes and goes"),
            (lambda counts: silenced(counts, [6, 9], slice(0, 400, 10)), {}, TORN, "frames are lost on the way"),
            (lambda counts: counts[np.arange(400) // 2 * 2], {}, TORN, "repeats itself"),
            (lambda counts: with_taxel(counts, 10, REST[:, 2, 2]), {}, STUCK, "broken"),
            (lambda counts: np.repeat(counts[:1], 400, axis=0), {}, STUCK | OLD, "one old scan"),
            (lambda counts: with_taxel(counts, 15, counts[:, :, 3, 3] + [0, 15_000, 0]), NEW, {"rest levels": "look"},
             "rests far from the others"),
            (lambda counts: with_taxel(counts, 10, [30_000, 30_000, 65_535]), NEW, STUCK | {"rest levels": "look"},
             "overloaded"),
            (lambda counts: (counts - SEAM) % 65_536, NEW, {}, ""),
            (swaying, {}, {"baseline": "wrong"}, "keep the pad still"),
            (pressed(800), {}, {"load": "wrong"}, "free the pad"),
            (pressed(800), NEW, {}, ""),  # without an earlier baseline a load cannot be seen
            (pressed(-800), {}, {"load": "wrong"}, "taken of a loaded pad"),
            (pressed(-800), REVERSED, {"load": "wrong"}, "free the pad"),  # a press, where z is reversed
            (lambda counts: silenced(counts, [1, 2, 3], slice(0, 1)), {}, {}, ""),  # a first scan cut in mid-cycle
            (lambda counts: counts[:20], {}, {"scans": "wrong"}, ""),
            (lambda counts: counts[:80], {}, UNZEROED, ""),
        ],
    )  # fmt: skip
    def test_readings_by_themselves(self, change, given, expected, words):
        scans = as_scans(change(healthy_counts()))
        assert faults(scans, **given) == ({"load": "not known"} if given == NEW else {}) | expected
        assert not words or words in remedy_of(next(iter(expected)), scans, **given)

    @pytest.mark.parametrize(("counts_more", "words"), [(150, "warm up for ten minutes"), (800, "something pressed")])
    def test_what_to_do_fits_the_drift(self, counts_more, words):
        assert words in remedy_of("drift", as_scans(pressed(counts_more, since=5000)(healthy_counts(6000))))

    @pytest.mark.parametrize(("counts_moved", "verdict"), [(15, "look"), (60, "wrong")])
    def test_drift_of_all_taxels(self, counts_moved, verdict):
        """15 in each are 240 of the summed z: to look at; 60 are 960, more than what ends a tap."""
        drift = np.zeros((6000, 3, 1, 1))
        drift[:, 2] = np.linspace(0, counts_moved * 1.12, 6000)[:, None, None]
        counts = np.rint(healthy_counts(6000) + drift).astype(np.int32)
        assert faults(as_scans(counts, times_ns(6000)), duration_s=60.0) == {"drift": verdict}

    def test_lost_scans_are_counted_by_the_gaps(self):
        kept = np.ones(400, dtype=bool)
        kept[[50, 120, 121]] = False
        scans = as_scans(healthy_counts()[kept], times_ns()[kept])
        assert Samples(scans).lost() == 3
        assert faults(scans) == {"lost scans": "look"}

        late = times_ns()  # a scan that is only late is none lost
        late[200] += 9_000_000
        late[201] = max(late[201], late[200])
        late[399] += 9_000_000
        assert faults(as_scans(healthy_counts(), late)) == {}

    def test_a_sensor_that_fell_silent_is_named(self):
        scans = as_scans(healthy_counts())
        assert faults(scans, until_ns=scans[-1].time_ns + 9_000_000_000) == {"lost scans": "wrong"}
        assert faults(scans, until_ns=scans[-1].time_ns + 1_000_000_000) == {}
        both = {"4": as_scans(healthy_counts(700), times_ns(700)), "6": as_scans(healthy_counts(), sensor="6")}
        found = judge(Watched(both, COUNTERS, 7.0), 0.0).findings
        assert [(one.sensor, one.name) for one in found if one.verdict == "wrong"] == [("6", "lost scans")]

    @pytest.mark.parametrize(
        ("rate_hz", "wanted_hz", "verdict"), [(50, None, "look"), (50, 50, None), (100, 50, "look")]
    )
    def test_rate(self, rate_hz, wanted_hz, verdict):
        scans = as_scans(healthy_counts(), times_ns(rate_hz=rate_hz))
        assert faults(scans, rate_hz=wanted_hz).get("rate") == verdict

    def test_ctrl_c_at_once_makes_no_fault(self):
        for stopped, length_s, verdict in ((True, 0.3, "not known"), (True, 1.5, "wrong"), (False, 0.3, "wrong")):
            few = Watched({"4": as_scans(healthy_counts(20))}, COUNTERS, length_s, stopped=stopped)
            assert [one.verdict for one in judge(few, 0.0).findings if one.name == "scans"] == [verdict]


class TestLine:
    @pytest.mark.parametrize(
        ("counters", "verdict", "words"),
        [
            ({"received_bytes": 0, "frames": 0}, "wrong", "both USB plugs"),
            ({"received_bytes": 5000, "frames": 0, "bad_lines": 70}, "wrong", "line speed"),
            ({"received_bytes": 2, "frames": 0, "refusals": 2}, "wrong", "held open"),
            (COUNTERS | {"bad_lines": 1}, "ok", ""),
            (COUNTERS | {"bad_lines": 9}, "look", "garbled"),
            (COUNTERS | {"bad_lines": 900}, "wrong", "garbled"),
            ({"receive_overruns": 3}, "look", "loses frames"),
        ],
    )
    def test_counters(self, counters, verdict, words):
        finding = check_link(Watched(counters=counters, duration_s=4.0))
        assert finding is not None and finding.verdict == verdict and words in finding.remedy
        assert check_link(Watched(counters={"scans": 5}, duration_s=1.0)) is None

    @pytest.mark.parametrize(
        ("baud", "rate_hz", "verdict"),
        [(3_000_000, 100, "ok"), (115_200, 32, "wrong"), (230_400, 20, "look"), (115_200, 100, "ok")],
    )
    def test_baud(self, baud, rate_hz, verdict):
        counters = {"received_bytes": 22 * 16 * rate_hz * 4, "frames": 16 * rate_hz * 4}
        finding = check_baud(Watched(counters=counters, duration_s=4.0, port="/dev/ttyUSB0", baud=baud), 1)
        assert finding is not None and finding.verdict == verdict

    def test_a_full_line_is_the_only_thing_wrong(self):
        rate_hz = 115_200 / 10 / (22 * 16)
        counters = {"received_bytes": 115_200 // 10 * 4, "frames": int(115_200 / 220 * 4)}
        scans = as_scans(healthy_counts(), times_ns(rate_hz=rate_hz))
        found = faults(scans, counters=counters, port="/dev/ttyUSB0", baud=115_200, latency_ms=1)
        assert found == {"rate": "not known", "baud rate": "wrong"}

    def test_latency_by_the_timer(self):
        held = check_latency(Watched(port="/dev/ttyUSB0", latency_ms=16))
        assert held.verdict == "wrong" and "ttyUSB0/latency_timer" in held.remedy
        assert check_latency(Watched(port="/dev/ttyUSB0", latency_ms=1)).verdict == "ok"
        assert check_latency(Watched(port="/dev/ttyACM0")) is None


def ids_of(model, sensor):
    return [can_id for can_id, _ in model.wire_order(sensor)]


class TestIdMap:
    @pytest.mark.parametrize("spoken", ID_MAPS)
    @pytest.mark.parametrize("asked", ID_MAPS)
    def test_the_map_to_try_is_that_of_the_ids_heard(self, asked, spoken):
        sensor = {"uSPa44": "4", "uSPa46": "4", "XR1944": "4", "A": "1", "B": "1a"}[spoken]
        heard = Watched(ids=frozenset(ids_of(ID_MAPS[spoken], sensor)), model=ID_MAPS[asked])
        finding = check_id_map(heard, half_silent={asked, spoken} == {"uSPa44", "XR1944"})
        if asked == spoken or (asked, spoken) == ("B", "A"):  # the ids of A's board 1 are those of B's 7b
            sensor = {"AB": "7b"}.get(spoken + asked, sensor)
            assert finding.verdict == "ok" and f"sensor {sensor} received" in finding.measured
        else:
            assert finding.verdict == "wrong" and finding.remedy.startswith(f"--id-map {spoken}")

    def test_half_a_sensor_of_another_map_is_no_defect(self):
        """The two boards share half of their ids."""
        counts = silenced(healthy_counts(), list(range(8)))
        found = faults(as_scans(counts), ids=frozenset(ids_of(XR1944_MAP, "4")))
        assert found["id map"] == "wrong" and found["silent taxels"] == "not known"

    @pytest.mark.parametrize(
        ("ids", "model", "half_silent", "verdict", "words"),
        [
            (ids_of(USPA44_MAP, "4")[:8], USPA44_MAP, True, "wrong", "8 ids received, 8 of them uSPa44's: 0x004"),
            ([*ids_of(USPA44_MAP, "4"), *ids_of(XR1944_MAP, "6")], USPA44_MAP, True, "wrong", "XR1944 (sensor 6)"),
            (ids_of(XR1944_MAP, "4")[1:], XR1944_MAP, False, "ok", "15 ids received"),  # a silent taxel alone
        ],
    )
    def test_a_sensor_with_a_fault_is_not_talked_into_another_map(self, ids, model, half_silent, verdict, words):
        finding = check_id_map(Watched(ids=frozenset(ids), model=model), half_silent)
        assert finding is not None and finding.verdict == verdict and words in finding.measured
        assert check_id_map(Watched(model=model), half_silent) is None, "a link without ids says nothing of maps"


def test_each_finding_has_a_row():
    source = "".join(path.read_text() for path in (ROOT / "edge" / "doctor").glob("*.py"))
    names = set(re.findall(r'\b(?:Finding|judged)\(\s*"([^"]+)"', source))
    assert {"link", "noise", "taxel order", "latency timer"} <= names
    page = (ROOT / "docs" / "trouble.md").read_text()
    rows = {one.strip() for line in page.splitlines() if line.startswith("| ") for one in line.split("|")[1].split(",")}
    assert names <= rows, names - rows
