"""A scene that several files write and read."""

import pytest

from tests.data.writers import Scene, make_scene


@pytest.fixture(scope="session")
def scene() -> Scene:
    return make_scene(48, 64)
