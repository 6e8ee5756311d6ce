"""3D-R2N2 learns eight objects by heart."""

import pytest
import torch

from lsmgeo.data import Recipe, collate
from lsmgeo.data.shards.shape_sources import Synthetic13
from lsmgeo.metrics import voxel_iou
from lsmgeo.models import compute_loss, create


@pytest.mark.long
@pytest.mark.parametrize("name", ["r2n2", "r2n2-pose"])
def test_eight_objects_are_learnt_by_heart(name):
    torch.manual_seed(0)
    model = create(name, preset="tiny")
    source = Synthetic13(8)
    batch = collate([source.render(index, Recipe(0, 4, 32, (16,))).sample for index in range(8)])
    optimiser = torch.optim.Adam(model.parameters(), 3e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 3e-3, 1000, pct_start=0.1)
    for step in range(1000):
        optimiser.zero_grad()
        compute_loss(model(batch.images, batch.cameras, steps="last"), batch, steps="last").backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimiser.step()
        schedule.step()
        if step % 50 == 49:
            found = voxel_iou(model.run(batch.images, batch.cameras, by_view=False).occupancy, batch.occupancy)
            if found.mean() > 0.95:
                break
    assert found.mean() > 0.9
    assert found.min() > 0.8
