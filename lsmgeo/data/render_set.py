"""Making a training set: shapes rendered and voxelised into shards, on all cores or on a cluster, resumed at will."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import torch

from lsmgeo.data.members import encode_sample
from lsmgeo.data.shards import hash_settings, verify_shard, write_shard
from lsmgeo.data.sources import Recipe, Source, open_source
from lsmgeo.errors import DataError, OptionError

__all__ = ["Made", "render_set"]

# Where workers tell how far they are, one byte a shape.
PROGRESS = ".progress"
SECONDS_BETWEEN_LOOKS = 0.5


class Made(NamedTuple):
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


class _Task(NamedTuple):
    """One shard: shapes start to stop."""

    source: Source
    recipe: Recipe
    start: int
    stop: int
    path: Path
    settings: str
    on_error: str


class _Done(NamedTuple):
    path: Path
    shapes: int
    kept: bool
    skipped: list[tuple[str, str]]


def render_set(
    source: str | Path,
    out: str | Path,
    recipe: Recipe | None = None,
    *,
    shapes: int | None = None,
    per_shard: int = 50,
    jobs: int = -1,
    on_error: str = "skip",
    progress: bool = False,
) -> Made:
    """Render a set of shapes into shards, ``NAME-000000.tar`` and so on, as `ShardSet` reads them.

    The bytes depend on the source, the recipe and ``per_shard`` alone, not on the number of workers, the machine's load
    or interruptions. Shards that are there, whole and made with the same settings, are kept.

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
        progress: show a bar.

    Returns:
        `Made`.

    Raises:
        OptionError: an option out of range, or joblib is missing.
        DataError: the source cannot be read or the folder cannot be written.

    Example:
        >>> import tempfile
        >>> from lsmgeo.data import Recipe, render_set
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     made = render_set("synthetic-13", folder, Recipe(views=2, size=32, voxels=(8,)), shapes=3, jobs=1)
        >>> made.shapes, [path.name for path in made.shards]
        (3, ['synthetic-13-000000.tar'])
    """
    recipe = Recipe() if recipe is None else recipe
    _check(recipe, per_shard, on_error)
    opened = open_source(source, shapes)
    out = Path(out)
    tasks = _tasks(opened, out, recipe, per_shard, on_error)
    try:
        (out / PROGRESS).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(out, f"cannot be written ({error})") from error
    try:
        with _bar(out, len(opened), recipe.views, progress):
            done = _run(tasks, jobs)
    finally:
        for path in (out / PROGRESS).glob("*"):
            path.unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            (out / PROGRESS).rmdir()
    return Made(
        tuple(one.path for one in done if one.shapes),
        sum(one.shapes for one in done),
        sum(one.kept for one in done),
        tuple(skip for one in done for skip in one.skipped),
    )


def _check(recipe: Recipe, per_shard: int, on_error: str) -> None:
    for name, value, least, most in (
        ("views", recipe.views, 1, 1000),
        ("size", recipe.size, 1, 4096),
        ("seed", recipe.seed, 0, 2**32 - 1),
        ("per_shard", per_shard, 1, 10_000),
    ):
        if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= most:
            raise OptionError(f"render_set: {name} must be a whole number from {least} to {most}; got {value!r}")
    voxels = recipe.voxels
    if len(set(voxels)) != len(voxels) or not all(isinstance(side, int) and 1 <= side <= 256 for side in voxels):
        raise OptionError(f"render_set: voxels must be different resolutions from 1 to 256; got {voxels!r}")
    if on_error not in ("skip", "raise"):
        raise OptionError(f"render_set: on_error must be 'skip' or 'raise'; got {on_error!r}")


def _tasks(source: Source, out: Path, recipe: Recipe, per_shard: int, on_error: str) -> list[_Task]:
    tasks = []
    for number, start in enumerate(range(0, len(source), per_shard)):
        stop = min(start + per_shard, len(source))
        settings = hash_settings({"recipe": recipe._asdict(), "source": source.identity(start, stop)})
        path = out / f"{source.name}-{number:06d}.tar"
        tasks.append(_Task(source, recipe, start, stop, path, settings, on_error))
    return tasks


def _run(tasks: list[_Task], jobs: int) -> list[_Done]:
    if jobs == 1:
        return [_make(task) for task in tasks]
    try:
        import joblib
    except ImportError as error:
        raise OptionError("render_set: jobs other than 1 need joblib; install lsmgeo[data]") from error
    result: list[_Done] = joblib.Parallel(n_jobs=jobs)(joblib.delayed(_make)(task) for task in tasks)
    return result


def _make(task: _Task) -> _Done:
    """Make one shard, or find that it is there."""
    progress = task.path.parent / PROGRESS / task.path.stem
    if verify_shard(task.path, task.settings):
        from lsmgeo.data.shard_index import read_sidecar

        count = len(read_sidecar(task.path))
        _tell(progress, task.stop - task.start)
        return _Done(task.path, count, True, [])
    skipped: list[tuple[str, str]] = []
    written = 0

    def items() -> Iterator[tuple[int, dict[str, bytes]]]:
        nonlocal written
        for index in range(task.start, task.stop):
            try:
                rendered = task.source.render(index, task.recipe)
            except DataError as error:
                if task.on_error == "raise":
                    raise
                skipped.append((str(error.path), error.reason))
            else:
                written += 1
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
            _tell(progress, 1)

    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # the cores are the workers', and one thread's sums have one order
    try:
        write_shard(task.path, items(), task.settings)
    except OptionError:
        if written:
            raise
        return _Done(task.path, 0, False, skipped)
    finally:
        torch.set_num_threads(threads)
    return _Done(task.path, written, False, skipped)


def _tell(path: Path, shapes: int) -> None:
    """Add to the shapes that a shard's worker has finished; a report that cannot be written is no reason to stop."""
    with contextlib.suppress(OSError), path.open("ab") as stream:
        stream.write(bytes(shapes))


@contextlib.contextmanager
def _bar(out: Path, shapes: int, views: int, shown: bool) -> Iterator[None]:
    """A progress bar over the views of all workers, fed by what they tell."""
    if not shown:
        yield
        return
    from tqdm import tqdm

    finished = threading.Event()
    bar: Any = tqdm(total=shapes * views, unit="view", disable=None)

    def look() -> None:
        done = sum(path.stat().st_size for path in (out / PROGRESS).glob("*"))
        bar.update(done * views - bar.n)

    def watch() -> None:
        while not finished.wait(SECONDS_BETWEEN_LOOKS):
            with contextlib.suppress(OSError):
                look()

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield
        look()
    finally:
        finished.set()
        watcher.join()
        bar.close()
