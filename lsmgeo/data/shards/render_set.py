"""Making a training set: shapes rendered and voxelised into shards, on all cores or on a cluster, resumed at will."""

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
from lsmgeo.data.sample import MAX_VIEWS
from lsmgeo.data.shards import hash_settings, verify_shard, write_shard
from lsmgeo.data.shards.shape_sources import Recipe, Source, open_source
from lsmgeo.data.shards.shard_index import MAX_SHAPES, ShardFile, read_index, read_sidecar, sidecar_path
from lsmgeo.data.shards.shard_members import encode_sample
from lsmgeo.data.shards.shard_metadata import MAX_SIDE, MAX_VOXELS
from lsmgeo.errors import DataError, OptionError

__all__ = ["SetResult", "render_set", "write_set"]

# Where workers tell how far they are, one byte a shape.
PROGRESS = ".progress"
SECONDS_BETWEEN_LOOKS = 0.5
SECONDS_BETWEEN_LINES = 30.0


class SetResult(NamedTuple):
    """What became of a set.

    Attributes:
        shards: all shards of the set, in order.
        shapes: how many shapes they hold.
        kept: how many of the shards were there already, whole and made with the same settings.
        skipped: (file, reason) of meshes that could not be used.
    """

    shards: tuple[Path, ...]
    shapes: int
    kept: int
    skipped: tuple[tuple[str, str], ...]


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

    With one installation of the library the bytes depend on the source, the recipe and ``per_shard`` alone, not on the
    number of workers, the machine's load or interruptions. Shards that are there and whole are kept; damaged ones, and
    those whose meshes have changed, are made again.

    Work is handed out by joblib, a shard a task: to processes of this machine, or to whatever backend the caller has
    chosen with ``joblib.parallel_config``, such as a Dask cluster whose workers see the same folders.

    Args:
        source: "synthetic-13", or a folder of meshes.
        out: the folder for the shards.
        recipe: views, sizes, seed; the paper's by default.
        shapes: how many shapes.
        per_shard: shapes in a shard.
        jobs: worker processes; -1 takes all cores, 1 works in this process.
        on_error: "skip" leaves out meshes that cannot be used and reports them, "raise" stops at the first.
        overwrite: make shards again that were made with another recipe; without it they are an error.
        progress: show a bar.

    Returns:
        `SetResult`.

    Raises:
        OptionError: an option out of range, or joblib is missing.
        DataError: the source cannot be read, none of its meshes can be used, the folder cannot be written, or it holds
            shards of another recipe, or beyond those of this set, which a reader would take for a part of it.

    Example:
        >>> import tempfile
        >>> from lsmgeo.data import Recipe, render_set
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     made = render_set("synthetic-13", folder, Recipe(views=2, size=32, voxels=(8,)), shapes=3, jobs=1)
        >>> made.shapes, [path.name for path in made.shards]
        (3, ['synthetic-13-000000.tar'])
    """
    return write_set(
        open_source(source, shapes),
        out,
        Recipe() if recipe is None else recipe,
        per_shard=per_shard,
        jobs=jobs,
        on_error=on_error,
        overwrite=overwrite,
        progress=progress,
        who="render_set",
        where=source,
    )


def write_set(
    source: Source,
    out: str | Path,
    recipe: Recipe,
    *,
    per_shard: int,
    jobs: int,
    on_error: str,
    overwrite: bool,
    progress: bool,
    who: str,
    where: str | Path,
) -> SetResult:
    """Make the shards of any source; see `render_set`, whose options these are.

    ``who`` stands before an option's name in errors, ``where`` is the source as the caller named it.

    Raises:
        OptionError, DataError: as `render_set`.
    """
    _check(who, recipe, per_shard, jobs, on_error)
    check_flag(who, "overwrite", overwrite)
    out = Path(out)
    if out.exists() and not out.is_dir():
        raise DataError(out, "is a file; the shards need a folder")
    tasks = _tasks(source, out, recipe, per_shard, on_error)
    _refuse_other_shards(out, tasks, overwrite)
    reports = [_progress_file(task.path) for task in tasks]
    half_written = f".{glob.escape(source.name)}-{'[0-9]' * 6}.*.tmp"
    try:
        (out / PROGRESS).mkdir(parents=True, exist_ok=True)
        left = [path for path in out.glob(half_written) if is_abandoned(path)]  # by a run that was killed
        for path in (*reports, *left):
            path.unlink(missing_ok=True)
    except OSError as error:
        raise DataError(out, f"cannot be written ({error})") from error
    try:
        with _progress_bar(reports, tasks[-1].stop, recipe.views, progress):
            done = _run(who, tasks, jobs)
    finally:
        with contextlib.suppress(OSError):
            for path in reports:
                path.unlink(missing_ok=True)
            (out / PROGRESS).rmdir()
    made = SetResult(
        tuple(path for one in done for path in one.shards),
        sum(one.shapes for one in done),
        sum(one.kept for one in done),
        tuple(skip for one in done for skip in one.skipped),
    )
    if not made.shapes:
        first, reason = made.skipped[0]
        raise DataError(where, f"holds no shape that can be used; the first: {first}: {reason}")
    return made


def _check(who: str, recipe: Recipe, per_shard: int, jobs: int, on_error: str) -> None:
    check_whole(who, "views", recipe.views, 1, MAX_VIEWS)
    check_whole(who, "size", recipe.size, 1, MAX_SIDE)
    check_whole(who, "seed", recipe.seed, 0, 2**32 - 1)
    check_whole(who, "per_shard", per_shard, 1, MAX_SHAPES)
    if check_whole(who, "jobs", jobs, -1) == 0:
        raise OptionError(f"{who}: jobs must be at least 1, or -1 for all cores; got 0")
    for side in recipe.voxels:
        check_whole(who, "voxels", side, 1, MAX_VOXELS)
    if len(set(recipe.voxels)) != len(recipe.voxels):
        raise OptionError(f"{who}: voxels must be different resolutions; got {recipe.voxels!r}")
    check_choice(who, "on_error", on_error, ("skip", "raise"))


def _tasks(source: Source, out: Path, recipe: Recipe, per_shard: int, on_error: str) -> list[_ShardTask]:
    tasks = []
    for number, start in enumerate(range(0, len(source), per_shard)):
        stop = min(start + per_shard, len(source))
        path = out / f"{source.name}-{number:06d}.tar"
        tasks.append(_ShardTask(source.part(start, stop), recipe, start, stop, path, on_error))
    return tasks


def _refuse_other_shards(out: Path, tasks: list[_ShardTask], overwrite: bool) -> None:
    """Refuse a folder that would come to hold two sets in one."""
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
        except DataError:  # what is damaged is made again
            continue
        if not settings.startswith(recipe):
            raise DataError(path, "was made with other settings; name another folder, or ask to overwrite it")


def _recipe_hash(recipe: Recipe) -> str:
    """What the settings of a shard begin with."""
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
    """Make one shard, or find that it is there."""
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
    torch.set_num_threads(1)  # the cores are the workers', and one thread's sums have one order
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
            yield (
                index,
                encode_sample(
                    rendered.sample,
                    index,
                    more_occupancy=rendered.more_occupancy,
                    source=task.source.name,
                    seed=task.recipe.seed,
                    split=rendered.split,
                ),
            )
        _report_progress(task.path, 1)


def _progress_file(path: Path) -> Path:
    """The file in which the worker of a shard tells how far it is."""
    return path.parent / PROGRESS / path.stem


def _report_progress(path: Path, shapes: int) -> None:
    """Add to the shapes that a shard's worker has finished; a report that cannot be written is no reason to stop."""
    with contextlib.suppress(OSError), _progress_file(path).open("ab") as stream:
        stream.write(bytes(shapes))


@contextlib.contextmanager
def _progress_bar(reports: list[Path], shapes: int, views: int, shown: bool) -> Iterator[None]:
    """A progress bar over the views of all workers, fed by what they tell; in a log, a line now and then."""
    if not shown:
        yield
        return
    from tqdm import tqdm

    finished = threading.Event()
    form = {} if sys.stderr.isatty() else {"bar_format": "{n} of {total} views\n", "mininterval": SECONDS_BETWEEN_LINES}
    with tqdm(total=shapes * views, unit="view", **form) as bar:

        def look() -> None:
            with contextlib.suppress(OSError):
                bar.update(views * sum(path.stat().st_size for path in reports if path.exists()) - bar.n)

        def watch() -> None:
            while not finished.wait(SECONDS_BETWEEN_LOOKS):
                look()

        watcher = threading.Thread(target=watch, daemon=True)
        watcher.start()
        try:
            yield
            look()
        finally:
            finished.set()
            watcher.join()
