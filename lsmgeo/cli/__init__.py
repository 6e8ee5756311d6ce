"""The command line: `main`, and one file per command. Heavy modules are imported when a command runs."""

from lsmgeo.cli.main import main

__all__ = ["main"]
