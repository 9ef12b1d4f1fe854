"""Frames for an emulated gs_usb adapter, and a link to it."""

import random

from bridge_samples import make_counts
from gs_usb_emulator import GsUsbBackend, GsUsbPort

from firmware_bridge.emulation.xela_controller import scan_frames
from firmware_bridge.links.gs_usb_link import GsUsbLink


def frames_of(scans, controller=4, seed=0):
    """Return the frames of so many scans that all differ."""
    noise = random.Random(seed)
    return [frame for counts in make_counts(scans, seed) for frame in scan_frames(counts, controller, noise)]


def opened(port=None, **settings):
    backend = GsUsbBackend(port or GsUsbPort())
    return backend.ports[0], GsUsbLink(backend=backend, **settings)
