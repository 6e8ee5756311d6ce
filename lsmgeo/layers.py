"""`Unproject`, `PlaneSweepProject` and `Splat`: the operators as modules without state."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from lsmgeo import kernels
from lsmgeo._checks import describe, moved
from lsmgeo._sites import Cameras, Grid
from lsmgeo.errors import DTypeError, GridError
from lsmgeo.functional.image_sampling import Names, Unprojected, run_unproject
from lsmgeo.functional.volume_sampling import Projected, run_plane_sweep_project, run_splat
from lsmgeo.grids import FrustumGrid, VoxelGrid, check_constant_depths, check_map_size

__all__ = ["PlaneSweepProject", "Splat", "Unproject"]


def _as_given(name: str) -> Any:
    """An option of a layer as it was given; setting it checks the options again."""
    return property(lambda self: self.given[name], lambda self, value: self._set_options({**self.given, name: value}))


class SamplingLayer(nn.Module):
    """A layer whose options are checked when they are set, not at each call.

    Attributes:
        options: the checked options, which `forward` passes on.
        given: the options as given, by name.
    """

    mode = _as_given("mode")
    padding_mode = _as_given("padding_mode")
    near = _as_given("near")
    backend = _as_given("backend")

    def __init__(self, who: str, smooth: str, **given: Any) -> None:
        super().__init__()
        self.who, self.smooth = who, smooth
        self._set_options(given)

    def _set_options(self, given: dict[str, Any]) -> None:
        choices = {name: value for name, value in given.items() if name != "backend"}
        self.options = kernels.check_options(self.who, self.smooth, given["backend"], **choices)
        self.given = given

    def _options_repr(self) -> str:
        return ", ".join(f"{name}={value!r}" for name, value in self.given.items())


class Unproject(SamplingLayer):
    """Lift image features to the sites of a grid; see `lsmgeo.functional.unproject` for equation and conventions.

    Args:
        grid: `VoxelGrid` or `FrustumGrid`; None if it is passed to every call. Not part of the ``state_dict``.
        mode: "bilinear" or "nearest".
        padding_mode: "zeros" or "border".
        augment: "depth", "direction" or both: channels to append, depth first.
        direction_frame: "world" or "camera".
        reduce: None, or "mean", "variance", "max" or several: statistics over the views that see a site.
        near: least depth of a visible site, world units.
        groups: of channels, that are correlated with the reference of a call.
        memory_format: ``torch.contiguous_format`` for a contiguous volume; by default its strides are what is fastest.
        backend: "auto", or the name of one.

    Shape:
        - features: (B, V, C, h, w); cameras: B*V, view fastest; view_mask: (B, V) bool.
        - reference: (B, C, D or 1, H, W).
        - volume: (B, V, C', D, H, W), or (B, C'', D, H, W) with `reduce`; visible: (B, V, D, H, W) bool.

    Raises:
        OptionError, DTypeError: at construction for options; for the rest see `lsmgeo.functional.unproject`.

    Example:
        >>> import torch
        >>> from lsmgeo import Unproject, VoxelGrid
        >>> from lsmgeo.cameras import orbit
        >>> unproject = Unproject(VoxelGrid(8), augment=("depth", "direction"))
        >>> cameras = orbit(torch.tensor([[0.0, 120.0, 240.0]]), 20.0, 2.0, focal_length=100.0, height=48, width=64)
        >>> volume, visible = unproject(torch.rand(1, 3, 5, 24, 32), cameras)
        >>> tuple(volume.shape), tuple(visible.shape)
        ((1, 3, 9, 8, 8, 8), (1, 3, 8, 8, 8))
    """

    augment = _as_given("augment")
    direction_frame = _as_given("direction_frame")
    reduce = _as_given("reduce")
    groups = _as_given("groups")
    memory_format = _as_given("memory_format")

    def __init__(
        self,
        grid: Grid | None = None,
        *,
        mode: str = "bilinear",
        padding_mode: str = "zeros",
        augment: Names = (),
        direction_frame: str = "world",
        reduce: Names | None = None,
        near: float = 1e-6,
        groups: int = 1,
        memory_format: torch.memory_format | None = None,
        backend: str = "auto",
    ) -> None:
        if grid is not None and not isinstance(grid, (VoxelGrid, FrustumGrid)):
            raise DTypeError(f"Unproject: grid must be a VoxelGrid or a FrustumGrid; got {describe(grid)}")
        super().__init__(
            "Unproject",
            "bilinear",
            mode=mode,
            padding_mode=padding_mode,
            augment=augment,
            direction_frame=direction_frame,
            reduce=reduce,
            near=near,
            groups=groups,
            memory_format=memory_format,
            backend=backend,
        )
        self.grid = grid

    def forward(
        self,
        features: Tensor,
        cameras: Cameras,
        view_mask: Tensor | None = None,
        *,
        grid: Grid | None = None,
        reference: Tensor | None = None,
    ) -> Unprojected:
        """Unproject features (B, V, C, h, w), or correlate them; `grid` takes precedence over the layer's."""
        grid = self.grid if grid is None else grid
        if grid is None:
            raise GridError("Unproject: grid must be given to the layer or to the call; got None")
        return run_unproject(features, cameras, grid, view_mask, reference, self.options)

    def extra_repr(self) -> str:
        """The arguments."""
        return f"{self.grid}, {self._options_repr()}"


class SweepingLayer(SamplingLayer):
    """A layer between volumes on a `VoxelGrid` and planes of depth in front of cameras; either may come with the call.

    Neither is part of the ``state_dict``.
    """

    def __init__(self, who: str, grid: VoxelGrid | None, depths: Tensor | None, **given: Any) -> None:
        if grid is not None and not isinstance(grid, VoxelGrid):
            raise DTypeError(f"{who}: grid must be a VoxelGrid; got {describe(grid)}")
        if depths is not None:
            check_constant_depths(who, depths, (1, 2, 3, 5))
        super().__init__(who, "trilinear", **given)
        self.grid = grid
        self.depths = depths

    def _lattice(self, source: Tensor, grid: VoxelGrid | None, depths: Tensor | None) -> tuple[VoxelGrid, Tensor]:
        """The grid and depths of a call, which take precedence over the layer's, moved to the source's device."""
        grid = self.grid if grid is None else grid
        if grid is None:
            raise GridError(f"{self.who}: grid must be given to the layer or to the call; got None")
        if depths is None and self.depths is not None:
            device = source.device if isinstance(source, Tensor) else self.depths.device
            depths = moved(self.who, "depths", self.depths, device)
        if depths is None:
            raise GridError(f"{self.who}: depths must be given to the layer or to the call; got None")
        return grid, depths

    def extra_repr(self) -> str:
        """The arguments."""
        depths = None if self.depths is None else f"<{tuple(self.depths.shape)} {self.depths.dtype}>"
        return f"{self.grid}, depths={depths}, {self._options_repr()}"


class PlaneSweepProject(SweepingLayer):
    """Read a volume along the rays of cameras at planes of depth; see `lsmgeo.functional.plane_sweep_project`.

    Args:
        grid: the `VoxelGrid` on which the volumes live; None if it is passed to every call.
        depths: (P,), (B, P), (B, V, P) or, for each pixel, (B, V, P, h, w), see `lsmgeo.depth_planes`; None if passed
            to every call. Neither is part of the ``state_dict``; both follow the volume's device.
        size: (h, w) of the maps; by default the cameras' image size, or that of depths of each pixel.
        mode: "trilinear" or "nearest".
        padding_mode: "zeros" or "border".
        augment: "depth", "direction" or both.
        direction_frame: "world" or "camera".
        flatten: whether channels and planes share an axis, index ``c * P + k``.
        near: least depth of a visible plane, world units.
        memory_format: ``torch.contiguous_format`` for contiguous maps; by default their strides are what is fastest.
        backend: "auto", or the name of one.

    Shape:
        - volume: (B, C, D, H, W); cameras: B*V, view fastest; view_mask: (B, V) bool.
        - maps: (B, V, C' P, h, w), or (B, V, C', P, h, w) where `flatten` is False; visible: (B, V, P, h, w) bool.

    Raises:
        OptionError, DTypeError, ShapeError, GridError: at construction; for the rest see
            `lsmgeo.functional.plane_sweep_project`.

    Example:
        >>> import torch
        >>> from lsmgeo import PlaneSweepProject, VoxelGrid, depth_planes
        >>> from lsmgeo.cameras import orbit
        >>> project = PlaneSweepProject(VoxelGrid(8), depth_planes(1.0, 3.0, 6), size=(12, 16), mode="nearest")
        >>> cameras = orbit(torch.tensor([[0.0, 120.0, 240.0]]), 20.0, 2.0, focal_length=100.0, height=48, width=64)
        >>> maps, visible = project(torch.rand(1, 5, 8, 8, 8), cameras)
        >>> tuple(maps.shape), tuple(visible.shape)
        ((1, 3, 30, 12, 16), (1, 3, 6, 12, 16))
    """

    augment = _as_given("augment")
    direction_frame = _as_given("direction_frame")
    flatten = _as_given("flatten")
    memory_format = _as_given("memory_format")

    def __init__(
        self,
        grid: VoxelGrid | None = None,
        depths: Tensor | None = None,
        size: tuple[int, int] | None = None,
        *,
        mode: str = "trilinear",
        padding_mode: str = "zeros",
        augment: Names = (),
        direction_frame: str = "world",
        flatten: bool = True,
        near: float = 1e-6,
        memory_format: torch.memory_format | None = None,
        backend: str = "auto",
    ) -> None:
        super().__init__(
            "PlaneSweepProject",
            grid,
            depths,
            mode=mode,
            padding_mode=padding_mode,
            augment=augment,
            direction_frame=direction_frame,
            flatten=flatten,
            near=near,
            memory_format=memory_format,
            backend=backend,
        )
        check_map_size(self.who, depths, size)
        self.size = size

    def forward(
        self,
        volume: Tensor,
        cameras: Cameras,
        view_mask: Tensor | None = None,
        *,
        grid: VoxelGrid | None = None,
        depths: Tensor | None = None,
        size: tuple[int, int] | None = None,
    ) -> Projected:
        """Sweep a volume (B, C, D, H, W); `grid`, `depths` and `size` take precedence over the layer's."""
        grid, depths = self._lattice(volume, grid, depths)
        size = self.size if size is None else size
        return run_plane_sweep_project(volume, cameras, grid, depths, size, view_mask, self.options)

    def extra_repr(self) -> str:
        """The arguments."""
        return f"{super().extra_repr()}, size={self.size}"


class Splat(SweepingLayer):
    """Add features along the rays of cameras to a volume, the adjoint of `PlaneSweepProject`.

    See `lsmgeo.functional.splat` for equation and conventions.

    Args:
        grid: the `VoxelGrid` of the volume; None if it is passed to every call.
        depths: (P,), (B, P), (B, V, P) or, for each pixel, (B, V, P, h, w), see `lsmgeo.depth_planes`; None if passed
            to every call. Neither is part of the ``state_dict``; both follow the features' device.
        mode: "trilinear" or "nearest".
        padding_mode: "zeros" or "border".
        near: least depth of a plane, world units.
        backend: "auto", or the name of one.

    Shape:
        - features: (B, V, C, h, w) with weights (B, V, P, h, w), or (B, V, C, P, h, w) without.
        - cameras: B*V, view fastest; view_mask: (B, V) bool.
        - volume: (B, C, D, H, W).

    Raises:
        OptionError, DTypeError, GridError: at construction; for the rest see `lsmgeo.functional.splat`.

    Example:
        >>> import torch
        >>> from lsmgeo import Splat, VoxelGrid, depth_planes
        >>> from lsmgeo.cameras import orbit
        >>> splat = Splat(VoxelGrid((1, 8, 8)), depth_planes(1.0, 3.0, 6), mode="nearest")
        >>> cameras = orbit(torch.tensor([[0.0, 120.0, 240.0]]), 20.0, 2.0, focal_length=100.0, height=48, width=64)
        >>> weights = torch.rand(1, 3, 6, 12, 16).softmax(2)
        >>> tuple(splat(torch.rand(1, 3, 5, 12, 16), cameras, weights=weights).shape)
        (1, 5, 1, 8, 8)
    """

    def __init__(
        self,
        grid: VoxelGrid | None = None,
        depths: Tensor | None = None,
        *,
        mode: str = "trilinear",
        padding_mode: str = "zeros",
        near: float = 1e-6,
        backend: str = "auto",
    ) -> None:
        super().__init__("Splat", grid, depths, mode=mode, padding_mode=padding_mode, near=near, backend=backend)

    def forward(
        self,
        features: Tensor,
        cameras: Cameras,
        view_mask: Tensor | None = None,
        *,
        weights: Tensor | None = None,
        grid: VoxelGrid | None = None,
        depths: Tensor | None = None,
    ) -> Tensor:
        """Add features to a volume (B, C, D, H, W); `grid` and `depths` take precedence over the layer's."""
        grid, depths = self._lattice(features, grid, depths)
        return run_splat(features, cameras, grid, depths, weights, view_mask, self.options)
