"""Matching costs of a reference image and its neighbours, at every plane of the frustum of the reference."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

from lsmgeo import functional
from lsmgeo._checks import check_finite, check_float, check_mask, check_whole
from lsmgeo.cameras.tensors import Cameras, as_tensors
from lsmgeo.classical.correlation import INVALID_COST, Correlation, on_threads
from lsmgeo.classical.sweep_options import SweepOptions
from lsmgeo.errors import ShapeError
from lsmgeo.grids import FrustumGrid

__all__ = ["INVALID_COST", "MatchingCosts", "aggregate_views", "matching_costs"]

LUMINANCE = (0.299, 0.587, 0.114)


class MatchingCosts(NamedTuple):
    """The cost of every neighbour at every site of a reference's frustum, and which neighbour sees which site."""

    costs: Tensor  # (V-1, P, h, w)
    visible: Tensor  # (V-1, P, h, w) bool


def matching_costs(
    images: Tensor,
    cameras: Cameras,
    depths: Tensor,
    *,
    score: str = "zncc",
    window: int = 5,
    noise: float = 2 / 255,
) -> MatchingCosts:
    """Compare every neighbour with the reference, the first view, at every plane of its frustum.

    Every neighbour is warped onto every plane, and patches of the warped image are compared with those of the
    reference, so that patches are rotated, scaled and foreshortened as the view is (Collins, "A space-sweep approach to
    true multi-image matching", CVPR 1996). Equation, with means E over the pixels of a patch, r of the reference, s
    warped:

    - "zncc": ``1 - cov(r, s) / sqrt((var r + noise^2) (var s + noise^2))`` of luminances, in [0, 2]: one minus the
      zero-mean normalised cross-correlation, so that a patch without texture matches nothing, not even another one;
    - "sad": ``E |r - s|``, the mean absolute difference over all channels;
    - "census": twice the fraction of the pixels of a patch that are darker than its centre in only one of the images,
      in [0, 2] (Zabih and Woodfill, "Non-parametric local transforms", ECCV 1994), of luminances;
    - "cosine": ``1 - E r.s / sqrt((E r.r + noise^2) (E s.s + noise^2))``, in [0, 2], for learned features.

    Convention:
        Depth is camera z of the first view. Integer pixel centres. At the border, patches are cut off. Where
        a site is outside a neighbour, it is not `visible`, and its cost is that of the nearest pixels.

    Args:
        images: (V, C, h, w), the reference first: C = 1 grey, C = 3 RGB, any C of features for "cosine" and "sad".
        cameras: leading shape (V,), of images of any sizes; they are resized to (h, w).
        depths: (P,) camera z in the reference, world units, positive, ascending.
        score: "zncc", "sad", "census" or "cosine".
        window: side of the patches in pixels of the reference, odd; 1 compares single pixels.
        noise: standard deviation below which texture has little weight; positive.

    Returns:
        `MatchingCosts`: costs (V-1, P, h, w) of the dtype of the images, and visible (V-1, P, h, w). Differentiable in
        images, cameras and depths ("census" is constant).

    Raises:
        OptionError: an unknown score, an even window, noise that is not positive.
        ShapeError, DTypeError, DeviceError, CameraError, GridError: as `lsmgeo.functional.unproject`.

    Example:
        >>> import torch
        >>> from lsmgeo.cameras import CameraTensors
        >>> K = torch.tensor([[8.0, 0.0, 3.5], [0.0, 8.0, 3.5], [0.0, 0.0, 1.0]]).expand(2, 3, 3)
        >>> E = torch.eye(4).repeat(2, 1, 1)
        >>> E[1, 0, 3] = -1.0  # the second camera is one unit to the right: 8 / depth pixels of disparity
        >>> left = torch.rand(1, 8, 8, generator=torch.Generator().manual_seed(0))
        >>> images = torch.stack((left, left.roll(-2, -1)))
        >>> costs, visible = matching_costs(images, CameraTensors(K, E, 8, 8), torch.tensor([2.0, 4.0, 8.0]), window=3)
        >>> bool(costs[0, 1, 4, 4] < 1e-3 < costs[0, 0, 4, 4])
        True
    """
    options = SweepOptions(score=score, window=window, noise=noise, who="matching_costs")
    check_float("matching_costs", "depths", depths, "(P,)", rank=1)
    reference, slabs = warp_neighbours(images, cameras, depths, depths.shape[0], options)
    _, volume, visible = next(slabs)
    return MatchingCosts(_comparison(options, reference)(volume), visible)


def warp_neighbours(
    images: Tensor,
    cameras: Cameras,
    depths: Tensor,
    planes_per_slab: int,
    options: SweepOptions,
) -> tuple[Tensor, Iterator[tuple[int, Tensor, Tensor]]]:
    """Check the tensors of `matching_costs`, and warp the neighbours, some planes at a time.

    Returns:
        The reference (C, h, w), and slabs: first plane, neighbours (V-1, C, d, h, w), visible (V-1, d, h, w).
    """
    who = "matching_costs"
    check_float(who, "images", images, "(V, C, h, w)", rank=4)
    if images.shape[0] < 2:
        raise ShapeError(f"{who}: images must be (V, C, h, w) with V at least 2; got {tuple(images.shape)}")
    check_finite(who, "images", images)
    check_float(who, "depths", depths, "(P,)", rank=1)
    tensors = as_tensors(cameras, who)
    if tensors.shape != (len(images),):
        raise ShapeError(
            f"{who}: cameras must have the images' leading shape (V,) = ({len(images)},); got {tensors.shape}"
        )
    if options.score in ("zncc", "census"):
        images = luminance(images)
    if options.score == "zncc":
        # Correlation ignores an offset; without it squares have smaller rounding errors.
        images = images - images[0].detach().mean()
    others = tensors.at(slice(1, None))
    grid = FrustumGrid(tensors.at(0), depths, (images.shape[2], images.shape[3]))
    slabs = functional.unproject_slabs(images[None, 1:], others, grid, max(1, planes_per_slab), padding_mode="border")
    return images[0], ((start, volume[0], visible[0]) for start, volume, visible in slabs)


def luminance(images: Tensor) -> Tensor:
    """Grey values (V, 1, h, w) of RGB images; grey images are returned as they are.

    Raises:
        ShapeError: neither 1 nor 3 channels.
    """
    if images.shape[1] == 1:
        return images
    if images.shape[1] != 3:
        raise ShapeError(f"images must be (V, 1, h, w) or (V, 3, h, w) for this score; got {tuple(images.shape)}")
    return (images * images.new_tensor(LUMINANCE)[:, None, None]).sum(1, keepdim=True)


def _comparison(options: SweepOptions, reference: Tensor) -> Callable[[Tensor], Tensor]:
    """The costs (N, d, h, w) of warped neighbours (N, C, d, h, w) against a reference (C, h, w)."""
    window, noise = options.window, options.noise
    if options.score == "zncc":
        grey = reference[0]
        mean, spread = window_means(grey, window), _variance(grey, window) + noise**2

        def zncc(warped: Tensor) -> Tensor:
            other = warped[:, 0]
            covariance = window_means(other * grey, window) - window_means(other, window) * mean
            return 1 - covariance * (spread * (_variance(other, window) + noise**2)).rsqrt()

        return zncc
    if options.score == "cosine":
        energy = window_means(reference.square().mean(0), window) + noise**2

        def cosine(warped: Tensor) -> Tensor:
            dot = window_means((warped * reference[:, None]).mean(1), window)
            return 1 - dot * (energy * (window_means(warped.square().mean(1), window) + noise**2)).rsqrt()

        return cosine
    if options.score == "sad":
        return lambda warped: window_means((warped - reference[:, None]).abs().mean(1), window)

    def census(warped: Tensor) -> Tensor:
        return _census(reference[0], warped[:, 0], window)

    return census


def window_means(values: Tensor, window: int) -> Tensor:
    """Means (..., h, w) over window x window pixels; windows are cut off at the border."""
    if window == 1:
        return values
    flat = values.reshape(1, -1, *values.shape[-2:])
    rows = avg_pool2d(flat, (1, window), 1, (0, window // 2), count_include_pad=False)
    return avg_pool2d(rows, (window, 1), 1, (window // 2, 0), count_include_pad=False).reshape(values.shape)


def _variance(values: Tensor, window: int) -> Tensor:
    return (window_means(values.square(), window) - window_means(values, window).square()).clamp_min(0)


def _census(reference: Tensor, warped: Tensor, window: int) -> Tensor:
    """Twice the fraction of differing bits "darker than the centre"; patches are cut off at the border."""
    radius = window // 2
    height, width = reference.shape
    differing, count = torch.zeros_like(warped), torch.zeros_like(reference)
    exists = pad(torch.ones_like(reference), (radius,) * 4)
    around = [pad(values.detach(), (radius,) * 4) for values in (reference, warped)]
    for y in range(window):
        for x in range(window):
            if y == x == radius:
                continue
            inside = exists[y : y + height, x : x + width]
            first, second = (values[..., y : y + height, x : x + width] for values in around)
            differing += ((first < reference) ^ (second < warped)) * inside
            count += inside
    return differing * (2 / count.clamp_min(1))


def aggregate_views(
    costs: Tensor, visible: Tensor, *, best: int | None = None, min_views: int = 1
) -> tuple[Tensor, Tensor]:
    """One cost per site: the mean over the best matches among the neighbours that see it.

    A point is often occluded in some neighbours; the mean over the better half leaves these out (Kang, Szeliski and
    Chai, "Handling occlusions in dense multi-view stereo", CVPR 2001, section 4.1).

    Args:
        costs: (V-1, P, h, w), see `matching_costs`.
        visible: (V-1, P, h, w) bool.
        best: the number of neighbours that are averaged, fewer where fewer see a site; by default half, rounded up.
        min_views: the least number of neighbours that must see a site.

    Returns:
        Costs (P, h, w), `INVALID_COST` where fewer than `min_views` neighbours see a site, and the number that do,
        (P, h, w). Differentiable in `costs`.

    Raises:
        OptionError: `best` or `min_views` is not a whole number from 1 to the number of neighbours.
        ShapeError, DTypeError: costs or visible of another shape or dtype.

    Example:
        >>> import torch
        >>> costs = torch.tensor([0.1, 0.9, 0.3, 0.0])[:, None, None, None]
        >>> cost, count = aggregate_views(costs, torch.tensor([True, True, True, False])[:, None, None, None])
        >>> cost.item(), count.item()
        (0.20000000298023224, 3)
    """
    check_float("aggregate_views", "costs", costs, "(V-1, P, h, w)", rank=4)
    check_mask("aggregate_views", "visible", visible, tuple(costs.shape), "of the shape of costs")
    number = costs.shape[0]
    best, min_views = _numbers("aggregate_views", number, best, min_views)
    count = visible.sum(0)
    if number == 1:
        return torch.where(visible[0], costs[0], INVALID_COST), count
    lowest = torch.where(visible, costs, torch.inf).sort(0).values[:best]
    total = torch.where(lowest.isfinite(), lowest, 0.0).sum(0)
    return torch.where(count >= min_views, total / count.clamp(1, best), INVALID_COST), count


def aggregated_costs(
    images: Tensor,
    cameras: Cameras,
    depths: Tensor,
    planes_per_slab: int,
    options: SweepOptions,
) -> Iterator[tuple[Tensor, Tensor]]:
    """`aggregate_views` of `matching_costs`, slab by slab: costs (d, h, w) float32, and whether enough see a site."""
    reference, slabs = warp_neighbours(images, cameras, depths, planes_per_slab, options)
    best, min_views = _numbers("sweep", len(images) - 1, options.best, options.min_views)
    is_plain = images.device.type == "cpu" and images.dtype == torch.float32 and not torch.is_grad_enabled()
    if options.score != "zncc" or not is_plain:
        compare = _comparison(options, reference)
        for _, volume, visible in slabs:
            cost, count = aggregate_views(compare(volume), visible, best=best, min_views=min_views)
            yield cost.float(), count >= min_views
        return
    correlate = Correlation(reference[0], options.window, options.noise).aggregate
    for _, volume, visible in slabs:
        cost, seen = torch.empty(visible.shape[1:]), torch.empty(visible.shape[1:], dtype=torch.bool)
        arrays = (volume[:, 0].numpy(), visible.numpy(), cost.numpy(), seen.numpy())

        def aggregate(plane: int, arrays: tuple[np.ndarray, ...] = arrays) -> None:
            values, sees, costs, seens = arrays
            correlate(values[:, plane], sees[:, plane], best, min_views, costs[plane], seens[plane])

        on_threads(aggregate, range(len(cost)))
        yield cost, seen


def _numbers(who: str, neighbours: int, best: int | None, min_views: int) -> tuple[int, int]:
    best = check_whole(who, "best", (neighbours + 1) // 2 if best is None else best, 1, neighbours)
    return best, check_whole(who, "min_views", min_views, 1, neighbours)
