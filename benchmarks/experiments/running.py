"""One experiment from its set to its evaluation, resumed wherever it was stopped."""

from __future__ import annotations

import hashlib
import json
import math
import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from benchmarks import measuring
from benchmarks.experiments.queue import SET, SHAPES, Experiment
from lsmgeo import evaluation, training
from lsmgeo.data import Batch, ShardSet, render_set, write_atomic
from lsmgeo.errors import OptionError
from lsmgeo.evaluation.held_out_shapes import batches
from lsmgeo.evaluation.report import finite
from lsmgeo.metrics import DepthError, VoxelIoU
from lsmgeo.models import Model, load
from lsmgeo.models.weights import read_weights, write_weights
from lsmgeo.training.batches import Need, open_shapes, validation_batches
from lsmgeo.training.checkpoints import load_latest
from lsmgeo.training.launch import StopRequest
from lsmgeo.training.validation import evaluate_model

__all__ = ["EVALUATION", "WEIGHTS", "Folder", "hash_shapes", "run_experiment"]

EVALUATION, WEIGHTS = "evaluation.json", "weights.safetensors"
RECIPE = Path(__file__).with_name("set.json")
# Of every category, in the order of the set: the test split of a table.
TEST_SHAPES, CATEGORIES, VIEWS = 80, 13, 8
# Half precision may change the measure on the validation split by this share.
LOSSLESS = 1e-3
# Of every category, where a report takes a set many times.
FEW_SHAPES = 20
THRESHOLDS = (0.2, 0.3, 0.4, 0.5)


class Folder:
    """The folder of the set and the runs; made if it does not exist."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.set = path / "set"

    def run(self, experiment: Experiment) -> Path:
        """The folder of a run."""
        return self.path / "runs" / experiment.name

    def is_done(self, experiment: Experiment) -> bool:
        """Whether a run is trained and evaluated."""
        return (self.run(experiment) / EVALUATION).is_file()


def run_experiment(experiment: Experiment, folder: Folder) -> int:
    """Train or resume an experiment, then evaluate it; on one thread, at the lowest priority.

    Returns:
        The exit status: that of training where it was stopped.
    """
    os.nice(19)
    torch.set_num_threads(1)
    digest = write_set(folder)
    path = folder.run(experiment)
    trained = training.train(experiment.config(folder.set), path)
    if trained.ended == "stop":
        return trained.exit_code
    begun = time.process_time()
    model = load(path)
    validation: dict[str, Any] = {}
    if experiment.model.startswith("r2n2"):
        validation["iou by threshold"] = validate_thresholds(model, experiment, folder)
    if experiment.ships:
        model, validation["by precision"] = ship(experiment, model, path, folder)
    content = {
        "set": digest,
        "machine": measuring.machine(),
        "parameters": sum(parameter.numel() for parameter in model.parameters()),
        "validation": validation,
        "evaluation": evaluate_test(experiment, model, validation, folder) if experiment.is_tested else {},
        "cpu_minutes": {
            "training": round(load_latest(path).part("place")["cpu_seconds"] / 60, 2),
            "evaluation": round((time.process_time() - begun) / 60, 2),
        },
    }
    write_atomic(path / EVALUATION, (json.dumps(finite(content), indent=1, allow_nan=False) + "\n").encode())
    return 0


def write_set(folder: Folder) -> str:
    """Render the set if it is missing, compare it with that of the results, and return the hash of its values."""
    marker = folder.set / "hash.json"
    if not marker.is_file():
        render_set("synthetic-13", folder.set, SET, shapes=SHAPES, per_shard=100, jobs=1, progress=True)
        shards = ShardSet(folder.set)
        write_atomic(marker, json.dumps({"sha256": hash_shapes(shards, range(len(shards)))}).encode())
    digest: str = json.loads(marker.read_text())["sha256"]
    expected = json.loads(RECIPE.read_text())["sha256"] if RECIPE.is_file() else digest
    if digest != expected:
        hashes = f"the set has hash {digest[:16]}, that of the results {expected[:16]}"
        print(f"{hashes}: pixels were rounded otherwise here")
    return digest


def hash_shapes(shards: ShardSet, indices: Sequence[int]) -> str:
    """A hash of the decoded values of shapes: images, depth, voxels, cameras, names; not of the files' bytes."""
    digest = hashlib.sha256()
    for index in tqdm(indices, desc="hashing the set", unit="shape", disable=None):
        sample = shards.read(index, occupancy=SET.voxels[0])
        digest.update(json.dumps([sample.name, sample.category, shards.splits[index]]).encode())
        for value in (sample.images, *sample.cameras, sample.depth, sample.mask, sample.occupancy):
            digest.update(np.ascontiguousarray(torch.as_tensor(value)).tobytes())
    return digest.hexdigest()


def evaluate_test(experiment: Experiment, model: Model, validation: dict[str, Any], folder: Folder) -> dict[str, Any]:
    """The content of a network's tables: its measure on the test split by views and categories, and further reports."""
    shapes = evaluation.open_shapes(folder.set, size=model.image_size, shapes=TEST_SHAPES * CATEGORIES)
    about = f"{len(shapes)} test shapes of the set of the experiments"
    if model.output == "depth":
        return {"data": about, "depth_error": depth_by_views(model, shapes.at(model.image_size))}
    by_threshold = validation.get("iou by threshold", {"0.4": 0.0})
    threshold = float(max(by_threshold, key=lambda level: by_threshold[level]))
    method = evaluation.Method(model.name, model)
    options = evaluation.Options(threshold=threshold, progress=True)
    iou, categories = evaluation.evaluate([method], shapes, "iou", replace(options, views=VIEWS)).tables[:2]
    rows = [row for row in iou.rows if not row.is_elsewhere]
    fewer = evaluation.open_shapes(folder.set, size=model.image_size, shapes=FEW_SHAPES * CATEGORIES)
    return {
        "data": about,
        "threshold": threshold,
        "iou": {row.name: [round(cell.value, 3) for cell in row.cells] for row in rows},
        "standard_errors": {row.name: [round(cell.error, 3) for cell in row.cells] for row in rows},
        "categories": numbers(categories),
        "reports": {
            name: {table.title: numbers(table) for table in evaluation.evaluate([method], fewer, name, options).tables}
            for name in experiment.reports
        },
    }


def numbers(table: Any) -> dict[str, dict[str, float | None]]:
    """The numbers of a table that were measured here, by row and column."""
    return {
        row.name: dict(zip(table.columns, [cell and round(cell.value, 3) for cell in row.cells], strict=True))
        for row in table.rows
        if not row.is_elsewhere
    }


def depth_by_views(model: Model, shapes: Any) -> dict[str, Any]:
    """The median depth error of all views of the input, by their number, and of categories."""
    measures = {views: DepthError() for views in (1, 2, 4, 8)}
    for batch in batches(shapes, VIEWS, 4, resolution=None, depth=True, progress=True):
        for views, measure in measures.items():
            some = batch.first_views(views)
            depth = model.run(some.images, some.cameras).depth  # type: ignore[operator]
            assert some.depth is not None
            measure.update(depth, some.depth, [name or "all" for name in some.category], some.mask)
    means = {str(views): measure.compute() for views, measure in measures.items()}
    return {
        views: {"mean": round(mean.mean, 5), **{name: round(value, 5) for name, value in mean.categories.items()}}
        for views, mean in means.items()
    }


def ship(experiment: Experiment, model: Model, path: Path, folder: Folder) -> tuple[Model, dict[str, float]]:
    """Write the weights that ship with the package, in half precision if that loses nothing.

    Returns:
        The model as written, and the measure on the validation split by precision.
    """
    about = dict(read_weights(path).about)
    about["training"]["data"]["source"] = "the set of benchmarks.experiments"
    file, found = path / WEIGHTS, {"float32": validate(model, experiment, folder)}
    try:
        half = load(write_weights(file, model, about=about, half=True))
        found["float16"] = validate(half, experiment, folder)
    except OptionError:  # a weight overflows
        pass
    if not abs(found.get("float16", math.inf) - found["float32"]) <= LOSSLESS * found["float32"]:
        write_weights(file, model, about=about)
    return load(file), found


def held_back(model: Model, experiment: Experiment, folder: Folder) -> Iterator[Batch]:
    """The shapes on which training was evaluated."""
    config, device = experiment.config(folder.set), torch.device("cpu")
    run = config.run
    need = Need(model.image_size, model.resolution if model.output == "voxels" else None, model.output == "depth")
    shapes = open_shapes(config.data, need, seed=run.seed, device=device, is_training=False)
    return validation_batches(shapes, seed=run.seed, count=run.evaluate_shapes, batch=run.batch, device=device)


def validate(model: Model, experiment: Experiment, folder: Folder) -> float:
    """The measure after all views on the shapes on which training was evaluated."""
    run, some = experiment.config(folder.set).run, held_back(model, experiment, folder)
    found = evaluate_model(model, some, StopRequest(), region=run.region, loss=run.loss, images=0)
    assert found is not None
    return found.value


def validate_thresholds(model: Model, experiment: Experiment, folder: Folder) -> dict[str, float]:
    """IoU after all views on the same shapes, by the probability above which a voxel is occupied."""
    measures = {level: VoxelIoU(threshold=level) for level in THRESHOLDS}
    for batch in held_back(model, experiment, folder):
        occupancy = model.run(batch.images, batch.cameras, batch.view_mask, by_view=False).occupancy  # type: ignore[operator]
        for measure in measures.values():
            measure.update(occupancy, batch.occupancy, [name or "all" for name in batch.category])
    return {str(level): round(measure.compute().mean, 5) for level, measure in measures.items()}
