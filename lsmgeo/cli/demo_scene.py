"""The demonstration: the depth of an analytic scene is recovered with both operators.

A textured sphere on a textured floor is ray traced from six viewpoints. The images are unprojected into a voxel grid,
in which a low variance means that the views agree; the agreement is projected into a plane sweep of one view, and the
highest peak along every ray is the depth, which is compared with the exact one.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from lsmgeo import PlaneSweepProject, Unproject, VoxelGrid, depth_planes, scenes
from lsmgeo.cameras import CameraTensors, centers, orbit, project, unproject_depth

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["DemoResult", "run_demo", "write_figure"]

RADIUS = 0.4
FLOOR = -RADIUS
# Summed variance of the colours at which agreement has fallen to 1/e.
TOLERANCE = 0.003
# Wave vectors of the solid texture, in radians per world unit: coarse enough for the grid, fine enough to match.
WAVES = (
    (9.0, 4.0, -3.0),
    (-4.0, 8.0, 5.0),
    (3.0, -5.0, 9.0),
    (13.0, -9.0, 7.0),
    (-8.0, -12.0, 11.0),
    (10.0, 11.0, 13.0),
)


@dataclass(frozen=True, eq=False)
class DemoResult:
    """The results of the demonstration.

    Attributes:
        images: (V, 3, H, W) the rendered views.
        cameras: leading shape (V,).
        grid: the voxels.
        agreement: (D, H, W) in [0, 1], 1 where all views that see a voxel have the same colour.
        view: index of the view whose depth is recovered.
        true_depth: (H, W) exact camera z, 0 outside the box of the scene.
        depth: (H, W) recovered camera z, 0 where there is no peak.
        error: (H, W) relative error, NaN outside the visible surface.
        seconds: time of the operators.
    """

    images: Tensor
    cameras: CameraTensors
    grid: VoxelGrid
    agreement: Tensor
    view: int
    true_depth: Tensor
    depth: Tensor
    error: Tensor
    seconds: float

    @property
    def median_error(self) -> float:
        """Median relative depth error over the visible surface, a fraction."""
        return float(self.error[self.error.isfinite()].median())


def _texture(points: Tensor) -> Tensor:
    """A solid texture: colour (..., 3) in [0, 1] of world points (..., 3)."""
    phases = points @ points.new_tensor(WAVES).T  # (..., 6)
    waves = torch.sin(phases + torch.arange(len(WAVES), dtype=points.dtype))
    return 0.5 + 0.25 * (waves[..., :3] + waves[..., 3:])


def _render(cameras: CameraTensors, scene: scenes.Scene, lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The textured scene: images (V, 3, H, W), camera z (V, H, W), 0 outside the box, and points (V, H, W, 3)."""
    dark = scenes.Lights(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(3))
    depth = scenes.render([scene], cameras.at(None), dark, dtype=torch.float64).depth[0]
    points = unproject_depth(cameras, depth[None])[0]
    hit = (depth > 0) & ((points >= lower) & (points <= upper)).all(-1)
    # Noise that differs between views: views of a uniform background would agree in empty space.
    noise = torch.rand(points.shape[:-1], generator=torch.Generator().manual_seed(0), dtype=points.dtype)
    colours = torch.where(hit[..., None], _texture(points), noise[..., None])
    return colours.permute(0, 3, 1, 2), torch.where(hit, depth, 0.0), points


def _seen_by(points: Tensor, cameras: CameraTensors, scene: scenes.Scene) -> Tensor:
    """The number of cameras that see each surface point (H, W, 3): in the image, and not occluded."""
    origins = centers(cameras)[:, None]  # (V, 1, 3)
    towards = points.reshape(1, -1, 3) - origins  # (V, H * W, 3)
    first = scenes.trace([scene], origins.expand_as(towards).reshape(1, -1, 3), towards.reshape(1, -1, 3)).distance
    inside = project(cameras, points.reshape(1, -1, 3)).visible[0]
    return (inside & (first.view(inside.shape) > 1 - 1e-3)).sum(0).view(points.shape[:2])


def run_demo(*, size: tuple[int, int] = (120, 160), voxels: int = 72, planes: int = 160) -> DemoResult:
    """Run the demonstration.

    Args:
        size: (H, W) of the images.
        voxels: voxels along the longest side of the grid.
        planes: depth planes of the sweep.

    Returns:
        `DemoResult`.
    """
    height, width = size
    view = 2
    # Close together, so that the sphere hides little of the floor in any view.
    azimuths = torch.tensor([68.0, 77.0, 86.0, 94.0, 103.0, 112.0], dtype=torch.float64)
    elevations = torch.tensor([34.0, 46.0, 40.0, 33.0, 48.0, 39.0], dtype=torch.float64)
    cameras = orbit(azimuths, elevations, 2.4, focal_length=1.45 * width, height=height, width=width)
    grid = VoxelGrid((voxels, voxels * 2 // 3, voxels), lower=(-0.75, -0.5, -0.75), upper=(0.75, 0.5, 0.75))
    lower, upper = torch.tensor(grid.lower).double(), torch.tensor(grid.upper).double()
    scene = scenes.Scene([scenes.sphere((0, 0, 0), RADIUS), scenes.half_space((0, FLOOR, 0), (0, 1, 0))])
    images, depths, points = _render(cameras, scene, lower, upper)
    images = images.float()

    start = time.perf_counter()
    unproject = Unproject(grid, reduce="variance", padding_mode="border")
    variance, visible = unproject(images[None], cameras)
    enough = visible.sum(1, keepdim=True) >= 3
    agreement = torch.where(enough, torch.exp(-variance.sum(1, keepdim=True) / TOLERANCE), 0.0)

    sweep_depths = depth_planes(1.4, 3.4, planes)
    swept = PlaneSweepProject(grid, sweep_depths, size)(agreement, cameras.at([view])).maps[0, 0]  # (P, H, W)
    depth = _peak(swept, sweep_depths)
    seconds = time.perf_counter() - start

    truth = depths[view]
    surface = (truth > 0) & (_seen_by(points[view], cameras, scene) >= 3)
    error = torch.where(surface, (depth - truth).abs() / truth.clamp_min(1e-6), torch.nan)
    return DemoResult(images, cameras, grid, agreement[0, 0], view, truth, depth, error, seconds)


def _peak(scores: Tensor, depths: Tensor) -> Tensor:
    """Depth of the highest score along the first axis, placed between planes by a parabola; 0 where all are 0."""
    best = scores.argmax(0).clamp(1, len(depths) - 2)
    before, middle, after = (scores.gather(0, (best + step)[None])[0] for step in (-1, 0, 1))
    curvature = (2 * middle - before - after).clamp_min(1e-9)
    place = best + (0.5 * (after - before) / curvature).clamp(-0.5, 0.5)
    spacing = depths[1] - depths[0]
    return torch.where(middle > 0, depths[0] + place * spacing, 0.0).double()


def write_figure(result: DemoResult, path: Path) -> Path:
    """Draw the demonstration as one PNG: the views, the agreement, and true depth, recovered depth and error.

    Raises:
        DataError: the file cannot be written.
    """
    from lsmgeo.data import write_atomic
    from lsmgeo.drawing import as_png, new_figure

    figure = new_figure(16, 7.2)
    rows = figure.subfigures(2, 1, height_ratios=(1, 1.75))
    assert isinstance(rows, np.ndarray)
    top, bottom = rows
    figure.suptitle(
        "Depth of an analytic scene, recovered by unprojecting its images and projecting the result into a plane sweep"
    )
    for view, axes in enumerate(top.subplots(1, len(result.images))):
        axes.imshow(result.images[view].permute(1, 2, 0).clamp(0, 1))
        chosen = view == result.view
        axes.set_title(f"input view {view}" + (" (depth of this view)" if chosen else ""), fontsize=9)
        axes.set_xticks([])
        axes.set_yticks([])
        for spine in axes.spines.values():
            spine.set(color="tab:red" if chosen else "0.6", linewidth=3 if chosen else 1)

    agreement, truth, depth, error = bottom.subplots(1, 4, width_ratios=(1.0, 1.1, 1.1, 1.1))
    _draw_slice(agreement, result)
    shown = torch.where(result.true_depth > 0, result.true_depth, torch.nan)
    found = torch.where(result.error.isfinite() & (result.depth > 0), result.depth, torch.nan)
    low, high = float(shown[shown.isfinite()].min()), float(shown[shown.isfinite()].max())
    for axes, values, title in ((truth, shown, "true depth (ray traced)"), (depth, found, "recovered depth")):
        drawn = axes.imshow(values, cmap="viridis", vmin=low, vmax=high)
        axes.set_title(f"{title}, view {result.view}")
        figure.colorbar(drawn, ax=axes, location="bottom", label="camera z [world units]")
    drawn = error.imshow(100 * result.error, cmap="magma", vmin=0, vmax=3)
    error.set_title(f"relative error, median {100 * result.median_error:.2f} %\n(the sphere hides the floor beside it)")
    figure.colorbar(drawn, ax=error, location="bottom", label="|recovered - true| / true [%]", extend="max")
    for axes in (truth, depth, error):
        axes.set_facecolor("0.85")
        axes.set(xlabel="x [pixel]", ylabel="y [pixel]")
    return write_atomic(path, as_png(figure))


def _draw_slice(axes: Axes, result: DemoResult) -> None:
    """The slice x = 0 of the agreement, with the true surface; the cameras are on the right."""
    from matplotlib.patches import Circle

    grid = result.grid
    assert isinstance(grid.lower, tuple)
    assert isinstance(grid.upper, tuple)
    values = result.agreement[:, :, result.agreement.shape[2] // 2].T  # (H, D): y upwards, z to the right
    extent = (grid.lower[2], grid.upper[2], grid.lower[1], grid.upper[1])
    drawn = axes.imshow(values, cmap="gray", vmin=0, vmax=1, extent=extent, origin="lower")
    axes.axhline(FLOOR, color="tab:red", linewidth=1.5, linestyle=":", label="true surface")
    axes.add_patch(Circle((0, 0), RADIUS, fill=False, color="tab:red", linewidth=1.5, linestyle=":"))
    axes.legend(loc="upper left", fontsize=8)
    axes.set(xlabel="z, towards the cameras [world units]", ylabel="y, up [world units]")
    axes.set_title("where the views agree, slice x = 0")
    axes.figure.colorbar(drawn, ax=axes, location="bottom", label=f"exp(-variance between views / {TOLERANCE})")
