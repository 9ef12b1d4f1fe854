"""Sensor files made to harm."""

import pytest
from hostile_samples import sensor_toml

from firmware_bridge.errors import SensorFileError
from firmware_bridge.sensor_file.model import load_sensor_file


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("version = 1", "version = 1" + ".a" * 30_000, "a line longer than 2048 bytes"),
        ("1200.5", "1" + "0" * 400, "'sensors.4.counts_per_newton': 1000.*a number from 0.001 to 1e"),
        ("1000.0", "1" + "0" * 400, "'sensors.4.baseline.created_unix_s': 1000.*a number from 1 to 1e"),
        ("gains = [1.0", "gains = [1" + "0" * 400, "'sensors.4.gains': .*expected positive numbers"),
        ("version = 1", "version = 0x" + "f" * 1999, "'version': .*expected 1"),
        ("version = 1", "version = 1\n" + "#" * 70_000, "larger than the 65,536 bytes"),
    ],
)
def test_a_sensor_file_made_to_harm_is_one_line(tmp_path, old, new, complaint):
    text = sensor_toml(tmp_path).decode()
    assert old in text
    path = tmp_path / "sensor.toml"
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(SensorFileError, match=complaint) as raised:
        load_sensor_file(path)
    assert "\n" not in str(raised.value) and len(str(raised.value)) < 1000
