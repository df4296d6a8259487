#!/bin/sh
# Print the path of a Python interpreter that can host a virtual environment.
#
#   find_python.sh [PYTHON]                    the main interpreter: PYTHON if it is suitable, else the newest found
#   find_python.sh --other MAIN [PYTHON]       one of the other ArviZ generation than MAIN (Python 3.11 has ArviZ 0.23,
#                                              3.12 and newer have ArviZ 1); prints nothing where there is none, or
#                                              where PYTHON is "none"
#
# A candidate counts only if it runs: a name on PATH may be a shim for a version that is not installed.
set -u

new_enough='import sys; sys.exit(sys.version_info < (3, 11))'
first_generation='import sys; sys.exit(sys.version_info >= (3, 12))'
second_generation='import sys; sys.exit(sys.version_info < (3, 12))'
where='import sys; print(sys.executable)'
version='import sys; print("%d.%d" % sys.version_info[:2])'

passes() { # passes INTERPRETER CODE
    command -v "$1" >/dev/null 2>&1 && "$1" -c "$2" >/dev/null 2>&1
}

makes_environments() { # Debian and Ubuntu ship Python without the modules for it
    passes "$1" 'import ensurepip, venv'
}

find_other() { # find_other MAIN [PYTHON]
    wanted=$first_generation
    passes "$1" "$first_generation" && wanted=$second_generation
    case "${2:-}" in
    none)
        return 0
        ;;
    ?*)
        if ! { passes "$2" "$new_enough" && makes_environments "$2"; }; then
            echo "ALT_PYTHON=$2 does not run, is older than Python 3.11 or cannot make virtual environments." >&2
            return 1
        fi
        "$2" -c "$where"
        return 0
        ;;
    esac
    for candidate in python3.13 python3.12 python3.11 python3 "${PYENV_ROOT:-${HOME:-}/.pyenv}"/versions/*/bin/python; do
        if passes "$candidate" "$new_enough" && passes "$candidate" "$wanted" && makes_environments "$candidate"; then
            "$candidate" -c "$where"
            return 0
        fi
    done
}

find_main() { # find_main [PYTHON]
    if [ -n "${1:-}" ] && ! passes "$1" "$new_enough"; then
        echo "PYTHON=$1 does not run or is older than Python 3.11; looking for another." >&2
    fi
    bare=
    for candidate in "${1:-}" python3.13 python3.12 python3.11 python3 python; do
        [ -n "$candidate" ] && passes "$candidate" "$new_enough" || continue
        if makes_environments "$candidate"; then
            "$candidate" -c "$where"
            return 0
        fi
        bare=${bare:-$candidate}
    done
    if [ -n "$bare" ]; then
        echo "$(command -v "$bare") cannot make virtual environments: install its venv package" \
            "(on Debian and Ubuntu: apt install python$("$bare" -c "$version")-venv)," \
            "or name another interpreter with make PYTHON=/path/to/python3." >&2
    else
        echo "No Python 3.11 or newer was found: install one," \
            "or name it with make PYTHON=/path/to/python3." >&2
    fi
    return 1
}

if [ "${1:-}" = --other ]; then
    find_other "$2" "${3:-}"
else
    find_main "${1:-}"
fi
