"""The command line."""

from starcal_uq import __version__

# From the package: the installed metadata say the same, and take ten times as long to read.
VERSION_LINE = f"starcal-uq {__version__}"
