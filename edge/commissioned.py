"""What a sensor file and the options beside it come to, for every command that opens a source."""

import argparse

from edge.errors import UsageError
from firmware_bridge.baseline import load_baselines
from firmware_bridge.sensor_file import SensorFile, load_sensor_file
from firmware_bridge.xela import ID_MAPS, USPA44_MAP


def use_sensor_file(options: argparse.Namespace) -> None:
    """Settle source, id map, mountings, baselines and counts per newton.

    What the command line says goes before the file, since a baseline may be newer than it. Only another id map is
    refused: the order and the baseline in the file are those of its own.

    Args:
        options: with `sensor`, `source` and `id_map`, and where the command has them `baseline` and
            `counts_per_newton`. Set are `sensor_file`, `model_map`, `mountings`, `orders` and `baselines`; `source` and
            `counts_per_newton` where they were not given.

    Raises:
        SensorFileError: the sensor file cannot be used.
        RecordingError: the baseline file cannot be used, or is of another order.
        UsageError: the file is for another id map than was asked for.
    """
    asked = options.id_map
    known = SensorFile(asked or USPA44_MAP.name) if options.sensor is None else load_sensor_file(options.sensor)
    if asked not in (None, known.model):
        raise UsageError(
            f"--id-map {asked}, but {options.sensor} is of a {known.model}, and so are its order and baseline: "
            "leave one of them out"
        )
    options.sensor_file = known
    options.mountings = known.mountings
    options.model_map = ID_MAPS[known.model]
    if not options.source and known.adapter is not None:
        options.source = [f"slcan:serial={known.adapter}"]
    stored = getattr(options, "baseline", None)
    options.orders = {name: one.order for name, one in known.mountings.items() if one.moves_taxels}
    options.baselines = (known.baselines or None) if stored is None else load_baselines(stored, options.orders)
    if getattr(options, "counts_per_newton", None) is None:
        options.counts_per_newton = known.counts_per_newton or None
