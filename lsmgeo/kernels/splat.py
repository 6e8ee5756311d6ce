"""Splat by the kernels of the plane sweep, whose transpose it is.

Weights are the gradient to a correlation of samples with features, summed over the channels.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from lsmgeo.kernels.native.library import channels_last
from lsmgeo.kernels.request import Options, Sites

__all__ = ["splat", "splat_backward"]


def splat(
    kernels: Any, features: Tensor, sites: Sites, weights: Tensor | None, shape: Sequence[int], options: Options
) -> Tensor:
    """As `reference.splat`, by these kernels' `plane_sweep_project_backward`."""
    B, channel = features.shape[0], features.shape[2]
    # In place of the volume, which is not read: any memory of its shape.
    volume = features.new_zeros(channel, dtype=torch.float32).expand(B, *shape, channel).movedim(-1, 1)
    values, factor = _factors(features, weights)
    needs = True, False, False, False
    total, *_ = kernels.plane_sweep_project_backward(values, volume, sites, options, needs, factor=factor)
    return total


def _factors(features: Tensor, weights: Tensor | None) -> tuple[Tensor, Tensor | None]:
    """What is added at the sites, (B, V, C or 1, P, h, w), and (B, V, C, 1, h, w) to multiply it with."""
    if weights is None:
        return features, None
    return weights[:, :, None].float(), channels_last(features, 2).float()[:, :, :, None]


def splat_backward(
    kernels: Any,
    gradient: Tensor,
    features: Tensor,
    sites: Sites,
    weights: Tensor | None,
    options: Options,
    needs: Sequence[bool],
) -> tuple[Tensor | None, Tensor | None, Tensor | None, Tensor | None]:
    """Vector-Jacobian product of `splat` to features, weights, matrix and z, None where not in `needs`.

    The gradient (B, C, D, H, W) is float32; so are those to features and weights. Others as in `unproject_backward`.
    """
    of_features, of_weights, of_matrix, of_z = needs
    gradient = channels_last(gradient, 1)
    values, factor = _factors(features, weights)
    samples = to_matrix = to_z = to_factor = None
    if of_features if weights is None else of_weights:
        samples, _ = kernels.plane_sweep_project(gradient, sites, options, factor=factor)
    of_factor = of_features and weights is not None
    if of_factor or of_matrix or of_z:
        wanted = False, of_matrix, False, of_z, of_factor
        _, to_matrix, _, to_z, to_factor = kernels.plane_sweep_project_backward(
            values, gradient, sites, options, wanted, factor=factor
        )
    if weights is None:
        return samples, None, to_matrix, to_z
    return (
        None if to_factor is None else to_factor[:, :, :, 0],
        None if samples is None else samples[:, :, 0],
        to_matrix,
        to_z,
    )
