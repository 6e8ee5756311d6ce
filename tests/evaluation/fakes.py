"""Shapes whose truth is a slab, and models that answer by a rule: every figure of a report follows by hand."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from lsmgeo.cameras import orbit
from lsmgeo.data import Sample
from lsmgeo.models import DepthResult, VoxelResult

SIDE, SIZE = 8, 16
AZIMUTHS = torch.tensor([0.0, 50.0, 100.0, 150.0, 200.0, 250.0, 300.0, 340.0])


def slab(width: int) -> Tensor:
    """(8, 8, 8) bool: the first planes along z."""
    solid = torch.zeros(SIDE, SIDE, SIDE, dtype=torch.bool)
    solid[:width] = True
    return solid


def iou(first: int, second: int) -> float:
    """Of two slabs."""
    return min(first, second) / max(first, second)


@dataclass
class FakeShapes:
    """Shapes that are slabs; view v has the brightness (v + 1) / 20, and its corner is the background."""

    widths: Sequence[int]
    categories: Sequence[str]
    seed: int = 0
    about: str = "slabs"
    most_views: int = len(AZIMUTHS)
    depth: Tensor = field(default_factory=lambda: torch.full((SIZE, SIZE), 2.0))

    def __len__(self):
        return len(self.widths)

    def at(self, size):
        assert size == SIZE
        return self

    def read(self, index, views, *, resolution, depth, background):
        images = torch.stack([torch.full((3, SIZE, SIZE), (view + 1) / 20) for view in range(views)])
        images[:, :, 0, 0] = 1.0 if background == "white" else 0.5
        mask = torch.ones(views, SIZE, SIZE, dtype=torch.bool)
        mask[:, 0, 0] = False
        return Sample(
            images,
            orbit(AZIMUTHS[:views], 10.0, 2.0, focal_length=1.875 * SIZE, height=SIZE, width=SIZE),
            torch.where(mask, self.depth, 0.0) if depth else None,
            mask,
            slab(self.widths[index]) if resolution else None,
            None,
            self.categories[index],
            f"shape-{index}",
        )


class FakeVoxels(nn.Module):
    """Predicts a slab after every view, as wide as a rule says of the images (v, 3, H, W) and cameras seen so far."""

    name, output, image_size, resolution = "voxel-lsm", "voxels", SIZE, SIDE

    def __init__(self, rule, kind="voxel-lsm", inside=0.41, outside=0.39):
        super().__init__()
        self.name, self.rule, self.values = kind, rule, (outside, inside)

    def run(self, images, cameras, view_mask=None, *, by_view=True):
        steps = range(1, images.shape[1] + 1) if by_view else [images.shape[1]]
        outside, inside = self.values
        found = torch.stack(
            [
                torch.stack(
                    [
                        torch.where(slab(self.rule(one[:step], R[:step])), inside, outside)
                        for one, R in zip(images, cameras.cam_from_world[..., :3, :3], strict=True)
                    ]
                )
                for step in steps
            ],
            1,
        )
        return VoxelResult(found[:, -1], found if by_view else None)


class FakeDepths(nn.Module):
    """Predicts the same depth maps of every shape."""

    name, output, image_size, resolution = "depth-lsm", "depth", SIZE, SIDE

    def __init__(self, depth):
        super().__init__()
        self.depth = depth

    def run(self, images, cameras, view_mask=None, **options):
        return DepthResult(self.depth.expand(*images.shape[:2], SIZE, SIZE), None)
