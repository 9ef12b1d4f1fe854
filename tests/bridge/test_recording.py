"""Recordings as CSV and npz, whatever program wrote them, and the stretch of one in which the pad is free."""

from pathlib import Path

import numpy as np
import pytest
from bridge_samples import REAL_RECORDINGS, write_npz
from hostile_samples import one_line

from edge.api import SourceError, open_recording
from firmware_bridge.errors import BaselineRefusedError, RecordingError
from firmware_bridge.links.replay import ReplayLink
from firmware_bridge.recording.csv_reader import csv_header
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.scans.scan import ABSENT
from firmware_bridge.zeroing.free_stretch import FEWEST_RECORDED, free_stretch

HEADER = ",".join(csv_header()) + "\n"


def row(number: int) -> str:
    """Taxel n of row `number` reads x = 100 n + number, y = 5000 + x, z = 9000 + x."""
    cells = [f"{base + 100 * taxel + number}.0" for taxel in range(16) for base in (0, 5000, 9000)]
    return ",".join(cells) + "\n"


def write_csv(folder: Path, text: str | bytes, name: str = "finger.csv") -> Path:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


COUNTS = np.arange(4 * 48, dtype=np.int32).reshape(4, 3, 4, 4)
COUNTS[1, :, 2, 3] = -1
TIMES_NS = np.array([10, 15, 20_000_010, 30_000_015])


def write_two(folder: Path, **changes: object) -> Path:
    arrays = {"scan": [0, 0, 1, 1], "time_ns": TIMES_NS, "sensor": ["4", "6", "4", "6"], "counts": COUNTS} | changes
    return write_npz(folder / "finger.npz", COUNTS, **arrays)


def test_csv(tmp_path):
    recording = load_recording(str(write_csv(tmp_path, HEADER + row(0) + row(7))))
    (track,) = recording.tracks
    assert track.sensor == "finger" and track.time_ns is track.mean_rate_hz is recording.rate_hz is None
    assert track.counts.dtype == np.int32 and track.counts.shape == (2, 3, 4, 4)
    taxels = np.arange(16).reshape(4, 4) * 100
    assert (track.counts[1] == np.stack([taxels + 7, taxels + 5007, taxels + 9007])).all()


def test_csv_rate_comes_from_the_file_beside_it(tmp_path):
    path = write_csv(tmp_path, HEADER + row(0))
    for text, rate_hz in (("dropped,notes,frequency_hz\n0,,59.75\n", 59.75), ("dropped,notes\n0,\n", None)):
        write_csv(tmp_path, text, "meta_data.csv")
        assert load_recording(path).rate_hz == rate_hz
    for cell in ("fast", "0", "-1", "nan", "inf", ""):
        write_csv(tmp_path, f"frequency_hz\n{cell}\n", "meta_data.csv")
        with pytest.raises(RecordingError, match=r"meta_data\.csv.*positive"):
            load_recording(path)


@pytest.mark.parametrize(
    ("written", "read"),
    [
        *(("65535", 65535), ("0.0", 0), ("12.", 12), (" 12.00 ", 12), ("000012", 12)),
        *dict.fromkeys(
            ("65536", "-1", "1.5", "", "nan", "inf", "1e4", "1_0", "0x10", "x", "\u0661", "9" * 5000)
        ).items(),
    ],
)
def test_a_cell_of_a_csv_is_a_whole_number_of_sixteen_bits(tmp_path, written, read):
    cells = row(0).strip().split(",")
    cells[5] = written
    path = write_csv(tmp_path, HEADER + row(0) + ",".join(cells) + "\n")
    if read is not None:
        assert load_recording(path).tracks[0].counts[1, 2, 0, 1] == read
    else:
        with pytest.raises(RecordingError, match=r"finger\.csv, line 3: .*expected a whole number 0\.\.65535"):
            load_recording(path)


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("", 1, "empty"),
        (row(0), 1, "48: txl1_x"),
        ("a,b\n" + row(0), 1, "2 columns: a, b, expected .* txl1_x"),
        (HEADER.replace("txl16_z", "txl17_z") + row(0), 1, "48: txl1_x"),
        (HEADER.replace("txl16_z", "txl16_y") + row(0), 1, "two columns 'txl16_y'"),
        (HEADER.strip() + ",pose_x\n" + row(0).strip() + ",1\n", 1, "pose_x_mm"),
        (HEADER + row(0).strip() + ",1\n", 2, "49 columns"),
        (f"Sensor,{HEADER}4,{row(0)}4,{row(1)}6,{row(0)}", 4, "sensor '6' after '4', expected one sensor"),
        (HEADER + '"1\n', 2, "not CSV"),
        (HEADER.encode("utf-16-le") + row(0).encode("utf-16-le"), 1, "txl1_x"),
    ],
)
def test_csv_that_is_none(tmp_path, text, line, words):
    with pytest.raises(RecordingError, match=rf"finger\.csv, line {line}: .*{words}"):
        load_recording(write_csv(tmp_path, text))


def test_nothing_of_a_header_reaches_a_terminal_as_a_command(tmp_path):
    with pytest.raises(RecordingError) as refused:
        load_recording(write_csv(tmp_path, "\x1b]0;mine\x07,\x9b2J\n"))
    recording = load_recording(write_csv(tmp_path, with_columns("\x1b[2J,t\x1b", ["1,0", "2,10"])))
    assert all(text.isprintable() for text in (str(refused.value), *recording.notes)) and len(recording.notes) == 2


@pytest.mark.parametrize(
    "tail",
    [
        row(1).replace(",", "", 1),
        row(1)[:100],
        row(1)[:-3],
        "\0" * 100_000,
        row(1)[:50] + "\0" * 50 + row(1)[100:],
        "\ufffd\n",
        '"1\n',
    ],
)
def test_a_damaged_tail_of_a_csv_costs_the_tail(tmp_path, tail):
    recording = load_recording(write_csv(tmp_path, HEADER + row(0) + row(0) + tail))
    assert len(recording.tracks[0].counts) == 2
    (note,) = recording.notes
    assert "finger.csv is damaged, line 4: " in note and "only the 2 scans before that are read" in note


def by_axes(text: str) -> str:
    """Return the lines of a CSV with all columns of x first, then those of y and z."""
    lines = [line.split(",") for line in text.splitlines()]
    return "".join(",".join(cell for axis in range(3) for cell in line[axis::3]) + "\n" for line in lines)


PLAIN = HEADER + row(0) + row(7)


@pytest.mark.parametrize(
    "text",
    [
        PLAIN[:-1],
        PLAIN + "  \r\n" + "," * 47 + "\n\n",
        HEADER + "\n" + row(0) + "\n\n" + row(7),
        PLAIN.replace(",", ";").replace(".0", ",0"),
        PLAIN.replace(",", " ; "),
        "sep=;\r\n" + PLAIN.replace(",", ";").replace("\n", "\r\n"),
        '"sep=|"\n' + PLAIN.replace(",", "|"),
        PLAIN.replace("\n", ",,\n"),
        HEADER.replace("\n", ",\n") + row(0) + row(7),
        PLAIN.replace("\n", "\r"),
        "\ufeff" + PLAIN.replace("\n", "\r\n"),
        "\n".join(",".join(f'"{cell}"' for cell in line.split(",")) for line in PLAIN.splitlines()),
        PLAIN.replace(",", "\t").encode("utf-16"),
        PLAIN.upper(),
        by_axes(PLAIN),
    ],
)
def test_csv_as_programs_write_it(tmp_path, text):
    recording = load_recording(write_csv(tmp_path, text))
    (track,) = recording.tracks
    assert recording.rate_hz is None and recording.notes == ()
    assert (track.counts == load_recording(write_csv(tmp_path, PLAIN, "plain.csv")).tracks[0].counts).all()


def with_columns(names: str, cells: list[str]) -> str:
    rows = zip([names, *cells], [HEADER, *(row(number) for number in range(len(cells)))], strict=True)
    return "".join(f"{before},{line}" for before, line in rows)


@pytest.mark.parametrize(
    ("name", "times", "rate_hz"),
    [
        ("time", ["0.000", "0.010", "0.020", "0.031"], 100),
        ("timestamp", ["1700000000000000000", "1700000000010000000", "1700000000020000000"], 100),
        ("time [ms]", ["0", "1", "2"], 1000),
        ("t (\u00b5s)", ["0", "10000", "20000"], 100),
        ("time_ns", ["0", "10000000", "20000000"], 100),
        ("datetime", ["2026-01-02 03:04:05.00", "2026-01-02 03:04:05.01", "2026-01-02T03:04:05.02"], 100),
        ("time", ["0", "0", "0", "40", "40", "40", "40", "80", "80"], 100),
        ("time", [f"{n / 100 + 30 * (n > 10):.2f}" for n in range(20)], 100),
        ("time", [f"{n // 12 * 0.12 + n % 12 * 0.0002 + 30 * (n >= 180):.4f}" for n in range(480)], 100),  # in bursts
    ],
)
def test_the_rate_of_a_csv_comes_from_its_times(tmp_path, name, times, rate_hz):
    recording = load_recording(write_csv(tmp_path, with_columns(name, times)))
    assert len(recording.tracks[0].counts) == len(times)
    assert recording.rate_hz == pytest.approx(rate_hz, rel=0.05)
    (note,) = recording.notes
    assert ": left out as times, which give " in note and note.endswith(f": {name!r}")


@pytest.mark.parametrize(
    ("name", "times", "why"),
    [
        ("time", [0, 0.01, 0.02, 0.01], "they go back at scan 4"),
        ("time", [5], "there is one alone"),
        ("time", [0, "", 0.02], "that of scan 2 is neither a number nor a date and time"),
        ("time", [5, 5, 5], "they never change"),
        ("time_ms", [0, 0.01, 0.02], "their mean step, 0.01 ms, is that of no sensor"),
        ("time_s", [0, 10, 20], "their mean step, 10 s, is that of no sensor"),
        ("t", [0, 1, 2], "they may as well number the scans"),
        ("time", [0, 300, 600], "their mean step, 300 s, ms, us or ns, is that of no sensor"),
    ],
)
def test_why_times_of_a_csv_give_no_rate(tmp_path, name, times, why):
    path = write_csv(tmp_path, with_columns(name, [str(time) for time in times]))
    with pytest.raises(SourceError, match=rf"finger\.csv does not state its rate: pass --rate-hz; .*{why}"):
        open_recording(path)
    assert open_recording(path, rate_hz=100).rate_hz == 100


def test_other_columns_of_a_csv_are_named_and_left_out(tmp_path):
    recording = load_recording(write_csv(tmp_path, with_columns(",label", ["0,grasp", "1,"])))
    assert (recording.tracks[0].counts[1] == load_recording(write_csv(tmp_path, PLAIN)).tracks[0].counts[0] + 1).all()
    (note,) = recording.notes
    assert note.endswith(": 'label'") and "rename it" in note


def vendor_log(forces: list[str]) -> str:
    """Return a log of the vendor's program: taxel n has force (n, 0.5, -2) N, or the text that is given."""
    taxels = [f"{taxel}{axis}" for taxel in range(1, 17) for axis in "XYZ"]
    header = ",".join(["Receive time", "Send time", "Message number", *taxels, *(f"Force {one}" for one in taxels)])
    lines = [
        f"{1700000000 + number / 80:.4f},{1699999999 + number / 80:.4f},{500 + number},{row(number).strip()},"
        + ",".join(force or f"{cell:.5f}" for taxel in range(1, 17) for cell in (taxel, 0.5, -2))
        for number, force in enumerate(forces)
    ]
    return "\n".join([header, *lines])


def test_the_vendors_log(tmp_path):
    path = write_csv(tmp_path, vendor_log(["", "", "", "nan", "", ""]))
    recording = load_recording(path)
    assert recording.rate_hz == pytest.approx(80, rel=0.01)
    assert (recording.tracks[0].counts[1, :, 0, 0] == [1, 5001, 9001]).all()
    with ReplayLink([path], paced=False) as link:
        scans = [link.read(0.0)[0] for _ in range(6)]
    assert scans[0].vendor_force_n == (136.0, 8.0, -32.0) and scans[3].vendor_force_n is None
    times, others = recording.notes
    assert times.endswith(": 'Receive time', 'Send time'") and others.endswith(": 'Message number'")


def test_npz(tmp_path):
    recording = load_recording(write_two(tmp_path, pattern=np.zeros((4, 40, 40))))
    assert [track.sensor for track in recording.tracks] == ["4", "6"]
    for track, rows in zip(recording.tracks, ([0, 2], [1, 3]), strict=True):
        assert track.counts.dtype == np.int32 and (track.counts == COUNTS[rows]).all()
        assert track.time_ns is not None and track.time_ns.tolist() == TIMES_NS[rows].tolist()
    assert recording.tracks[0].mean_rate_hz == pytest.approx(50.0)


OF_65 = {"sensor": np.arange(65).astype(str), "counts": np.zeros((65, 3, 4, 4), int)}


@pytest.mark.parametrize(
    ("words", "changes"),
    [
        ("array 'format': 'tactile-results', .* play the .mcap", {"format": "tactile-results"}),
        ("array 'mountings': a file of an earlier release", {"mountings": "{}"}),
        ("array 'source': a file of an earlier release", {"source": ["emulated"] * 4}),
        ("array 'version': 2, expected 1", {"version": 2}),
        ("array 'counts': missing", {"counts": None}),
        *(
            (r"\(scans, 3, rows, cols\), 64 taxels at most, at least one scan", {"counts": np.zeros(shape, np.int32)})
            for shape in ((4, 4, 4, 3), (0, 3, 4, 4), (4, 3, 5, 13))
        ),
        (r"array 'counts': counts 65536\.\.65536", {"counts": np.full((4, 3, 4, 4), 65536)}),
        ("absent on some axes", {"counts": np.full((4, 3, 4, 4), [[[-1]], [[0]], [[0]]])}),
        ("array 'sensor'", {"sensor": ["4"]}),
        ("printable", {"sensor": ["4", "6", "6", "4\n5"]}),
        ("65 sensors, expected at most 64", OF_65 | dict.fromkeys(("scan", "time_ns"), np.arange(65))),
        ("array 'time_ns'", {"time_ns": np.zeros(4)}),
        ("array 'time_ns': times of sensor '4' that go back", {"time_ns": [5, 0, 4, 0]}),
        ("expected 0", {"time_ns": np.array([5, 0, 1 << 63, 0], np.uint64)}),
    ],
)
def test_npz_that_is_none(tmp_path, words, changes):
    with pytest.raises(RecordingError, match=words) as refused:
        load_recording(write_two(tmp_path, **changes))
    assert one_line(refused)


def test_files_that_cannot_be_read(tmp_path):
    whole = write_two(tmp_path).read_bytes()
    (tmp_path / "folder.csv").mkdir()
    for name, content, words in (
        ("gone.csv", None, r"gone\.csv: cannot be read: No such file"),
        ("folder.csv", None, r"folder\.csv is a folder, expected a recording: it holds no \.mcap"),
        ("finger.txt", b"", r"ends in \.csv, \.npz or \.mcap"),
        ("finger.csv", b"", "line 1: an empty file, expected a header and a row of counts"),
        ("finger.csv", HEADER.encode(), r"finger\.csv, .*expected a row of counts"),
        ("finger.npz", whole[:-1], "not a whole .npz archive"),
        ("finger.npz", whole[:600] + bytes([whole[600] ^ 0xFF]) + whole[601:], "finger"),
    ):
        path = tmp_path / name if content is None else write_csv(tmp_path, content, name)
        with pytest.raises(RecordingError, match=words):
            load_recording(path)


def scans(*levels, noise_counts=3):
    """Return counts of (count, press) parts of a pad; a press is a number, one for each scan, or None: it grows."""
    rng, parts = np.random.default_rng(3), []
    for count, press in levels:
        part = 30000 + rng.normal(0, noise_counts, (count, 3, 4, 4))
        part[:, 2] += (np.linspace(200, 3000, count) if press is None else np.broadcast_to(press, count))[:, None, None]
        parts.append(part)
    return np.concatenate(parts).round().astype(np.int32)


def test_the_freest_still_scans_are_taken_wherever_they_are():
    counts = scans((120, None), (150, 1000), (80, None), (60, 0), (40, None))
    stretch = free_stretch(counts)
    assert stretch.rows[0] >= 349 and stretch.rows[-1] < 411 and len(stretch.rows) == FEWEST_RECORDED
    baseline = stretch.baseline("4", 5.0)
    assert np.abs(baseline.counts - 30000).max() < 3
    assert (baseline.scans, baseline.origin) == (len(stretch.rows), "recording")
    assert not stretch.opens and stretch.touched


def recovering(count, counts):
    """Counts of a pad that recovers by so many counts a taxel on z after a grip."""
    grip, free = (40, 600 + 20 * np.sin(np.arange(40))), (count, counts * np.linspace(1, 0, count))
    return scans(grip, free, noise_counts=2)


def test_where_a_pad_only_recovers_its_freest_scans_are_taken():
    stretch = free_stretch(recovering(38, 40))
    assert stretch.touched and not stretch.opens and stretch.rows.tolist() == list(range(48, 78))
    assert stretch.within_counts == pytest.approx(16, abs=5)
    assert np.abs(stretch.baseline("4", 5.0).counts - 30000).max() < 16 + 8
    assert free_stretch(recovering(200, 40)).within_counts is None, "still at its end"


@pytest.mark.parametrize(
    ("counts", "words"),
    [
        # Still for longer than any other part, and loaded: the pad is free elsewhere, if never for long enough.
        (scans((200, 1000), (40, None), (FEWEST_RECORDED - 5, 0), (40, None)), "nowhere free and still for 30 scans"),
        (recovering(38, 200), "nowhere free and still"),
        (np.repeat(scans((FEWEST_RECORDED - 1, 0)), 4, axis=0), "29 whole new scans"),
    ],
)
def test_a_grip_and_repeated_scans_are_not_free(counts, words):
    with pytest.raises(BaselineRefusedError, match=words):
        free_stretch(counts)


def test_a_free_beginning_is_where_a_live_run_zeroes():
    counts = scans((110, 2), (50, None), (100, 0))
    stretch = free_stretch(counts)
    assert stretch.opens and stretch.rows.tolist() == list(range(100)) and stretch.touched
    counts[5, :, 1, 1] = ABSENT
    assert 5 not in free_stretch(counts).rows


def test_without_a_contact_nothing_shows_that_a_pad_is_free():
    for last, touched in ((((40, 60),), False), (((5, 100),), True), (((4, 100), (40, 0)), False)):  # damaged
        assert free_stretch(scans((40, 8), (60, 0), *last)).touched == touched


GRIPS = sorted(REAL_RECORDINGS.glob("*/xela_sensor?.csv"))


@pytest.mark.skipif(not GRIPS, reason=f"no recordings in {REAL_RECORDINGS} (set TACTILE_RECORDINGS)")
def test_of_real_grips_the_stretch_with_the_lowest_z_is_taken():
    """Three trials hold the box to their end. One lets go: it is still at first, too, with 12,000 counts on the pad."""
    for path in GRIPS:
        counts = load_recording(path).tracks[0].counts
        stretch = free_stretch(counts)
        z = counts[:, 2].sum(axis=(1, 2))
        assert stretch.rows[0] > len(counts) / 2 and not stretch.opens, path
        assert np.median(z[stretch.rows]) < np.quantile(z, 0.4), path
        assert stretch.touched == ("2022-02-22" in path.parent.name), path
