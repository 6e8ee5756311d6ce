"""The first training that the README offers, from several seeds."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch

from lsmgeo.training import read_config, train
from lsmgeo.training.batches import Need, open_shapes
from tests.training.runs import events

CONFIG = Path(__file__).resolve().parents[2] / "examples" / "configs" / "vlsm_tiny.toml"


@pytest.mark.long
@pytest.mark.timeout(3000)
def test_the_tiny_v_lsm_knows_more_after_every_view(tmp_path):
    """In four runs of five at least, on 52 shapes or more with voxels that it was not trained on."""
    config = read_config(CONFIG, ["run.tensorboard=false", "run.pictures=0", "run.device=cpu"])
    config_data = dataclasses.replace(config.data, workers=0)
    shapes = open_shapes(
        config_data, Need(32, 16, False), seed=0, device=torch.device("cpu"), is_training=False, views=1
    )
    assert sum(bool(shapes.dataset[0, index].occupancy.any()) for index in range(len(shapes))) >= 52
    assert config.run.evaluate_shapes >= len(shapes)
    rises = []
    for seed in range(5):
        seeded = dataclasses.replace(config, run=dataclasses.replace(config.run, seed=seed))
        found = train(seeded, tmp_path / str(seed), quiet=True).evaluation
        assert found is not None
        one, two, three = (found.by_view[views] for views in (1, 2, 3))
        rises.append(one + 0.01 < two < three)
        middle = events(tmp_path / str(seed), "evaluation")[0]
        assert middle["step"] == config.run.steps // 2
        assert three > max(0.2, middle["iou"]["3"])
    assert sum(rises) >= 4
