"""Small worlds that are made once."""

from __future__ import annotations

import pytest

from nolbo_ppl.synthetic.worlds import SequenceConfig, World, make_world

STREET = SequenceConfig(frames=40, step=3.0, laps=1.3, objects=90, clutter=12, size=(160, 96), supersample=1, seed=5)
INDOOR = SequenceConfig(
    world="indoor", frames=40, step=1.0, laps=1.3, objects=50, clutter=8, size=(160, 96), supersample=1, seed=6
)


@pytest.fixture(scope="session")
def street() -> World:
    return make_world(STREET)


@pytest.fixture(scope="session")
def indoor() -> World:
    return make_world(INDOOR)
