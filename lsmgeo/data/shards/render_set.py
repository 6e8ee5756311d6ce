"""Making a training set: shapes rendered and voxelised into shards, on all cores or a cluster; it can be resumed."""

from __future__ import annotations

import contextlib
import glob
import re
import sys
import threading
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import torch

from lsmgeo._checks import check_choice, check_flag, check_whole
from lsmgeo.data.atomic_files import is_abandoned
from lsmgeo.data.read_files import os_errors_as_data_errors
from lsmgeo.data.sample import MAX_VIEWS
from lsmgeo.data.shards import hash_settings, verify_shard, write_shard
from lsmgeo.data.shards.shape_sources import Recipe, Source, open_source
from lsmgeo.data.shards.shard_index import MAX_SHAPES, ShardFile, read_index, read_sidecar, sidecar_path
from lsmgeo.data.shards.shard_members import encode_sample
from lsmgeo.data.shards.shard_metadata import MAX_SIDE, MAX_VOXELS
from lsmgeo.errors import DataError, OptionError

__all__ = ["SetOptions", "SetResult", "render_set", "write_set"]

# The folder where workers report their progress, one byte for each shape.
PROGRESS = ".progress"
SECONDS_BETWEEN_UPDATES = 0.5
SECONDS_BETWEEN_LINES = 30.0


class SetResult(NamedTuple):
    """The result of `render_set` and `convert_set`.

    Attributes:
        shards: all shards of the set, in order.
        shapes: the number of shapes in them.
        kept: the number of shards that already existed, complete and with the same settings.
        skipped: (file, reason) of the shapes that could not be used.
    """

    shards: tuple[Path, ...]
    shapes: int
    kept: int
    skipped: tuple[tuple[str, str], ...]


class SetOptions(NamedTuple):
    """The options that `render_set` and `convert_set` share; documented there."""

    per_shard: int
    jobs: int
    on_error: str
    overwrite: bool
    progress: bool


class _ShardTask(NamedTuple):
    """One shard: shapes start to stop."""

    source: Source
    recipe: Recipe
    start: int
    stop: int
    path: Path
    on_error: str


def render_set(
    source: str | Path,
    out: str | Path,
    recipe: Recipe | None = None,
    *,
    shapes: int | None = None,
    per_shard: int = 50,
    jobs: int = -1,
    on_error: str = "skip",
    overwrite: bool = False,
    progress: bool = False,
) -> SetResult:
    """Render a set of shapes into shards, ``NAME-000000.tar`` and so on, as `ShardSet` reads them.

    With one installation of the library the bytes depend only on the source, the recipe and ``per_shard``, not on the
    number of workers, the load or interruptions. Complete shards are kept; damaged ones, and those whose meshes have
    changed, are made again.

    A task of joblib is one shard. Tasks run in processes of this machine, or on the backend that is set by
    ``joblib.parallel_config``, such as a Dask cluster whose workers see the same folders.

    Args:
        source: "synthetic-13", or a folder of meshes.
        out: the folder for the shards.
        recipe: views, sizes, seed; the paper's by default.
        shapes: the number of shapes.
        per_shard: shapes in a shard.
        jobs: worker processes; -1 for all cores, 1 for only this process.
        on_error: "skip" leaves out and reports meshes that cannot be used, "raise" stops at the first.
        overwrite: replace shards made with other settings; without it they are an error.
        progress: show a progress bar.

    Returns:
        `SetResult`.

    Raises:
        OptionError: an option out of range, or joblib is missing.
        DataError: the source cannot be read, none of its meshes can be used, the folder cannot be written, or it holds
            shards of another recipe or beyond those of this set, which a reader would take for a part of it.

    Example:
        >>> import tempfile
        >>> from lsmgeo.data import Recipe, render_set
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     made = render_set("synthetic-13", folder, Recipe(views=2, size=32, voxels=(8,)), shapes=3, jobs=1)
        >>> made.shapes, [path.name for path in made.shards]
        (3, ['synthetic-13-000000.tar'])
    """
    options = SetOptions(per_shard, jobs, on_error, overwrite, progress)
    return write_set(open_source(source, shapes), out, recipe or Recipe(), options, who="render_set", where=source)


def write_set(
    source: Source, out: str | Path, recipe: Recipe, options: SetOptions, *, who: str, where: str | Path
) -> SetResult:
    """Make the shards of any source, see `render_set`; ``who`` and ``where`` name function and source in errors."""
    _check(who, recipe, options)
    out = Path(out)
    if out.exists() and not out.is_dir():
        raise DataError(out, "is a file; the shards need a folder")
    tasks = _tasks(source, out, recipe, options)
    _refuse_other_shards(out, tasks, options.overwrite)
    reports = [_progress_file(task.path) for task in tasks]
    half_written = f".{glob.escape(source.name)}-{'[0-9]' * 6}.*.tmp"
    with os_errors_as_data_errors(out):
        (out / PROGRESS).mkdir(parents=True, exist_ok=True)
        left = [path for path in out.glob(half_written) if is_abandoned(path)]  # by a run that was killed
        for path in (*reports, *left):
            path.unlink(missing_ok=True)
    try:
        with _progress_bar(reports, tasks[-1].stop, recipe.views, options.progress):
            results = _run(who, tasks, options.jobs)
    finally:
        with contextlib.suppress(OSError):
            for path in reports:
                path.unlink(missing_ok=True)
            (out / PROGRESS).rmdir()
    made = SetResult(
        tuple(path for result in results for path in result.shards),
        sum(result.shapes for result in results),
        sum(result.kept for result in results),
        tuple(skip for result in results for skip in result.skipped),
    )
    if not made.shapes:
        first, reason = made.skipped[0]
        raise DataError(where, f"holds no shape that can be used; the first: {first}: {reason}")
    return made


def _check(who: str, recipe: Recipe, options: SetOptions) -> None:
    check_whole(who, "views", recipe.views, 1, MAX_VIEWS)
    check_whole(who, "size", recipe.size, 1, MAX_SIDE)
    check_whole(who, "seed", recipe.seed, 0, 2**32 - 1)
    check_whole(who, "per_shard", options.per_shard, 1, MAX_SHAPES)
    if check_whole(who, "jobs", options.jobs, -1) == 0:
        raise OptionError(f"{who}: jobs must be at least 1, or -1 for all cores; got 0")
    for side in recipe.voxels:
        check_whole(who, "voxels", side, 1, MAX_VOXELS)
    if len(set(recipe.voxels)) != len(recipe.voxels):
        raise OptionError(f"{who}: voxels must be different resolutions; got {recipe.voxels!r}")
    check_choice(who, "on_error", options.on_error, ("skip", "raise"))
    check_flag(who, "overwrite", options.overwrite)


def _tasks(source: Source, out: Path, recipe: Recipe, options: SetOptions) -> list[_ShardTask]:
    tasks = []
    for number, start in enumerate(range(0, len(source), options.per_shard)):
        stop = min(start + options.per_shard, len(source))
        path = out / f"{source.name}-{number:06d}.tar"
        tasks.append(_ShardTask(source.part(start, stop), recipe, start, stop, path, options.on_error))
    return tasks


def _refuse_other_shards(out: Path, tasks: list[_ShardTask], overwrite: bool) -> None:
    """Refuse a folder in which two sets would be mixed."""
    name = tasks[0].source.name
    ours = {task.path for task in tasks}
    recipe = _recipe_hash(tasks[0].recipe)
    for path in sorted(out.glob("*.tar")):
        if path not in ours and re.fullmatch(re.escape(name) + "-[0-9]{6}", path.stem):
            raise DataError(path, "belongs to a larger set; remove that set, or name another folder")
        if overwrite and path in ours:
            continue
        try:
            settings = read_sidecar(ShardFile(path)).settings
        except DataError:  # damaged shards are made again
            continue
        if not settings.startswith(recipe):
            raise DataError(path, "was made with other settings; name another folder, or ask to overwrite it")


def _recipe_hash(recipe: Recipe) -> str:
    """The beginning of the settings hash of a shard."""
    return hash_settings(recipe._asdict())[:32]


def _run(who: str, tasks: list[_ShardTask], jobs: int) -> list[SetResult]:
    if jobs == 1:
        return [_write_shard(task) for task in tasks]
    try:
        import joblib
    except ImportError as error:
        raise OptionError(f"{who}: jobs other than 1 need joblib; install lsmgeo[data]") from error
    result: list[SetResult] = joblib.Parallel(n_jobs=jobs)(joblib.delayed(_write_shard)(task) for task in tasks)
    return result


def _write_shard(task: _ShardTask) -> SetResult:
    """Make one shard, unless it exists."""
    made_from = hash_settings({"shapes": [task.start, task.stop], "source": task.source.identity()})
    settings = f"{_recipe_hash(task.recipe)}-{made_from}"
    if verify_shard(task.path, settings):
        there = {int(key) for key in read_index(task.path).keys}
        missing = [index for index in range(task.start, task.stop) if index not in there]
        if not missing or task.on_error == "skip":
            _report_progress(task.path, task.stop - task.start)
            reason = "could not be used when its shard was made"
            left_out = tuple((task.source.file(index), reason) for index in missing)
            return SetResult((task.path,), len(there), 1, left_out)
    skipped: list[tuple[str, str]] = []
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # workers use the other cores, and one thread adds in one order
    try:
        items = _items(task, skipped)
        first = next(items, None)
        if first is None:
            task.path.unlink(missing_ok=True)
            sidecar_path(task.path).unlink(missing_ok=True)
            return SetResult((), 0, 0, tuple(skipped))
        write_shard(task.path, chain([first], items), settings)
    finally:
        torch.set_num_threads(threads)
    return SetResult((task.path,), task.stop - task.start - len(skipped), 0, tuple(skipped))


def _items(task: _ShardTask, skipped: list[tuple[str, str]]) -> Iterator[tuple[int, dict[str, bytes]]]:
    """The shapes of a task, encoded one at a time; those that cannot be used go to ``skipped``."""
    for index in range(task.start, task.stop):
        try:
            rendered = task.source.render(index, task.recipe)
        except DataError as error:
            if task.on_error == "raise":
                raise
            skipped.append((str(error.path), error.reason))
        else:
            shape, grids, split = rendered
            members = encode_sample(
                shape, index, more_occupancy=grids, source=task.source.name, seed=task.recipe.seed, split=split
            )
            yield index, members
        _report_progress(task.path, 1)


def _progress_file(path: Path) -> Path:
    """The file to which the worker of a shard reports its progress."""
    return path.parent / PROGRESS / path.stem


def _report_progress(path: Path, shapes: int) -> None:
    """Report shapes as finished; a report that cannot be written does not stop the worker."""
    with contextlib.suppress(OSError), _progress_file(path).open("ab") as stream:
        stream.write(bytes(shapes))


@contextlib.contextmanager
def _progress_bar(reports: list[Path], shapes: int, views: int, shown: bool) -> Iterator[None]:
    """A progress bar over the views of all workers; in a log, a line every 30 seconds."""
    if not shown:
        yield
        return
    from tqdm import tqdm

    finished = threading.Event()
    form = {} if sys.stderr.isatty() else {"bar_format": "{n} of {total} views\n", "mininterval": SECONDS_BETWEEN_LINES}
    with tqdm(total=shapes * views, unit="view", **form) as bar:

        def update() -> None:
            with contextlib.suppress(OSError):
                bar.update(views * sum(path.stat().st_size for path in reports if path.exists()) - bar.n)

        def watch() -> None:
            while not finished.wait(SECONDS_BETWEEN_UPDATES):
                update()

        watcher = threading.Thread(target=watch, daemon=True)
        watcher.start()
        try:
            yield
            update()
        finally:
            finished.set()
            watcher.join()
