"""Gains that a running sensor learns from its contacts: bounded, robust, kept, and forgotten on demand."""

import fcntl
import os
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from edge_samples import BASELINE, FakeLink, FakeModel, make_pad_contract
from runtime_samples import make_runtime
from trust_samples import make_trust

from edge.api import USPA44, EdgeError, SensorFileError, Source, Stream
from edge.cli import main as cli
from edge.inference.bundled import CONTACTS_FILE
from edge.perception.gain_learning import (
    BOUND,
    CONTRADICTED_CONTACTS,
    ContactModel,
    GainLearner,
    Learn,
    load_contact_model,
)
from edge.perception.run_options import RuntimeOptions
from edge.perception.trust_check import PatternCheck, SensorPad
from edge.pipeline.gain_keeper import GainKeeper, forget_learned, keep_learned
from firmware_bridge.pad_geometry import CHANNELS
from firmware_bridge.scans.pad_constants import Pad
from firmware_bridge.scans.scan import ScanSeries
from firmware_bridge.sensor_file.model import SensorEntry, SensorFile, load_sensor_file
from firmware_bridge.sensor_file.toml_writer import save_sensor_file

Z = slice(32, 48)
ALL_ALIVE = np.zeros((4, 4), dtype=bool)
FREE = np.zeros((3, 4, 4))


def make_model(seed=0):
    """Return a model of three kinds of contacts on pads that are all alike, and what draws from each kind."""
    rng, kinds = np.random.default_rng(seed), 3
    means = np.zeros((kinds, 2, CHANNELS))
    means[:, 0] = rng.normal(0, 0.3, (kinds, CHANNELS))
    means[:, 0, Z] = 1 + rng.normal(0, 0.25, (kinds, 16))
    means[:, 0, Z] /= np.sqrt(np.square(means[:, 0, Z]).mean(axis=1, keepdims=True))
    mixing = rng.normal(0, 0.08, (kinds, CHANNELS, 4))
    covariances = mixing @ mixing.transpose(0, 2, 1) + 1e-3 * np.eye(CHANNELS)
    logs = -0.5 * np.linalg.slogdet(covariances)[1] - np.log(kinds)
    precisions = np.linalg.inv(covariances).astype(np.float32)
    constants = (("poisson", 0.445, 0.045),)
    return ContactModel(logs, means, precisions, 1.0, np.zeros(CHANNELS), constants, 1.0), np.linalg.cholesky(
        covariances
    )


MODEL, ROOTS = make_model()


def draw_contacts(count, gains=None, seed=1):
    """Return contacts (count, 3, 4, 4) in counts as a sensor of these gains reads them."""
    rng = np.random.default_rng(seed)
    kinds = rng.integers(len(ROOTS), size=count)
    drawn = MODEL.means[kinds, 0] + (ROOTS[kinds] @ rng.normal(size=(count, CHANNELS, 1)))[:, :, 0]
    drawn /= np.sqrt(np.square(drawn[:, Z]).mean(axis=1, keepdims=True))
    gains = np.ones(CHANNELS) if gains is None else gains
    return (drawn * gains * rng.uniform(500, 900, (count, 1))).reshape(count, 3, 4, 4).astype(np.float32)


def draw_gains(seed=2, spread=0.075):
    logs = np.random.default_rng(seed).normal(0, spread, (3, 16)).clip(-0.2, 0.2)
    return np.exp(logs - logs.mean(axis=1, keepdims=True)).ravel()


def taught(contacts, start=None, dead=None):
    learner = GainLearner(MODEL, start)
    for contact in contacts:
        learner.learn(contact, dead)
    learner.solve()
    return learner


def rms(logs):
    return float(np.sqrt(np.square(logs).mean()))


class TestLearner:
    def test_gains_are_recovered_within_their_intervals(self):
        gains = draw_gains()
        learners = [taught(draw_contacts(count, gains)) for count in (1, 20, 120)]
        error = np.log(learners[-1].gains / gains)
        assert rms(error) < rms(np.log(gains)) / 2
        assert np.mean(np.abs(error) <= learners[-1].pad().gain_half_widths) > 0.85
        sure = [learner.pad().gains_certainty for learner in learners]
        assert sure == sorted(sure) and sure[0] < 0.1 < 0.5 < sure[-1]

    def test_nothing_leaves_the_bounds(self):
        learner = taught(draw_contacts(120, (draw_gains(spread=0.2) ** 4).clip(0.3, 3)))
        assert np.abs(learner.gains - 1).max() <= BOUND + 1e-9
        assert np.isfinite(learner.gains).all() and np.isfinite(learner.deviations).all()

    def test_weak_clipped_strange_or_repeated_contacts_teach_nothing(self):
        contact, rng, learner = draw_contacts(1)[0], np.random.default_rng(0), GainLearner(MODEL)
        clipped, strange = contact.copy(), contact.copy()
        clipped[0, 1, 1] = 1400
        strange[2] = 0
        strange[2, 0, 0] = 3000
        for one in (contact * 0.1, clipped, strange):
            assert not learner.learn(one) and learner.contacts == 0
        for _ in range(300):
            learner.learn(contact * rng.uniform(0.7, 1.2) + rng.normal(0, 2, contact.shape))
        assert learner.contacts == 1

    def test_a_dead_taxel_is_left_out_and_does_not_spoil_the_others(self):
        gains, dead = draw_gains(5), ALL_ALIVE.copy()
        contacts = draw_contacts(120, gains)
        dead[1, 2] = True
        contacts[:, :, dead] = draw_contacts(120, None)[:, :, dead]  # estimates, not what a gain has changed
        learner = taught(contacts, dead=dead)
        alive = np.tile(~dead.ravel(), 3)
        assert rms(np.log(learner.gains / gains)[alive]) < rms(np.log(gains)) / 2
        assert learner.deviations[~alive].min() > learner.deviations[alive].max()

    def test_drift_that_stays_is_not_taken_for_gains(self):
        drift = FREE.copy()
        drift[2] = 45 + np.random.default_rng(0).normal(0, 12, (4, 4))
        assert rms(np.log(taught(draw_contacts(70) + drift).gains)) < 0.03

    def test_it_begins_at_measured_gains_and_stays_there(self):
        gains = draw_gains()
        start = Pad(gains=tuple(gains.tolist()), gain_half_widths=(0.02,) * CHANNELS)
        learner = GainLearner(MODEL, start)
        np.testing.assert_allclose(learner.gains, gains)
        assert learner.pad().gains_certainty == pytest.approx(start.gains_certainty, abs=0.02)
        learner = taught(draw_contacts(120, gains), start=start)
        assert rms(np.log(learner.gains / gains)) < 0.015
        assert learner.pad().gains_certainty == pytest.approx(start.gains_certainty, abs=1e-4), "and no surer"

    def test_the_bundled_model_is_read_and_another_file_named(self, tmp_path):
        model = load_contact_model(CONTACTS_FILE)
        assert len(model.means) >= 24 and CONTACTS_FILE.stat().st_size < 400_000
        np.testing.assert_allclose(GainLearner(model).gains, 1)
        np.savez(tmp_path / "c.npz", share=np.zeros(3))
        with pytest.raises(EdgeError, match=r"c\.npz cannot be read .*train\.learning\.contact_mixture"):
            load_contact_model(tmp_path / "c.npz")


def learning_of(measured, used=None, check=None):
    """Return the stage of a sensor that learns, the pad in use, and the events that it reports."""
    pad, events = SensorPad(make_pad_contract(), None, used or measured, None), []
    return Learn(MODEL, measured, pad, check, lambda kind, detail="": events.append((kind, detail))), pad, events


def held(learn, contact, trusted=None):
    learn(SimpleNamespace(force_counts=5000.0), SimpleNamespace(trusted=trusted), contact)


class TestStage:
    @pytest.mark.parametrize(
        ("seed_in_file", "count", "contradicted"),
        [(9, 60, True), (2, 60, False), (9, CONTRADICTED_CONTACTS - 1, False)],
    )
    def test_gains_of_another_sensor_are_contradicted_once(self, seed_in_file, count, contradicted):
        file = Pad(gains=tuple(draw_gains(seed_in_file)), gain_half_widths=(0.03,) * CHANNELS)
        check = PatternCheck(make_trust(), make_pad_contract())
        learn, _, events = learning_of(file, file, check)
        for contact in draw_contacts(count, draw_gains()):
            held(learn, contact)
            learn.learn(ALL_ALIVE)
        suspected = [text for kind, text in events if kind == "suspected"]
        assert check.suspected == contradicted == len(suspected)
        assert not contradicted or ("another sensor's file" in suspected[0] and events[-1][0] == "suspected")

    def test_gains_learned_before_stay_until_new_ones_are_as_certain(self):
        learned = taught(draw_contacts(120, draw_gains())).pad()
        learn, pad, _ = learning_of(None, learned)
        for contact in draw_contacts(60, draw_gains(), seed=5):
            held(learn, contact)
            assert not learn.learn(ALL_ALIVE), "half as many contacts are less certain"
        assert pad.gains_certainty == learned.gains_certainty and learn.take_learned() is None

    def test_an_untrusted_scan_teaches_nothing(self):
        (learn, _, _), contact = learning_of(None), draw_contacts(1)[0]
        for trusted in (False, None, False):
            held(learn, contact, trusted)
            assert learn.waiting == (trusted is None)


def scans_of(contacts, noise=0.0):
    """Return a scan of each contact, followed by a free pad, as is the first."""
    series, rng, scans = ScanSeries("4", USPA44), np.random.default_rng(3), []
    for felt in [FREE, *(one for contact in contacts for one in (contact, FREE))]:
        counts = np.rint(BASELINE.counts + felt + rng.normal(0, noise, FREE.shape)).astype(np.int32)
        scans.append(series.close(counts, 10_000_000 * (len(scans) + 1)))
    return scans


@pytest.mark.parametrize("learn", [True, False])
def test_learned_gains_come_into_use_with_an_event(learn):
    gains, model = draw_gains(), FakeModel(make_pad_contract(taps=1))
    runtime = make_runtime(model, contacts=MODEL, options=RuntimeOptions(learn=learn))
    results = [runtime.push(scan) for scan in scans_of(draw_contacts(100, gains), noise=2)]
    events = [event for result in results for event in result.events]
    if not learn:
        assert events == [] and runtime.take_learned() == {} and results[-1].gains_certainty is None
        return
    assert {event.kind for event in events} == {"gains_learned"}
    assert events[0].sensor == "4" and "gains learned from" in events[0].text
    learned = runtime.take_learned()["4"]
    assert runtime.take_learned() == {} and rms(np.log(np.array(learned.gains) / gains)) < rms(np.log(gains)) / 2
    assert results[0].gains_certainty is None
    assert results[-1].gains_certainty == pytest.approx(learned.gains_certainty, abs=0.05)
    assert model.pads[-1][-1] == pytest.approx(results[-1].gains_certainty) and model.pads[0][-1] == 0


LEARNED = Pad(gains=tuple(draw_gains().round(4).tolist()), gain_half_widths=(0.05,) * CHANNELS)
SURER = replace(LEARNED, gain_half_widths=(0.03,) * CHANNELS)


class TestKeeping:
    @pytest.fixture
    def file(self, tmp_path):
        path = tmp_path / "sensor.toml"
        save_sensor_file(path, SensorFile(adapter="D30BL366", sensors={"4": SensorEntry(baseline=BASELINE)}))
        return path

    def test_two_runs_that_learn_into_one_file_lose_nothing(self, file):
        keepers = [GainKeeper(file, {}, emulated=False) for _ in range(2)]
        for number in range(12):
            keepers[number % 2].keep(str(number), LEARNED)
        for keeper in keepers:
            assert keeper.close() is None
        known = load_sensor_file(file)
        assert known.pads == {str(number): LEARNED for number in range(12)}
        assert known.adapter == "D30BL366" and known.baselines["4"].id == BASELINE.id

    def test_surer_gains_and_a_real_sensors_file_stay(self, file):
        keep_learned(file, "4", LEARNED, emulated=True)
        assert load_sensor_file(file).sensors["4"].learned is None
        for learned in (SURER, LEARNED):
            keep_learned(file, "4", learned)
        assert load_sensor_file(file).sensors["4"].learned == SURER
        save_sensor_file(file, SensorFile(sensors={"4": SensorEntry(emulated=frozenset(("baseline",)))}))
        keep_learned(file, "4", LEARNED, emulated=True)
        assert load_sensor_file(file).sensors["4"].learned == LEARNED

    def test_one_command_forgets_them_unless_the_file_is_locked(self, file, capsys):
        keep_learned(file, "4", LEARNED)
        assert cli.main(["doctor", "--sensor", str(file), "--forget-gains", "4"]) == 0
        assert capsys.readouterr().out == f"{file}: learned gains of sensor 4 removed\n"
        left = load_sensor_file(file)
        assert left.pads == {} and left.baselines["4"].id == BASELINE.id
        with pytest.raises(SensorFileError, match="no learned gains of sensor 4, expected one that has them: of no"):
            forget_learned(file, "4")
        assert cli.main(["doctor", "--forget-gains", "4"]) == 2
        assert "add --sensor FILE" in capsys.readouterr().err
        other = os.open(file.parent, os.O_RDONLY)
        fcntl.flock(other, fcntl.LOCK_EX)
        assert cli.main(["doctor", "--sensor", str(file), "--forget-gains", "4"]) == 2
        assert f"{file}: another program has kept it locked for 5 s" in capsys.readouterr().err
        os.close(other)

    @pytest.mark.parametrize("kind", ["device", "emulated", "replay", "file gone", "turned by hand"])
    def test_a_stream_keeps_what_its_runtime_learns_of_a_device(self, file, kind):
        changed = {"file gone": "cannot be read", "turned by hand": "the mounting of sensor 4 was"}.get(kind)
        events = []
        scans = scans_of(draw_contacts(8, draw_gains()))  # the last of which teaches as its pad is let go
        link = FakeLink([[scan] for scan in scans], kind="device" if changed else kind)
        link.patient = True  # else newer scans overtake contacts, and those get no pattern
        with Source(link, sensor_file=load_sensor_file(file)) as source:
            runtime = make_runtime(FakeModel(make_pad_contract(taps=1)), contacts=MODEL, source=source.kind)
            if kind == "file gone":
                file.unlink()
            elif kind == "turned by hand":
                file.write_text(file.read_text().replace("swap_xy = false", "swap_xy = true"))
            last = list(Stream(source, runtime, on_event=events.append))[-1]
        assert last.gains_certainty is not None and last.gains_certainty > 0.1
        if changed:
            assert [event.kind for event in events] == ["note"]
            assert "learned gains are not kept: " in events[0].text and changed in events[0].text
            assert not file.exists() or "learned" not in file.read_text()
            return
        learned = load_sensor_file(file).sensors["4"].learned
        assert (learned is not None) == (kind == "device")
        if learned is not None:
            assert learned.gains_certainty == pytest.approx(last.gains_certainty, abs=1e-6)
