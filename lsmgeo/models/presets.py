"""Settings by name: "paper" as published, "compact" and "standard" for CPUs, "tiny" for tests."""

from __future__ import annotations

from typing import Any

from lsmgeo.models.r2n2 import R2N2Settings
from lsmgeo.models.settings import DepthSettings, VoxelSettings

__all__ = ["PRESETS", "RELEASES"]

# Views are fused on 16^3 cells, but their features are sampled at 32^3. The recurrence works point by point: with 3^3
# kernels it takes most of a step's time, and the grid network sees the neighbours.
_COMPACT: dict[str, Any] = {
    "image_size": 128,
    "grid_size": 16,
    "encoder_channels": (16, 32, 64, 96),
    "grid_channels": (48, 96),
    "feature_channels": 8,
    "feature_stride": 4,
    "lift": 2,
    "input_kernel": 1,
    "state_kernel": 1,
    "output_channels": 16,
    "grid_skip": True,
}
_TINY: dict[str, Any] = {
    "image_size": 32,
    "grid_size": 8,
    "encoder_channels": (8, 12),
    "grid_channels": (8, 12),
    "feature_channels": 8,
    "hidden_channels": 8,
    "input_kernel": 1,
    "state_kernel": 1,
    "output_channels": 8,
    "grid_skip": True,
}
_COMPACT_R2N2: dict[str, Any] = {
    "image_size": 64,
    "channels": (24, 48, 96, 128, 128),
    "shortcuts": ("none", "convolution", "convolution", "convolution", "identity"),
    "features": 256,
    "pose_features": 64,
    "hidden": 64,
    "decoder": (64, 32, 16),
    "upsample": 2,
}
_TINY_R2N2: dict[str, Any] = {
    "image_size": 32,
    "channels": (8, 12, 16, 16),
    "shortcuts": ("none", "convolution", "convolution", "identity"),
    "features": 12,
    "pose_features": 4,
    "hidden": 8,
    "decoder": (8, 8, 4),
}

# "standard" is what the experiments use: a wider network was no better in the same time (docs/experiments).
PRESETS: dict[str, dict[str, Any]] = {
    "voxel-lsm": {
        "paper": VoxelSettings(),
        "compact": VoxelSettings(**_COMPACT, upsample=2),
        "standard": VoxelSettings(**_COMPACT, upsample=2),
        "tiny": VoxelSettings(**_TINY, upsample=2),
    },
    "depth-lsm": {
        "paper": DepthSettings(),
        "compact": DepthSettings(**_COMPACT, planes=24, ray_channels=(128, 64), projection="trilinear"),
        "standard": DepthSettings(**_COMPACT, planes=24, ray_channels=(128, 64), projection="trilinear"),
        "tiny": DepthSettings(**_TINY, planes=8, ray_channels=(16, 12), projection="trilinear"),
    },
    "r2n2": {
        "paper": R2N2Settings(),
        "compact": R2N2Settings(**_COMPACT_R2N2),
        "standard": R2N2Settings(**_COMPACT_R2N2),
        "tiny": R2N2Settings(**_TINY_R2N2),
    },
    "r2n2-pose": {
        "paper": R2N2Settings(pose=True),
        "compact": R2N2Settings(pose=True, **_COMPACT_R2N2),
        "standard": R2N2Settings(pose=True, **_COMPACT_R2N2),
        "tiny": R2N2Settings(pose=True, **_TINY_R2N2),
    },
}

# Built layer by layer as released; there is one of each.
RELEASES: dict[str, Any] = {
    "voxel-lsm": VoxelSettings(variant="release"),
    "depth-lsm": DepthSettings(variant="release", ray_channels=(512,)),
}
