"""Check of the CAN ids on the bus against the id maps."""

from collections import Counter
from collections.abc import Set as AbstractSet

from edge.doctor.findings import Finding
from firmware_bridge.scans.can_id_maps import ID_MAPS, ModelMap

_SHOWN = 8


def check_id_map(ids: AbstractSet[int], model: ModelMap, half_silent: bool) -> Finding | None:
    """Return whether the chosen id map fits the sensors on the bus; None where no CAN ids are seen at all.

    Args:
        ids: the CAN ids that came.
        model: the id map that the user chose.
        half_silent: half of the taxels or more of some sensor are silent.
    """
    if not ids:
        return None
    norm = "every taxel of a sensor by its id"
    whole = _whole_sensors(ids, model)
    others = {
        name: sensors
        for name, other in ID_MAPS.items()
        if name != model.name and (sensors := _whole_sensors(ids, other))
    }
    # The ids of a smaller pad may be among those of a larger one: then the larger one is on the bus.
    largest = max((ID_MAPS[name].geometry.taxel_count for name in others), default=0)
    others = {name: sensors for name, sensors in others.items() if ID_MAPS[name].geometry.taxel_count == largest}
    if whole and not half_silent and largest <= model.geometry.taxel_count:
        return Finding("id map", "ok", f"{model.name}, all ids of sensor {', '.join(whole)} received", norm)
    if others:
        owners = " or ".join(f"{name} (sensor {', '.join(sensors)})" for name, sensors in others.items())
        tries = " or ".join(f"--id-map {name}" for name in others)
        measured = f"the ids received are not {model.name}'s but those of {owners}"
        return Finding("id map", "wrong", measured, norm, tries)
    known = [can_id for can_id in ids if can_id in model.taxels]
    shown = ", ".join(f"0x{can_id:03x}" for can_id in sorted(ids)[:_SHOWN]) + ", ..." * (len(ids) > _SHOWN)
    measured = f"{len(ids)} ids received, {len(known)} of them {model.name}'s: {shown}"
    if half_silent or not known:
        remedy = "no map has all of these ids: half of the sensor may be broken, or other devices share the bus"
        return Finding("id map", "wrong", measured, norm, remedy)
    return Finding("id map", "ok", measured, norm)


def _whole_sensors(ids: AbstractSet[int], model: ModelMap) -> list[str]:
    """Return the sensors of a model whose ids all came."""
    taxels: Counter[str] = Counter(sensor for can_id, (sensor, _) in model.taxels.items() if can_id in ids)
    return [sensor for sensor, count in taxels.items() if count == model.geometry.taxel_count]
