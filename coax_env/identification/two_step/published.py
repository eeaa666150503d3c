"""Table VIII as the paper prints it, beside what the paper's own Tables I to V predict for it.

The numbers are data (`published.toml`, with their source). What they hide is shown twice: on the
printed numbers here, and on a flight simulated from the same tables (method.py).
"""

import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from coax_env.identification.two_step.loads import loads, scales
from coax_env.identification.two_step.regression import least_squares
from coax_env.model.vehicle import Vehicle

PATH = Path(__file__).with_name("published.toml")
RPM = (2000.0, 2143.0)
"""Rotor speeds of the flight, Table VII [rev/min]."""
SPREAD = 0.01
"""Std of rotor speeds over their mean, small enough for a straight line to fit; ours."""


@dataclass(frozen=True)
class Published:
    """A row of Table VIII: coefficient -> value and printed std."""

    response: str
    values: dict[str, float]
    std: dict[str, float]


def table_viii() -> tuple[Published, ...]:
    """The three rows."""
    document = tomllib.loads(PATH.read_text(encoding="utf-8"))
    return tuple(
        Published(
            row["response"],
            dict(zip(document["columns"], row["value"], strict=True)),
            dict(zip(document["columns"], row["std"], strict=True)),
        )
        for row in document["row"]
    )


def predicted(vehicle: Vehicle) -> dict[str, dict[str, float]]:
    """What the vehicle file's tables give for each entry at the flight's rotor speeds, (61)-(69)."""
    omega_u, omega_l = (np.array(rpm * np.pi / 30.0) for rpm in RPM)
    level = loads(vehicle, omega_u, omega_l)
    T_u, T_l = float(level.T_u), float(level.T_l)
    force, moment = (float(x) for x in scales(vehicle, omega_u))
    none = dict.fromkeys(("1", "alpha_u", "alpha_l", "q", "delta_lon", "T_l", "T_u"), 0.0)
    lift = -float(level.Z) / force
    by_lower, by_upper = 1.0 / force, -T_l / (T_u * force)
    arm_u, arm_l = vehicle["arm_upper"].value, vehicle["arm_lower"].value
    return {
        "C_X": none | {"alpha_u": -T_u / force, "alpha_l": -T_l / force},
        "C_Z": none
        | {"1": lift - by_lower * T_l - by_upper * T_u, "T_l": by_lower, "T_u": by_upper},
        "C_m": none | {"alpha_u": arm_u * T_u / moment, "alpha_l": arm_l * T_l / moment},
    }


def direction(rows: tuple[Published, ...]) -> dict[str, tuple[float, float]]:
    """delta_lon and q entries of each row over its alpha_l entry.

    A nearly collinear pair leaves one direction of the data in all rows: (1, -K_b, tau) is what eq
    (26) ties.
    """
    return {
        row.response: (
            row.values["delta_lon"] / row.values["alpha_l"],
            row.values["q"] / row.values["alpha_l"],
        )
        for row in rows
    }


def lift_artefact(vehicle: Vehicle) -> dict[str, float]:
    """m g / (1/2 k_T omega_u^2) regressed on 1, T_l, T_u while a_z does not change at all.

    The published C_Z row without any flight: dividing by omega_u^2 makes it.
    """
    rng = np.random.default_rng(0)
    drawn = 1.0 + SPREAD * rng.standard_normal((2, 400))
    omega_u, omega_l = (rpm * np.pi / 30.0 * share for rpm, share in zip(RPM, drawn, strict=True))
    T_u, T_l, *_ = loads(vehicle, omega_u, omega_l)
    force, _ = scales(vehicle, omega_u)
    weight = vehicle["mass"].value * vehicle["gravity"].value
    names = ("1", "T_l", "T_u")
    X = np.column_stack([np.ones(400), T_l, T_u])
    fit = least_squares(X, weight / force, names)
    return dict(zip(names, fit.values.tolist(), strict=True))
