"""The command line: parse, call the API, print. See docs/cli.md."""

from kalux.cli.app import main

__all__ = ["main"]
