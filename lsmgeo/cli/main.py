"""The command line: its arguments, its errors in one line, and its exit status."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterable, Sequence
from inspect import signature
from typing import Any

__all__ = ["main"]

KINDS = {"int": "a whole number", "float": "a finite number"}
LONGEST_MESSAGE = 300


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: by default those of the process.

    Returns:
        The exit status: that of the command, 2 after a wrong argument or a file that cannot be used, 130 after an
        interrupt, 141 if the output is closed.
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
            # The reader of the output, such as head, has closed it.
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            return 141
        raise


def _run(arguments: Sequence[str] | None) -> int:
    from importlib.metadata import PackageNotFoundError, version

    from jsonargparse import ActionYesNo, ArgumentParser, auto_cli

    from lsmgeo.cli.convert_command import convert
    from lsmgeo.cli.demo_command import demo
    from lsmgeo.cli.evaluate_command import evaluate
    from lsmgeo.cli.info_command import info
    from lsmgeo.cli.reconstruct_command import reconstruct
    from lsmgeo.cli.render_command import render
    from lsmgeo.cli.train_command import train

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
        description="Shape from posed photos; training sets of rendered shapes; training and testing of models.",
        # Errors are caught in `main`; options must be written in full.
        exit_on_error=False,
        allow_abbrev=False,
    )
    return status if isinstance(status, int) else 0


def _plain(words: Sequence[str], commands: Iterable[Callable[..., object]]) -> list[str]:
    """Arguments in the form of the parser: ``--quiet true`` becomes ``--quiet``, and ``--set`` appends."""
    parameters = (parameter for command in commands for parameter in signature(command).parameters.values())
    flags = "|".join(sorted({parameter.name for parameter in parameters if parameter.annotation == "bool"}))
    text = "\0".join(words)
    text = re.sub(rf"(?<![^\0])--({flags})[=\0](?i:true|yes)(?![^\0])", r"--\1", text)
    text = re.sub(rf"(?<![^\0])--({flags})[=\0](?i:false|no)(?![^\0])", r"--no_\1", text)
    # jsonargparse appends to a list with "+"; other command lines do so for a repeated option.
    return re.sub(r"(?<![^\0])--set(?![^=\0])", "--set+", text).split("\0") if words else []


def _reason(message: str) -> str:
    """A message of the parser, which may have several lines, in one line."""
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
