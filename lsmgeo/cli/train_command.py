"""`lsmgeo train`: a model from a configuration."""

from __future__ import annotations

__all__ = ["train"]


def train(configuration: str, out: str = "lsmgeo-run", set: list[str] | None = None, quiet: bool = False) -> int:
    """Train a model, or resume a run; on several devices with torchrun, see the guide.

    Args:
        configuration: a TOML or JSON file; examples/configs holds some.
        out: the run's folder, for checkpoints, the log and images; a run that it holds is resumed.
        set: a setting that takes precedence over the file's, such as --set run.steps=100; may be repeated.
        quiet: whether to show no progress.

    Returns:
        The exit status: 0; 143 after SIGTERM or 130 after Ctrl-C, where everything is saved and the same command
        resumes.
    """
    import os
    from pathlib import Path

    import torch

    from lsmgeo import training

    config = training.read_config(configuration, set or ())
    if "OMP_NUM_THREADS" not in os.environ:
        # Each prefetching process takes a core: threads that wait for a core slow all others down.
        torch.set_num_threads(max(1, torch.get_num_threads() - config.data.workers))
    trained = training.train(config, out, quiet=quiet)
    if trained.is_first:
        why = {"steps": "all steps are taken", "minutes": "the time is over", "stop": "a signal asked for it"}
        print(f"ended:       at step {trained.step}, since {why[trained.ended]}")
        if trained.evaluation is not None:
            print(f"{trained.evaluation.title + ':':<13}{trained.evaluation.words}")
        print(f"checkpoint:  {trained.checkpoint.resolve()}")
        best = None if trained.best is None else trained.checkpoint.with_name(f"step_{trained.best:08d}")
        # It may not have fit on a full disk.
        if trained.best != trained.step and best is not None and best.is_dir():
            print(f"best:        {best.resolve()}")
        print(f"log:         {(Path(out) / 'log.jsonl').resolve()}; tensorboard --logdir {Path(out).resolve()}")
        print(f"evaluate:    lsmgeo evaluate {trained.checkpoint}")
        if trained.ended == "stop":
            print("resume:      the same command")
    return trained.exit_code
