"""The trainings, in order. Rows are compared only at equal CPU minutes, which include the evaluation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from lsmgeo.data import Recipe
from lsmgeo.training import TrainingConfig
from lsmgeo.training.config import make_config

__all__ = ["ALL", "EVALUATION_MINUTES", "QUEUE", "SET", "SHAPES", "Experiment", "find"]

# The set of all runs; `set.json` beside this file holds the hash of its values.
SET = Recipe(seed=0, views=8, size=128, voxels=(32,), depth=True, shadows=False)
SHAPES = 12_000
# Minutes of an experiment for the evaluation of its network, and for further reports.
EVALUATION_MINUTES = {"voxels": 6.0, "depth": 8.0, "backgrounds": 1.5, "pose-noise": 3.0, "order": 5.0}


@dataclass(frozen=True)
class Experiment:
    """One run."""

    name: str  # of its folder and of its results
    what: str  # its purpose, in words
    minutes: float  # of CPU time, evaluation included
    model: str  # the network, as `lsmgeo.models.create` knows it
    settings: Mapping[str, Any] = field(default_factory=dict)  # in place of its usual training's, as "group.key"
    preset: str = "standard"  # of the network
    reports: Sequence[str] = ()  # further ones, see ``lsmgeo evaluate``, on fewer test shapes
    ships: bool = False  # whether its weights become part of the package
    # Whether its weights are measured on the test split; else only training measures them, on the validation split.
    is_tested: bool = True

    @property
    def output(self) -> str:
        """The network's output: "voxels" or "depth"."""
        return "depth" if self.model == "depth-lsm" else "voxels"

    @property
    def evaluation_minutes(self) -> float:
        """The minutes reserved for the evaluation of the weights."""
        if not self.is_tested:
            return 0.0
        return EVALUATION_MINUTES[self.output] + sum(EVALUATION_MINUTES[report] for report in self.reports)

    def config(self, folder: Path) -> TrainingConfig:
        """The configuration of its training on the shards of a folder."""
        values: dict[str, dict[str, Any]] = {
            "model": {"name": self.model, "preset": self.preset},
            "data": {"source": str(folder), "views": 4, "workers": 0},
            "optimiser": {"schedule": "cosine", "warm_up": 100, "clip_norm": 1.0},
            "run": {
                "cpu_minutes": self.minutes - self.evaluation_minutes,
                "batch": 4,
                "device": "cpu",
                "precision": "auto",
                "loss": "bce+iou",
                "evaluate_every": 500,
                "evaluate_shapes": 260,
                "checkpoint_every": 200,
                "keep": 1,
                "tensorboard": False,
            },
        }
        for key, value in {**USUAL[self.model], **self.settings}.items():
            group, _, name = key.partition(".")
            values[group][name] = value
        return make_config(values)


USUAL: Mapping[str, Mapping[str, Any]] = {
    "voxel-lsm": {"optimiser.learning_rate": 2e-3, "run.loss_views": "random"},
    "depth-lsm": {"optimiser.learning_rate": 2e-3, "run.loss_views": "last"},
    "r2n2": {"optimiser.learning_rate": 3e-4, "run.loss_views": "random"},
    "r2n2-pose": {"optimiser.learning_rate": 3e-4, "run.loss_views": "random"},
}

BACKGROUNDS, NOISE = {"data.background": "random"}, {"data.pose_noise": 10.0}
FIRST, SECOND = {"data.categories": "first"}, {"data.categories": "second"}

QUEUE = (
    Experiment("vlsm_45", "V-LSM", 45, "voxel-lsm", reports=("backgrounds", "pose-noise")),
    Experiment("r2n2_pose_45", "3D-R2N2 with pose", 45, "r2n2-pose"),
    Experiment("dlsm_45", "D-LSM", 45, "depth-lsm"),
    Experiment("vlsm_90", "V-LSM, the weights of the package", 90, "voxel-lsm", reports=("order",), ships=True),
    Experiment("dlsm_90", "D-LSM, the weights of the package", 90, "depth-lsm", ships=True),
    Experiment("r2n2_45", "3D-R2N2", 45, "r2n2"),
    Experiment("vlsm_bg_45", "V-LSM on random backgrounds", 45, "voxel-lsm", BACKGROUNDS, reports=("backgrounds",)),
    Experiment("vlsm_noise_45", "V-LSM with pose noise", 45, "voxel-lsm", NOISE, reports=("pose-noise",)),
    Experiment("vlsm_first_45", "V-LSM on the first categories", 45, "voxel-lsm", FIRST),
    Experiment("vlsm_second_45", "V-LSM on the second categories", 45, "voxel-lsm", SECOND),
    Experiment("r2n2_pose_first_45", "3D-R2N2 with pose on the first categories", 45, "r2n2-pose", FIRST),
    Experiment("r2n2_pose_second_45", "3D-R2N2 with pose on the second categories", 45, "r2n2-pose", SECOND),
    Experiment(
        "vlsm_release_rules_45",
        "V-LSM with the release's rule of pixels, 1.5 pixels aside: what right geometry buys",
        45,
        "voxel-lsm",
        {"model.settings": {"pixel_rules": "release"}},
    ),
    Experiment("r2n2_pose_90", "3D-R2N2 with pose: whether it has come to its plateau", 90, "r2n2-pose"),
)

# The compact V-LSM and D-LSM of the version before, in float32.
BEFORE = {
    "image_size": 64,
    "encoder_channels": [32, 64, 96],
    "feature_channels": 28,
    "lift": 1,
    "input_kernel": 3,
    "state_kernel": 3,
}

WIDE = {"grid_channels": [64, 128], "feature_channels": 12, "hidden_channels": 48}

EVERY, RANDOM = {"run.loss_views": "every"}, {"run.loss_views": "random"}
SHORT = {"run.precision": "bf16", "run.cpu_minutes": None, "run.steps": 10, "run.evaluate_shapes": 4}
CHANNELS = {"channels": [32, 64, 128, 192, 192], "hidden": 96, "decoder": [96, 48, 24]}
V_BEFORE = {"model.settings": BEFORE, "run.loss": "bce", **EVERY}

# Settings were chosen by these, on the validation split; run by name.
TRIALS = tuple(
    replace(trial, is_tested=False, preset="compact")
    for trial in (
        Experiment("vlsm_before_5", "V-LSM as it was before, in float32", 5, "voxel-lsm", V_BEFORE),
        Experiment("vlsm_every_5", "V-LSM, the loss after every view", 5, "voxel-lsm", EVERY),
        Experiment("vlsm_bf16_5", "V-LSM in bfloat16, ten steps", 5, "voxel-lsm", SHORT),
        Experiment("vlsm_5", "V-LSM", 5, "voxel-lsm"),
        Experiment("vlsm_20", "V-LSM", 20, "voxel-lsm"),
        Experiment("vlsm_wide_20", "V-LSM, wider", 20, "voxel-lsm", {"model.settings": WIDE}),
        Experiment("dlsm_before_10", "D-LSM as it was before, in float32", 10, "depth-lsm", {"model.settings": BEFORE}),
        Experiment("dlsm_10", "D-LSM", 10, "depth-lsm"),
        Experiment("dlsm_random_10", "D-LSM, the loss after a random view", 10, "depth-lsm", RANDOM),
        Experiment("r2n2_pose_8", "3D-R2N2 with pose", 8, "r2n2-pose"),
        Experiment("r2n2_pose_fast_8", "3D-R2N2 with pose, 1e-3", 8, "r2n2-pose", {"optimiser.learning_rate": 1e-3}),
        Experiment("r2n2_pose_every_8", "3D-R2N2 with pose, the loss after every view", 8, "r2n2-pose", EVERY),
        Experiment(
            "r2n2_pose_channels_8", "3D-R2N2 with pose, more channels", 8, "r2n2-pose", {"model.settings": CHANNELS}
        ),
        Experiment("r2n2_pose_16", "3D-R2N2 with pose, twice as long", 16, "r2n2-pose"),
    )
)

ALL = (*TRIALS, *QUEUE)


def find(name: str) -> Experiment:
    """The experiment of a name.

    Raises:
        SystemExit: there is none.
    """
    for experiment in ALL:
        if experiment.name == name:
            return experiment
    raise SystemExit(f"there is no experiment {name!r}; there are {', '.join(one.name for one in ALL)}")
