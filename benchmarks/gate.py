"""Nothing is timed that computes something else: every contender against the reference, in value and gradient."""

from __future__ import annotations

import time
from collections.abc import Mapping

import torch
from torch import Tensor

from benchmarks import ours
from benchmarks.problems import Problem, Run, Scene

# Relative norms of the difference. Rivals compute pixels in float32, which moves a sample by up to 1e-4 pixel or voxel;
# one in some hundred thousand samples changes its nearest cell by that.
TOLERANCES = {"float32": 3e-4, "float16": 5e-3, "bfloat16": 3e-2}
NEAREST = 1e-2
STATISTIC = 5e-3  # a view that sees a site at its image's very border, or does not, changes its mean
INVISIBLE = 1e-4  # the share of samples at a border, about which two computations may differ


class Different(AssertionError):
    """A contender that computes something else."""


def tolerance(problem: Problem) -> float:
    """Largest relative norm of a difference."""
    borders = NEAREST if problem.mode == "nearest" else STATISTIC if problem.statistic else 0.0
    return max(TOLERANCES[problem.dtype], borders)


def leaves(scene: Scene) -> list[Tensor]:
    """What gradients are taken to: the source, and the weights of a linear map."""
    source = scene.source.detach().requires_grad_()
    return [source, scene.weight.requires_grad_()] if scene.problem.operator == "reduce" else [source]


def differentiate(scene: Scene, run: Run, inputs: list[Tensor], cotangent: Tensor) -> tuple[Tensor, list[Tensor]]:
    """The output and the gradients."""
    output, _ = run(inputs[0])
    return output, list(torch.autograd.grad(output, inputs, cotangent))


def check(scene: Scene, runs: Mapping[str, Run], backward: bool = True) -> tuple[dict[str, Tensor], dict[str, float]]:
    """Compare all with the reference.

    Returns:
        A cotangent for each contender, in its output's own memory layout, and the seconds of its first calls: what it
        compiles, loads or lays out once.

    Raises:
        Different: one is not equal up to rounding.
    """
    limit = tolerance(scene.problem)
    reference = ours.contender(scene, "reference")
    inputs = leaves(scene)
    with torch.no_grad():
        expected, expected_visible = reference(inputs[0])
    cotangent = scene.cotangent(expected)
    expected_gradients = differentiate(scene, reference, inputs, cotangent)[1] if backward else []
    cotangents, first = {}, {}
    for name, run in runs.items():
        start = time.perf_counter()
        with torch.no_grad():
            output, visible = run(inputs[0])
        first[name] = time.perf_counter() - start
        compare(f"{name}: values", output, expected, limit)
        if visible is not None and expected_visible is not None:
            share = float((visible != expected_visible).double().mean())
            if share > INVISIBLE:
                raise Different(f"{name}: visibility differs at a share of {share:.1e} of the samples")
        cotangents[name] = torch.empty_like(output).copy_(cotangent)
        del output, visible
        if backward:
            start = time.perf_counter()
            _, gradients = differentiate(scene, run, inputs, cotangents[name])
            first[name] += time.perf_counter() - start
            for gradient, expected_gradient in zip(gradients, expected_gradients, strict=True):
                compare(f"{name}: gradient", gradient, expected_gradient, limit)
    return cotangents, first


def compare(what: str, value: Tensor, expected: Tensor, limit: float) -> None:
    """Require a shape, and a small relative norm of the difference."""
    if value.shape != expected.shape:
        raise Different(f"{what} of shape {tuple(value.shape)}, not {tuple(expected.shape)}")
    norm = float(expected.float().norm())
    distance = float((value.float() - expected.float()).norm())
    if not norm > 0.0:
        raise Different(f"{what}: the reference is zero, which proves nothing")
    if not distance <= limit * norm:
        raise Different(f"{what} differ by {distance / norm:.1e} of their norm; at most {limit:.1e}")
