"""Pairs of flights of one machine, flown by the injector: the same, or with one change between them."""

import json
import math
import tempfile
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import injector
import numpy as np
from injector_air import Air
from injector_craft import LAMA

from coax_env.comparison.compare import compare
from coax_env.diagnosis.settings import SETTINGS
from study.judge import TIES, wilson
from study.plan import sizes_of

RUNS = ("lon_3211", "lat_3211", "heave_3211", "yaw_3211")
LONGEST = 8.0
"""s of each run: 32 s a flight, for time; `whole` pairs fly all the injector's runs, to their ends."""
CHANGES = (
    "added_mass", "thrust_scale", "swash_offset", "motor_lag", "servo_lag", "cg_offset",
    "swash_gain", "torque_balance", "gyro_bias", "accel_bias", "attitude_bias", "swash_phase",
)  # fmt: skip
"""What may change: payload, blades, rigging, motors, servos, sensors."""
FAULTS: tuple[dict[str, dict[str, float]], ...] = (
    {"motor_lag": {"upper": 0.06, "lower": 0.06}, "gyro_bias": {"x": 0.01, "y": -0.01, "z": 0.005}},
    {"swash_offset": {"lon": 0.01, "lat": -0.008}, "servo_lag": {"time": 0.03}},
    {"cg_offset": {"x": 1e-3, "y": 5e-4}, "swash_gain": {"scale": -0.1}},
    {},
)
"""What the machine has in both flights and its file has not, in turn."""
DENSITIES = (1.20, 1.14, 1.09)
"""kg/m3 that air may have."""
LARGEST_CHARGE = 0.03
"""Share of the rotors' speed per command between a full and a used battery, either way."""


@dataclass(frozen=True)
class Pair:
    """One pair of the study.

    change: effect -> parameter -> size in the second flight beside the first; empty: the same machine.
    airs: gusts of each; densities [kg/m3]; pilots; faster: the second's rotor speed per command.
    whole: whether each flight is as long as a labelled one.
    """

    number: int
    change: dict[str, dict[str, float]]
    faults: dict[str, dict[str, float]]
    airs: tuple[dict[str, Any], dict[str, Any]]
    densities: tuple[float, float]
    pilots: tuple[str, str]
    faster: float
    seed: int
    whole: bool = False

    @property
    def name(self) -> str:
        """Of the file that it is stored in."""
        kind = "changed" if self.change else "same"
        return f"{kind}-{self.number:04d}{'-whole' * self.whole}"


def planned(changed: bool, number: int, seed: int, whole: bool = False) -> Pair:
    """A pair, drawn from the study's seed, its kind and its number alone."""
    rng = np.random.default_rng([seed, int(changed), number])
    turn = number + number // len(
        CHANGES
    )  # every change meets every fault, in gusts and in still air
    faults = FAULTS[turn % len(FAULTS)]
    change = {}
    if changed:
        effect = CHANGES[number % len(CHANGES)]
        change = {effect: sizes_of(effect, rng)}
        if effect == "swash_phase":
            change[effect]["per_rpm"] = 0.0
    airs = (_air(rng, turn), _air(rng, turn))
    dense = [float(d) for d in rng.choice(DENSITIES, 2)]
    pilots = [str(p) for p in rng.choice(["usual", "stabiliser", "slow_human"], 2)]
    faster = float(rng.uniform(1.0 - LARGEST_CHARGE, 1.0 + LARGEST_CHARGE))
    return Pair(
        number,
        change,
        dict(faults),
        airs,
        (dense[0], dense[1]),
        (pilots[0], pilots[1]),
        faster,
        int(rng.integers(2**31)),
        whole,
    )


def _air(rng: np.random.Generator, turn: int) -> dict[str, Any]:
    """Still air in every other pair, else gusts of any strength and memory."""
    if turn % 2 == 0:
        return {"gusts": "none"}
    scale = float(rng.uniform(0.5, 1.5))
    return {
        "gusts": "markov", "force": 0.2 * scale, "moment_xy": 0.006 * scale,
        "moment_z": 0.003 * scale, "memory": rng.uniform(0.2, 1.0, 2).tolist(),
    }  # fmt: skip


def fly(pair: Pair, folder: Path) -> tuple[Path, Path]:
    """Both flights of a pair, in a folder."""
    for k, name in enumerate("ab"):
        effects = {e: dict(p) for e, p in pair.faults.items()}
        if k:
            for effect, sizes in pair.change.items():
                own = effects.setdefault(effect, {})
                for parameter, size in sizes.items():
                    own[parameter] = own.get(parameter, 0.0) + size
        air = dict(pair.airs[k])
        if "memory" in air:
            air["memory"] = tuple(air["memory"])
        density = pair.densities[k]
        injector.fly(
            folder / name, effects, gusts=Air(**air), seed=pair.seed + k,
            runs=None if pair.whole else RUNS, longest=math.inf if pair.whole else LONGEST,
            craft=LAMA._replace(density=density), known_as=LAMA, pilot=pair.pilots[k],
        )  # fmt: skip
        card = folder / name / "card.toml"
        text = card.read_text()
        card.write_text(text.replace(f"density = {LAMA.density}", f"density = {density}"))
        if f"density = {density}" not in card.read_text():
            raise ValueError(f"no density in {text}")
        if k:
            _with_battery(folder / name, 1.0 / pair.faster)
    return folder / "a", folder / "b"


def _with_battery(folder: Path, factor: float) -> None:
    """Commands as a battery in another state asks for them: the rotors turn as they did."""
    for path in folder.glob("*.csv"):
        header, *rows = [line.split(",") for line in path.read_text().splitlines()]
        at = [header.index(c) for c in ("rpm_upper_cmd", "rpm_lower_cmd")]
        for row in rows:
            for i in at:
                if row[i]:
                    row[i] = f"{float(row[i]) * factor:.6f}"
        path.write_text("\n".join(",".join(row) for row in [header, *rows]) + "\n")


def fly_and_compare(pair: Pair) -> dict[str, Any]:
    """The row of a pair; a failure is a row with `error`."""
    row: dict[str, Any] = {"pair": json.loads(json.dumps(asdict(pair)))}
    try:
        with tempfile.TemporaryDirectory() as folder:
            a, b = fly(pair, Path(folder))
            changes = compare(a, b).changes
    except Exception:
        return row | {"error": traceback.format_exc()}
    return row | {"changes": changes}


# --- judged -----------------------------------------------------------------------------------------


def judged(row: Mapping[str, Any]) -> dict[str, Any]:
    """One row: right names or not, and which intervals hold.

    A change should show where the comparison's own information gives it twice the threshold.
    """
    truth, found = row["pair"]["change"], row["changes"]["changes"]
    names = {c["effect"] for c in found}
    exact = names == set(truth) or _tied(names, set(truth))
    intervals, expected = [], None
    for effect, sizes in truth.items():
        known = row["changes"]["bounds"]
        z = [
            sizes.get(n.partition(".")[2], 0.0) / b["std"]
            for n, b in known.items()
            if n.startswith(effect + ".")
        ]
        expected = 0.5 * float(np.sum(np.square(z)))
        for c in found:
            if c["effect"] == effect:
                intervals += [
                    abs(p["change"] - sizes.get(n.partition(".")[2], 0.0)) <= 1.96 * p["std"]
                    for n, p in c["parameters"].items()
                ]
    return {
        "exact": exact,
        "false": sorted(names - set(truth)) if not exact else [],
        "missed": sorted(set(truth) - names) if not exact else [],
        "should_show": expected is not None and expected > 2.0 * SETTINGS.evidence,
        "intervals": intervals,
    }


def _tied(names: set[str], truth: set[str]) -> bool:
    """Whether one name stands for another that was declared the same before the study."""
    return len(names) == len(truth) == 1 and any(names | truth <= tie for tie in TIES)


def text_of(rows: Sequence[Mapping[str, Any]]) -> str:
    """The figures of all rows, and every wrong one."""
    good = [r for r in rows if "changes" in r]
    verdicts = [(r, judged(r)) for r in good]
    same = [j for r, j in verdicts if not r["pair"]["change"]]
    changed = [j for r, j in verdicts if r["pair"]["change"]]
    shown = [j for j in changed if j["should_show"]]
    held = [held for j in changed for held in j["intervals"]]
    lines = ["| figure | right | of | share | 95 % interval |", "|---|---|---|---|---|"]
    for words, right, of in (
        ("the same, said so", sum(j["exact"] for j in same), len(same)),
        ("one change, exact", sum(j["exact"] for j in changed), len(changed)),
        ("one change that should show, exact", sum(j["exact"] for j in shown), len(shown)),
        (
            "a false name beside or instead of it",
            sum(bool(j["false"]) for j in changed),
            len(changed),
        ),
        ("intervals of the difference hold", sum(held), len(held)),
    ):
        low, high = wilson(right, of)
        share = f"{100 * right / of:.0f} %" if of else "-"
        lines.append(
            f"| {words} | {right} | {of} | {share} | {100 * low:.0f} to {100 * high:.0f} % |"
        )
    lines += ["", f"{len(rows) - len(good)} failed.", ""]
    for r, j in verdicts:
        if not j["exact"]:
            kind = "same" if not r["pair"]["change"] else str(r["pair"]["change"])
            show = "should show" if j["should_show"] else "not expected to show"
            said = [(c["effect"], round(c["evidence"], 1), c["confusable_with"])
                    for c in r["changes"]["changes"]]  # fmt: skip
            lines.append(f"- {r['pair']['number']} {kind} ({show}): {said}")
    return "\n".join(lines) + "\n"
