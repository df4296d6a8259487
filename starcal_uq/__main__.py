"""``python -m starcal_uq``: the command line."""

from starcal_uq.cli.app import program

program()
