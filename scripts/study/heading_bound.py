"""How far any yaw model can foretell a real heading for a second from logged rotor commands.

Commands that a stabiliser gives are answers to the heading. Flown open loop, the gain that is best in
hindsight has the wrong sign, and of the right ones it is the least. This asks what 1 s error the best
of all such models leaves on the very run that it is judged on.

    python scripts/study/heading_bound.py ../shared/flights/skybotix_coax --run circles

Data flow::

    heading of a run -> even rows, its rate and acceleration by cubics over 0.12 s
        -> torque balance, gain, delay, motor lag, reaction and damping by least squares of the error a
        second ahead -> that error, the gain at least half of the bench's, and free
"""

import argparse
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import lfilter

from coax_env import load_vehicle, read_flight
from coax_env.logs.flight import Run
from coax_env.model.vehicle import Vehicle

ROW = 0.01  # s
HALF = 0.06  # s on each side of a row, over which a cubic is fitted
HORIZON = 100  # rows
EVERY = 10  # rows between starts
DELAYS = (0.0, 0.03, 0.06, 0.09)  # s
FIRST = 0.3  # s left out at both ends


class Yaw(NamedTuple):
    """A heading on even rows. psi, rate: (n,). command: (n, 2) rotor speeds [rad/s]."""

    psi: np.ndarray
    rate: np.ndarray
    command: np.ndarray


def yaw_of(run: Run) -> Yaw:
    """The heading of a run, NaN where it was not read."""
    read = np.isfinite(run.measured["psi"])
    at, psi = run.t[read], np.unwrap(run.measured["psi"][read])
    t = np.arange(at[0] + FIRST, at[-1] - FIRST, ROW)
    fitted = np.full((t.size, 2), np.nan)
    for i, now in enumerate(t):
        near = slice(*np.searchsorted(at, (now - HALF, now + HALF)))
        if at[near].size > 4:
            fitted[i] = np.polyfit(at[near] - now, psi[near], 3)[[3, 2]]
    row = np.searchsorted(run.t, t, side="right") - 1
    return Yaw(fitted[:, 0], fitted[:, 1], run.command[row, :2])


def errors(yaw: Yaw, vehicle: Vehicle, gains: np.ndarray, delay: float) -> np.ndarray:
    """Errors a second ahead from every tenth of a second [rad].

    Args:
        yaw: as read. vehicle: its torque coefficients and inertias.
        gains: (6,) of the upper rotor's torque; of the lower over it; motor lag [s]; damping [1/s];
            balance [rad/s2]; reaction, of the rotors' inertias.
        delay: of the commands [s].
    """
    of_upper, ratio, lag, damping, balance, reaction = gains
    v = {name: p.value for name, p in vehicle.parameters.items()}
    per_speed2 = math.pi * v["air_density"] * v["rotor_radius"] ** 5
    late = round(delay / ROW)
    speed = np.concatenate([np.repeat(yaw.command[:1], late, axis=0), yaw.command])[: len(yaw.psi)]
    share = 1.0 - math.exp(-ROW / max(lag, 1e-6))
    start = (1.0 - share) * speed[:1]
    speed, _ = lfilter([share], [1.0, share - 1.0], speed, axis=0, zi=start)
    torque = per_speed2 * speed**2 * [v["torque_coefficient_upper"], v["torque_coefficient_lower"]]
    inertia = [v["rotor_inertia_upper"] + v["flybar_inertia"], v["rotor_inertia_lower"]]
    torque += reaction * np.gradient(speed, ROW, axis=0) * inertia
    driven = of_upper * (torque[:, 0] - ratio * torque[:, 1]) / v["inertia_zz"] + balance
    start_rows = np.arange(0, len(yaw.psi) - HORIZON, EVERY)
    known = np.isfinite(yaw.psi + yaw.rate)
    start_rows = start_rows[known[start_rows] & known[start_rows + HORIZON]]
    # a row of rate adds ROW rate to psi, a row of torque ROW torque to the rate, of which stays...
    stays = (1.0 - ROW * damping) ** np.arange(HORIZON)
    moved = np.cumsum(stays)  # ...so much in the rows that follow, all of them summed up
    of_rate, of_driven = moved[-1], np.append(moved[-2::-1], 0.0)
    psi = yaw.psi[start_rows] + ROW * of_rate * yaw.rate[start_rows]
    psi += ROW**2 * (driven[start_rows[:, None] + np.arange(HORIZON)] @ of_driven)
    return psi - yaw.psi[start_rows + HORIZON]


def best(yaw: Yaw, vehicle: Vehicle, least: float) -> tuple[float, np.ndarray, float]:
    """Least rms error a second ahead [rad], at which gains and delay [s].

    Args:
        yaw, vehicle: as of `errors`. least: gain of the upper rotor's torque.
    """
    low, high = [least, 0.8, 0.0, 0.0, -60.0, 0.0], [2.0, 1.25, 0.5, 30.0, 60.0, 2.0]
    found = []
    for delay in DELAYS:
        fit = least_squares(
            lambda gains, delay=delay: errors(yaw, vehicle, gains, delay),
            [1.0, 1.0, 0.08, 2.0, 0.0, 1.0], bounds=(low, high), x_scale=[1, 0.1, 0.1, 5, 10, 1],
        )  # fmt: skip
        found.append((float(np.sqrt(np.mean(fit.fun**2))), fit.x, delay))
    return min(found, key=lambda f: f[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("flight", type=Path)
    parser.add_argument("--run", required=True)
    options = parser.parse_args()
    flight = read_flight(options.flight)
    vehicle = load_vehicle(flight.vehicle).in_air(flight.air)
    yaw = yaw_of(flight.run(options.run))
    apart = yaw.psi[HORIZON::EVERY] - yaw.psi[:-HORIZON:EVERY]
    print(f"nothing moves: {np.sqrt(np.nanmean(apart**2)):.3f} rad")
    none = np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0])
    print(f"it turns on: {np.sqrt(np.mean(errors(yaw, vehicle, none, 0.0) ** 2)):.3f} rad")
    names = ("gain", "lower over upper", "lag", "damping", "balance", "reaction")
    for words, least in (("gain at least half", 0.5), ("gain free", -2.0)):
        error, gains, delay = best(yaw, vehicle, least)
        numbers = ", ".join(f"{n} {g:.2g}" for n, g in zip(names, gains, strict=True))
        print(f"{words}: {error:.3f} rad, at {numbers}, delay {delay:g}")


if __name__ == "__main__":
    main()
