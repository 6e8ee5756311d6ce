"""The machines and 3D-R2N2 learn eight objects by heart."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

from lsmgeo.data import Batch, Recipe, collate
from lsmgeo.data.shards.shape_sources import Synthetic13
from lsmgeo.metrics import voxel_iou
from lsmgeo.models import Model, compute_loss, create


def learn(model: Model, batch: Batch, steps: int, rate: float, after: str | None = None) -> Iterator[int]:
    optimiser = torch.optim.Adam(model.parameters(), rate)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, rate, steps, pct_start=0.1)
    for step in range(steps):
        optimiser.zero_grad()
        found = model(batch.images, batch.cameras, batch.view_mask, steps=after)
        compute_loss(found, batch, steps=after).backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimiser.step()
        schedule.step()
        yield step


def eight_objects(views: int) -> Batch:
    source = Synthetic13(8)
    return collate([source.render(index, Recipe(0, views, 32, (16,))).sample for index in range(8)])


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_voxels_of_eight_objects_are_learnt_by_heart():
    torch.manual_seed(0)
    model, batch = create("voxel-lsm", preset="tiny"), eight_objects(4)
    list(learn(model, batch, 250, 1e-2))
    truth = batch.occupancy[:, None].expand(-1, 4, -1, -1, -1)
    found = voxel_iou(model.run(batch.images, batch.cameras).by_view, truth)
    print("IoU after 1 to 4 views", found.mean(0).tolist())
    assert found[:, -1].mean() > 0.95
    assert found[:, -1].min() > 0.9


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_depth_of_eight_objects_is_learnt_by_heart():
    torch.manual_seed(0)
    model, batch = create("depth-lsm", preset="tiny"), eight_objects(3)
    list(learn(model, batch, 800, 1e-2))
    errors = (model.run(batch.images, batch.cameras).depth - batch.depth).abs()
    found = torch.stack([error[mask].mean() for error, mask in zip(errors, batch.mask, strict=True)])
    print("mean absolute depth error of each object", found.tolist())
    assert found.mean() < 0.01


@pytest.mark.long
@pytest.mark.parametrize("name", ["r2n2", "r2n2-pose"])
def test_r2n2_learns_voxels_of_eight_objects_by_heart(name):
    torch.manual_seed(0)
    model, batch = create(name, preset="tiny"), eight_objects(4)
    for step in learn(model, batch, 1000, 3e-3, "last"):
        if step % 50 == 49:
            found = voxel_iou(model.run(batch.images, batch.cameras, by_view=False).occupancy, batch.occupancy)
            if found.mean() > 0.95:
                break
    assert found.mean() > 0.9
    assert found.min() > 0.8
