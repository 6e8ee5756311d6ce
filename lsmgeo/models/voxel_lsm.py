"""V-LSM, the Voxel Learnt Stereo Machine: images and cameras to occupancy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor

from lsmgeo.cameras.tensors import Cameras
from lsmgeo.grids import VoxelGrid
from lsmgeo.models.blocks import Block, interleave
from lsmgeo.models.machine import Machine
from lsmgeo.models.model import VoxelModel
from lsmgeo.models.outputs import VoxelOutput
from lsmgeo.models.settings import VoxelSettings, changed

__all__ = ["VoxelLSM"]

PAPER = VoxelSettings()


class VoxelLSM(Machine, VoxelModel):
    """The Voxel Learnt Stereo Machine: any number of images with cameras to occupancy of the cube [-0.5, 0.5]^3.

    A shared UNet makes features of each image; they are unprojected into the grid, with depth and ray direction as
    further channels; a recurrence of 3D convolutions fuses the views one after the other; a 3D UNet and a last layer
    make occupancy of its state, after each view or after the last.

    Source: Kar, Haene and Malik, "Learning a Multi-View Stereo Machine", 2017, section 3. Where the paper is silent
    (widths, kernels) the authors' release is followed, but for strided kernels in 2D, which are even, so that a map
    covers what its image covers. The variant "release" has the release's layers one by one (2,730,113 parameters):
    odd strided kernels padded as TensorFlow does, instance norm without scale, no ray directions, features outside an
    image taken from its border. Its pixel and voxel rules, which are half a pixel or voxel off, are not copied: the
    geometry is this library's in both variants, unless ``pixel_rules="release"`` asks for them.

    Args:
        settings: `VoxelSettings`, which follow as keywords; `lsmgeo.models.create` has presets.

    Shape:
        - images: (B, V, 3, H, W) in [0, 1]; cameras: B*V, view fastest; view_mask: (B, V).
        - logits: (B, S, D, H, W), after S of the views.

    Raises:
        OptionError: a setting that is none, or an impossible value.

    Example:
        >>> import torch
        >>> from lsmgeo.cameras import orbit
        >>> from lsmgeo.models import create
        >>> model = create("voxel-lsm", preset="tiny")
        >>> cameras = orbit(torch.tensor([[0.0, 120.0, 240.0]]), 20.0, 2.0, focal_length=60.0, height=32, width=32)
        >>> tuple(model(torch.rand(1, 3, 3, 32, 32), cameras).logits.shape)
        (1, 3, 16, 16, 16)
        >>> tuple(model.run(torch.rand(1, 3, 3, 32, 32), cameras).occupancy.shape)
        (1, 16, 16, 16)
    """

    name = "voxel-lsm"

    def __init__(self, settings: VoxelSettings = PAPER, **changes: Any) -> None:
        settings = changed(settings, changes)
        super().__init__(settings)
        self.settings = settings
        is_release = settings.variant == "release"
        # One channel: the softmax of two classes is the sigmoid of their difference.
        parts = settings.upsample**3
        self.out = Block(
            3, self.grid_network.out_channels, parts, 4 if is_release else 3, norm="none", transposed=is_release
        )
        self.resolution = settings.grid_size * settings.upsample
        self.grid = VoxelGrid(self.resolution)

    def forward(
        self,
        images: Tensor,
        cameras: Cameras,
        view_mask: Tensor | None = None,
        *,
        steps: str | Sequence[int] | None = None,
    ) -> VoxelOutput:
        """Occupancy after every view, or after some.

        Args:
            images: (B, V, 3, H, W) in [0, 1].
            cameras: B*V cameras.
            view_mask: (B, V) bool; views where it is False are not read, and what follows repeats what was before.
            steps: after which views: None for all, "last", or their indices.

        Returns:
            `VoxelOutput` with logits (B, S, D, H, W).

        Raises:
            ShapeError, DTypeError, DeviceError, CameraError, OptionError: see `lsmgeo.errors`.
        """
        grids, _ = self.see(images, cameras, view_mask, steps)
        logits = self.out(grids.flatten(0, 1))
        if self.settings.upsample > 1:
            logits = interleave(logits, self.settings.upsample)
        return VoxelOutput(logits.squeeze(1).unflatten(0, grids.shape[:2]))
