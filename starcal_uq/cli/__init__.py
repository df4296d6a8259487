"""The command line."""

from pathlib import Path

from starcal_uq import __version__

# From the package: the installed metadata say the same, and take ten times as long to read.
VERSION_LINE = f"starcal-uq {__version__}"
# What `--help` of the program prints, which takes less time than to load the commands.
HELP = Path(__file__).with_name("help.txt")
