"""Train a small D-LSM and measure its depth error on unseen shapes.

The data are rendered here. Run from the root of the repository::

    python examples/train_dlsm.py runs/dlsm_example

It takes a minute or two; useful depth takes hours (examples/configs/dlsm_compact.toml). The same command continues an
interrupted run.
"""

import sys

from lsmgeo.data import Recipe, ShapeDataset, ShardSet, collate, render_set
from lsmgeo.metrics import median_depth_error
from lsmgeo.models import load
from lsmgeo.training import DataConfig, ModelConfig, OptimiserConfig, RunConfig, TrainingConfig, train

out = sys.argv[1] if len(sys.argv) > 1 else "runs/dlsm_example"

# Shapes of 13 categories, five views of 32 pixels each, in shards.
render_set("synthetic-13", f"{out}/shards", Recipe(views=5, size=32, voxels=(16,)), shapes=65, jobs=1)

config = TrainingConfig(
    model=ModelConfig(name="depth-lsm", preset="tiny"),
    data=DataConfig(source=f"{out}/shards", views=3),
    optimiser=OptimiserConfig(learning_rate=5e-3, clip_norm=1.0),
    run=RunConfig(steps=150, batch=4, evaluate_every=50, pictures=2),
)
trained = train(config, f"{out}/run")
print(f"{trained.step} steps, {trained.checkpoint}")

model = load(trained.checkpoint)
unseen = ShapeDataset(ShardSet(f"{out}/shards"), views=4, split="test", depth=True, occupancy=None)
batch = collate([unseen[index] for index in range(4)])
depth = model.run(batch.images, batch.cameras).depth
error = median_depth_error(depth, batch.depth, batch.mask).error.nanmean(1)
print(f"median depth error: {', '.join(f'{value:.3f}' for value in error)} of {', '.join(batch.category)}")
print(f"of a constant depth of 2: {median_depth_error(depth * 0 + 2, batch.depth).error.nanmean():.3f}")
