"""Edge-aware filters of matching costs."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from lsmgeo._checks import check_float, check_positive, check_whole
from lsmgeo.errors import ShapeError

__all__ = ["guided_filter"]


def guided_filter(image: Tensor, *, radius: int = 6, eps: float = 1e-4) -> Callable[[Tensor], Tensor]:
    """Make a filter that averages matching costs over a window, but not across the edges of an image.

    Equation: each plane p becomes ``mean(a) I + mean(b)``, with ``a = cov(I, p) / (var(I) + eps)`` and
    ``b = mean(p) - a mean(I)`` in every window, I the colours of the image (He, Sun and Tang, "Guided image filtering",
    2013, equations 14 to 16; on matching costs: Hosni et al., "Fast cost-volume filtering for visual correspondence
    and beyond", 2013). Computed by ``cv2.ximgproc``.

    Args:
        image: (C, h, w) in [0, 1], the reference that the costs belong to, C = 1 or 3.
        radius: the window is ``2 radius + 1`` pixels wide, at least 1.
        eps: variance of colour above which a window holds an edge.

    Returns:
        A function from planes (d, h, w) to filtered planes (d, h, w); on the CPU, not differentiable.

    Raises:
        ShapeError, DTypeError: an image of another shape or dtype; later, planes of another size than the image.
        OptionError: a radius below 1, or an ``eps`` that is not positive.

    Example:
        A step where the image has one is kept, noise beside it is removed:

        >>> import torch
        >>> from lsmgeo.classical import guided_filter
        >>> step = (torch.arange(32) >= 16).float().expand(1, 16, 32)
        >>> noise = 0.1 * torch.randn(1, 16, 32, generator=torch.Generator().manual_seed(0))
        >>> smooth = guided_filter(step, radius=3)(step + noise)
        >>> bool((smooth - step).std() < 0.3 * noise.std())
        True
    """
    check_float("guided_filter", "image", image, "(1, h, w) or (3, h, w)")
    if image.ndim != 3 or image.shape[0] not in (1, 3):
        raise ShapeError(f"guided_filter: image must be (1, h, w) or (3, h, w); got {tuple(image.shape)}")
    radius = check_whole("guided_filter", "radius", radius, 1, 2**15)
    check_positive("guided_filter", "eps", eps)
    import cv2

    guide = np.ascontiguousarray(image.detach().cpu().float().permute(1, 2, 0).numpy())
    made = cv2.ximgproc.createGuidedFilter(guide, radius, float(eps))

    def filtered(planes: Tensor) -> Tensor:
        if planes.ndim != 3 or planes.shape[1:] != image.shape[1:]:
            raise ShapeError(
                f"guided_filter: planes must be (d, h, w) of the image's size {tuple(image.shape[1:])}; "
                f"got {tuple(planes.shape)}"
            )
        result = torch.empty(planes.shape, dtype=torch.float32)
        for plane, out in zip(planes.detach().float(), result, strict=True):
            out.copy_(torch.from_numpy(made.filter(plane.contiguous().numpy())))
        return result

    return filtered
