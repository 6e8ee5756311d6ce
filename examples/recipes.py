"""Cost volumes of the field in a few lines each; ``docs/recipes.rst`` shows them, and tests hold them to the formulas.

Everywhere: features (B, V, C, h, w) and cameras (B, V), the reference view first.
"""

import torch
from torch import Tensor

from lsmgeo import FrustumGrid, Unproject
from lsmgeo.cameras import CameraTensors, centers


def mvsnet_variance(features: Tensor, cameras: CameraTensors, depths: Tensor) -> tuple[Tensor, Tensor]:
    """MVSNet: the variance over all views, and where it is meaningful: at least two views see the site."""
    frustum = FrustumGrid(cameras.at((slice(None), 0)), depths, size=tuple(features.shape[-2:]))
    volume, visible = Unproject(frustum, reduce="variance", padding_mode="border")(features, cameras)
    return volume, visible.sum(1) >= 2


def casmvsnet_stage(
    features: Tensor, cameras: CameraTensors, depth: Tensor, interval: float, planes: int
) -> tuple[Tensor, Tensor, Tensor]:
    """A CasMVSNet stage: hypotheses (B, P, h, w) around a depth map (B, h, w), their variance, and where it counts."""
    offsets = interval * (torch.arange(planes, dtype=depth.dtype, device=depth.device) - (planes - 1) / 2)
    hypotheses = (depth[:, None] + offsets[:, None, None]).clamp_min(1e-3)
    frustum = FrustumGrid(cameras.at((slice(None), 0)), hypotheses)
    volume, visible = Unproject(frustum, reduce="variance", padding_mode="border")(features, cameras)
    return hypotheses, volume, visible.sum(1) >= 2


def patchmatchnet_step(
    features: Tensor, cameras: CameraTensors, depth: Tensor, weights: Tensor, groups: int
) -> tuple[Tensor, Tensor]:
    """A PatchmatchNet step: each pixel tries its own depth (B, h, w) and its neighbours', in no order.

    `weights` (B, V - 1, h, w) say how much each source view counts.
    """
    near = torch.nn.functional.pad(depth[:, None], (1, 1, 1, 1), mode="replicate").unfold(2, 3, 1).unfold(3, 3, 1)
    hypotheses = near[:, 0].flatten(3)[..., [4, 1, 7, 3, 5]].movedim(-1, 1)  # itself, above, below, left, right
    frustum, sources = FrustumGrid(cameras.at((slice(None), 0)), hypotheses), cameras.at((slice(None), slice(1, None)))
    match, visible = Unproject(frustum, groups=groups)(features[:, 1:], sources, reference=features[:, 0, :, None])
    share = weights[:, :, None] * visible
    share = share / share.sum(1, keepdim=True).clamp_min(1e-6)
    return hypotheses, (match * share[:, :, None]).sum(1)  # (B, groups, P, h, w)


def groupwise_correlation(features: Tensor, cameras: CameraTensors, depths: Tensor, groups: int) -> Tensor:
    """Group-wise correlation, the mean over the source views that see the site."""
    frustum = FrustumGrid(cameras.at((slice(None), 0)), depths, size=tuple(features.shape[-2:]))
    match = Unproject(frustum, groups=groups, reduce="mean", padding_mode="border")
    sources = cameras.at((slice(None), slice(1, None)))
    return match(features[:, 1:], sources, reference=features[:, 0, :, None]).volume


def simplerecon_volume(features: Tensor, cameras: CameraTensors, depths: Tensor) -> Tensor:
    """SimpleRecon: a dot product for each source view and its metadata, (B, V - 1, 8, P, h, w), for an MLP."""
    own, sources = cameras.at((slice(None), slice(1))), cameras.at((slice(None), slice(1, None)))
    frustum = FrustumGrid(own.at((slice(None), 0)), depths, size=tuple(features.shape[-2:]))
    unproject = Unproject(frustum, augment=("depth", "direction"))
    values, visible = unproject(features[:, 1:], sources, reference=features[:, 0, :, None])
    ray = unproject(features[:, :1, :0], own).volume[:, :, 1:]  # the reference's own direction
    angle = (ray * values[:, :, 2:]).sum(2, keepdim=True).clamp(-1 + 1e-6, 1 - 1e-6).acos()
    baseline = (centers(sources) - centers(own)).norm(dim=-1)[:, :, None, None, None, None]
    return torch.cat((values, angle, visible[:, :, None], baseline.expand_as(angle)), 2)
