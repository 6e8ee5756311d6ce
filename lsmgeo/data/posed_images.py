"""Images with known cameras, and the points, depth and voxels that come with them: what every reader returns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch

from lsmgeo._checks import describe, is_whole
from lsmgeo.data.images import read_cut_out, read_image
from lsmgeo.data.sample import Sample
from lsmgeo.errors import DataError, OptionError, ShapeError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from lsmgeo.cameras import CameraTensors
    from lsmgeo.data.formats.depth_files import DepthFile
    from lsmgeo.data.formats.lenses import Lens
    from lsmgeo.grids import VoxelGrid

__all__ = ["Observations", "PosedImages", "SparsePoints", "Voxels"]


class Observations(NamedTuple):
    """The pixels at which one image observes sparse points; integer centres."""

    points: np.ndarray  # (M,) int64, rows of SparsePoints.positions
    pixels: np.ndarray  # (M, 2) float64, x then y


class SparsePoints(NamedTuple):
    """Sparse points of a reconstruction, and the images that observe them."""

    positions: np.ndarray  # (N, 3) float64, world
    colours: np.ndarray  # (N, 3) uint8, RGB
    observations: tuple[Observations, ...]  # one for each image


class Voxels(NamedTuple):
    """The object in the images as voxels, and their grid in the world."""

    occupancy: torch.Tensor  # (D, H, W) bool
    grid: VoxelGrid

    @property
    def world_from_lattice(self) -> np.ndarray:
        """(4, 4) float64, from voxel index (x, y, z) to world."""
        return self.grid.world_from_lattice.double().reshape(-1, 4, 4)[0].numpy()

    @property
    def voxel_size(self) -> float:
        """Side of a cube with the volume of one voxel, in world units."""
        return float(np.cbrt(abs(np.linalg.det(self.world_from_lattice[:3, :3]))))


@dataclass(frozen=True, eq=False)
class PosedImages:
    """V images with known cameras; sizes may differ.

    Convention:
        Cameras are world-to-camera, OpenCV axes, integer pixel centres, float64, whatever the source's convention.
        They belong to the images that :meth:`load` returns: distortion is removed.

    Attributes:
        names: the names of the images in the source.
        paths: their files, all in the scene's folder.
        cameras: :class:`lsmgeo.cameras.CameraTensors` with leading shape (V,).
        points: sparse points, if the source has them.
        source: the name of the format, as `lsmgeo.data.detect` gives it.
        lenses: the lens of each image, None for one without distortion; None if no image has distortion.
        depths: the depth of each image, None for one without; None if no image has depth.
        voxels: the object as voxels, if the source has them.
        cut_out: whether alpha is the silhouette of the object; :meth:`load` then puts it on a white background.
        category: the category of the object, if the source names one.
    """

    names: tuple[str, ...]
    paths: tuple[Path, ...]
    cameras: CameraTensors
    points: SparsePoints | None
    source: str
    lenses: tuple[Lens | None, ...] | None = None
    depths: tuple[DepthFile | None, ...] | None = None
    voxels: Voxels | None = None
    cut_out: bool = False
    category: str | None = None

    def __len__(self) -> int:
        return len(self.names)

    def __repr__(self) -> str:
        """Number, size and source of the images, and what else the scene has."""
        sizes = list(dict.fromkeys(self.size(view) for view in range(len(self))))
        size = f"{sizes[0][1]} x {sizes[0][0]}" if len(sizes) == 1 else f"{len(sizes)} sizes"
        extras = [name for name in ("points", "lenses", "depths", "voxels") if getattr(self, name) is not None]
        return f"<PosedImages: {len(self)} x {size}, {', '.join((self.source, *extras))}>"

    def camera(self, view: int) -> CameraTensors:
        """The camera of one view, leading shape ()."""
        return self.cameras.at(view)

    def size(self, view: int) -> tuple[int, int]:
        """(height, width) of one image in pixels."""
        height, width = (int(size) for size in self.camera(view)[2:])
        return height, width

    def load(self, view: int) -> torch.Tensor:
        """Read one image, undistorted; on a white background if it is cut out.

        Returns:
            (3, H, W) float32 in [0, 1], RGB.

        Raises:
            DataError: the file is missing, damaged, or not of its camera's size.
        """
        if self.cut_out:
            pixels = self._undistorted(view, read_cut_out(self.paths[view], self.size(view)))
            alpha = pixels[..., 3:].astype(np.float32) / 255
            mixed = pixels[..., :3] * alpha + 255 * (1 - alpha)
            return torch.from_numpy(mixed).permute(2, 0, 1).div_(255)
        pixels = self._undistorted(view, read_image(self.paths[view], self.size(view)))
        # In place, so that an image of many megapixels is not held twice as floats.
        return torch.from_numpy(pixels).permute(2, 0, 1).to(torch.float32).div_(255)

    def load_mask(self, view: int) -> torch.Tensor | None:
        """Read the silhouette of the object in one image: where alpha is at least one half.

        Returns:
            (H, W) bool, or None if the images are not cut out.

        Raises:
            DataError: as :meth:`load`.
        """
        if not self.cut_out:
            return None
        pixels = self._undistorted(view, read_cut_out(self.paths[view], self.size(view)))
        return torch.from_numpy(pixels[..., 3] >= 128)

    def load_depth(self, view: int) -> torch.Tensor | None:
        """Read the depth of one image.

        Returns:
            (H, W) float32 camera z in world units, 0 for no depth; None if this image has no depth.

        Raises:
            DataError: the file is missing, damaged, or not of its camera's size.
        """
        file = None if self.depths is None else self.depths[view]
        if file is None:
            return None
        return torch.from_numpy(self._undistorted(view, file.read(self.size(view)), nearest=True))

    def _undistorted(self, view: int, image: np.ndarray, *, nearest: bool = False) -> np.ndarray:
        lens = None if self.lenses is None else self.lenses[view]
        return image if lens is None else lens.straighten(image, nearest=nearest)

    def sample(self, views: Sequence[int] | None = None) -> Sample:
        """Read images as one `Sample`, the input of models, named after their folder.

        If there are voxels, the world is moved and scaled so that they fill [-0.5, 0.5]^3, the convention of `Sample`.

        Args:
            views: which views, in which order; None for all. They must be of one size: resize or crop others first
                (`lsmgeo.cameras.resize` and `lsmgeo.cameras.crop` change the cameras).

        Returns:
            Images and cameras (float64); depth if all the images have it, mask and occupancy if the source has them;
            no mesh.

        Raises:
            OptionError: no view, or a view that does not exist.
            ShapeError: images of different sizes.
            DataError: a file is missing, damaged, or not of its camera's size; or the voxels do not fill a cube.
        """
        chosen = list(range(len(self)) if views is None else views)
        if not chosen or not all(is_whole(view) and 0 <= view < len(self) for view in chosen):
            raise OptionError(f"sample: views must be numbers from 0 to {len(self) - 1}; got {describe(views)}")
        # All sizes are checked before the first image is read.
        sizes = {self.size(view): self.names[view] for view in chosen}
        if len(sizes) > 1:
            (first, name), (second, other) = list(sizes.items())[:2]
            raise ShapeError(
                "sample: images must be of one size; "
                f"{name!r} is {first[0]} x {first[1]} (height x width), {other!r} {second[0]} x {second[1]}: "
                "select views of one size, or load them one by one"
            )
        images = torch.stack([self.load(view) for view in chosen])
        cameras = self.cameras.at(chosen)
        maps = [depth for view in chosen if (depth := self.load_depth(view)) is not None]
        depth = torch.stack(maps) if len(maps) == len(chosen) else None
        masks = [mask for view in chosen if (mask := self.load_mask(view)) is not None]
        occupancy = None
        if self.voxels is not None:
            occupancy = self.voxels.occupancy
            unit, middle = self._cube(self.voxels.grid)
            # X = unit X' + middle; camera coordinates are scaled alike, so that R remains a rotation.
            E = cameras.cam_from_world.clone()
            E[:, :3, 3] = (E[:, :3, 3] + (E[:, :3, :3] * middle).sum(-1)) / unit
            cameras = cameras._replace(cam_from_world=E)
            depth = None if depth is None else depth / unit
        folder = self.paths[chosen[0]].parent
        name = folder.parent.name if folder.name in ("images", "rendering") else folder.name
        mask = torch.stack(masks) if masks else None
        return Sample(images, cameras, depth, mask, occupancy, None, self.category, name or self.source)

    def _cube(self, grid: VoxelGrid) -> tuple[float, torch.Tensor]:
        """Side and centre of the cube that the voxels fill."""
        index = torch.tensor(grid.shape, dtype=torch.float64)
        T = grid.world_from_lattice.double()
        sides = T[:3, :3].diagonal() * index.flip(0)
        straight = bool(((T[:3, :3] - T[:3, :3].diagonal().diag()).abs() <= 1e-9 * sides.abs().max()).all())
        if not straight or not bool((sides - sides[0]).abs().max() <= 1e-6 * sides[0]):
            raise DataError(self.paths[0].parent, "its voxels do not fill a cube along the axes, which a sample needs")
        return float(sides[0]), T[:3, 3] + T[:3, :3].diagonal() * (index.flip(0) - 1) / 2
