"""The command line: `main`, and one file a command. Heavy imports wait until a command runs."""

from lsmgeo.cli.main import main

__all__ = ["main"]
