"""Tables in the pages, made from the table of fields: `python tests/docs/field_tables.py` writes them."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from edge.perception.record_fields import FIELDS, Field, Out
from edge.sinks.shm import IN_MEMORY, MAPS_IN_MEMORY, MEMBERS, offsets_of

DOCS = Path(__file__).parents[2] / "docs"
SHAPES = {"scan": "3, rows, cols", "pattern": "H, W", "deviation": "H, W", "traction": "3, h, w", "poses": "taps, 5"}
MEMORY_SHAPES = {
    "scan": "[3][rows][cols]",
    "pattern": "[height][width]",
    "deviation": "[height][width]",
    "traction": "[3][traction_height][traction_width]",
}
PACKED = {"i": "i32", "i4x": "i32", "q": "i64", "Q": "u64", "d": "f64"}
ARRAYS = {"<f4": "f32", "<i4": "i32"}


def record_table() -> Iterator[str]:
    """Keys of a record."""
    yield "| key | type | what |\n|---|---|---|"
    for field in FIELDS:
        if field.out & (Out.RECORD | Out.MAP):
            kind = "object" if field.json and not field.kind.shape else _type_in_json(field)
            yield f"| `{field.name}` | {kind} | {field.text} |"


def memory_table() -> Iterator[str]:
    """Members of a half of shared memory that are of a result."""
    yield "| byte | field | type | unknown | what |\n|---|---|---|---|---|"
    offsets = offsets_of(MEMBERS)
    for field in IN_MEMORY:
        kind, unknown = PACKED.get(field.kind.packed), _unknown(field.kind.unknown)
        kind = kind or f"char[{field.kind.packed[:-1]}]"
        words = ", ".join(f"{number} `{word}`" for number, word in enumerate(field.kind.words, 1))
        unknown = "0" if unknown == "empty" else unknown
        text = f"{words}: {field.text}" if words else field.text
        for name in field.names:
            yield f"| {offsets[name]} | `{name}` | {kind} | {unknown} | {text} |"
            text = ""
    for field in MAPS_IN_MEMORY:
        kind = ARRAYS[field.kind.array] + MEMORY_SHAPES[field.kind.shape]
        unknown = "-1" if kind.startswith("i") else "NaN"
        yield f"| `{field.name}_at` | `{field.name}` | {kind} | {unknown} | {field.text} |"


def _type_in_json(field: Field) -> str:
    if field.kind.shape:
        return f"array ({SHAPES[field.kind.shape]})"
    if field.kind.words:
        return ", ".join(f"`{word}`" for word in field.kind.words)
    return f"array of {len(field.parts)}" if field.parts else field.kind.label


def _unknown(value: Any) -> str:
    if isinstance(value, str):
        return value or "empty"
    return "" if value is None else f"{value:g}".replace("nan", "NaN")


TABLES = {"formats.md": ("record", record_table), "middleware.md": ("shm", memory_table)}


def with_tables(page: str) -> str:
    """Return the text of a page with its table of fields as it should be."""
    table, rows = TABLES[page]
    before, begin, after = (DOCS / page).read_text().partition(f"<!-- fields: {table} -->\n\n")
    _, end, after = after.partition("<!-- end of fields -->")
    if not end:
        raise ValueError(f"{page} has no place for the fields of {table}: expected {begin!r} and an end")
    return before + begin + "\n".join(rows()) + "\n\n" + end + after


def main() -> None:
    """Write the pages."""
    for page in TABLES:
        (DOCS / page).write_text(with_tables(page))
        sys.stdout.write(f"{DOCS / page}\n")


if __name__ == "__main__":
    main()
