"""Behaviour of edge-sr and edge.api, frozen: records, events, notes, exit codes and messages of each scene."""

import json

import pytest
from scenes import SCENES, differences, frozen_of, play


@pytest.mark.parametrize("name", SCENES)
def test_a_scene_gives_what_it_gave(name):
    changes = differences(json.loads(frozen_of(name).read_text()), play(name))
    assert not changes, "\n".join(["as in frozen/, or write it again by tests/golden/scenes.py:", *changes[:20]])
