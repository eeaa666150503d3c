"""Flights in which something begins, flown by the injector: is it named, and with its moment?

Of three kinds: a fault begins in mid-run, a fault is there all the time, nothing is hidden. Other
faults are there all the time in three of four, gusts in every other flight.
"""

import json
import math
import tempfile
import time
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import injector
import numpy as np
from injector_air import Air

from coax_env.diagnosis.diagnose import diagnose
from study.judge import tied
from study.pairs import FAULTS, wilson
from study.plan import sizes_of

RUNS = ("lon_3211", "lat_3211", "heave_3211", "yaw_3211")
LONGEST = 12.0
"""s of each run: 48 s a flight, for time."""
KINDS = ("begins", "constant", "clean")
BEGINS = (
    "swash_offset", "torque_balance", "gyro_bias", "thrust_scale", "cg_offset", "attitude_bias",
    "added_mass", "motor_lag", "accel_bias", "servo_play", "swash_gain", "servo_lag",
)  # fmt: skip
"""What may begin: rigging, blades, sensors, payload, motors, servos, play."""
EARLIEST, LATEST = 3.0, 9.0
"""s of the run in which it begins."""


@dataclass(frozen=True)
class Planned:
    """One flight of the study. fault: what begins at `since`, or is there all the time."""

    kind: str
    number: int
    fault: dict[str, dict[str, float]]
    others: dict[str, dict[str, float]]
    since: tuple[str, float]
    air: dict[str, Any]
    seed: int

    @property
    def name(self) -> str:
        """Of the file that it is stored in."""
        return f"onset-{self.kind}-{self.number:04d}"


def planned(kind: str, number: int, seed: int) -> Planned:
    """A flight, drawn from the study's seed, its kind and its number alone."""
    rng = np.random.default_rng([seed, 1000 + KINDS.index(kind), number])
    fault = BEGINS[number % len(BEGINS)]
    sizes = sizes_of(fault, rng)
    others = FAULTS[int(rng.integers(len(FAULTS)))]
    others = {e: dict(p) for e, p in others.items() if not tied(e, fault)}
    since = (RUNS[int(rng.integers(1, 3))], round(float(rng.uniform(EARLIEST, LATEST)), 2))
    air: dict[str, Any] = {"gusts": "none"}
    if number % 2:
        scale = float(rng.uniform(0.5, 1.5))
        air = {
            "gusts": "markov", "force": 0.2 * scale, "moment_xy": 0.006 * scale,
            "moment_z": 0.003 * scale, "memory": rng.uniform(0.2, 1.0, 2).tolist(),
        }  # fmt: skip
    hidden = {} if kind == "clean" else {fault: sizes}
    return Planned(
        kind, number, hidden, others if hidden else {}, since, air, int(rng.integers(2**31))
    )


def fly_and_diagnose(plan: Planned) -> dict[str, Any]:
    """The row of a flight; a failure is a row with `error`."""
    row: dict[str, Any] = {"plan": json.loads(json.dumps(asdict(plan)))}
    air = {**plan.air, "memory": tuple(plan.air["memory"])} if "memory" in plan.air else plan.air
    begins = plan.kind == "begins"
    try:
        with tempfile.TemporaryDirectory() as folder:
            injector.fly(
                folder, plan.others if begins else {**plan.others, **plan.fault},
                gusts=Air(**air), seed=plan.seed, runs=RUNS, longest=LONGEST,
                later=plan.fault if begins else None, since=plan.since if begins else ("", 0.0),
            )  # fmt: skip
            began = time.process_time()
            findings = diagnose(folder, hold_out=[]).findings
    except Exception:
        return row | {"error": traceback.format_exc()}
    return row | {"causes": findings["causes"], "seconds": time.process_time() - began}


# --- judged -----------------------------------------------------------------------------------------


def judged(row: Mapping[str, Any]) -> dict[str, Any]:
    """One row: what was named, since when, and what was named falsely."""
    plan, causes = row["plan"], row["causes"]
    hidden = [*plan["fault"], *plan["others"]]
    mine = [c for c in causes if any(tied(c["effect"], e) for e in plan["fault"])]
    begun = [c for c in mine if c["since"]] if plan["kind"] == "begins" else []
    error = None
    held = False
    if begun:
        since, (run, t) = begun[0]["since"], plan["since"]
        same = since["run"] == run
        error = abs(since["t"] - t) if same else math.inf
        held = error <= 1.96 * since["std"]
    return {
        "named": bool(mine),
        "since": bool(begun),
        "error": error,
        "held": held,
        "false": [
            c["effect"] for c in causes if not any(tied(c["effect"], truth) for truth in hidden)
        ],
        "false_since": [c["effect"] for c in causes if c["since"] and c not in begun],
    }


def text_of(rows: Sequence[Mapping[str, Any]]) -> str:
    """The figures of all rows, and every one that is not as it should be."""
    good = [(r, judged(r)) for r in rows if "causes" in r]
    of = {kind: [j for r, j in good if r["plan"]["kind"] == kind] for kind in KINDS}
    since = [j for j in of["begins"] if j["since"]]
    constant = of["constant"] + of["clean"]
    lines = ["| figure | right | of | share | 95 % interval |", "|---|---|---|---|---|"]
    for words, right, count in (
        ("begins in mid-run: named", sum(j["named"] for j in of["begins"]), len(of["begins"])),
        ("and with its moment", len(since), len(of["begins"])),
        ("the moment within its 95 % interval", sum(j["held"] for j in since), len(since)),
        ("a false name where it begins", sum(bool(j["false"]) for j in of["begins"]),
         len(of["begins"])),
        ("a false moment where it begins", sum(bool(j["false_since"]) for j in of["begins"]),
         len(of["begins"])),
        ("constant: a moment", sum(bool(j["false_since"]) for j in of["constant"]),
         len(of["constant"])),
        ("clean: a moment", sum(bool(j["false_since"]) for j in of["clean"]), len(of["clean"])),
        ("constant or clean: a false name", sum(bool(j["false"]) for j in constant), len(constant)),
    ):  # fmt: skip
        low, high = wilson(right, count)
        share = f"{100 * right / count:.0f} %" if count else "-"
        lines.append(
            f"| {words} | {right} | {count} | {share} | {100 * low:.0f} to {100 * high:.0f} % |"
        )
    if since:
        errors = [j["error"] for j in since]
        lines += ["", f"Median error of the moment: {float(np.median(errors)):.3f} s."]
    lines += ["", f"{len(rows) - len(good)} failed.", ""]
    return "\n".join([*lines, *(_remark(r, j) for r, j in good if _is_off(r, j))]) + "\n"


def _is_off(row: Mapping[str, Any], j: Mapping[str, Any]) -> bool:
    missed = row["plan"]["kind"] == "begins" and not (j["since"] and j["held"])
    return bool(missed or j["false"] or j["false_since"])


def _remark(row: Mapping[str, Any], j: Mapping[str, Any]) -> str:
    plan = row["plan"]
    said = [(c["effect"], round(c["evidence"], 1), c["since"]) for c in row["causes"]]
    return (
        f"- {plan['kind']} {plan['number']} {plan['fault']} {plan['since']} beside"
        f" {list(plan['others'])} ({plan['air']['gusts']}): {said}"
    )
