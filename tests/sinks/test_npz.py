"""The npz sink: arrays of all scans, whole whatever ended their writer."""

import errno
import json
import os
import resource
import signal
import subprocess
import sys
import zipfile

import numpy as np
import pytest
from edge_samples import BASELINE, ROOT, FakeModel, make_contract, make_scan
from sink_samples import RUN, SHAPES, make_results, make_sure_results

from edge.errors import SinkError
from edge.perception.runtime import Runtime
from edge.sinks import npz
from edge.sinks.npz import NpzSink, gather, parts_dir
from edge.sinks.registry import open_sink
from firmware_bridge.recording.formats import load_recording


def test_an_npz_keeps_the_model_of_each_row_however_long_its_name(tmp_path):
    model = FakeModel()
    model.name = "n" * 100
    sink = NpzSink(tmp_path / "out.npz", *SHAPES)
    sink.write(Runtime(model, source="device", baselines={"4": BASELINE}).push(make_scan(0)), RUN)
    sink.close()
    assert np.load(tmp_path / "out.npz")["model"].tolist() == ["n" * 32]


class TestNpz:
    def record(self, path, results, **settings):
        sink = NpzSink(path, *SHAPES, **settings)
        for result in results:
            sink.write(result, {})
        sink.close()

    def test_what_replay_reads_back_is_the_same_scans(self, tmp_path):
        path = tmp_path / "out.npz"
        results = make_results()
        self.record(path, results)
        tracks = load_recording(path).tracks
        assert [track.sensor for track in tracks] == ["4", "6"]
        for track in tracks:
            mine = [result.scan for result in results if result.scan.sensor == track.sensor]
            np.testing.assert_array_equal(track.counts, np.stack([scan.counts for scan in mine]))
            assert track.time_ns is not None and track.time_ns.tolist() == [scan.time_ns for scan in mine]
        assert not parts_dir(path).exists() and list(tmp_path.iterdir()) == [path]

    def test_the_rows_stay_until_the_npz_is_on_the_disk(self, tmp_path, monkeypatch):
        """A power cut may leave the name of a file whose content was never written."""
        path, fsync, written = tmp_path / "out.npz", os.fsync, []

        def note(descriptor):
            written.append((os.fstat(descriptor).st_ino, parts_dir(path).exists(), path.exists()))
            fsync(descriptor)

        monkeypatch.setattr(os, "fsync", note)
        self.record(path, make_results())
        assert written == [(path.stat().st_ino, True, False)] and zipfile.ZipFile(path).testzip() is None

    def test_a_disk_that_fails_at_the_end_costs_no_row(self, tmp_path, monkeypatch):
        def fail(descriptor):
            raise OSError(errno.EIO, "Input/output error")

        path = tmp_path / "out.npz"
        with monkeypatch.context() as patch:
            patch.setattr(os, "fsync", fail)
            with pytest.raises(SinkError, match="Input/output error; the parts are kept"):
                self.record(path, make_results())
        assert gather(path) == len(make_results()) and list(tmp_path.iterdir()) == [path]

    def test_every_array_holds_its_row(self, tmp_path):
        results = make_results(counts_per_newton=5)
        self.record(tmp_path / "out.npz", results)
        data = dict(np.load(tmp_path / "out.npz"))
        assert str(data.pop("format")) == "tactile-recording" and int(data.pop("version")) == 1
        assert str(data.pop("mountings")) == "{}"
        assert {len(column) for column in data.values()} == {len(results)}
        assert np.isnan(data["interval_mm"]).all() and "deviation" not in data
        for i, result in enumerate(results):
            row = {name: column[i] for name, column in data.items()}
            assert row["scan"] == result.scan.number and row["sensor"] == result.scan.sensor
            assert row["source"] == "emulated" and row["state"] == result.state and row["model"] == "fake"
            assert row["contact"] == {None: -1, False: 0, True: 1}[result.contact]
            assert row["taps_used"] == result.taps_used
            assert row["has_pattern"] == (result.pattern is not None)
            np.testing.assert_array_equal(row["pattern"], 0 if result.pattern is None else result.pattern)
            for name in ("force_counts", "run_time_us"):
                value = getattr(result, name)
                assert np.isnan(row[name]) if value is None else row[name] == np.float32(value)
            assert row["baseline"] == ("" if result.baseline is None else result.baseline.id)
            counts = np.nan if result.baseline is None else result.baseline.counts
            np.testing.assert_array_equal(row["baseline_counts"], counts)
        assert {"contact", "idle", "zeroing"} <= set(data["state"].tolist())

    def test_deviations_are_kept_where_the_model_gives_them(self, tmp_path):
        results = make_sure_results()
        self.record(tmp_path / "out.npz", results, deviations=True)
        data = np.load(tmp_path / "out.npz")
        assert data["deviation"].shape == data["pattern"].shape
        for i, result in enumerate(results):
            np.testing.assert_array_equal(data["deviation"][i], 0 if result.pattern is None else result.deviation)
            interval_mm = np.nan if result.interval_mm is None else np.float32(result.interval_mm)
            np.testing.assert_array_equal(data["interval_mm"][i], interval_mm)
        assert 0 < np.isfinite(data["interval_mm"]).sum() == data["has_pattern"].sum() < len(results)
        assert len(load_recording(tmp_path / "out.npz").tracks) == 2

    def test_nothing_is_at_the_target_before_the_end_and_an_old_one_is_left_alone(self, tmp_path):
        path = tmp_path / "out.npz"
        sink = NpzSink(path, *SHAPES)
        sink.write(make_results(1)[0], {})
        assert not path.exists()
        sink.close()
        assert len(load_recording(path).tracks[0].counts) == 1
        with pytest.raises(SinkError, match=r"out\.npz exists: give another name"):
            NpzSink(path, *SHAPES)
        path.rename(tmp_path / "first.npz")
        sink = NpzSink(path, *SHAPES)
        sink.write(make_results(1)[0], {})
        path.write_bytes(b"of another meanwhile")
        with pytest.raises(SinkError, match=r"out\.npz exists, .* move it away, then `python -m edge\.sinks\.npz"):
            sink.close()
        assert path.read_bytes() == b"of another meanwhile"
        path.unlink()
        assert npz.gather(path) == 1

    def test_without_a_scan_nothing_is_written(self, tmp_path):
        NpzSink(tmp_path / "out.npz", *SHAPES).close()
        assert list(tmp_path.iterdir()) == []

    def test_every_row_is_on_disk_as_soon_as_written_and_none_is_kept(self, tmp_path):
        sink = NpzSink(tmp_path / "out.npz", *SHAPES)
        result = make_results(3)[4]
        for count in range(1, 4):
            sink.write(result, {})
            size = (parts_dir(tmp_path / "out.npz") / npz.ROWS).stat().st_size
            assert size % count == 0 and 40 * 40 * 4 < size // count < 40 * 40 * 4 + 2000
        sink.close()

    def test_kill_9_costs_no_whole_scan(self, tmp_path):
        path = tmp_path / "out.npz"
        results = make_results()
        script = (
            "import os, sys; sys.path[:0] = ['tests/support']; from sink_samples import *\n"
            "from pathlib import Path; from edge.sinks.npz import NpzSink\n"
            "sink = NpzSink(Path(sys.argv[1]), *SHAPES)\n"
            "for result in make_results(): sink.write(result, {})\n"
            "os.kill(os.getpid(), 9)"
        )
        done = subprocess.run([sys.executable, "-c", script, str(path)], cwd=ROOT, timeout=60)
        assert done.returncode == -signal.SIGKILL and not path.exists()
        with (parts_dir(path) / npz.ROWS).open("ab") as rows:
            rows.write(b"\1" * 1300)  # of one more, half
        with pytest.raises(SinkError, match=r"not finished: `python -m edge.sinks.npz .*out.npz` makes the .npz"):
            NpzSink(path, *SHAPES)
        done = subprocess.run(
            [sys.executable, "-m", "edge.sinks.npz", str(path)], cwd=ROOT, capture_output=True, text=True, timeout=60
        )
        assert (done.returncode, done.stdout) == (0, f"{path}: {len(results)} scans\n")
        counts = np.stack([result.scan.counts for result in results])
        np.testing.assert_array_equal(np.load(path)["counts"], counts)
        assert len(zipfile.ZipFile(path).read("scan.npy")) == 128 + 8 * len(results), "nothing hangs on behind"
        assert not parts_dir(path).exists()

    def test_a_row_of_which_the_disk_takes_a_part_is_gone_on_with(self, tmp_path):
        """Else what is written once there is room again would lie between the rows."""
        sink = NpzSink(tmp_path / "out.npz", *SHAPES)
        rows, sizes = sink._rows, []

        class Stubborn:
            close = rows.close

            def write(self, data):
                sizes.append(len(data))
                return rows.write(data[: len(data) // 2 + 1])

        sink._rows = Stubborn()
        results = make_results(2)
        for result in results:
            sink.write(result, {})
        sink.close()
        assert len(sizes) > 2 * len(results)
        counts = np.stack([result.scan.counts for result in results])
        np.testing.assert_array_equal(np.load(tmp_path / "out.npz")["counts"], counts)

    def test_gathering_what_is_not_there_is_told(self, tmp_path, capsys):
        assert npz.main([str(tmp_path / "none.npz")]) == 1
        assert "none.npz is not there, finished or not: a recording that a crash" in capsys.readouterr().err
        with pytest.raises(SystemExit):
            npz.main([])
        NpzSink(tmp_path / "empty.npz", *SHAPES)
        with pytest.raises(SinkError, match=r"^\S+/empty.npz.parts holds no scan: delete it$"):
            gather(tmp_path / "empty.npz")
        (parts_dir(tmp_path / "empty.npz") / npz.LAYOUT).write_text("{")
        with pytest.raises(SinkError, match=r"layout.json cannot be read"):
            gather(tmp_path / "empty.npz")

    def test_a_whole_file_needs_no_gathering_and_is_not_to_be_moved_away(self, tmp_path, capsys):
        path = tmp_path / "out.npz"
        sink = NpzSink(path, *SHAPES)
        sink.write(make_results(1)[0], {})
        sink.close()
        content = path.read_bytes()
        assert npz.main([str(path)]) == 1
        words = capsys.readouterr().err
        assert words.startswith(f"{path} is finished, and can be read as it is: ") and "move" not in words
        assert path.read_bytes() == content

    def test_what_cannot_be_recorded_into_is_told_at_the_start(self, tmp_path):
        with pytest.raises(SinkError, match="is a directory"):
            NpzSink(tmp_path, *SHAPES)
        with pytest.raises(SinkError, match=r"No such file"):
            NpzSink(tmp_path / "none" / "out.npz", *SHAPES)

    def test_wrong_rows_are_refused_rather_than_shifting_the_array(self, tmp_path):
        sink = NpzSink(tmp_path / "out.npz", (3, 4, 4), (20, 20))
        with pytest.raises(SinkError, match=r"pattern has shape \(40, 40\), expected \(20, 20\)"):
            sink.write(make_results(3)[4], {})
        sink = NpzSink(tmp_path / "long.npz", *SHAPES)
        runtime = Runtime(FakeModel(), source="device")
        with pytest.raises(SinkError, match="too long"):
            sink.write(runtime.push(make_scan(sensor="x" * 65)), {})

    @pytest.mark.parametrize("when", ["writing", "gathering"])
    def test_a_full_disk_keeps_the_parts_and_says_so(self, tmp_path, when):
        """The limit on a file's size stands for the disk's end."""
        path = tmp_path / "out.npz"
        sink = NpzSink(path, *SHAPES)
        result = make_results(3)[4]
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        try:
            if when == "writing":
                sink.write(result, {})
                row_bytes = (parts_dir(path) / npz.ROWS).stat().st_size
                resource.setrlimit(resource.RLIMIT_FSIZE, (20 * row_bytes + 100, limits[1]))
            with pytest.raises(SinkError, match=r"File too large.*python -m edge.sinks.npz"):
                for _ in range(50):
                    sink.write(result, {})
                resource.setrlimit(resource.RLIMIT_FSIZE, (2000, limits[1]))
                sink.close()
            sink.close() if when == "writing" else None
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert list(tmp_path.iterdir()) == [parts_dir(path)]
        assert gather(path) == (20 if when == "writing" else 50)
        assert zipfile.ZipFile(path).testzip() is None


def test_the_npz_sink_gets_the_shapes_of_the_contract(tmp_path):
    sink = open_sink(f"npz:{tmp_path}/a.npz", make_contract(scale=2))
    layout = json.loads((parts_dir(tmp_path / "a.npz") / npz.LAYOUT).read_text())
    assert layout["pattern"][1] == [8, 8] and layout["counts"][1] == [3, 4, 4] and "deviation" not in layout
    sink.close()
    sink = open_sink(f"npz:{tmp_path}/b.npz", make_contract(scale=2, interval_factor=1.6))
    layout = json.loads((parts_dir(tmp_path / "b.npz") / npz.LAYOUT).read_text())
    assert layout["deviation"] == layout["pattern"]
    sink.close()
