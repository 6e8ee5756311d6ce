"""Realistic faults in the Triton kernels, as changes of their text: each must be noticed by a comparison.

A fault is loaded as its own module, which `launcher` and `operators` use during the comparison.
"""

from __future__ import annotations

import contextlib
import importlib.util
import itertools
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import torch

from lsmgeo.kernels.request import Options
from lsmgeo.kernels.triton import launch_tables, launcher, operators
from tests.kernels import cases as shared
from tests.kernels.triton_support import compare, compare_sweep, features, image_sites, sweep_sites, volumes

FOLDER = Path(operators.__file__).parent
KERNELS, GRADIENTS, TABLES = "forward", "backward", "launch_tables"
COUNT = itertools.count()


PAIR = features(2, views=2)
SAME = image_sites(27, views=2)
SAME = SAME._replace(matrix=SAME.matrix[:, :1].expand(1, 2, 3, 4))
COMPARISONS: dict[str, Callable[[], object]] = {
    "views": lambda: compare(
        PAIR,
        image_sites(20, views=2, projective=True),
        Options("bilinear", "border", depth=True, direction="world", near=1.0),
    ),
    "zeros": lambda: compare(PAIR, image_sites(21, views=2), Options("bilinear")),
    "masked": lambda: compare(features(1), image_sites(22, mask=True), Options("nearest", depth=True)),
    "statistics": lambda: compare(
        features(2), image_sites(23), Options("bilinear", reduce=("mean", "variance", "max"))
    ),
    "ties": lambda: compare(PAIR[:, :1].expand_as(PAIR), SAME, Options("bilinear", reduce=("max",))),
    "own depths": partial(shared.CASES["depths of pixels"], "triton"),
    "own sweep": partial(shared.CASES["sweep of pixels' depths"], "triton"),
    "correlation": partial(shared.CASES["correlation, groups"], "triton"),
    "splat": partial(shared.CASES["splat, nearest, border"], "triton"),
    "sweep": lambda: compare_sweep(volumes(2), sweep_sites(25), Options("trilinear", "border", depth=True, near=0.6)),
}


class Fault(NamedTuple):
    file: str
    text: str
    instead: str
    noticed_by: str


CHANGES = {
    "pixels half a pixel off": Fault(
        KERNELS,
        "x = tl.where(front, _row(table, site, w, along, CONFIG) * inverse, OUTSIDE)",
        "x = tl.where(front, _row(table, site, w, along, CONFIG) * inverse + 0.5, OUTSIDE)",
        "zeros",
    ),
    "the lower cell for the nearest": Fault(KERNELS, "index - cell >= 0.5", "index - cell >= 1.5", "masked"),
    "no test of what is in front": Fault(
        KERNELS, "front = unmasked & (height > tl.maximum(near * unit, SMALLEST_DEPTH))", "front = unmasked", "views"
    ),
    "near not in units of depth": Fault(KERNELS, "tl.maximum(near * unit,", "tl.maximum(near,", "views"),
    "no near plane in sweeps": Fault(KERNELS, "front = unmasked & (distance > near)", "front = unmasked", "sweep"),
    "depth without s": Fault(KERNELS, "unit = unit * along", "unit = unit * 1.0", "views"),
    "masked views taken in": Fault(
        KERNELS, "return tl.where(site.keep, tl.load(table + UNMASKED), 0.0) != 0.0", "return site.keep", "masked"
    ),
    "visible up to the outermost cells' neighbours": Fault(KERNELS, "(index >= -0.5)", "(index >= -1.0)", "zeros"),
    "the weight of another axis": Fault(
        KERNELS,
        "weight_y = cell.fraction_y if dy else 1.0 - cell.fraction_y",
        "weight_y = cell.fraction_x if dy else 1.0 - cell.fraction_x",
        "zeros",
    ),
    "the third axis not sampled": Fault(
        KERNELS,
        "x, y, z = cell.x + dx, cell.y + dy, cell.z + dz",
        "x, y, z = cell.x + dx, cell.y + dy, cell.z",
        "sweep",
    ),
    "a slope at the border": Fault(
        KERNELS, "slope = tl.where((index > 0.0) & (index < size - 1.0), 1.0, 0.0)", "slope = slope", "sweep"
    ),
    "shares of all views": Fault(KERNELS, "count += seen.to(tl.float32)", "count += 1.0", "statistics"),
    "unseen views in the mean": Fault(
        KERNELS, "visible_values = tl.where(seen, values, 0.0)", "visible_values = values", "statistics"
    ),
    "squares about zero": Fault(
        KERNELS,
        "projection.visible[:, None], values - mean, 0.0",
        "projection.visible[:, None], values, 0.0",
        "statistics",
    ),
    "the last of equal views": Fault(KERNELS, "(values > best)", "(values >= best)", "ties"),
    "a derivative of the wrong sign": Fault(
        GRADIENTS, "(1.0 if corner // 2 % 2 else -1.0)", "(-1.0 if corner // 2 % 2 else 1.0)", "zeros"
    ),
    "a quotient's derivative of the wrong sign": Fault(
        GRADIENTS,
        "grad_z = -(grad_x * x + grad_y * y) * projection.inverse",
        "grad_z = (grad_x * x + grad_y * y) * projection.inverse",
        "zeros",
    ),
    "directions not normalised in backward": Fault(
        GRADIENTS, "(grad_x - along * unit_x) * inverse", "grad_x * inverse", "views"
    ),
    "half of the variance's derivative": Fault(
        GRADIENTS, "2.0 * deviation * grad_square", "deviation * grad_square", "statistics"
    ),
    "gradients to views that see nothing": Fault(
        GRADIENTS, "grad = tl.where(projection.visible[:, None], grad, 0.0)", "grad = grad", "statistics"
    ),
    "masked depths with a gradient": Fault(GRADIENTS, " & _is_unmasked(table, site)", " & site.keep", "masked"),
    "no gradient through s": Fault(TABLES, "through = -extra[..., 3] / z", "through = through", "views"),
    "a sweep's offset taken for a slope": Fault(
        TABLES, "_matrix_sums(rows, depth, torch.ones_like(depth))", "_matrix_sums(rows, depth, depth)", "sweep"
    ),
    "one depth for all rows": Fault(KERNELS, "site.j.to(tl.int64) * array.y + site.i", "site.i", "own depths"),
    "w forgotten": Fault(KERNELS, "plane = plane * w", "plane = plane", "own depths"),
    "own depth's gradient of the wrong sign": Fault(
        GRADIENTS, "to_depth = -_along_z(table", "to_depth = _along_z(table", "own depths"
    ),
    "own depth's direction forgotten": Fault(
        GRADIENTS, "to_depth -= tl.div_rn(inner * z, own)", "to_depth = to_depth", "own depths"
    ),
    "own depths of a sweep by one row": Fault(
        GRADIENTS, "to_depth += grad_z * _clamped", "to_depth += 0.0 * _clamped", "own sweep"
    ),
    "sums in another order": Fault(TABLES, "columns = [0, 1, 3, 2]", "columns = [0, 1, 2, 3]", "own depths"),
    "correlation not a mean": Fault(KERNELS, "n), LARGEST) / divisor", "n), LARGEST)", "correlation"),
    "features of the first view": Fault(
        KERNELS, "start, mask = _view_start(lattice.reference, view, n)", "start, mask = view * 0", "splat"
    ),
    "gradient to the features of another view": Fault(
        GRADIENTS, "_addresses(array, _view_start(array, view, n)", "_addresses(array, view * 0", "splat"
    ),
    "groups mixed up": Fault(KERNELS, "channel // size == group", "channel % n.features == group", "correlation"),
    "reference's gradient without its weight": Fault(
        GRADIENTS, "addresses, each * sampled", "addresses, sampled", "correlation"
    ),
    "source's gradient without the reference": Fault(
        GRADIENTS,
        "each = each * _reference(lattice, view",
        "each = each + 0.0 * _reference(lattice, view",
        "correlation",
    ),
    "depth's gradient left on its inverse": Fault(TABLES, "-along * depth.square()", "-along", "sweep"),
}


def _load(name: str, text: str, folder: Path) -> ModuleType:
    """A module of this text, which Triton wants to find in a file."""
    path = folder / f"{name}.py"
    path.write_text(text)
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    sys.modules[name] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@contextlib.contextmanager
def broken(fault: Fault | None) -> Iterator[None]:
    """Launch modules with the fault; modules loaded the same way without one if None."""
    texts = {name: (FOLDER / f"{name}.py").read_text() for name in (KERNELS, GRADIENTS, TABLES)}
    if fault is not None:
        assert texts[fault.file].count(fault.text) >= 1, f"not found: {fault.text}"
        texts[fault.file] = texts[fault.file].replace(fault.text, fault.instead)
    names = {name: f"{name}_{next(COUNT)}" for name in texts}
    texts[GRADIENTS] = texts[GRADIENTS].replace(f"lsmgeo.kernels.triton.{KERNELS}", names[KERNELS])
    before = launcher.kernels, operators.tables, operators.lattice_gradients, operators.site_gradients
    with tempfile.TemporaryDirectory() as folder:
        kernels, gradients, tables = (_load(names[name], texts[name], Path(folder)) for name in texts)
        found = {"resample": kernels.resample, "resample_backward": gradients.resample_backward}
        launcher.kernels = lambda: found
        operators.tables, operators.lattice_gradients = tables.tables, tables.lattice_gradients
        operators.site_gradients = tables.site_gradients
        try:
            yield
        finally:
            launcher.kernels, operators.tables, operators.lattice_gradients, operators.site_gradients = before
            for name in names.values():
                sys.modules.pop(name)


def _sound() -> None:
    """Without a fault every comparison passes."""
    assert operators.tables is launch_tables.tables
    with broken(None):
        assert operators.tables is not launch_tables.tables
        for comparison in COMPARISONS.values():
            comparison()
    assert operators.tables is launch_tables.tables


def _noticed(fault: Fault) -> Callable[[], None]:
    def check() -> None:
        with broken(fault):
            try:
                COMPARISONS[fault.noticed_by]()
            except AssertionError:
                return
        raise AssertionError(f"{fault.noticed_by} does not notice it")

    return check


FAULTS = {"none": _sound} | {name: _noticed(fault) for name, fault in CHANGES.items()}
torch.set_num_threads(1)
