"""Open a recording in Rerun with a layout: patterns in metres, plots of numbers, events and frames.

pip install 'rerun-sdk>=0.41'
python examples/viewers/rerun_view.py press.mcap [--save press.rrd]
"""

import argparse
import sys
from pathlib import Path

from mcap.reader import make_reader

try:
    import rerun as rr
    import rerun.blueprint as rrb
    from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping
except ModuleNotFoundError as error:
    sys.exit(f"rerun_view: {error}, expected Rerun 0.41 or later: pip install 'rerun-sdk>=0.41'")

RESULT = "tactile_edge_sr/msg/Result"
PLOTS = {"force, counts": ("force_counts",), "area, mm2": ("area_mm2",), "uncertainty, mm": ("interval_mm",)}
FULL_SCALE_M = 0.3e-3


def plot(title: str, sensor: str, numbers: tuple[str, ...]) -> rrb.TimeSeriesView:
    """Return a plot of numbers of the results of one sensor."""
    entity, component = f"{sensor}/result", f"{RESULT.replace('/', '.')}:message"
    lines = []
    for number in numbers:
        kind = ComponentSourceKind.SourceComponent
        source = VisualizerComponentMapping("Scalars:scalars", kind, source_component=component, selector=f".{number}")
        lines.append(rr.SeriesLines(names=number).visualizer(mappings=[source]))
    return rrb.TimeSeriesView(name=title, contents=[entity], overrides={entity: lines})


def image(sensor: str, name: str) -> rrb.Spatial2DView:
    """Return a view of one map of a sensor, with the same colours for the same metres in every scan."""
    shown = rr.DepthImage.from_fields(meter=1.0, depth_range=(0.0, FULL_SCALE_M), colormap="turbo")
    entity = f"{sensor}/{name}"
    return rrb.Spatial2DView(name=f"{entity}, m", contents=[entity], overrides={entity: shown})


def layout(sensors: list[str]) -> rrb.Blueprint:
    """Return the layout for the sensors of a recording, named as their topics begin."""
    rows = []
    for sensor in sensors:
        maps = rrb.Horizontal(image(sensor, "pattern"), image(sensor, "deviation"))
        rows.append(rrb.Horizontal(maps, rrb.Vertical(*(plot(title, sensor, PLOTS[title]) for title in PLOTS))))
    frames = rrb.Spatial3DView(name="frames", contents=["tf_static"])
    below = rrb.Horizontal(rrb.TextLogView(name="events", contents=["events"]), frames)
    return rrb.Blueprint(rrb.Vertical(*rows, below), collapse_panels=True)


def main(recording: Path, save: Path | None) -> None:
    """Show a recording, or save it with its layout."""
    with recording.open("rb") as file:
        summary = make_reader(file).get_summary()
    topics = [channel.topic for channel in summary.channels.values()] if summary is not None else []
    sensors = sorted(topic.removesuffix("/result") for topic in topics if topic.endswith("/result"))
    rr.init("tactile_edge_sr", spawn=save is None)
    if save is not None:
        rr.save(save)
    rr.send_blueprint(layout(sensors))
    rr.log_file_from_path(recording)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Open a recording in Rerun.")
    parser.add_argument("recording", type=Path, help="an .mcap file of edge-sr")
    parser.add_argument("--save", type=Path, help="write an .rrd file instead of opening the viewer")
    options = parser.parse_args()
    main(options.recording, options.save)
