"""One experiment from its set to its evaluation, resumed wherever it was stopped."""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from benchmarks import timing
from benchmarks.experiments.queue import SET, SHAPES, Experiment
from lsmgeo.data import ShardSet, render_set, write_atomic
from lsmgeo.metrics import DepthError
from lsmgeo.models import Model, evaluation, load, training
from lsmgeo.models.evaluation.shapes import SizedShapes, batches
from lsmgeo.models.training.evaluating import evaluate_model
from lsmgeo.models.training.feeding import Need, open_shapes, validation_batches
from lsmgeo.models.training.signals import StopRequest
from lsmgeo.models.weights import read_weights, write_weights

__all__ = ["EVALUATION", "WEIGHTS", "Folder", "hash_shapes", "run_experiment"]

EVALUATION, WEIGHTS = "evaluation.json", "weights.safetensors"
RECIPE = Path(__file__).with_name("set.json")
# Of every category, in the order of the set: the test split of a table.
TEST_SHAPES, CATEGORIES, VIEWS = 80, 13, 8
# Half precision may cost so much of the measure on the validation split.
LOSSLESS = 5e-4


class Folder:
    """Where the set and the runs lie.

    Args:
        path: made if it is not there.
    """

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
    """Train an experiment, or go on with it, then evaluate it; on one thread, at the lowest priority.

    Returns:
        The exit status: that of training where it was stopped.
    """
    os.nice(19)
    torch.set_num_threads(1)
    digest = make_set(folder)
    path = folder.run(experiment)
    trained = training.train(experiment.config(folder.set), path)
    if trained.ended == "stop":
        return trained.exit_code
    begun = time.process_time()
    model = load(path)
    weights = _ship(experiment, model, path, folder) if experiment.ships else None
    found = evaluate_test(weights or model, folder) if experiment.is_tested else {}
    content = {
        "set": digest,
        "machine": timing.machine("cpu"),
        "parameters": sum(parameter.numel() for parameter in model.parameters()),
        "cpu_minutes": {
            "training": round(training_seconds(path) / 60, 2),
            "evaluation": round((time.process_time() - begun) / 60, 2),
        },
        "evaluation": found,
    }
    write_atomic(path / EVALUATION, (json.dumps(content, indent=1) + "\n").encode())
    return 0


def make_set(folder: Folder) -> str:
    """Render the set if it is missing, and compare it with the one that the results are about.

    Returns:
        The hash of its values.
    """
    marker = folder.set / "hash.json"
    if not marker.is_file():
        render_set("synthetic-13", folder.set, SET, shapes=SHAPES, per_shard=100, jobs=1, progress=True)
        shards = ShardSet(folder.set)
        write_atomic(marker, json.dumps({"sha256": hash_shapes(shards, range(len(shards)))}).encode())
    digest: str = json.loads(marker.read_text())["sha256"]
    expected = json.loads(RECIPE.read_text())["sha256"] if RECIPE.is_file() else digest
    if digest != expected:
        print(
            f"the set has hash {digest[:16]}, that of the results {expected[:16]}: pixels were rounded otherwise here"
        )
    return digest


def hash_shapes(shards: ShardSet, indices: Sequence[int]) -> str:
    """A hash of the decoded values of shapes: pictures, depth, voxels, cameras, names; not of the files' bytes."""
    digest = hashlib.sha256()
    for index in tqdm(indices, desc="hashing the set", unit="shape", disable=None):
        sample = shards.read(index, occupancy=SET.voxels[0])
        digest.update(json.dumps([sample.name, sample.category, shards.splits[index]]).encode())
        for value in (sample.images, *sample.cameras, sample.depth, sample.mask, sample.occupancy):
            digest.update(np.ascontiguousarray(torch.as_tensor(value)).tobytes())
    return digest.hexdigest()


def evaluate_test(model: Model, folder: Folder) -> dict[str, Any]:
    """What the tables of a network need: its measure on the test split, by views and categories, and shape by shape."""
    shapes = evaluation.open_shapes(folder.set, size=model.image_size, shapes=TEST_SHAPES * CATEGORIES)
    about = f"{len(shapes)} test shapes of the set of the experiments"
    if model.output == "depth":
        return {"data": about, "depth_error": depth_by_views(model, SizedShapes(shapes, model.image_size))}
    method = evaluation.Contender(model.name, model)
    report = evaluation.evaluate([method], shapes, "iou", evaluation.Options(views=VIEWS, progress=True))
    rows = {row.name: row for row in report.tables[0].rows if not row.is_elsewhere}
    names = [shape["name"] for shape in report.shapes]
    return {
        "data": about,
        "iou": {name: [round(cell.value, 3) for cell in row.cells] for name, row in rows.items()},
        "standard_errors": {name: [round(cell.error, 3) for cell in row.cells] for name, row in rows.items()},
        "categories": {
            row.name: dict(zip(report.tables[1].columns, [round(cell.value, 3) for cell in row.cells], strict=True))
            for row in report.tables[1].rows
            if not row.is_elsewhere
        },
        "shapes": hashlib.sha256(json.dumps(names).encode()).hexdigest()[:16],
    }


def depth_by_views(model: Model, shapes: Any) -> dict[str, Any]:
    """The median depth error of all views that a model was given, by their number, and of categories."""
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


def training_seconds(path: Path) -> float:
    """CPU seconds of a run's training over all its resumes, as its log says at the end."""
    lines = [json.loads(line) for line in (path / "log.jsonl").read_text(encoding="utf-8").splitlines()]
    return float([line for line in lines if line["event"] == "stop"][-1]["cpu_seconds"])


def _ship(experiment: Experiment, model: Model, path: Path, folder: Folder) -> Model:
    """Write the weights that the package takes, in half precision if that loses nothing; returns what was written."""
    about = dict(read_weights(path).about)
    about["training"]["data"]["source"] = "the set of benchmarks.experiments"
    file = write_weights(path / WEIGHTS, model, about=about, half=True)
    whole, half = (_validate(one, experiment, folder) for one in (model, load(file)))
    if abs(whole - half) > LOSSLESS:
        write_weights(file, model, about=about)
    print(f"validation: {whole:.5f}, {half:.5f} in half precision")
    return load(file)


def _validate(model: Model, experiment: Experiment, folder: Folder) -> float:
    """The measure after all views on the shapes that training was evaluated on."""
    config = experiment.config(folder.set)
    run, device = config.run, torch.device("cpu")
    need = Need(model.image_size, model.resolution if model.output == "voxels" else None, model.output == "depth")
    shapes = open_shapes(config.data, need, seed=run.seed, device=device, is_training=False)
    some = validation_batches(shapes, seed=run.seed, count=run.evaluate_shapes, batch=run.batch, device=device)
    found = evaluate_model(model, some, StopRequest(), region=run.region, loss=run.loss, pictures=0)
    assert found is not None
    return found.value
