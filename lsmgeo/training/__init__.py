"""Training: the loop, its configuration and batches, checkpoints and the log."""

from lsmgeo.training.config import (
    DataConfig,
    ModelConfig,
    OptimiserConfig,
    RunConfig,
    TrainingConfig,
    make_config,
    read_config,
)
from lsmgeo.training.loop import Trained, train

__all__ = [
    "DataConfig",
    "ModelConfig",
    "OptimiserConfig",
    "RunConfig",
    "Trained",
    "TrainingConfig",
    "make_config",
    "read_config",
    "train",
]
