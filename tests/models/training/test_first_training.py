"""The first training that the README offers, from several seeds."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from lsmgeo.models.training import read_config, train

CONFIG = Path(__file__).resolve().parents[3] / "examples" / "configs" / "vlsm_tiny.toml"


@pytest.mark.long
@pytest.mark.timeout(3000)
def test_the_tiny_v_lsm_knows_more_after_every_view(tmp_path):
    """In four runs of five at least, on 52 shapes that it was not trained on; and more than after half the steps."""
    config = read_config(CONFIG, ["run.tensorboard=false", "run.pictures=0", "run.device=cpu"])
    assert config.run.evaluate_shapes == 52
    rises = []
    for seed in range(5):
        seeded = dataclasses.replace(config, run=dataclasses.replace(config.run, seed=seed))
        found = train(seeded, tmp_path / str(seed), quiet=True).evaluation
        assert found is not None
        one, two, three = (found.by_view[views] for views in (1, 2, 3))
        rises.append(one + 0.01 < two < three)
        print(seed, found.by_view)
        assert one > 0.1
    assert sum(rises) >= 4
