"""Ratios measured in one run: what effects cost when off, and the speed of step, env and estimator.

Absolute times depend on the machine and its neighbours; compare ratios only.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import command_line

from coax_env.files import write_json

PACKAGE = Path(__file__).resolve().parent.parent / "coax_env"
ROUNDS = 5

TIMER = """
import json, time
import numba, numpy as np
from coax_env import dynamics
from coax_env.vehicle import load_vehicle

@numba.njit
def many(x, u, p, work, n):
    for _ in range(n):
        dynamics.step(x, u, 0.01, p, work, x)

def seconds(vehicle, n=100_000):
    state, command = dynamics.hover_trim(vehicle)
    u, work = dynamics.kernel_input(command), np.zeros(dynamics.WORK_SIZE)
    x = dynamics.full_state(state, command, vehicle)
    best = np.inf
    for _ in range(15):
        y = x.copy()
        start = time.perf_counter()
        many(y, u, vehicle.vector, work, n)
        best = min(best, time.perf_counter() - start)
    return best / n * 1e6

bare = load_vehicle("lama400d")
many(dynamics.full_state(*dynamics.hover_trim(bare), bare),
     dynamics.kernel_input(dynamics.hover_trim(bare)[1]), bare.vector, np.zeros(dynamics.WORK_SIZE), 1)
print(json.dumps(seconds(bare)))
"""


def main() -> None:
    parser = command_line.parser("benchmark", __doc__)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        stripped = Path(folder) / "coax_env"
        shutil.copytree(PACKAGE, stripped, ignore=shutil.ignore_patterns("__pycache__", "flights"))
        strip_effects(stripped / "dynamics.py")
        times: dict[str, list[float]] = {"with": [], "without": []}
        for _ in range(ROUNDS):
            times["with"].append(step_microseconds(PACKAGE.parent))
            times["without"].append(step_microseconds(Path(folder)))
    ratio = min(times["with"]) / min(times["without"])
    write_json(options.out / "benchmark.json", {"step_us": times, "effects_off_ratio": ratio})
    print(f"one step of 10 ms: {min(times['with']):.2f} us with all effects off, "
          f"{min(times['without']):.2f} us with the effects' calls cut out: "
          f"{100 * (ratio - 1):+.1f} %")  # fmt: skip


def strip_effects(path: Path) -> None:
    """Cut every call of a stage of effects out of a copy of the kernel."""
    text = path.read_text()
    cut, count = re.subn(
        r"\n +if (with_effects and )?p\[effects\.[A-Z]+\] != 0\.0:"
        r"\n +_[a-z]+_(effects|terms)\(x, f, p\)",
        "",
        text,
    )
    if count != 7:
        raise RuntimeError(f"expected 7 stages of effects in {path.name}, found {count}")
    switch = "if flown + p[effects.UNLISTED] != 0.0:"
    if switch not in cut:
        raise RuntimeError(f"the switch between the two rates is not in {path.name}")
    path.write_text(cut.replace(switch, "if False:"))


def step_microseconds(root: Path) -> float:
    """Best time of one step in a fresh interpreter that sees this copy of the package."""
    environment = {**os.environ, "PYTHONPATH": str(root), "COAX_CACHE_DIR": str(root / ".cache")}
    if root == PACKAGE.parent:
        environment.pop("COAX_CACHE_DIR")
    done = subprocess.run(
        [sys.executable, "-c", TIMER], env=environment, cwd=root, capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    return float(done.stdout)


if __name__ == "__main__":
    command_line.run(main)
