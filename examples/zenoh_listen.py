"""Print the messages of grippers that run `edge-sr --sink zenoh:KEY`: python zenoh_listen.py KEY [tcp/ADDRESS:7447].

The grippers connect to this program, on this machine by default; with a zenoh router, zenohd, in its place, insert
"connect/endpoints" instead of "listen/endpoints". Messages are described in docs/middleware.md.
"""

import json
import os
import sys
from contextlib import suppress
from math import prod
from struct import unpack_from

import numpy as np

try:
    import zenoh
except ModuleNotFoundError as error:
    sys.exit(f"zenoh_listen: {error}: pip install eclipse-zenoh")


def unpack(message: bytes) -> tuple[dict, dict[str, np.ndarray]]:
    """Return header and maps of a pattern's message."""
    (length,) = unpack_from("<I", message)
    header, at, maps = json.loads(message[4 : 4 + length]), 4 + length, {}
    for name, shape in header["maps"]:
        maps[name] = np.frombuffer(message, "<f4", prod(shape), at).reshape(shape)
        at += maps[name].nbytes
    return header, maps


def tell(line: str) -> None:
    """Print at once, from any thread, since zenoh has its own."""
    try:
        sys.stdout.write(f"{line}\n")  # in one piece: print would let another thread's line between it and its end
        sys.stdout.flush()
    except BrokenPipeError:  # the reader has closed
        os._exit(0)


def main(key: str, endpoint: str = "tcp/127.0.0.1:7447") -> None:
    """Print a line for each new pattern, each event, and each gripper that comes or goes."""
    config = zenoh.Config()
    config.insert_json5("listen/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config) as session, session.declare_subscriber(f"{key}/**") as samples:
        session.liveliness().declare_subscriber(
            f"{key}/alive/*",
            lambda token: tell(f"{token.key_expr} {'came' if token.kind == zenoh.SampleKind.PUT else 'went'}"),
        )
        tell("listens")
        for sample in samples:
            what = str(sample.key_expr).rpartition("/")[2]
            if what == "event":
                tell(json.loads(sample.payload.to_bytes())["note"])
            elif what == "pattern":
                header, maps = unpack(sample.payload.to_bytes())
                # "source" must be "device" before a robot acts on it.
                place = f"{header['sensor']} {header['source']} scan {header['scan']}"
                tell(f"{place}: {header['force_counts']} counts, {maps['pattern'].max():.3f} mm at most")


if __name__ == "__main__":
    if len(sys.argv) not in (2, 3):
        sys.exit("usage: python zenoh_listen.py KEY [tcp/ADDRESS:7447]")
    try:
        with suppress(KeyboardInterrupt):
            main(*sys.argv[1:])
    except zenoh.ZError as error:
        sys.exit(f"zenoh_listen: {error}")
