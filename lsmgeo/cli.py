"""The command line: scenes, training sets, models. Heavy imports wait until a command runs."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from inspect import signature
from pathlib import Path
from typing import Any, Literal

__all__ = ["convert", "demo", "info", "main", "render"]

KINDS = {"int": "a whole number", "float": "a finite number"}
LONGEST_MESSAGE = 300
MOST_SKIPPED = 5
CLUSTER_SECONDS = 20


def demo(out: str = "lsmgeo-demo") -> None:
    """Recover the depth of a known scene from six pictures of it, and draw how.

    Args:
        out: folder for the picture; created where it does not exist.
    """
    from lsmgeo.demo import run_demo, write_picture

    result = run_demo()
    errors = result.error[result.error.isfinite()]
    path = write_picture(result, Path(out) / "demo.png")
    print(f"voxels:                        {' x '.join(map(str, result.grid.shape))}")  # type: ignore[arg-type]
    print(f"views:                         {len(result.images)}")
    print(f"surface pixels compared:       {len(errors)}")
    print(f"median relative depth error:   {100 * result.median_error:.3f} %")
    print(f"pixels within 1 %:             {100 * float((errors < 0.01).double().mean()):.1f} %")
    print(f"time of the operators:         {result.seconds:.1f} s")
    print(f"picture:                       {path.resolve()}")


def info(path: str, out: str = "lsmgeo-info") -> int:
    """Say what a path holds and whether its cameras and pictures belong together; name the likely mistake where not.

    Args:
        path: scene, calibration or voxels: a folder, or the file that is meant where a folder holds several.
        out: folder for the pictures; created where it does not exist.

    Returns:
        The exit status: 0 all is well, 1 it is not, 3 nothing could be measured (2 is for what cannot be read).
    """
    import time

    from lsmgeo import data
    from lsmgeo.data.detect import detect
    from lsmgeo.diagnosis import examine
    from lsmgeo.diagnosis.findings import report
    from lsmgeo.diagnosis.photographs import examine_photographs
    from lsmgeo.diagnosis.pictures import draw_examination

    start = time.perf_counter()
    source = Path(path)
    content = detect(source).read(source)
    drawn: dict[str, tuple[str, bytes]] = {}
    if isinstance(content, data.PosedImages):
        examination = examine_photographs(content)
        findings = examination.findings
        verdict = findings.verdict if findings.cause is None else findings.cause.name
        drawn = draw_examination(content, examination, f"{source.resolve().name}: {verdict}")
    else:
        findings = examine(content, source)
    written = {what: data.write_atomic(Path(out) / name, content) for what, (name, content) in drawn.items()}
    print(report(findings))
    print(f"{'time:':<18}{time.perf_counter() - start:.1f} s")
    for what, file in written.items():
        print(f"{what + ':':<28}{file.resolve()}")
    if not written:
        print(f"no pictures are drawn of {'voxels alone' if findings.kind == 'voxels' else 'a calibration'}")
    return {"good": 0, "bad": 1, "unknown": 3}[findings.verdict]


def render(
    source: str = "synthetic-13",
    shapes: int | None = None,
    views: int = 20,
    out: str = "lsmgeo-set",
    size: int = 224,
    voxels: str = "32,64",
    depth: bool = True,
    shadows: bool = False,
    seed: int = 0,
    per_shard: int = 50,
    jobs: int = -1,
    cluster: str | None = None,
    on_error: Literal["skip", "raise"] = "skip",
    overwrite: bool = False,
) -> None:
    """Make a training set: views, depth and voxels of many shapes, in tar shards; run again, it goes on where it was.

    Args:
        source: "synthetic-13", or a folder of meshes such as a ShapeNetCore tree.
        shapes: number of shapes; by default all meshes of the folder.
        views: pictures of each shape.
        out: folder for the shards; created where it does not exist.
        size: height and width of the pictures in pixels.
        voxels: resolutions of the occupancy grids, such as 32 or 32,64.
        depth: whether to write depth.
        shadows: whether shapes cast shadows on themselves.
        seed: decides shapes, lights and views.
        per_shard: shapes in a shard.
        jobs: worker processes; -1 takes all cores.
        cluster: address of a Dask scheduler whose workers see the same folders; by default this machine works alone.
        on_error: what to do with a mesh that cannot be used.
        overwrite: whether to make shards again that were made with other settings.
    """
    import time

    from lsmgeo.data import Recipe, render_set
    from lsmgeo.errors import OptionError

    if not re.fullmatch(r"[0-9]+(,[0-9]+)*", voxels):
        raise OptionError(f"render: voxels must be whole numbers with commas between, such as 32,64; got {voxels!r}")
    sides = tuple(int(side[:6]) for side in voxels.split(","))
    start = time.perf_counter()
    with ExitStack() as stack:
        if cluster is not None:
            _join(cluster, stack)
        made = render_set(
            source,
            out,
            Recipe(seed, views, size, sides, depth, shadows),
            shapes=shapes,
            per_shard=per_shard,
            jobs=_jobs(jobs) if cluster is None else jobs,
            on_error=on_error,
            overwrite=overwrite,
            progress=True,
        )
    seconds = time.perf_counter() - start
    print(f"shapes:   {made.shapes}, {views} views each at {size} x {size}")
    _print_shards(made.shards, made.kept, out)
    if made.kept < len(made.shards):
        fresh = "" if made.kept else f", {made.shapes * views / seconds:.0f} views a second"
        print(f"time:     {seconds:.1f} s{fresh}")
    _print_skipped(made.skipped, "meshes")


def _jobs(jobs: int) -> int:
    """All cores where joblib is there to let them work, else one."""
    from importlib.util import find_spec

    if jobs == -1 and not find_spec("joblib"):
        print("lsmgeo: one process works; joblib (of the extra data) lets all cores work", file=sys.stderr)
        return 1
    return jobs


# Types of lsmgeo.data are not named here: the parser of the arguments imports what annotations name.
def _print_shards(shards: Sequence[Path], kept: int, out: str) -> None:
    megabytes = sum(path.stat().st_size for path in shards) / 1e6
    print(f"shards:   {len(shards)} in {Path(out).resolve()}, {megabytes:.0f} MB; {kept} were there already")


def _print_skipped(skipped: Sequence[tuple[str, str]], what: str) -> None:
    if skipped:
        print(f"skipped:  {len(skipped)} {what} that cannot be used")
        for path, reason in skipped[:MOST_SKIPPED]:
            print(f"          {path}: {reason}")
        if len(skipped) > MOST_SKIPPED:
            print(f"          and {len(skipped) - MOST_SKIPPED} more")


def _join(address: str, stack: ExitStack) -> None:
    """Hand the work of joblib to a Dask cluster."""
    from lsmgeo.errors import OptionError

    try:
        import joblib
        from distributed import Client
    except ImportError as error:
        raise OptionError("render: cluster needs joblib and distributed; install them first") from error
    try:
        stack.enter_context(Client(address, timeout=CLUSTER_SECONDS))
    except (OSError, ValueError) as error:
        raise OptionError(f"render: no Dask scheduler answers at cluster {address!r} ({error})") from error
    stack.enter_context(joblib.parallel_config("dask"))


def convert(
    scene: str,
    to: Literal["colmap", "transforms", "cameras", "shards"] = "colmap",
    out: str = "lsmgeo-convert",
    splits: str | None = None,
    jobs: int = -1,
) -> None:
    """Write posed photographs in the form that another program reads, straightened where their lens bent them.

    Args:
        scene: posed photographs in any form that lsmgeo reads; for shards, a whole tree of the LSM release or of
            3D-R2N2's renderings.
        to: "colmap" is a COLMAP model as text, "transforms" a transforms.json of instant-ngp and nerfstudio, "cameras"
            a plain JSON of K and world-to-camera matrices; "shards" is a training set, as lsmgeo render makes it.
        out: folder to make for the photographs and their cameras; it must not exist or be empty. Run again, shards go
            on where they were.
        splits: for shards, a splits.json that says what is trained on; by default names decide.
        jobs: for shards, worker processes; -1 takes all cores.
    """
    from lsmgeo import data
    from lsmgeo.errors import OptionError

    if to == "shards":
        made = data.convert_set(scene, out, splits=splits, jobs=_jobs(jobs), progress=True)
        print(f"objects:  {made.shapes}")
        _print_shards(made.shards, made.kept, out)
        _print_skipped(made.skipped, "objects")
        return
    if splits is not None or jobs != -1:
        raise OptionError(f"convert: splits and jobs are for shards; got to={to!r}")
    images = data.open(scene)
    write = {"colmap": data.write_colmap, "transforms": data.write_transforms, "cameras": data.write_cameras_json}[to]
    folder = write(images, out)
    left = [
        what
        for what, there in (
            ("points", images.points is not None and len(images.points.positions) > 0 and to != "colmap"),
            ("depth", images.depths is not None),
            ("voxels", images.voxels is not None),
        )
        if there
    ]
    bent = sum(lens is not None for lens in images.lenses or ())
    print(f"scene:       {len(images)} photographs, {images.source}")
    if bent:
        print(f"straight:    {bent} photographs had distortion and are written without, as PNG")
    if left:
        print(f"left out:    {', '.join(left)}: {to} is written without")
    print(f"written:     {to} in {folder.resolve()}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: by default those of the process.

    Returns:
        The exit status: 0, 1 or 3 as `info` says, 2 after a wrong argument or a file that cannot be used, 130 after an
        interrupt, 141 where what is printed is no longer read.
    """
    import os
    from argparse import ArgumentError

    from lsmgeo.errors import LsmGeoError

    try:
        try:
            return _run(arguments)
        finally:
            if sys.stdout is not None and not sys.stdout.closed:
                sys.stdout.flush()
    except ArgumentError as error:
        print(f"lsmgeo: error: {_reason(str(error))} (see lsmgeo --help)", file=sys.stderr)
        return 2
    except LsmGeoError as error:
        print(f"lsmgeo: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("lsmgeo: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        try:
            sys.stdout.flush()
        except BrokenPipeError:
            # Whoever read has read enough, as head does; what is left to print goes nowhere.
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            return 141
        raise


def _run(arguments: Sequence[str] | None) -> int:
    from importlib.metadata import PackageNotFoundError, version

    from jsonargparse import ActionYesNo, ArgumentParser, auto_cli

    from lsmgeo.commands import evaluate, reconstruct, train

    try:
        release = version("lsmgeo")
    except PackageNotFoundError:
        from lsmgeo import __version__ as release

    class Parser(ArgumentParser):
        """Booleans are flags: ``--quiet`` and ``--no_quiet``."""

        def add_argument(self, *names: Any, **options: Any) -> Any:
            if options.get("type") is bool and names[0].startswith("--"):
                del options["type"]
                options["action"] = ActionYesNo
            return super().add_argument(*names, **options)

    commands: dict[str, Any] = {
        "demo": demo,
        "info": info,
        "reconstruct": reconstruct,
        "convert": convert,
        "render": render,
        "train": train,
        "evaluate": evaluate,
    }
    status = auto_cli(
        commands,
        args=_plain(sys.argv[1:] if arguments is None else arguments, commands.values()),
        parser_class=Parser,
        as_positional=True,
        prog="lsmgeo",
        version=release,
        description="Shape from posed photographs, training sets of rendered shapes, models trained and measured.",
        # Errors come here, to become one line; and an option is what it is called, not how its name begins.
        exit_on_error=False,
        allow_abbrev=False,
    )
    return status if isinstance(status, int) else 0


def _plain(words: Sequence[str], commands: Iterable[Callable[..., object]]) -> list[str]:
    """Arguments as the parser has them: ``--quiet true`` as the flag ``--quiet``, every ``--set`` as one more."""
    parameters = (parameter for command in commands for parameter in signature(command).parameters.values())
    flags = "|".join(sorted({parameter.name for parameter in parameters if parameter.annotation == "bool"}))
    text = "\0".join(words)
    text = re.sub(rf"(?<![^\0])--({flags})[=\0](?i:true|yes)(?![^\0])", r"--\1", text)
    text = re.sub(rf"(?<![^\0])--({flags})[=\0](?i:false|no)(?![^\0])", r"--no_\1", text)
    # jsonargparse appends to a list with "+"; that an option is given again and again is how others do it.
    return re.sub(r"(?<![^\0])--set(?![^=\0])", "--set+", text).split("\0") if words else []


def _reason(message: str) -> str:
    """What the parser of the arguments says over several lines, in one."""
    found = re.match(r'Parser key "(.+?)":(.*?)(?:Given value type:.*?Given|Got) value: ([^\n]*)', message, re.DOTALL)
    if found:
        name, expected, value = found.groups()
        choices = re.search(r"Literal\[(.*?)\]", expected)
        kinds = [words for kind, words in KINDS.items() if f"<class '{kind}'>" in expected]
        if choices or kinds:
            wanted = f"one of {choices[1]}" if choices else " or ".join(kinds)
            message = f"{name} must be {wanted}; got {value!r}"
    message = re.sub(r'^Parser key "(.+?)":', r"\1:", " ".join(message.split()))
    return message if len(message) <= LONGEST_MESSAGE else f"{message[:LONGEST_MESSAGE]} ..."


if __name__ == "__main__":
    sys.exit(main())
