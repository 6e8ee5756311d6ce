"""The recurrences' equations in float64 numpy, voxel by voxel: shares no code with the library."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def convolve(volume: Array, weight: Array, bias: Array | None = None) -> Array:
    """Zero-padded correlation of (C, D, H, W) with (O, C, k, k, k)."""
    outputs, channels, side = weight.shape[:3]
    reach = side // 2
    result = np.zeros((outputs, *volume.shape[1:]))
    for z, y, x in np.ndindex(*volume.shape[1:]):
        for k, j, i in np.ndindex(side, side, side):
            there = (z + k - reach, y + j - reach, x + i - reach)
            if all(0 <= at < n for at, n in zip(there, volume.shape[1:], strict=True)):
                for c in range(channels):
                    result[:, z, y, x] += weight[:, c, k, j, i] * volume[(c, *there)]
    return result if bias is None else result + bias[:, None, None, None]


def normalise(volume: Array, gain: Array, shift: Array, eps: float) -> Array:
    """Over channels and voxels together, with a gain and a shift a channel."""
    centred = volume - volume.mean()
    spread = np.sqrt((centred**2).mean() + eps)
    return gain[:, None, None, None] * centred / spread + shift[:, None, None, None]


def sigmoid(x: Array) -> Array:
    return 1.0 / (1.0 + np.exp(-x))


def run_gru(views: Array, state_dict: dict[str, Array], hidden: int, eps: float) -> list[Array]:
    """States after every view of (V, C, D, H, W)."""

    def norm(name: str, x: Array) -> Array:
        return normalise(x, state_dict[f"{name}_norm.weight"], state_dict[f"{name}_norm.bias"], eps)

    # One kernel over [x, h] for each of reset, update and candidate.
    of_x = np.split(state_dict["input.weight"], 3)
    of_h = [*np.split(state_dict["state_gates.weight"], 2), state_dict["state_candidate.weight"]]
    reset_kernel, update_kernel, candidate_kernel = (np.concatenate(pair, 1) for pair in zip(of_x, of_h, strict=True))
    h = np.zeros((hidden, *views.shape[2:]))
    states = []
    for x in views:
        both = np.concatenate((x, h))
        r = sigmoid(norm("reset", convolve(both, reset_kernel)))
        u = sigmoid(norm("update", convolve(both, update_kernel)))
        c = np.tanh(norm("candidate", convolve(np.concatenate((x, r * h)), candidate_kernel)))
        h = u * h + (1 - u) * c
        states.append(h)
    return states


def run_lstm(views: Array, state_dict: dict[str, Array], hidden: int, eps: float) -> list[Array]:
    """Outputs after every view of (V, C, D, H, W)."""
    kernel = np.concatenate((state_dict["input.weight"], state_dict["state_parts.weight"]), 1)
    h = memory = np.zeros((hidden, *views.shape[2:]))
    outputs = []
    for x in views:
        parts = np.split(convolve(np.concatenate((x, h)), kernel), 4)
        g, i, f, o = (
            normalise(part, state_dict[f"norms.{k}.weight"], state_dict[f"norms.{k}.bias"], eps)
            for k, part in enumerate(parts)
        )
        memory = memory * sigmoid(f + 1) + sigmoid(i) * np.tanh(g)
        memory = normalise(memory, state_dict["memory_norm.weight"], state_dict["memory_norm.bias"], eps)
        h = np.tanh(memory) * sigmoid(o)
        outputs.append(h)
    return outputs
