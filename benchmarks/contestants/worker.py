"""One contestant in a process of its own: prepares, then runs whenever it is told to.

    python worker.py FILE FUNCTION FOLDER OPTIONS

`FILE` is a module of this folder, and ``FUNCTION(FOLDER, **OPTIONS)`` prepares and returns what is
to be timed. The answers are lines of JSON: ready, then for every ``go`` the times, the peak of
memory and the result, until ``end``. Python's standard library alone, because the interpreter may
be any.
"""

import importlib
import json
import os
import pathlib
import resource
import sys
import time
import traceback


class Missing(Exception):  # noqa: N818 (no error: a rival that is not there)
    """The contestant cannot run here; the message says why."""


def plain(value):
    """What JSON knows."""
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    return value.tolist() if hasattr(value, "tolist") else value


def processor_seconds():
    """Of this process, all its threads, and its finished children."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def peak_mb():
    """Largest memory of this process or of one of its finished children."""
    unit = 1.0 if sys.platform == "darwin" else 1024.0
    own = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
    try:
        # Linux counts what the parent held before the program was replaced; the kernel's own mark
        # does not.
        with open("/proc/self/status", encoding="ascii") as status:
            own = next(
                1024.0 * float(line.split()[1]) for line in status if line.startswith("VmHWM")
            )
    except (OSError, StopIteration):
        pass
    return max(own, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * unit) / 1e6


def main():
    """Serve."""
    # What a library prints must not get between the lines of the protocol.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)

    if os.environ.get("ONE_CORE") and hasattr(os, "sched_setaffinity"):
        # Some libraries take no other hint.
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})

    def say(**message):
        answers.write(json.dumps(plain(message)) + "\n")
        answers.flush()

    try:
        prepare = getattr(importlib.import_module(sys.argv[1]), sys.argv[2])
        run = prepare(pathlib.Path(sys.argv[3]), **json.loads(sys.argv[4]))
    except (ImportError, Missing, AttributeError) as error:
        say(
            missing=f"{type(error).__name__}: {error}"
            if not isinstance(error, Missing)
            else str(error)
        )
        return
    say(ready=True)
    for line in sys.stdin:
        if line.strip() == "end":
            break
        try:
            wall, processor = time.perf_counter(), processor_seconds()
            result = run()
            wall, processor = time.perf_counter() - wall, processor_seconds() - processor
            # A contestant that starts processes may know their sum.
            say(
                wall=wall,
                processor=processor,
                peak_mb=result.pop("peak_mb", peak_mb()),
                result=result,
            )
        except Exception as error:
            traceback.print_exc()
            say(failed=f"{type(error).__name__}: {error}")
            return


if __name__ == "__main__":
    # `Missing` of the contestants is that of the module of this name.
    from worker import main as served

    served()
