"""Ratios measured in one run: speed of the env against others, its start, and what effects cost.

Without --peers in under three minutes; --diagnosis and --training take two more each, --growth and
--before half an hour on a slow core. With --peers other simulators are installed, each into a venv of
its own (a gigabyte each, once), and flown in turns with ours: ours, peer, ours, peer; the best of all
rounds counts. Everyone flies random actions in their own vector env with their own settings, which the
table states. Vehicles with effects, in wind, and drawn fly in turns with the bare one. Absolute times
depend on the machine and its neighbours; compare ratios only.
"""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import command_line
from speed import diagnosis_times, peers

from coax_env.errors import InputError
from coax_env.files import write_json

SCRIPTS = Path(__file__).resolve().parent
PACKAGE = SCRIPTS.parent / "coax_env"
PROGRAMS = SCRIPTS / "speed"
OURS = "coax"
LIMIT = 300.0  # [s] for one program

TIMER = """
import json, time
import numba, numpy as np
from coax_env.model import dynamics
from coax_env.model.vehicle_file import load_vehicle

def many_of(step):
    @numba.njit
    def many(x, u, p, work, n):
        for _ in range(n):
            step(x, u, 0.01, p, work, x)
    return many

bare = load_vehicle("lama400d")
state, command = dynamics.hover_trim(bare)
u, work = dynamics.kernel_input(command), np.zeros(dynamics.WORK_SIZE)
x = dynamics.full_state(state, command, bare)
kinds = {"step": many_of(dynamics.step), "step_bare": many_of(dynamics.step_bare)}
best = dict.fromkeys(kinds, np.inf)
n = 50_000
for k in range(40):
    for name, many in kinds.items():
        y = x.copy()
        start = time.perf_counter()
        many(y, u, bare.vector, work, n if k else 1)
        if k:
            best[name] = min(best[name], (time.perf_counter() - start) / n * 1e6)
print(json.dumps(best))
"""


@dataclass(frozen=True)
class Contender:
    """A program that flies one simulator, and the Python that has it."""

    name: str
    python: Path
    program: str
    plays: Sequence[str] = ("many", "one", "start")


@dataclass(frozen=True)
class Row:
    """One comparison. ``mode`` as in speed/timing.py; ``fewer``: less is better."""

    title: str
    mode: str
    unit: str = "/s"
    fewer: bool = False


ROWS = (
    Row("env-steps, many envs", "many"),
    Row("env.step, one env", "one"),
    Row("import to first step, warm", "start", "s", fewer=True),
)


def main() -> None:
    parser = command_line.parser("benchmark", __doc__)
    parser.add_argument(
        "--peers", action="store_true", help="install other simulators, fly them too"
    )
    parser.add_argument("--diagnosis", action="store_true",
                        help="time diagnoses of 12 runs in gusts too")  # fmt: skip
    parser.add_argument("--growth", action="store_true",
                        help="time diagnoses of 12, 48 and 200 runs, and their memory")  # fmt: skip
    parser.add_argument("--before", type=Path, metavar="DIR",
                        help="with --diagnosis: a checkout to compare with")  # fmt: skip
    parser.add_argument("--training", action="store_true",
                        help="time PPO from nothing on each vehicle too")  # fmt: skip
    parser.add_argument("--only", nargs="+", metavar="PEER", help="only these (with --peers)")
    parser.add_argument("--venvs", type=Path, default=Path("runs/peers"), metavar="DIR",
                        help="where the peers' venvs are kept (default: %(default)s)")  # fmt: skip
    parser.add_argument("--sources", type=Path, metavar="DIR",
                        help="checkouts of peers that PyPI does not have, by name")  # fmt: skip
    parser.add_argument("--envs", type=int, default=4096, help="in a vector env (default: 4096)")
    parser.add_argument("--rounds", type=int, default=3, help="turns each (default: 3)")
    parser.add_argument("--seconds", type=float, default=2.0, help="of a turn (default: 2)")
    options = parser.parse_args()
    if min(options.envs, options.rounds) < 1 or options.seconds <= 0.0:
        raise InputError("--envs, --rounds and --seconds must be positive")
    load = os.getloadavg()[0]
    ours = Contender(OURS, Path(sys.executable), "fly_coax.py")
    with command_line.progress("benchmark") as report_progress:
        others, absent = find_peers(options, report_progress) if options.peers else ([], {})
        rows: dict[str, Any] = {}
        for row in ROWS:
            flown = [ours, *(c for c in others if row.mode in c.plays)]
            rows[row.title] = in_turns(flown, row, options, report_progress)
        report_progress("the kernel alone, a cold start, effects off")
        kernel = in_turns([ours], Row("kernel", "kernel"), options, report_progress)[OURS]
        cold = cold_start()
        steps = effects_off()
        report_progress("vehicles with effects, in wind, drawn")
        vehicles = in_one_process("fly", options.envs, 4 * options.rounds)
        if options.training:
            report_progress("PPO on each of them")
        trained = in_one_process("train", 1, options.rounds) if options.training else {}
        diagnoses = (
            diagnosis_times.measure(report_progress, options.before) if options.diagnosis else []
        )
        diagnoses += diagnosis_times.growth(report_progress) if options.growth else []
    result = {
        "load_average": load, "processors": os.cpu_count(), "envs": options.envs, "rows": rows,
        "kernel": kernel, "cold_start_s": cold, "absent": absent,
        "vehicles": vehicles, "training": trained, "diagnoses": diagnoses, **steps,
    }  # fmt: skip
    write_json(options.out / "benchmark.json", result)
    command_line.print_columns(table(result))
    for name, why in absent.items():
        print(f"{name}: not measured: {why}")


def find_peers(options: Any, report_progress: Any) -> tuple[list[Contender], dict[str, str]]:
    """Install what can be installed; the rest with the reason why not."""
    names = [peer.name for peer in peers.PEERS]
    if unknown := set(options.only or ()) - set(names):
        raise InputError(f"no peer {sorted(unknown)[0]!r}: choose from {', '.join(names)}")
    found, absent = [], {}
    for peer in peers.PEERS:
        if options.only and peer.name not in options.only:
            continue
        report_progress(f"installing {peer.name}")
        try:
            python = peers.install(peer, options.venvs.resolve(), options.sources)
            found.append(Contender(peer.name, python, peer.program, peer.plays))
        except peers.Unavailable as why:
            absent[peer.name] = str(why)
    return found, absent


def in_turns(
    contenders: Sequence[Contender], row: Row, options: Any, report_progress: Any
) -> dict[str, dict[str, Any]]:
    """The best of all rounds of each contender, who take turns; or why one has no number.

    Args:
        contenders: who takes part. row: what is compared.
        options: the command line's: envs, seconds of a turn, rounds.
        report_progress: called with a line before each turn.
    """
    best: dict[str, dict[str, Any]] = {}
    for k in range(options.rounds):
        for contender in contenders:
            report_progress(f"{row.title}: {contender.name}, round {k + 1} of {options.rounds}")
            if "failed" in best.get(contender.name, {}):
                continue
            found = fly(contender, row.mode, options.envs, options.seconds)
            known = best.setdefault(contender.name, found)
            if "failed" in found or (found["value"] < known["value"]) == row.fewer:
                best[contender.name] = found
    return best


def fly(contender: Contender, mode: str, envs: int, seconds: float) -> dict[str, Any]:
    """What a program of speed/ prints, from a fresh interpreter.

    Args:
        contender: whose program. mode: as in speed/timing.py.
        envs: in a vector env. seconds: that are flown [s].
    """
    environment = peers.clean_environment()
    if contender.name == OURS:
        environment["PYTHONPATH"] = str(PACKAGE.parent)
    call = [contender.python, PROGRAMS / contender.program, mode, str(envs), str(seconds)]
    try:
        done = subprocess.run(
            list(map(str, call)), env=environment, capture_output=True, text=True, timeout=LIMIT,
            cwd=tempfile.gettempdir(),  # MuJoCo writes a log where it stands
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return {"failed": f"no answer in {LIMIT:.0f} s"}
    if done.returncode:
        return {"failed": peers.reason(done.stderr)}
    return json.loads(done.stdout.splitlines()[-1])


def table(result: dict[str, Any]) -> list[list[str]]:
    """The rows of the table: what, who, figure, ratio to ours, and how it was flown."""
    lines = [["", "who", "figure", "ours is", "envs", "control", "physics steps", ""]]
    for row in ROWS:
        flown = result["rows"][row.title]
        for name, found in flown.items():
            if "failed" in found:
                lines.append([row.title, name, "-", "", "", "", "", found["failed"]])
                continue
            ratio = flown[OURS].get("value", float("nan")) / found["value"]
            lines.append([
                row.title, name, figure(found["value"], row.unit),
                "" if name == OURS else times(1.0 / ratio if row.fewer else ratio, row.fewer),
                str(found["count"]), f"{found['control_hz']:.0f} Hz",
                str(found["physics_steps"]), found["note"],
            ])  # fmt: skip
            if "bytes_per_env" in found:
                memory = f"{found['bytes_per_env'] / 1e3:.1f} kB per env"
                lines.append(["memory, resident", name, memory, *[""] * 5])
    kernel = result["kernel"]
    many = result["rows"][ROWS[0].title][OURS]
    if "value" in kernel and "value" in many:
        share = f"{many['value'] / kernel['value']:.2f} of it in the env"
        lines.append(["dynamics alone, many rows", OURS, figure(kernel["value"], "/s"), "",
                      str(kernel["count"]), "100 Hz", "1", share])  # fmt: skip
    cold = result["cold_start_s"]
    lines.append(["import to first step, cold", OURS, figure(cold, "s"), *[""] * 5])
    off = 100.0 * (result["effects_off_ratio"] - 1.0)
    lines.append(["effects off, against cut out", OURS, f"{off:+.1f} %", *[""] * 5])
    for what, flown in (("env-steps", result["vehicles"]), ("PPO", result["training"])):
        bare = flown.get("bare")
        for name, value in flown.items():
            share = f"{value / bare:.2f} of bare"
            lines.append([f"{what}, {name}", OURS, figure(value, "/s"), *[""] * 4, share])
    for row in result["diagnoses"]:
        facts = [f"{1e3 * row['seconds'] / row['flown_s']:.0f} ms per second flown"]
        if "before" in row:
            facts.append(f"{row['seconds'] / row['before']:.2f} of before")
        if "memory_mb" in row:
            facts.append(f"{row['memory_mb']:.0f} MB")
        lines.append([
            f"diagnosis of {row['runs']} runs, {len(row['hidden'])} hidden, {len(row['named'])} named",
            OURS, figure(row["seconds"], "s"), "", "", "", "", ", ".join(facts),
        ])  # fmt: skip
    return lines


def figure(value: float, unit: str) -> str:
    """Three digits."""
    return f"{value:,.0f} {unit}" if value >= 100.0 else f"{value:.3g} {unit}"


def times(ratio: float, fewer: bool) -> str:
    """How many times better ours is."""
    return f"{ratio:.3g} x {'quicker' if fewer else 'faster'}"


def cold_start() -> float:
    """Seconds from import to first step with an empty cache."""
    with tempfile.TemporaryDirectory() as folder:
        environment = peers.clean_environment()
        environment |= {"PYTHONPATH": str(PACKAGE.parent), "COAX_CACHE_DIR": folder}
        done = subprocess.run(
            [sys.executable, str(PROGRAMS / "fly_coax.py"), "start", "1", "1"],
            env=environment, capture_output=True, text=True, check=True,
        )  # fmt: skip
    return json.loads(done.stdout.splitlines()[-1])["value"]


def in_one_process(mode: str, envs: int, rounds: int) -> dict[str, float]:
    """Steps per second of the vehicles of speed/fly_vehicles.py, in turns.

    Args:
        mode: "fly" or "train". envs: in a vector env. rounds: turns each.
    """
    call = [sys.executable, PROGRAMS / "fly_vehicles.py", mode, str(envs), str(rounds)]
    done = subprocess.run(
        list(map(str, call)), capture_output=True, text=True, check=True,
        env=peers.clean_environment() | {"PYTHONPATH": str(PACKAGE.parent)},
    )  # fmt: skip
    return json.loads(done.stdout.splitlines()[-1])


def effects_off() -> dict[str, Any]:
    """What a step costs with all effects off, and without their calls (one source, compiled twice)."""
    done = subprocess.run(
        [sys.executable, "-c", TIMER], capture_output=True, text=True, check=True,
        env=peers.clean_environment() | {"PYTHONPATH": str(PACKAGE.parent)},
    )  # fmt: skip
    microseconds = json.loads(done.stdout)
    return {
        "step_us": microseconds,
        "effects_off_ratio": microseconds["step"] / microseconds["step_bare"],
    }


if __name__ == "__main__":
    command_line.run(main)
