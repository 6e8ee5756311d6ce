"""The comparison with the oracle can fail: each of these faults in the source is noticed."""

from __future__ import annotations

import inspect
import types

import numpy as np
import pytest
import torch

from lsmgeo import VoxelGrid, scenes
from lsmgeo.scenes import inside, intervals, rendering, surfaces, tracing
from tests.oracle import primitives as truth
from tests.scenes.drawn import KINDS, Drawn, build
from tests.scenes.test_tracing import SUN, compare

MODULES = (intervals, surfaces, tracing, inside, rendering)

# Fault: (module, correct source, faulty source)
FAULTS = {
    "a radius off by a thousandth": (intervals, "- a * c\n    root", "- 1.001 * a * c\n    root"),
    "the wrong nappe of a cone": (intervals, "steep & (change > 0)", "steep & (change < 0)"),
    "a half-space inside out": (intervals, "torch.where(dy < 0, place, -", "torch.where(dy > 0, place, -"),
    "a slab without a far side": (
        intervals,
        "return middle - reach, middle + reach",
        "return middle - reach, middle + 9",
    ),
    "a cone's slope in the normal": (surfaces, "gradient[1] -= slope", "gradient[1] += slope"),
    "normals of cuts not inverted": (surfaces, "normal * (side /", "normal * (1.0 /"),
    "normals not by the transpose": (
        surfaces,
        "(linear * local_normal[:, None]).sum(0)",
        "(linear * local_normal).sum(1)",
    ),
    "one round of cuts": (tracing, "for _ in cuts:", "for _ in cuts[:1]:"),
    "the farthest hit": (tracing, "closer &= start < before", "closer &= (start > before) | before.isinf()"),
    "windows too small": (tracing, ".windows(world,", ".windows(0.5 * (world + tables.center[rows, None]),"),
    "half a pixel": (tracing, "count, dtype=torch.float64, device=device)", "count, dtype=torch.float64) + 0.5"),
    "another depth": (rendering, "torch.where(mask, nearest, 0.0)", "torch.where(mask, 1.01 * nearest, 0.0)"),
    "cuts filled": (inside, "inside &= ~_contains", "inside |= _contains"),
    "the grid's axes swapped": (inside, "inside[z, y, x] |=", "inside[z, x, y] |="),
}


def some() -> list[Drawn]:
    """Scenes of two solids with cuts; together they have every kind, as a solid and as a cut."""
    found: list[Drawn] = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        names = [
            (str(rng.choice(KINDS)), [str(kind) for kind in rng.choice(KINDS, rng.integers(0, 3))]) for _ in range(2)
        ]
        found += [one for one in [build(names, seed)] if one is not None]
    return found


def examine(several: list[Drawn]) -> None:
    """The laws of `test_tracing` that pin values, on fixed scenes."""
    for one in several:
        compare(scenes.render([one.scene], one.cameras, SUN, dtype=torch.float64), one, torch.float64)
        points = np.random.default_rng(0).uniform(-1, 1, (300, 3))
        occupied = scenes.occupancy([one.scene], torch.from_numpy(points)[None])[0].numpy()
        np.testing.assert_array_equal(occupied, truth.holds(one.parts, points))
        grid = scenes.voxels([one.scene], VoxelGrid((5, 7, 9), -0.8, 0.8))[0].numpy()
        axes = [-0.8 + (np.arange(count) + 0.5) * 1.6 / count for count in (5, 7, 9)]
        z, y, x = np.meshgrid(*axes, indexing="ij")
        np.testing.assert_array_equal(grid.ravel(), truth.holds(one.parts, np.stack((x, y, z), -1).reshape(-1, 3)))


def plant(patch: pytest.MonkeyPatch, module: types.ModuleType, sound: str, faulty: str) -> None:
    """Replace a module's functions, wherever they were imported, by those of its faulty source."""
    source = inspect.getsource(module)
    assert sound in source, "the source has changed: name the fault anew"
    broken = types.ModuleType(module.__name__)
    broken.__dict__.update({name: value for name, value in vars(module).items() if name.startswith("__")})
    exec(compile(source.replace(sound, faulty), module.__file__ or "", "exec"), broken.__dict__)  # the faults above
    for name, sound_value in list(vars(module).items()):
        if not name.startswith("__") and name in vars(broken):
            for user in (*MODULES, scenes):
                if getattr(user, name, None) is sound_value and sound_value is not vars(broken)[name]:
                    patch.setattr(user, name, vars(broken)[name])


@pytest.fixture(scope="module")
def several() -> list[Drawn]:
    return some()


def test_the_correct_source_passes(several):
    examine(several)


@pytest.mark.parametrize("name", FAULTS)
def test_faults_are_noticed(several, name):
    with pytest.MonkeyPatch.context() as patch:
        plant(patch, *FAULTS[name])
        with pytest.raises((AssertionError, RuntimeError, IndexError)):
            examine(several)
    assert scenes.render is rendering.render
