"""Imported by pages that show commands: `!command` runs this installation's and wraps long lines."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from pathlib import Path

from IPython import get_ipython

PATH = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
COLOURS = ("FORCE_COLOR", "CLICOLOR", "CLICOLOR_FORCE")
ENVIRONMENT = {name: value for name, value in os.environ.items() if name not in COLOURS}
ENVIRONMENT |= {"PATH": PATH, "COLUMNS": "110", "NO_COLOR": "1", "TERM": "dumb"}


def run_command(command: str) -> None:
    """Run a command that writes to a pipe, as into a log file, and print its output."""
    run = subprocess.run(
        command,
        shell=True,
        env=ENVIRONMENT,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    for line in run.stdout.splitlines():
        words = line[:1].isalpha()
        print(*(textwrap.wrap(line, 88, subsequent_indent="  ") if words else [line]), sep="\n")


get_ipython().system = run_command
