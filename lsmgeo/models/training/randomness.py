"""Random numbers that follow from where a run is, and the state of those that do not."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import torch

__all__ = ["random_state", "restore_random_state", "seeded_generator"]


def seeded_generator(seed: int, *position: int) -> torch.Generator:
    """A generator on the CPU that depends on a seed and a position alone, so that no state of it need be saved.

    Args:
        seed: of the run, at least 0.
        position: what names the place of its use, for example step, rank and a number for the purpose; each at least 0.

    Returns:
        The generator.

    Example:
        >>> first, second = seeded_generator(0, 7), seeded_generator(0, 7)
        >>> torch.rand(1, generator=first).item() == torch.rand(1, generator=second).item()
        True
    """
    # With their number: zeros at the end of a sequence change nothing.
    state = np.random.SeedSequence([len(position), seed, *position]).generate_state(1, np.uint64)
    return torch.Generator().manual_seed(int(state[0] >> np.uint64(1)))


def random_state() -> dict[str, Any]:
    """The state of the generators of torch (CPU, every CUDA device), Python and numpy, as plain numbers and tensors."""
    version, words, gauss = random.getstate()
    legacy: Any = np.random.get_state(legacy=False)  # noqa: NPY002 - code of others may draw from it
    return {
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
        "python": [version, torch.tensor(words), gauss],
        "numpy": {
            "key": torch.from_numpy(legacy["state"]["key"].astype(np.int64)),
            "pos": int(legacy["state"]["pos"]),
            "has_gauss": int(legacy["has_gauss"]),
            "gauss": float(legacy["gauss"]),
        },
    }


def restore_random_state(state: dict[str, Any]) -> None:
    """Set the generators to what `random_state` gave. CUDA devices that the state does not know are left as they are.

    Args:
        state: as from `random_state`.
    """
    torch.set_rng_state(state["torch"])
    if torch.cuda.is_available():
        for device, words in enumerate(state["cuda"][: torch.cuda.device_count()]):
            torch.cuda.set_rng_state(words, device)
    version, words, gauss = state["python"]
    random.setstate((version, tuple(words.tolist()), gauss))
    numpy = state["numpy"]
    legacy = ("MT19937", numpy["key"].numpy().astype(np.uint32), numpy["pos"], numpy["has_gauss"], numpy["gauss"])
    np.random.set_state(legacy)  # noqa: NPY002 - as above
