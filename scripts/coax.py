"""The scripts' verbs as one command: `coax diagnose FLIGHT` is `scripts/diagnose.py FLIGHT`."""

import ast
import runpy
import sys
from pathlib import Path
from typing import NoReturn

import coax_env
from coax_env.errors import InputError

FOLDER = Path(__file__).resolve().parent
VERBS = (
    "demo", "simulate", "import_log", "check_flight", "replay", "diagnose", "identify",
    "plan_flight", "design_lqr", "train_ppo", "evaluate", "compare_models", "export",
)  # fmt: skip
"""Scripts that need nothing but the package; studies and benchmark also need its sources."""


def main() -> NoReturn:
    if str(FOLDER) not in sys.path:
        sys.path.insert(0, str(FOLDER))
    import command_line

    command_line.called_as_verb = True
    try:
        command_line.run(dispatch)
    finally:
        command_line.called_as_verb = False


def dispatch() -> None:
    """Run the verb's script with the words behind it."""
    words = sys.argv[1:]
    if not words or words[0] in ("-h", "--help"):
        print(usage())
        return
    if words[0] == "--version":
        print(f"coax {coax_env.__version__}")
        return
    verb = words[0].replace("-", "_")
    if verb not in VERBS:
        raise InputError(f"no verb {words[0]!r}; there are {', '.join(VERBS)}")
    sys.argv = [f"coax {verb}", *words[1:]]
    runpy.run_path(str(FOLDER / f"{verb}.py"), run_name="__main__")


def usage() -> str:
    """The verbs, each with the first line of its script."""
    lines = ["usage: coax VERB ...   (coax VERB --help says more; results go to --out DIR)", ""]
    for verb in VERBS:
        text = (FOLDER / f"{verb}.py").read_text(encoding="utf-8")
        summary = (ast.get_docstring(ast.parse(text)) or "").partition("\n")[0]
        lines.append(f"  {verb:14s} {summary}")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
