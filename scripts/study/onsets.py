"""Flights in which something begins, flown by the injector: is it named, and with its moment?

Of five kinds: a fault begins in mid-run, ends there, grows from there on, is there all the time, or
nothing is hidden. Other faults are there all the time in three of four, gusts in every other flight.
"""

import json
import math
import tempfile
import time
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import injector
import numpy as np
from injector_air import Air

from coax_env.diagnosis.diagnose import diagnose
from coax_env.diagnosis.settings import SETTINGS
from coax_env.estimation.helicopter import Moment
from study.judge import tied, wilson
from study.onset_worth import worth_of_change
from study.pairs import FAULTS
from study.plan import sizes_of

RUNS = ("lon_3211", "lat_3211", "heave_3211", "yaw_3211")
LONGEST = 12.0
"""s of each run: 48 s a flight, for time; `whole` flights have all twelve runs, to their ends."""
MIDDLE = (3, 9)
"""Places among those between which something begins there: in one of the six runs in the middle."""
KINDS = ("begins", "constant", "clean", "ends", "grows")
CHANGES = ("begins", "ends", "grows")
"""Kinds in which something changes in flight."""
GROWING = 12.0
"""s of flight over which what grows comes to its size."""
GROWING_WHOLE = (4.0, 80.0)
"""The same in whole flights, log-uniform: from a screw that works loose to a battery that goes flat."""
BEGINS = (
    "swash_offset", "torque_balance", "gyro_bias", "thrust_scale", "cg_offset", "attitude_bias",
    "added_mass", "motor_lag", "accel_bias", "servo_play", "swash_gain", "servo_lag",
)  # fmt: skip
"""What may begin: rigging, blades, sensors, payload, motors, servos, play."""
EARLIEST = 3.0
"""s from the start, and from the end, of the run in which it begins."""


@dataclass(frozen=True)
class Planned:
    """One flight of the study. fault: what changes at `since`, or is there all the time.

    whole: whether it is as long as a labelled one. growing: s over which what grows comes.
    """

    kind: str
    number: int
    fault: dict[str, dict[str, float]]
    others: dict[str, dict[str, float]]
    since: tuple[str, float]
    air: dict[str, Any]
    seed: int
    whole: bool = False
    growing: float = 0.0

    @property
    def name(self) -> str:
        """Of the file that it is stored in."""
        return f"onset-{self.kind}-{self.number:04d}{'-whole' * self.whole}"


def lengths(whole: bool) -> dict[str, float]:
    """Runs of a flight in the order in which they are flown, with the length of each [s]."""
    if whole:
        return dict(injector.MANEUVERS)
    return dict.fromkeys(RUNS, LONGEST)


def planned(kind: str, number: int, seed: int, whole: bool = False) -> Planned:
    """A flight, drawn from the study's seed, its kind and its number alone."""
    rng = np.random.default_rng([seed, 1000 + KINDS.index(kind), number])
    fault = BEGINS[number % len(BEGINS)]
    sizes = sizes_of(fault, rng)
    others = FAULTS[int(rng.integers(len(FAULTS)))]
    others = {e: dict(p) for e, p in others.items() if not tied(e, fault)}
    runs = lengths(whole)
    run = list(runs)[int(rng.integers(*(MIDDLE if whole else (1, 3))))]
    since = (run, round(float(rng.uniform(EARLIEST, runs[run] - EARLIEST)), 2))
    air: dict[str, Any] = {"gusts": "none"}
    if number % 2:
        scale = float(rng.uniform(0.5, 1.5))
        air = {
            "gusts": "markov", "force": 0.2 * scale, "moment_xy": 0.006 * scale,
            "moment_z": 0.003 * scale, "memory": rng.uniform(0.2, 1.0, 2).tolist(),
        }  # fmt: skip
    hidden = {} if kind == "clean" else {fault: sizes}
    of_flight = int(rng.integers(2**31))
    growing = 0.0
    if kind == "grows":
        low, high = np.log(GROWING_WHOLE if whole else (GROWING, GROWING))
        growing = round(float(np.exp(rng.uniform(low, high))), 2)
    return Planned(
        kind, number, hidden, others if hidden else {}, since, air, of_flight, whole, growing
    )


def fly(plan: Planned, folder: Path) -> Path:
    """The flight, in a folder."""
    air = {**plan.air, "memory": tuple(plan.air["memory"])} if "memory" in plan.air else plan.air
    before, after = stages(plan)
    return injector.fly(
        folder, {**plan.others, **before}, gusts=Air(**air), seed=plan.seed,
        runs=lengths(plan.whole), longest=math.inf if plan.whole else LONGEST,
        later=after if plan.kind in CHANGES else None,
        since=plan.since if plan.kind in CHANGES else ("", 0.0),
        growing=plan.growing,
    )  # fmt: skip


def stages(plan: Planned) -> tuple[dict[str, dict[str, float]], dict[str, dict[str, float]]]:
    """The fault with its sizes at first and at last."""
    off = {effect: dict.fromkeys(sizes, 0.0) for effect, sizes in plan.fault.items()}
    if plan.kind in ("begins", "grows"):
        return {}, plan.fault
    return plan.fault, off if plan.kind == "ends" else plan.fault


def fly_and_diagnose(plan: Planned) -> dict[str, Any]:
    """The row of a flight; a failure is a row with `error`."""
    row: dict[str, Any] = {"plan": json.loads(json.dumps(asdict(plan)))}
    try:
        with tempfile.TemporaryDirectory() as name:
            folder = fly(plan, Path(name))
            began = time.process_time()
            findings = diagnose(folder, hold_out=[]).findings
            row |= {"causes": findings["causes"], "seconds": time.process_time() - began}
            if plan.kind in CHANGES:
                before, after = stages(plan)
                off = {effect: dict.fromkeys(sizes, 0.0) for effect, sizes in after.items()}
                moment = Moment(*plan.since, plan.growing)
                row["worth"] = worth_of_change(folder, before or off, after, plan.others, moment)
    except Exception:
        return row | {"error": traceback.format_exc()}
    return row


# --- judged -----------------------------------------------------------------------------------------


def judged(row: Mapping[str, Any]) -> dict[str, Any]:
    """One row: what was named, since when, and what was named falsely.

    A change should show where the flight's own information gives it twice the threshold.
    """
    plan, causes = row["plan"], row["causes"]
    hidden = [*plan["fault"], *plan["others"]]
    mine = [c for c in causes if any(tied(c["effect"], e) for e in plan["fault"])]
    changed = [c for c in mine if c["since"]] if plan["kind"] in CHANGES else []
    error = None
    held = grows = False
    if changed:
        since = changed[0]["since"]
        before = flown_before(plan.get("whole", False))
        error = abs(before[since["run"]] + since["t"] - before[plan["since"][0]] - plan["since"][1])
        held = error <= 1.96 * since["std"]
        grows = since["grown"] is not None
    return {
        "named": bool(mine),
        "since": bool(changed),
        "grows": grows,
        "should_show": row.get("worth", 0.0) > 2.0 * SETTINGS.evidence,
        "error": error,
        "held": held,
        "false": [
            c["effect"] for c in causes if not any(tied(c["effect"], truth) for truth in hidden)
        ],
        "false_since": [c["effect"] for c in causes if c["since"] and c not in changed],
    }


def flown_before(whole: bool) -> dict[str, float]:
    """s of flight before each run."""
    runs = lengths(whole)
    return dict(zip(runs, np.cumsum([0.0, *runs.values()]).tolist(), strict=False))


def text_of(rows: Sequence[Mapping[str, Any]]) -> str:
    """The figures of all rows, and every one that is not as it should be."""
    good = [(r, judged(r)) for r in rows if "causes" in r]
    of = {kind: [j for r, j in good if r["plan"]["kind"] == kind] for kind in KINDS}
    figures = [f for kind in CHANGES if of[kind] for f in _of_change(kind, of[kind])]
    constant = of["constant"] + of["clean"]
    figures += [
        ("constant: a moment", [bool(j["false_since"]) for j in of["constant"]]),
        ("clean: a moment", [bool(j["false_since"]) for j in of["clean"]]),
        ("constant or clean: a false name", [bool(j["false"]) for j in constant]),
    ]
    lines = ["| figure | right | of | share | 95 % interval |", "|---|---|---|---|---|"]
    lines += [_line(words, right) for words, right in figures]
    for kind in CHANGES:
        if errors := [j["error"] for j in of[kind] if j["since"]]:
            middle, most = float(np.median(errors)), max(errors)
            lines += [
                "",
                f"{kind}: median error of the moment {middle:.3f} s, largest {most:.2f} s.",
            ]
    lines += ["", f"{len(rows) - len(good)} failed.", ""]
    return "\n".join([*lines, *(_remark(r) for r, j in good if _is_off(r, j))]) + "\n"


def _of_change(kind: str, of: Sequence[Mapping[str, Any]]) -> list[tuple[str, list[bool]]]:
    """Figures of one kind in which something changes."""
    shown = [j for j in of if j["should_show"]]
    dated = [j for j in of if j["since"]]
    return [(f"{kind}: named", [j["named"] for j in of]),
            (f"{kind}: with its moment", [j["since"] for j in of]),
            (f"{kind}, should show: named", [j["named"] for j in shown]),
            (f"{kind}, should show: with its moment", [j["since"] for j in shown]),
            (f"{kind}: the moment within its 95 % interval", [j["held"] for j in dated]),
            (f"{kind}: said to grow", [j["grows"] for j in dated]),
            (f"{kind}: a false name", [bool(j["false"]) for j in of]),
            (f"{kind}: a false moment", [bool(j["false_since"]) for j in of])]  # fmt: skip


def _line(words: str, right: Sequence[bool]) -> str:
    """A row of the table."""
    low, high = wilson(sum(right), len(right))
    share = f"{100 * sum(right) / len(right):.0f} %" if right else "-"
    interval = f"{100 * low:.0f} to {100 * high:.0f} %"
    return f"| {words} | {sum(right)} | {len(right)} | {share} | {interval} |"


def _is_off(row: Mapping[str, Any], j: Mapping[str, Any]) -> bool:
    kind = row["plan"]["kind"]
    right = j["since"] and j["held"] and j["grows"] == (kind == "grows")
    missed = kind in CHANGES and not right
    return bool(missed or j["false"] or j["false_since"])


def _remark(row: Mapping[str, Any]) -> str:
    plan = row["plan"]
    worth = f", worth {row['worth']:.0f} nats" if "worth" in row else ""
    said = [(c["effect"], round(c["evidence"], 1), c["since"]) for c in row["causes"]]
    over = f" over {plan['growing']:g} s" if plan.get("growing") else ""
    return (
        f"- {plan['kind']} {plan['number']} {plan['fault']} {plan['since']}{over} beside"
        f" {list(plan['others'])} ({plan['air']['gusts']}){worth}: {said}"
    )
