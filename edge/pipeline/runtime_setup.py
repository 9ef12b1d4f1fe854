"""Models and runtimes by name, with the settings of a source."""

import threading
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edge.inference.bundled import TAXELS, find_model, taps_of
from edge.inference.model_interface import Model
from edge.perception.contact_options import RuntimeOptions
from edge.perception.dead_taxel_fill import load_estimator
from edge.perception.gain_learning import load_contact_model
from edge.perception.runtime import Runtime
from edge.pipeline.scan_reader import Source
from edge.pipeline.source_setup import of_single_csv, stored_baselines
from edge.validation import check_whole
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.scans.pad_constants import Pad
from firmware_bridge.zeroing.baseline import Baseline

if TYPE_CHECKING:
    from edge.inference.onnx_session import ModelSession


def load_model(model: str | Path, threads: int = 1, stop: threading.Event | None = None) -> "ModelSession":
    """Load a model, a file or a bundled one by its name, and its contract; mtsr2 to mtsr7 take as many taps at most.

    `threads` share the work of one run, and `stop` ends the loading early.

    Raises:
        ModelError: the model does not exist or cannot be used; the message names the bundled ones or the fault.
        UsageError: the number of threads is out of range.
    """
    check_whole("threads", threads, 1)
    from edge.inference.onnx_session import ModelSession

    return ModelSession(find_model(model), threads, stop, taps=taps_of(model))


def open_runtime(
    model: str | Path | Model,
    source: Source,
    *,
    baselines: Mapping[str, Baseline] | str | Path | None = None,
    counts_per_newton: float | Mapping[str, float] | None = None,
    pad: Pad | Mapping[str, Pad] | None = None,
    **options: Any,
) -> Runtime:
    """Return a runtime that makes results of a source's scans; its defaults are those of `edge-sr`.

    Args:
        model: name of a bundled one, a file, or a model that `load_model` returned.
        source: open source of the scans.
        baselines: stored ones, or their file; they take precedence over those of the source's sensor file. A sensor
            without one is zeroed from its first 100 scans, during which its pad must be still and free.
        counts_per_newton: summed z per [N], of all sensors or by name; by default as in the sensor file. A name from
            which no scan arrives is reported as an event.
        pad: properties of the pad of all sensors, or of each by name, for models that use them; by default as in the
            sensor file.
        options: those of `RuntimeOptions`, such as `every_scan=True`. With `learn` a `Stream` keeps the gains that it
            learns in the source's sensor file; with `taps` and without poses taps follow the paper's schedule, each
            turned by 5 degrees from the one before.

    Raises:
        ModelError: the model does not exist, cannot be used, or is for another sensor.
        RecordingError: the baseline file cannot be used, or its taxel order is not that of the sensor file.
        UsageError: the source is not open; a baseline is of another grid; a number is out of range; `taps` is more than
            the model takes.
    """
    chosen = RuntimeOptions(**options)
    known, nominal = source.sensor_file, source.sensor_file.geometry == USPA44
    return Runtime(
        load_model(model) if isinstance(model, (str, Path)) else model,
        source=source.kind,
        estimator=load_estimator(TAXELS, (USPA44.rows, USPA44.cols)) if nominal else None,
        contacts=load_contact_model() if nominal and chosen.learn else None,
        geometry=known.geometry,
        baselines=of_single_csv(stored_baselines(baselines, known), source.name),
        counts_per_newton=(known.counts_per_newton or None) if counts_per_newton is None else counts_per_newton,
        mountings=known.mountings,
        pad=known.pads if pad is None else pad,
        measured=known.measured_pads if pad is None else None,
        options=chosen,
        unix_time_s=source.unix_time_s,
    )
