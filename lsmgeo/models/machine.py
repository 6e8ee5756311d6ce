"""What both learnt stereo machines begin with: from images and cameras to the grid that knows the shape."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from lsmgeo._checks import check_devices, check_float, check_mask
from lsmgeo.cameras.tensors import Cameras, CameraTensors, as_tensors, image_sizes
from lsmgeo.errors import ShapeError
from lsmgeo.fusion import ConvGRU3d, ConvLSTM3d
from lsmgeo.grids import VoxelGrid
from lsmgeo.layers import Unproject
from lsmgeo.models.grid_unet import GridUNet
from lsmgeo.models.image_encoder import ImageEncoder
from lsmgeo.models.model import Model
from lsmgeo.models.outputs import chosen_steps
from lsmgeo.models.settings import MachineSettings

__all__ = ["Machine", "Seen", "moved_center", "views_of"]


class Seen(NamedTuple):
    """Grids (B, S, C, D, H, W) after S of the views, and the image encoder's early maps (B, V, C, h, w)."""

    grids: Tensor
    maps: tuple[Tensor, ...]


class Machine(Model):
    """Image encoder, unprojection, recurrent fusion, grid network: a `Seen` of images and cameras."""

    def __init__(self, settings: MachineSettings) -> None:
        super().__init__()
        is_release = settings.variant == "release"
        self.image_size = settings.image_size
        # The release takes pixel j of a map at j times its stride: the camera's image lies aside by so many pixels.
        self.lift_offset = (settings.feature_stride - 1) / 2 if settings.pixel_rules == "release" else 0.0
        self.resolution = settings.grid_size
        self.grid = VoxelGrid(settings.grid_size)
        self.image_encoder = ImageEncoder(settings)
        # "zeros": what lies outside an image is told apart from what looks like its border; the release smears that.
        padding_mode = "border" if is_release else "zeros"
        self.unproject = Unproject(
            self.grid, padding_mode=padding_mode, augment="depth" if is_release else ("depth", "direction")
        )
        self.lift = settings.lift
        self.unproject_finely: Unproject | None = None
        if settings.lift > 1:
            self.unproject_finely = Unproject(VoxelGrid(settings.grid_size * settings.lift), padding_mode=padding_mode)
        recurrence = ConvGRU3d if settings.fusion == "gru" else ConvLSTM3d
        self.fusion = recurrence(
            settings.feature_channels * settings.lift**3 + (1 if is_release else 4),
            settings.hidden_channels,
            kernel_size=settings.input_kernel,
            state_kernel_size=settings.state_kernel,
            eps=1e-12 if is_release else 1e-5,
        )
        self.grid_network = GridUNet(settings)

    def see(
        self,
        images: Tensor,
        cameras: Cameras,
        view_mask: Tensor | None,
        steps: str | Sequence[int] | None,
    ) -> Seen:
        """The common part of `forward`, whose arguments these are."""
        after = chosen_steps(self.name, steps, self._check(images, view_mask))
        if view_mask is not None:
            images = torch.where(view_mask[:, :, None, None, None], images, 0.0)
        views = tuple(images.shape[:2])
        features, maps = self.image_encoder(images.flatten(0, 1))
        volume = self._unproject(features.unflatten(0, views), cameras, view_mask)
        states = self.fusion.states(volume, None, view_mask)[:, after]
        grids = self.grid_network(states.flatten(0, 1)).unflatten(0, states.shape[:2])
        return Seen(grids, tuple(item.unflatten(0, views) for item in maps))

    def _unproject(self, features: Tensor, cameras: Cameras, view_mask: Tensor | None) -> Tensor:
        """The volume (B, V, C, D, H, W) of every view: its samples, sub-voxel by sub-voxel, depth and direction."""
        if self.lift_offset:
            cameras = moved_center(self.name, cameras, self.lift_offset)
        if self.unproject_finely is None:
            return self.unproject(features, cameras, view_mask).volume
        samples = self.unproject_finely(features, cameras, view_mask).volume
        cells = samples.unflatten(5, (-1, self.lift)).unflatten(4, (-1, self.lift)).unflatten(3, (-1, self.lift))
        folded = cells.permute(0, 1, 2, 4, 6, 8, 3, 5, 7).flatten(2, 5)  # (B, V, C * lift^3, D, H, W)
        geometry = self.unproject(features[:, :, :0], cameras, view_mask).volume
        return torch.cat((folded, geometry), 2)

    def _check(self, images: Tensor, view_mask: Tensor | None) -> int:
        """Check images and mask; the number of views."""
        stride = 1 << len(self.image_encoder.down)
        expected = f"(B, V, 3, H, W), V at least 1, H and W multiples of {stride}, {2 * stride} at least"
        check_float(self.name, "images", images, expected, 5)
        _, V, channels, height, width = images.shape
        if V < 1 or channels != 3 or height % stride or width % stride or min(height, width) < 2 * stride:
            raise ShapeError(f"{self.name}: images must be {expected}; got {tuple(images.shape)}")
        if view_mask is not None:
            check_mask(self.name, "view_mask", view_mask, tuple(images.shape[:2]), "(B, V)")
            check_devices(self.name, images=images, view_mask=view_mask)
        return V


def moved_center(who: str, cameras: Cameras, pixels: float) -> CameraTensors:
    """Move the principal points of cameras.

    Args:
        who: the model that asks, named in errors.
        cameras: of any leading shape.
        pixels: of the image, to the right and down.

    Returns:
        Cameras of the same leading shape.
    """
    tensors = as_tensors(cameras, who)
    offset = torch.zeros_like(tensors.intrinsics)
    offset[..., :2, 2] = pixels
    return tensors._replace(intrinsics=tensors.intrinsics + offset)


def views_of(who: str, cameras: Cameras, scenes: int) -> CameraTensors:
    """Cameras with the leading shape (B, V), whatever form they came in."""
    tensors = as_tensors(cameras, who)
    leading = tuple(tensors.cam_from_world.shape[:-2])
    if len(leading) == 2 and leading[0] == scenes:
        return tensors
    if len(leading) != 1 or scenes == 0 or leading[0] % scenes:
        raise ShapeError(f"{who}: cameras must have leading shape (B, V) or (B*V,) with B = {scenes}; got {leading}")
    K, E, height, width = (
        item.unflatten(0, (scenes, -1)) for item in (tensors.intrinsics, tensors.cam_from_world, *image_sizes(tensors))
    )
    return CameraTensors(K, E, height, width)
