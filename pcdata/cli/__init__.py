"""The command line: thin layers that parse, call and print; one module for each group of commands."""

from pcdata.cli.main import main

__all__ = ["main"]
