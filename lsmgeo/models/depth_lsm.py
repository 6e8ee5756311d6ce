"""D-LSM, a multi-view stereo network from images and cameras to a depth map of each view.

`LSMTrunk`, shared with V-LSM, then ``PlaneSweepProject -> reduction along rays -> upsampling`` in this file.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

from lsmgeo._checks import check_flag
from lsmgeo.cameras.camera_checks import views_of, views_per_scene
from lsmgeo.cameras.tensors import Cameras, CameraTensors, as_tensors, image_sizes
from lsmgeo.errors import OptionError
from lsmgeo.grids import VoxelGrid, depth_planes
from lsmgeo.layers import PlaneSweepProject
from lsmgeo.models.blocks import Block, Convolution, InstanceNorm, evaluation_mode, shift_principal_point
from lsmgeo.models.outputs import DepthOutput, DepthResult
from lsmgeo.models.settings import DepthSettings, replace_settings
from lsmgeo.models.voxel_lsm import LSMTrunk
from lsmgeo.rays import ProjectReduce

__all__ = ["DepthLSM"]

PAPER = DepthSettings()


class _Separable(nn.Module):
    """A 3x3 convolution of each channel and a 1x1 convolution: the release's reduction of the features along a ray."""

    def __init__(self, in_channels: int, out_channels: int, *, activate: bool) -> None:
        super().__init__()
        self.activate = activate
        self.depthwise = Convolution(2, in_channels, in_channels, 3, groups=in_channels, bias=False)
        self.pointwise = Convolution(2, in_channels, out_channels, 1, bias=False)
        self.norm = InstanceNorm(out_channels, scale=False)

    def forward(self, x: Tensor) -> Tensor:
        return self.norm(self.pointwise(self.depthwise(x.relu() if self.activate else x)))


class _Upsample(nn.Module):
    """Twice the size: nearest neighbours and a 3x3 convolution in the release, else a transposed convolution."""

    def __init__(self, in_channels: int, out_channels: int, *, is_release: bool) -> None:
        super().__init__()
        self.is_release = is_release
        if is_release:
            self.block = Block(2, in_channels, out_channels, 3, norm="shift")
        else:
            self.block = Block(2, in_channels, out_channels, 4, norm="scale", stride=2, transposed=True)

    def forward(self, x: Tensor) -> Tensor:
        return self.block(interpolate(x, scale_factor=2.0, mode="nearest") if self.is_release else x)


class DepthLSM(LSMTrunk):
    """The Depth Learnt Stereo Machine: any number of images with cameras to a depth map of each of them.

    The grid is computed as in `VoxelLSM` and swept by planes of depth in each view's camera, with depth and ray
    direction as further channels; 1x1 convolutions reduce the features along a ray, the first of them fused with the
    sweep; transposed convolutions upsample to the image's size, beside the image encoder's early maps.

    Source: Kar, Haene and Malik, "Learning a Multi-View Stereo Machine", 2017, section 3. Where the paper is silent
    the authors' release is followed, as in `VoxelLSM`. The variant "release" has the release's layers one by one
    (3,888,673 parameters, without a layer that it builds and never trains): separable convolutions over the stacked
    planes, upsampling by nearest neighbours, only features in the sweep. The geometry is this library's in both
    variants.

    Convention:
        Depth is camera z in world units, a plain linear output that starts in the middle of the planes. The last layer
        is computed in float32 under autocast too: bfloat16 would round depths of 2 to steps of 1/64.

    Args:
        settings: `DepthSettings`, whose fields are also keywords; `lsmgeo.models.create` has presets.
        encoder: your own image encoder, as for `VoxelLSM`; needs ``skips=False``, since it has no early maps.

    Shape:
        - images: (B, V, 3, H, W) in [0, 1]; cameras: B*V, view fastest; view_mask: (B, V).
        - depth: (B, S, T, H, W), after S of the views, of the V views or of T others.

    Raises:
        OptionError: an unknown setting, or an impossible value.

    Example:
        >>> import torch
        >>> from lsmgeo.cameras import orbit
        >>> from lsmgeo.models import create
        >>> model = create("depth-lsm", preset="tiny")
        >>> cameras = orbit(torch.tensor([[0.0, 120.0, 240.0]]), 20.0, 2.0, focal_length=60.0, height=32, width=32)
        >>> tuple(model(torch.rand(1, 3, 3, 32, 32), cameras, steps="last").depth.shape)
        (1, 1, 3, 32, 32)
        >>> tuple(model.run(torch.rand(1, 3, 3, 32, 32), cameras).depth.shape)
        (1, 3, 32, 32)
    """

    name = "depth-lsm"
    output = "depth"

    def __init__(self, settings: DepthSettings = PAPER, *, encoder: nn.Module | None = None, **changes: Any) -> None:
        settings = replace_settings(settings, changes)
        if encoder is not None and settings.skips:
            raise OptionError(f"{self.name}: skips must be False with an encoder of your own, which has no early maps")
        super().__init__(settings, encoder)
        if encoder is not None:
            self.image_stride = settings.map_stride
        self.settings = settings
        is_release = settings.variant == "release"
        planes = depth_planes(settings.near, settings.far, settings.planes)
        swept = self.grid
        if settings.pixel_rules == "release":
            # The release rounds an index that counts from the box's side: every voxel is read half a voxel back.
            back = 0.5 / settings.grid_size
            swept = VoxelGrid(settings.grid_size, -0.5 - back, 0.5 - back)
        channels, early = self.grid_network.out_channels, settings.encoder_channels
        level = settings.map_stride.bit_length() - 2  # of the early map that has the swept maps' size
        self.sweep: PlaneSweepProject | ProjectReduce
        if is_release:
            self.sweep = PlaneSweepProject(swept, planes, mode=settings.projection)
            stacked, (reduced,) = channels * settings.planes, settings.ray_channels
            self.rays = nn.Sequential(
                _Separable(stacked, reduced, activate=False), _Separable(reduced, early[level], activate=True)
            )
        else:
            first, second = settings.ray_channels
            augment = ("depth", "direction")
            self.sweep = ProjectReduce(
                channels, first, swept, planes, bias=False, mode=settings.projection, augment=augment
            )
            nn.init.xavier_uniform_(self.sweep.weight)
            self.rays = nn.Sequential(
                InstanceNorm(first),
                Block(2, first, second, 1, norm="scale"),
                Block(2, second, early[level], 3, norm="scale"),
            )
        sides = 2 if settings.skips else 1
        widths = (*early[level::-1], early[0])
        self.rise = nn.ModuleList(
            _Upsample(sides * before, after, is_release=is_release) for before, after in pairwise(widths)
        )
        self.out = Block(2, early[0], 1, 3, norm="none")
        assert self.out.convolution.bias is not None
        nn.init.constant_(self.out.convolution.bias, (settings.near + settings.far) / 2)

    def forward(
        self,
        images: Tensor,
        cameras: Cameras,
        view_mask: Tensor | None = None,
        *,
        steps: str | Sequence[int] | None = None,
        target_cameras: Cameras | None = None,
    ) -> DepthOutput:
        """Depth after every view, or after some.

        Args:
            images: (B, V, 3, H, W) in [0, 1].
            cameras: B*V cameras.
            view_mask: (B, V) bool; views where it is False are not read, and the prediction before them is repeated.
            steps: after which views: None for all, "last", or their indices.
            target_cameras: B*T cameras to predict the depth of, in place of the images' own; needs ``skips=False``.

        Returns:
            `DepthOutput` with depth (B, S, T, H, W); 0 in masked views.

        Raises:
            ShapeError, DTypeError, DeviceError, CameraError, OptionError: see `lsmgeo.errors`.
        """
        if target_cameras is not None and self.settings.skips:
            raise OptionError(
                f"{self.name}: target_cameras must be None for a model with skips, which needs the views' images; "
                "create it with skips=False"
            )
        grids, early = self.encode(images, cameras, view_mask, steps)
        B, S = grids.shape[:2]
        targets = as_tensors(cameras if target_cameras is None else target_cameras, self.name)
        targets = views_of(self.name, targets, views_per_scene(self.name, targets, B, "images'"))
        mask = view_mask if target_cameras is None else None
        if self.settings.pixel_rules == "release":
            # Rays pass the corner of a map's pixels.
            targets = shift_principal_point(self.name, targets, -0.5)
        size = (images.shape[-2] // self.settings.map_stride, images.shape[-1] // self.settings.map_stride)
        maps, _ = self.sweep(
            grids.flatten(0, 1),
            CameraTensors(
                *(_repeat(item, S) for item in (targets.intrinsics, targets.cam_from_world, *image_sizes(targets)))
            ),
            None if mask is None else _repeat(mask, S),
            size=size,
        )
        x = self.rays(maps.flatten(0, 1))
        for level, block in zip(range(len(self.rise) - 1, -1, -1), self.rise, strict=True):
            if self.settings.skips:
                x = torch.cat((_repeat(early[level], S).flatten(0, 1).to(x.dtype), x), 1)
            x = block(x)
        with torch.autocast(x.device.type, enabled=False):
            depth = self.out(x.to(self.out.convolution.weight.dtype)).squeeze(1).unflatten(0, (B, S, targets.shape[1]))
        return DepthOutput(depth if mask is None else torch.where(mask[:, None, :, None, None], depth, 0.0))

    def run(
        self,
        images: Tensor,
        cameras: Cameras,
        view_mask: Tensor | None = None,
        *,
        by_view: bool = False,
        target_cameras: Cameras | None = None,
    ) -> DepthResult:
        """Depth, in evaluation mode and without gradients.

        Args:
            images: (B, V, 3, H, W) in [0, 1].
            cameras: B*V cameras.
            view_mask: (B, V) bool.
            by_view: whether to predict after every view too, at V times the work of the last networks.
            target_cameras: B*T cameras to predict the depth of, in place of the images' own; needs ``skips=False``.

        Returns:
            `DepthResult`, float32.

        Raises:
            ShapeError, DTypeError, DeviceError, CameraError, OptionError: see `lsmgeo.errors`.
        """
        check_flag(self.name, "by_view", by_view)
        with evaluation_mode(self):
            steps = None if by_view else "last"
            depth = self(images, cameras, view_mask, steps=steps, target_cameras=target_cameras).depth.float()
        return DepthResult(depth[:, -1], depth if by_view else None)


def _repeat(item: Tensor, times: int) -> Tensor:
    """(B, V, ...) as (B*S, V, ...), each scene S times."""
    return item[:, None].expand(-1, times, *item.shape[1:]).flatten(0, 1)
