"""Training: a loop that is read from top to bottom, what it is configured with and fed with, and what it keeps."""

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
