"""The sensor file, written and read again or refused, and the writing in place of all users' files."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hostile_samples import one_line

from firmware_bridge.errors import RecordingError, SensorFileError
from firmware_bridge.in_place import check_writable, write_in_place
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.pad_constants import PAD_RANGES, Pad
from firmware_bridge.sensor_file.model import PadFrame, SensorEntry, SensorFile, load_sensor_file
from firmware_bridge.sensor_file.toml_writer import save_sensor_file
from firmware_bridge.zeroing.baseline import Baseline

GAINS = tuple(np.random.default_rng(0).uniform(0.01, 100, 48).tolist())
WIDTHS = tuple(np.random.default_rng(1).uniform(0, 1, 48).tolist())


def test_what_is_written_is_read(tmp_path):
    """Names of any printable characters, numbers with every digit, and each part with and without what may be in it."""
    counts = np.random.default_rng(2).uniform(0, 65_535, (3, 4, 4))
    constants = {name: low + (high - low) / 3 for name, (low, high) in PAD_RANGES.items()}
    intervals = {name: (PAD_RANGES[name][0], value) for name, value in constants.items()}
    place = PadFrame("left/finger_tip", (-1e5, 0.1, 1 / 3), (0.0, 0.6, 0.8, 0.0))
    names = ("4", "left/6", "a.b", '"', "'", "\\n", "#=[é\U0001f916")
    entries = {
        name: SensorEntry(
            Mounting(tuple(np.random.default_rng(number).permutation(16).tolist()), number % 2 == 0, (1, -1, 1)),
            np.float32(1e6) / 3 if number else None,
            Baseline.of(name, counts, (1, 1.5, 1.7e9)[number % 3], 100, "file") if number != 1 else None,
            (None, Pad(**constants, intervals=intervals), Pad(gains=GAINS, gain_half_widths=WIDTHS))[number % 3],
            frame=place if number == 2 else PadFrame("tool0"),
            counts_per_newton_interval=(1e-3, 1e6) if number > 1 else None,
        )
        for number, name in enumerate(names)
    }
    written = SensorFile("XR1944", "D30BL366", entries)
    save_sensor_file(tmp_path / "s.toml", written)
    read = load_sensor_file(tmp_path / "s.toml")
    assert (read.model, read.adapter) == (written.model, written.adapter)
    for name, entry in entries.items():
        got = read.sensors[name]
        assert (got.baseline and got.baseline.id) == (entry.baseline and entry.baseline.id)
        assert replace(got, baseline=None) == replace(entry, baseline=None)
    assert max(map(len, (tmp_path / "s.toml").read_text().splitlines())) <= 120, "for people, too"


GRID = "[[0, 1, 2, 3], [4, 5, 6, 7], [8, 9, 10, 11], [12, 13, 14, 15]]"
GOOD = {
    "format": '"tactile-sensor"', "version": "1", "model": '"uSPa44"', "adapter": '"D30BL366"',
    "order": GRID, "swap_xy": "false", "signs": "[1, 1, 1]", "counts_per_newton": "1180",
    "counts_per_newton_interval": "[1100, 1260]",
    "id": "", "created_unix_s": "1000.0", "scans": "100", "x": GRID, "y": GRID, "z": GRID,
}  # fmt: skip


def text_of(**changes):
    values = GOOD | changes
    tables = {"format": "", "order": "[sensors.4]\n", "id": "[sensors.4.baseline]\n"}
    return "".join(tables.get(key, "") + (f"{key} = {value}\n" if value else "") for key, value in values.items())


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("format", '"tactile-baseline"', "'tactile-sensor'"),
        ("version", "2", "expected 1"),
        ("model", '"XR9"', "'uSPa44' or 'uSPa46' or 'XR1944' or 'A' or 'B'"),
        ("order", GRID.replace("15", "14"), "each of 0..15 once"),
        ("order", GRID.replace("[12,", "[12, 13,"), "4 rows of 4"),
        ("swap_xy", "1", "true or false"),
        ("signs", "[1, 1, true]", "1 or -1 for each of x, y, z"),
        *(("counts_per_newton", value, "a number from 0.001 to 1e+06") for value in ("nan", "1" + "0" * 400)),
        *(("counts_per_newton_interval", value, "around counts_per") for value in ("[1200, 1300]", "[1000, 1100]")),
        ("counts_per_newton_interval", "[1300, 1000]", "the lower first"),
        ("id", '"ffff"', "which the counts give, or none; the baseline was changed"),
        *(("created_unix_s", value, "a number from 1 to 1e+11") for value in ("0", "1" + "0" * 400)),
        ("scans", "1.0", "a whole number from 1"),
        ("x", GRID.replace("15", "65536"), "numbers 0..65535"),
        ("y", "", "missing"),
    ],
)
def test_a_value_that_cannot_be_is_refused_by_its_key(tmp_path, key, value, expected):
    (tmp_path / "s.toml").write_text(text_of(**{key: value}))
    with pytest.raises(SensorFileError, match=re.escape(expected)) as refused:
        load_sensor_file(tmp_path / "s.toml")
    assert str(refused.value).startswith(f"{tmp_path}/s.toml, '") and f"{key}'" in str(refused.value)
    assert one_line(refused)


HEAD = 'format = "tactile-sensor"\nversion = 1\nmodel = "uSPa44"\n'
PAD = f"{HEAD}[sensors.4.pad]\n"
FRAME = f"{HEAD}[sensors.4]\n[sensors.4.frame]\n"
PLACE = "place_mm = [0, 0, 0]\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (text_of() + "colour = 1\n", "'sensors.4.baseline.colour': not known, expected one of id, created_unix_s"),
        ("offset = 1\n" + text_of(), "'offset': not known"),
        (HEAD, "'sensors': missing"),
        (HEAD + '[sensors."4\\n"]\n', "names of 1 to 64 printable characters"),
        ("format = ", "not TOML"),
        ("\udc80", "not TOML"),
        (text_of(version="1" + ".a" * 30_000), "a line longer than 2048 bytes"),
        (text_of(version="1\n" + "#" * 70_000), "larger than the 65,536 bytes"),
        (None, "cannot be read: No such file"),
        (PAD + "thickness_mm = 0", "'sensors.4.pad.thickness_mm': 0, expected a number from 0.1 to 100"),
        (PAD + "poisson = nan", "a number from 0 to 0.4999"),
        (PAD + "in_plane_share_interval = [2, 1]", "the lower first"),
        (PAD + "in_plane_share = 0.2\nin_plane_share_interval = [0.3, 0.4]", "an interval around in_plane_share"),
        (PAD + "gains = [1, 1, 1]", "48 numbers from 0.01 to 100: x of all places, then y, then z"),
        (PAD + f"gain_half_widths = {[0.1] * 48}", "'sensors.4.pad.gain_half_widths': without gains, expected both"),
        (f"{HEAD}[sensors.4]\ngains = [1, 1, 1.1]", "'sensors.4.gains': [1, 1, 1.1], expected 1 for each, or none"),
        (FRAME + 'parent = "tool0"\nplace_mm = [0, 0, 1e6]', "expected three numbers up to 100000"),
        (FRAME + PLACE + 'parent = "/tool0"', "parent is '/tool0', expected the name of a frame"),
        (FRAME + PLACE + 'parent = "a"\nquaternion = [1, 1, 0, 0]', "expected x, y, z, w of norm 1"),
    ],
)
def test_what_is_no_sensor_file_is_refused(tmp_path, text, words):
    path = tmp_path / "s.toml"
    path.write_text(text_of())
    assert load_sensor_file(path).baselines["4"].counts[2, 3, 3] == 15, "it has no other fault"
    path.unlink()
    if text is not None:
        path.write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(SensorFileError, match=re.escape(words)) as refused:
        load_sensor_file(path)
    assert one_line(refused)


def test_a_short_file_by_hand_is_enough(tmp_path):
    for gains in ([1.0] * 3, [[[1.0] * 4] * 4] * 3):  # which the doctor of an earlier release wrote into each
        (tmp_path / "s.toml").write_text(f"{HEAD}[sensors.4]\nswap_xy = true\ngains = {gains}\n")
        assert load_sensor_file(tmp_path / "s.toml").mountings["4"].swap_xy
    gains = [1.0, 0.5, *[1.0] * 46]
    counts = "".join(f"{axis} = {[[16_000.0] * 4] * 4}\n" for axis in "xyz")
    (tmp_path / "s.toml").write_text(
        f"{HEAD}[sensors.1]\nsigns = [1, -1, 1]\n[sensors.4.pad]\nthickness_mm = 4\npoisson = 0\n"
        f"poisson_interval = [0, 0.49]\ngains = {gains}\n"
        f"[sensors.6.baseline]\ncreated_unix_s = 1790000000\nscans = 100\n{counts}"
    )
    read = load_sensor_file(tmp_path / "s.toml")
    assert read.mountings["1"] == Mounting(signs=(1, -1, 1)) and read.sensors["4"].mounting == Mounting()
    assert read.sensors["4"].pad == Pad(thickness_mm=4, poisson=0, intervals={"poisson": (0, 0.49)}, gains=tuple(gains))
    assert (read.baselines["6"].counts == 16_000).all() and read.adapter is None and not read.counts_per_newton


@pytest.mark.parametrize(
    ("by_hand", "by_itself", "used"),
    [(None, 0.04, 0.04), (0.03, None, 0.03), (0.04, 0.03, 0.03), (0.03, 0.03, 0.03)],
)
def test_of_gains_by_hand_and_learned_the_surer_are_used(by_hand, by_itself, used, tmp_path):
    """The constants are those that were entered by hand."""

    def pad(width, gain, **constants):
        gains = {} if width is None else {"gains": (gain,) * 48, "gain_half_widths": (width,) * 48}
        return Pad(**constants, **gains)

    learned = pad(by_itself, 1.1, poisson=0.42, thickness_mm=5.0)
    learned = replace(learned, intervals={"poisson": (0.41, 0.43), "thickness_mm": (4.8, 5.2)})
    one = SensorEntry(pad=pad(by_hand, 0.9, thickness_mm=4.0), learned=learned)
    save_sensor_file(tmp_path / "s.toml", SensorFile(sensors={"4": one, "6": SensorEntry(learned=learned)}))
    read = load_sensor_file(tmp_path / "s.toml")
    assert read.sensors["4"] == one and read.path == tmp_path / "s.toml" and read.pads["6"] == learned
    assert read.pads["4"].gain_half_widths == (used,) * 48
    assert read.pads["4"].gains == ((0.9 if used == by_hand else 1.1),) * 48
    assert read.pads["4"].constants == {"thickness_mm": 4.0, "poisson": 0.42}
    assert read.pads["4"].intervals == {"poisson": (0.41, 0.43)}


def test_a_baseline_without_a_taxel_is_not_written(tmp_path):
    rest = np.full((3, 4, 4), 16_000.0)
    rest[:, 1, 2] = np.nan
    silent = Baseline.of("4", rest, 1.7e9, 100, "file")
    with pytest.raises(SensorFileError, match="a taxel of sensor 4 was silent while zeroing: zero again"):
        save_sensor_file(tmp_path / "t.toml", SensorFile(sensors={"4": SensorEntry(baseline=silent)}))
    assert not (tmp_path / "t.toml").exists()


def listing(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def written(path: Path, text: str, **settings) -> None:
    write_in_place(path, lambda draft: draft.write_text(text), lambda draft: draft.read_text(), **settings)


def test_a_new_file_has_its_name_and_the_one_before_is_kept(tmp_path):
    path = tmp_path / "a.json"
    written(path, "1")
    assert path.read_text() == "1" and listing(tmp_path) == ["a.json"]
    for text in "23":
        written(path, text)
    assert path.read_text() == "3" and (tmp_path / "a.json.bak").read_text() == "2"
    written(path, "4", keep_before=False)
    assert (tmp_path / "a.json.bak").read_text() == "2" and listing(tmp_path) == ["a.json", "a.json.bak"]


def broken(draft: Path) -> None:
    raise RecordingError("cannot be read back")


def full(draft: Path) -> None:
    draft.write_text("half")
    raise OSError(28, "No space left on device")


@pytest.mark.parametrize(
    ("write", "load", "error"),
    [
        (full, Path.read_text, OSError),
        (Path.touch, broken, RecordingError),
        (lambda draft: None, Path.read_text, OSError),
    ],
)
def test_what_cannot_be_written_or_read_back_leaves_the_former(tmp_path, write, load, error):
    written(tmp_path / "a.json", "good")
    with pytest.raises(error) as refused:
        write_in_place(tmp_path / "a.json", write, load)
    assert write is not full or refused.value.filename == str(tmp_path / "a.json"), "a message can name it"
    assert (tmp_path / "a.json").read_text() == "good" and listing(tmp_path) == ["a.json"]


def test_what_is_no_plain_file_is_not_replaced(tmp_path):
    (tmp_path / "folder").mkdir()
    for path in (tmp_path / "folder", Path("/dev/null"), tmp_path / "none" / "a.json"):
        with pytest.raises(OSError, match=r"directory|plain file|No such file"):
            check_writable(path)
        with pytest.raises(OSError, match=r"directory|plain file|No such file"):
            written(path, "1")
    assert Path("/dev/null").is_char_device() and listing(tmp_path / "folder") == []
