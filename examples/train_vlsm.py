"""Train a small V-LSM and measure its IoU on unseen shapes.

The data are rendered here. Run from the root of the repository::

    python examples/train_vlsm.py runs/vlsm_example

It takes a minute or two, and predicts blobs: good shapes take half an hour (examples/configs/vlsm_compact.toml) and
more. The same command continues an interrupted run.
"""

import sys

import torch

from lsmgeo.data import Recipe, ShapeDataset, ShardSet, collate, render_set
from lsmgeo.metrics import voxel_iou
from lsmgeo.models import load
from lsmgeo.training import DataConfig, ModelConfig, OptimiserConfig, RunConfig, TrainingConfig, train

out = sys.argv[1] if len(sys.argv) > 1 else "runs/vlsm_example"

# Shapes of 13 categories, five views of 32 pixels each, in shards.
render_set("synthetic-13", f"{out}/shards", Recipe(views=5, size=32, voxels=(16,)), shapes=65, jobs=1)

config = TrainingConfig(
    model=ModelConfig(name="voxel-lsm", preset="tiny"),
    data=DataConfig(source=f"{out}/shards", views=3),
    optimiser=OptimiserConfig(learning_rate=5e-3, clip_norm=1.0),
    run=RunConfig(steps=150, batch=4, evaluate_every=50, pictures=2),
)
trained = train(config, f"{out}/run")
print(f"{trained.step} steps, {trained.checkpoint}")

model = load(trained.checkpoint)
unseen = ShapeDataset(ShardSet(f"{out}/shards"), views=4, split="test", depth=False, occupancy=model.resolution)
batch = collate([unseen[index] for index in range(4)])
result = model.run(batch.images, batch.cameras)
for view in range(4):
    iou = voxel_iou(result.by_view[:, view], batch.occupancy)
    print(f"IoU after {view + 1} views: {', '.join(f'{value:.2f}' for value in iou)} of {', '.join(batch.category)}")
assert torch.equal(result.occupancy, result.by_view[:, -1])
