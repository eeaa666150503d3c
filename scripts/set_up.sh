# Sourced by scripts/demo and scripts/test: makes .venv complete, at no cost when it already is.
# Sets ROOT and PYTHON. A stamp, written last, says which pins this .venv was finished with; a mark
# that is still there says that an install was cut short, and the .venv is then made anew.
# Packages come without bytecode, which takes longer to make for all of them than they take to come:
# Python makes that of what is imported.

unset PYTHONDONTWRITEBYTECODE # else every program parses every module anew

ROOT="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
PYTHON="$ROOT/.venv/bin/python"
CONSTRAINTS="$ROOT/scripts/constraints.txt"
STAMP="$ROOT/.venv/coax.stamp"
UNFINISHED="$ROOT/.venv/coax.unfinished"

# What .venv depends on: its place, the declared packages and their pins.
wanted_stamp() {
    { echo "$ROOT"; cat "$ROOT/pyproject.toml" "$CONSTRAINTS"; } | cksum
}

is_set_up() {
    [ -x "$PYTHON" ] && [ "$(cat "$STAMP" 2>/dev/null)" = "$(wanted_stamp)" ]
}

# The first python that is new enough and can make environments.
find_python() {
    local candidate
    for candidate in python3.11 python3 python3.12 python3.13; do
        if "$candidate" -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' \
            >/dev/null 2>&1; then
            echo "$candidate"
            return
        fi
    done
    echo "error: needs python 3.11 or newer with its venv module; found $(python3 -V 2>&1)" >&2
    return 1
}

install_packages() {
    "$PYTHON" -c 'import pip' 2>/dev/null || return 1
    touch "$UNFINISHED"
    local pip=("$PYTHON" -m pip install -qq --disable-pip-version-check --no-compile -c "$CONSTRAINTS")
    "${pip[@]}" setuptools && "${pip[@]}" --no-build-isolation -e "$ROOT" || return 1
    fill_cache & # all that it needs is there
    local compiling=$!
    # torch first, at the pin of the constraints, so that nothing else chooses a build of it
    if ! { "${pip[@]}" torch && "${pip[@]}" --no-build-isolation -e "$ROOT[rl,report,render,dev]"; }; then
        kill "$compiling" 2>/dev/null
        return 1
    fi
    wait "$compiling" || true # whoever needs the kernel says what is wrong with it
}

# Compiles what a diagnosis calls, where that has not been done.
fill_cache() {
    (cd "$ROOT" && "$PYTHON" -c "from coax_env.estimation.compile_ahead import fill_cache; fill_cache()")
}

set_up() {
    local base
    if [ -e "$UNFINISHED" ] || ! install_packages; then # nothing there, or only half of it
        base="$(find_python)" || return 1
        "$base" -m venv --clear "$ROOT/.venv" && install_packages ||
            { echo "error: could not install the packages into $ROOT/.venv" >&2; return 1; }
    fi
    wanted_stamp >"$STAMP"
    rm -f "$UNFINISHED"
}

if ! is_set_up; then
    echo "setting up $ROOT/.venv (once, a few minutes)" >&2
    ( # one at a time: whoever waited finds it done
        if command -v flock >/dev/null; then flock 9; fi
        is_set_up || set_up
    ) 9>"$ROOT/.venv.lock" || exit 1
fi
