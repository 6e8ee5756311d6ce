"""Small normalised patches as features, so that the variance between views is their zero-mean correlation."""

from __future__ import annotations

import torch
from torch import Tensor

from lsmgeo import functional
from lsmgeo.cameras import CameraTensors

__all__ = ["patch_features", "patch_frames"]

LUMINANCE = (0.299, 0.587, 0.114)


def patch_frames(cameras: CameraTensors, depth: float) -> Tensor:
    """How a step of one pixel in the first view moves the sample in each view, on the plane of the given depth.

    Equation: the 2x2 derivative of ``pi_v(C + depth ray(p))`` at the first view's image centre: it turns, scales and
    foreshortens a patch as the view does (a camera held upside down turns it by 180 degrees).

    Args:
        cameras: leading shape (V,), the reference first; of the images in which the steps are taken, at their size.
        depth: camera z in the reference, world units.

    Returns:
        (V, 2, 2) float64, the identity for the first.
    """
    K, E = cameras.intrinsics.double(), cameras.cam_from_world.double()
    center = torch.stack(((cameras.width[0] - 1) / 2, (cameras.height[0] - 1) / 2)).double()  # type: ignore[index]
    offsets = torch.tensor([[0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]], dtype=torch.float64)
    pixels = torch.cat((center + offsets, torch.ones(4, 1, dtype=torch.float64)), -1)  # (4, 3)
    camera = depth * torch.linalg.solve(K[0], pixels.T)  # (3, 4)
    world = E[0, :3, :3].T @ (camera - E[0, :3, 3:])
    image = K @ (E[:, :3, :3] @ world + E[:, :3, 3:])  # (V, 3, 4)
    image = image[:, :2] / image[:, 2:].clamp_min(1e-6 * depth)
    return torch.stack((image[..., 0] - image[..., 1], image[..., 2] - image[..., 3]), -1)


def patch_features(images: Tensor, frames: Tensor, *, window: int = 3, noise: float = 2 / 255) -> Tensor:
    """Describe every pixel by the patch around it, so that variance between views measures how unlike they are.

    Equation: with the patch's luminances minus their mean as p, channels are ``p / sqrt(|p|^2 + window^2 noise^2)``,
    and one channel that only this view has fills the vector up to length 1. For unit vectors f_v of n views,
    ``n / (n - 1) * sum_c variance_v(f_vc) = 1 - mean_{v<w} f_v . f_w``: one minus the mean zero-mean normalised
    cross-correlation of all pairs, where a patch without texture resembles nothing, not even another one.

    Args:
        images: (V, 3, h, w) RGB in [0, 1].
        frames: (V, 2, 2), see `patch_frames`: where the steps of the patch lead in each view.
        window: odd side of the patch in pixels of the reference.
        noise: standard deviation of luminance below which texture counts for little.

    Returns:
        (V, window^2 + V, h, w) float32.
    """
    views, _, height, width = images.shape
    grey = torch.einsum("vchw,c->vhw", images, images.new_tensor(LUMINANCE))[None, :, None]  # (1, V, 1, h, w)
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    pixels = torch.stack((x, y), -1).reshape(1, 1, -1, 2).to(images.dtype)
    depth = images.new_ones((1, views, height * width))
    valid = torch.ones_like(depth, dtype=torch.bool)
    radius = window // 2
    features = images.new_zeros((views, window * window + views, height, width))
    for index in range(window * window):
        step = torch.tensor([index % window - radius, index // window - radius], dtype=frames.dtype)
        moved = pixels + (frames @ step).to(images.dtype)[None, :, None]  # (1, V, N, 2)
        sampled = functional.sample_views(grey, moved, depth, valid, padding_mode="border")
        features[:, index] = sampled.volume[0].reshape(views, height, width)
    patch = features[:, : window * window]
    patch -= patch.mean(1, keepdim=True)
    energy = patch.square().sum(1, keepdim=True)
    patch /= (energy + window * window * noise**2).sqrt()
    rest = (1 - patch.square().sum(1)).clamp_min(0).sqrt()  # (V, h, w)
    for view in range(views):
        features[view, window * window + view] = rest[view]
    return features
