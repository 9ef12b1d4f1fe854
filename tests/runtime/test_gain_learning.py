"""Gains that a running sensor learns from its contacts: bounded, robust, kept, and forgotten on demand."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from edge_samples import BASELINE, FakeLink, FakeModel, make_pad_contract
from runtime_samples import make_runtime
from trust_samples import make_trust

from edge.cli import main as cli
from edge.errors import EdgeError
from edge.inference.bundled import CONTACTS
from edge.perception.contact_options import RuntimeOptions
from edge.perception.gain_following import CONTRADICTED_CONTACTS, HELD_SCANS, GainFollower, Learn, SensorPad
from edge.perception.gain_learning import BOUND, REMEMBERED, SOLVE_EVERY, ContactModel, GainLearner, load_contact_model
from edge.perception.pattern_check import PatternCheck
from edge.pipeline.gain_keeper import GainKeeper, forget_learned, keep_learned
from edge.pipeline.result_stream import Stream
from edge.pipeline.scan_reader import Source
from firmware_bridge.errors import SensorFileError
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.scans.pad_constants import GAINS, Pad
from firmware_bridge.scans.scan import ScanSeries
from firmware_bridge.sensor_file.model import SensorEntry, SensorFile, load_sensor_file
from firmware_bridge.sensor_file.toml_writer import save_sensor_file

Z = slice(32, 48)
ALL_ALIVE = np.zeros((4, 4), dtype=bool)


def make_model(seed=0, kinds=3):
    """Return a model of a few kinds of contacts on pads that are all alike."""
    rng = np.random.default_rng(seed)
    means = np.zeros((kinds, 2, GAINS))
    means[:, 0] = rng.normal(0, 0.3, (kinds, GAINS))
    means[:, 0, Z] = 1 + rng.normal(0, 0.25, (kinds, 16))
    means[:, 0, Z] /= np.sqrt(np.square(means[:, 0, Z]).mean(axis=1, keepdims=True))
    mixing = rng.normal(0, 0.08, (kinds, GAINS, 4))
    covariances = mixing @ mixing.transpose(0, 2, 1) + 1e-3 * np.eye(GAINS)
    logs = -0.5 * np.linalg.slogdet(covariances)[1] - np.log(kinds)
    precisions = np.linalg.inv(covariances).astype(np.float32)
    return ContactModel(logs, means, precisions, 1.0, np.zeros(GAINS), (("poisson", 0.445, 0.045),), 1.0), covariances


MODEL, COVARIANCES = make_model()


def draw_contacts(count, gains=None, seed=1):
    """Return contacts (count, 3, 4, 4) in counts as a sensor of these gains reads them."""
    rng = np.random.default_rng(seed)
    kinds = rng.integers(len(COVARIANCES), size=count)
    drawn = np.array([rng.multivariate_normal(MODEL.means[kind, 0], COVARIANCES[kind]) for kind in kinds])
    drawn /= np.sqrt(np.square(drawn[:, Z]).mean(axis=1, keepdims=True))
    gains = np.ones(GAINS) if gains is None else gains
    return (drawn * gains * rng.uniform(500, 900, (count, 1))).reshape(count, 3, 4, 4).astype(np.float32)


def draw_gains(seed=2, spread=0.075):
    logs = np.random.default_rng(seed).normal(0, spread, (3, 16)).clip(-0.2, 0.2)
    return np.exp(logs - logs.mean(axis=1, keepdims=True)).ravel()


def taught(contacts, model=MODEL, start=None, dead=None):
    learner = GainLearner(model, start)
    for contact in contacts:
        learner.learn(contact, dead)
    learner.solve()
    return learner


def rms(logs):
    return float(np.sqrt(np.square(logs).mean()))


class TestFileOfAnotherSensor:
    WIDTHS = (0.03,) * GAINS

    def follow(self, gains_in_file, count=120):
        true = draw_gains()
        file = Pad(gains=tuple(gains_in_file), gain_half_widths=self.WIDTHS)
        contract, events = make_pad_contract(), []
        check = PatternCheck(make_trust(), contract)
        pad = SensorPad(contract, file, None, check)
        learn = Learn(GainFollower(MODEL, file), pad, check, lambda kind, detail="": events.append((kind, detail)))
        step, made = SimpleNamespace(force_counts=5000.0), SimpleNamespace(trusted=None)
        for contact in draw_contacts(count, true):
            learn(step, made, contact, ALL_ALIVE)
            learn.learn(ALL_ALIVE)
        return check, events

    def test_gains_of_another_sensor_are_contradicted_once_and_nothing_is_believed(self):
        check, events = self.follow(draw_gains(seed=9))
        assert check.suspected
        ((place, text),) = [(place, text) for place, (kind, text) in enumerate(events) if kind == "suspected"]
        assert "another sensor's file" in text and place == len(events) - 1, "nothing is learned after it"

    def test_its_own_gains_are_not(self):
        check, events = self.follow(draw_gains())
        assert not check.suspected and "suspected" not in dict(events)

    def test_it_takes_some_contacts(self):
        check, _ = self.follow(draw_gains(seed=9), CONTRADICTED_CONTACTS - 1)
        assert not check.suspected


class TestRestart:
    def test_what_was_learned_before_is_used_but_is_no_beginning(self):
        true = draw_gains()
        learned = taught(draw_contacts(200, true)).pad()
        follower = GainFollower(MODEL, None, learned)
        assert np.array_equal(follower._learner.gains, np.ones(GAINS)) and not follower.contradicts_file
        pads = []
        for contact in draw_contacts(100, true, seed=5):
            follower.see(None, 5000.0, contact)
            pads.append(follower.learn(ALL_ALIVE))
        taken = [pad for pad in pads if pad is not None]
        assert all(pad.gains_certainty >= learned.gains_certainty for pad in taken)

    def test_contacts_make_measured_gains_no_surer_than_they_are(self):
        measured = Pad(gains=tuple(draw_gains()), gain_half_widths=(0.03,) * GAINS)
        learner = taught(draw_contacts(200, draw_gains()), start=measured)
        assert learner.pad().gains_certainty <= measured.gains_certainty + 1e-4  # half widths are rounded

    def test_an_untrusted_scan_takes_back_what_its_contact_would_teach(self):
        follower = GainFollower(MODEL, None)
        follower.see(None, 5000.0, draw_contacts(1)[0])
        assert follower.waiting
        follower.see(False, 5000.0, draw_contacts(1)[0])
        assert not follower.waiting


class TestLearner:
    def test_gains_are_recovered_within_their_intervals(self):
        off, inside = [], []
        for seed in range(4):
            gains = draw_gains(seed)
            learner = taught(draw_contacts(200, gains, seed + 10))
            error = np.log(learner.gains / gains)
            off.append(rms(error))
            inside.append(np.abs(error) <= learner.pad().gain_half_widths)
            assert rms(error) < rms(np.log(gains)) / 2
        assert np.mean(inside) > 0.85, off

    def test_more_contacts_are_surer(self):
        sure = [taught(draw_contacts(count, draw_gains())).pad().gains_certainty for count in (1, 20, 60, 200)]
        assert sure == sorted(sure) and sure[0] < 0.1 < 0.5 < sure[-1]

    def test_nothing_leaves_the_bounds(self):
        gains = draw_gains(spread=0.2) ** 4
        learner = taught(draw_contacts(300, gains.clip(0.3, 3)))
        assert np.abs(learner.gains - 1).max() <= BOUND + 1e-9
        assert np.isfinite(learner.gains).all() and np.isfinite(learner.deviations).all()

    def test_always_the_same_contact_teaches_once(self):
        contact = draw_contacts(1)[0]
        rng = np.random.default_rng(0)
        learner = GainLearner(MODEL)
        for _ in range(300):
            learner.learn(contact * rng.uniform(0.7, 1.2) + rng.normal(0, 2, contact.shape))
        assert learner.contacts == 1

    def test_weak_clipped_and_unexplained_contacts_teach_nothing(self):
        contact = draw_contacts(1)[0]
        clipped, strange = contact.copy(), contact.copy()
        clipped[0, 1, 1] = 1400
        strange[2] = 0
        strange[2, 0, 0] = 3000
        learner = GainLearner(MODEL)
        for one in (contact * 0.1, clipped, strange):
            assert not learner.learn(one)
        assert learner.contacts == 0
        assert learner.learn(contact) is False and learner.contacts == 1

    def test_a_dead_taxel_is_left_out_and_does_not_spoil_the_others(self):
        gains = draw_gains(5)
        contacts = draw_contacts(200, gains)
        dead = np.zeros((4, 4), dtype=bool)
        dead[1, 2] = True
        estimated = draw_contacts(200, None).reshape(200, 3, 16)[:, :, 6]
        contacts.reshape(200, 3, 16)[:, :, 6] = estimated
        learner = taught(contacts, dead=dead)
        alive = np.tile(~dead.ravel(), 3)
        assert rms(np.log(learner.gains / gains)[alive]) < rms(np.log(gains)) / 2
        assert learner.deviations[~alive].min() > learner.deviations[alive].max()

    def test_drift_that_stays_is_not_taken_for_gains(self):
        contacts = draw_contacts(200)
        drift = np.zeros((3, 4, 4))
        drift[2] = 45 + np.random.default_rng(0).normal(0, 12, (4, 4))
        assert rms(np.log(taught(contacts + drift).gains)) < 0.03

    def test_it_begins_at_measured_gains_and_stays_where_they_are_right(self):
        gains = draw_gains()
        start = Pad(gains=tuple(gains.tolist()), gain_half_widths=(0.02,) * GAINS)
        learner = GainLearner(MODEL, start)
        np.testing.assert_allclose(learner.gains, gains)
        assert learner.pad().gains_certainty == pytest.approx(start.gains_certainty, abs=0.02)
        learner = taught(draw_contacts(200, gains), start=start)
        assert rms(np.log(learner.gains / gains)) < 0.015
        assert learner.pad().gains_certainty >= start.gains_certainty

    def test_its_memory_does_not_grow(self):
        learner = GainLearner(MODEL)
        size = {name: getattr(value, "nbytes", 0) for name, value in vars(learner).items()}
        for contact in draw_contacts(REMEMBERED + 3 * SOLVE_EVERY):
            learner.learn(contact)
        assert {name: getattr(value, "nbytes", 0) for name, value in vars(learner).items()} == size


class TestModel:
    def test_the_one_that_comes_with_the_package(self):
        model = load_contact_model(CONTACTS)
        assert len(model.means) >= 24 and CONTACTS.stat().st_size < 400_000
        np.testing.assert_allclose(GainLearner(model).gains, 1)

    def test_a_file_that_is_none_is_named(self, tmp_path):
        np.savez(
            tmp_path / "c.npz", **{name: np.zeros(3) for name in ("share", "means", "factors", "widening", "bias")}
        )
        with pytest.raises(EdgeError, match=r"c\.npz cannot be read .*train\.learning\.contact_mixture"):
            load_contact_model(tmp_path / "c.npz")


class Run:
    """Runtime that taps contacts one after the other; keeps the results."""

    def __init__(self, *, pad=None, learn=True, contract=None, every_scan=False):
        self.model = FakeModel(contract or make_pad_contract(taps=1))
        self.runtime = make_runtime(
            self.model, contacts=MODEL, pad=pad, options=RuntimeOptions(learn=learn, every_scan=every_scan)
        )
        self.results = []
        self._series = ScanSeries("4", USPA44)
        self._rng = np.random.default_rng(3)
        self.tap(np.zeros((3, 4, 4)))  # a contact begins from rest

    def tap(self, contact, scans=1):
        for felt in [contact] * scans + [np.zeros((3, 4, 4))]:
            noise = self._rng.normal(0, 2, (3, 4, 4))
            counts = np.rint(BASELINE.counts + felt + noise).astype(np.int32)
            self.results.append(self.runtime.push(self._series.close(counts, 10_000_000 * (len(self.results) + 1))))


class TestRuntime:
    def test_learned_gains_come_into_use_with_an_event_and_reach_the_model(self):
        gains, run = draw_gains(), Run()
        for contact in draw_contacts(120, gains):
            run.tap(contact)
        events = [event for result in run.results for event in result.events]
        assert {event.kind for event in events} == {"gains_learned"}
        assert events[0].sensor == "4" and "gains learned from" in events[0].text
        learned = run.runtime.take_learned()["4"]
        assert learned.gains is not None and run.runtime.take_learned() == {}
        assert rms(np.log(np.array(learned.gains) / gains)) < rms(np.log(gains)) / 2
        assert run.results[0].gains_certainty is None
        assert run.results[-1].gains_certainty == pytest.approx(learned.gains_certainty, abs=0.05)
        assert run.model.pads[-1][-1] == pytest.approx(run.results[-1].gains_certainty)
        assert run.model.pads[0][-1] == 0

    def test_without_learning_everything_is_as_before(self):
        run = Run(learn=False)
        for contact in draw_contacts(60, draw_gains()):
            run.tap(contact)
        assert not any(result.events for result in run.results)
        assert run.runtime.take_learned() == {} and run.results[-1].gains_certainty is None

    def test_a_free_pad_costs_and_teaches_nothing(self, monkeypatch):
        run = Run()
        monkeypatch.setattr(GainFollower, "learn", lambda *_: pytest.fail("there was no contact"))
        monkeypatch.setattr(GainFollower, "see", lambda *_: pytest.fail("there was no contact"))
        for _ in range(50):
            run.tap(np.zeros((3, 4, 4)))

    def test_results_that_are_not_trusted_teach_nothing(self):
        contact = draw_contacts(1)[0]
        follower = GainFollower(MODEL, None)
        for _ in range(2 * HELD_SCANS):
            assert not follower.see(False, 5000.0, contact)
        assert not follower.waiting
        assert not follower.see(None, 5000.0, contact)
        assert follower.waiting

    def test_a_long_hold_is_learned_from_while_it_lasts(self, monkeypatch):
        run = Run(every_scan=True)
        learn = GainFollower.learn
        learned = []
        monkeypatch.setattr(GainFollower, "learn", lambda self, dead: learned.append(1) or learn(self, dead))
        run.tap(draw_contacts(1)[0], scans=HELD_SCANS + 5)
        assert len(learned) == 2, "after the hold's first part, and after the rest of it"

    def test_gains_by_hand_are_not_replaced_by_less_certain_ones(self):
        sure = Pad(gains=(1.0,) * GAINS, gain_half_widths=(0.01,) * GAINS)
        run = Run(pad=sure)
        for contact in draw_contacts(60):
            run.tap(contact)
        assert all(result.gains_certainty >= sure.gains_certainty for result in run.results)


LEARNED = Pad(gains=tuple(draw_gains().round(4).tolist()), gain_half_widths=(0.05,) * GAINS)
SURER = replace(LEARNED, gain_half_widths=(0.03,) * GAINS)


class TestKeeping:
    @pytest.fixture
    def file(self, tmp_path):
        path = tmp_path / "sensor.toml"
        save_sensor_file(path, SensorFile(adapter="D30BL366", sensors={"4": SensorEntry(baseline=BASELINE)}))
        return path

    def test_a_keeper_writes_beside_what_the_file_holds(self, file):
        keeper = GainKeeper(file, emulated=False)
        keeper.keep("4", LEARNED)
        keeper.keep("6", SURER)
        keeper.close()
        known = load_sensor_file(file)
        assert keeper.trouble is None and known.adapter == "D30BL366" and known.baselines["4"].id == BASELINE.id
        assert known.pads == {"4": LEARNED, "6": SURER}

    def test_two_runs_that_learn_into_one_file_lose_nothing_of_each_other(self, file):
        keepers = [GainKeeper(file, emulated=False) for _ in range(2)]
        for number in range(24):
            keepers[number % 2].keep(str(number), LEARNED)
        for keeper in keepers:
            keeper.close()
            assert keeper.trouble is None
        assert load_sensor_file(file).pads.keys() == {str(number) for number in range(24)}

    def test_surer_gains_are_not_overwritten(self, file):
        for learned in (SURER, LEARNED):
            keep_learned(file, "4", learned)
        assert load_sensor_file(file).sensors["4"].learned == SURER

    def test_gains_of_an_emulated_sensor_do_not_enter_the_file_of_a_real_one(self, file):
        keep_learned(file, "4", LEARNED, emulated=True)
        assert load_sensor_file(file).sensors["4"].learned is None
        save_sensor_file(file, SensorFile(sensors={"4": SensorEntry(emulated=frozenset(("baseline",)))}))
        keep_learned(file, "4", LEARNED, emulated=True)
        assert load_sensor_file(file).sensors["4"].learned == LEARNED

    def test_a_file_that_went_away_is_reported_and_ends_nothing(self, tmp_path):
        keeper = GainKeeper(tmp_path / "gone.toml", emulated=False)
        keeper.keep("4", LEARNED)
        keeper.close()
        assert keeper.trouble is not None and "gone.toml: cannot be read" in keeper.trouble

    @pytest.mark.parametrize("ends", [True, False])
    def test_a_stream_reports_that_gains_cannot_be_kept(self, file, ends):
        events = []
        with Source(FakeLink([], endless=not ends), sensor_file=load_sensor_file(file)) as source:
            stream = Stream(source, make_runtime(FakeModel()), on_event=events.append)
            file.unlink()
            stream._loop._keeper.keep("4", LEARNED)
            if ends:
                assert list(stream) == []
            else:
                assert stream.latest().result is None  # closing the source ends it
        assert [event.kind for event in events] == ["note"]
        assert "learned gains are not kept: " in events[0].text and "cannot be read" in events[0].text

    def test_one_command_forgets_them(self, file, capsys):
        keep_learned(file, "4", LEARNED)
        assert cli.main(["doctor", "--sensor", str(file), "--forget-gains", "4"]) == 0
        assert capsys.readouterr().out == f"{file}: learned gains of sensor 4 removed\n"
        left = load_sensor_file(file)
        assert left.pads == {} and left.baselines["4"].id == BASELINE.id
        with pytest.raises(
            SensorFileError, match="no learned gains of sensor 4, expected one that has them: of no sensor"
        ):
            forget_learned(file, "4")
        assert cli.main(["doctor", "--forget-gains", "4"]) == 2
        assert "add --sensor FILE" in capsys.readouterr().err

    @pytest.mark.parametrize(("kind", "kept"), [("device", True), ("emulated", False), ("replay", False)])
    def test_a_stream_keeps_what_its_runtime_learns_of_a_device(self, file, kind, kept):
        series, scans = ScanSeries("4", USPA44), []
        for contact in draw_contacts(100, draw_gains()):
            for felt in (contact, np.zeros((3, 4, 4))):
                counts = np.rint(BASELINE.counts + felt).astype(np.int32)
                scans.append([series.close(counts, 10_000_000 * (len(scans) + 1))])
        link = FakeLink(scans, kind=kind)
        link.patient = True  # else newer scans overtake contacts, and those get no pattern
        with Source(link, sensor_file=load_sensor_file(file)) as source:
            model = FakeModel(make_pad_contract(taps=1))
            runtime = make_runtime(model, contacts=MODEL, source=kind)
            last = list(Stream(source, runtime))[-1]
        learned = load_sensor_file(file).sensors["4"].learned
        assert last.gains_certainty is not None and last.gains_certainty > 0.1
        assert (learned is not None) == kept
        if learned is not None:
            assert learned.gains_certainty == pytest.approx(last.gains_certainty, abs=1e-6)
