"""The pilot of simulated flights: his gain is the cheapest there is, his hands tremble as said.

The gain is held against value iteration, written out here, on the same linear rows; corrections
against what he was asked for; the tremor against its own std and memory.
"""

import math

import numpy as np
import pytest

from coax_env import load_vehicle
from coax_env.model import state as S
from coax_env.model.layout import N_FULL
from coax_env.model.linear import N_FLOWN, sampled
from coax_env.simulation import pilot
from coax_env.simulation.pilot import TREMOR, TREMOR_MEMORY, Pilot, rounded

LAMA = load_vehicle("lama400d")
DT = 0.01
STILL = np.zeros(4)
RNG = np.random.default_rng


@pytest.fixture(scope="module")
def flown() -> Pilot:
    return Pilot(LAMA, 2.0, DT)


def correction(
    one: Pilot, change: dict[int, float], asked: np.ndarray = STILL, rate: np.ndarray = STILL
) -> np.ndarray:
    """What he does where states differ so from trim, at 2 m asked for."""
    x = np.zeros(N_FULL)
    x[:N_FLOWN] = one.trim_state
    for i, by in change.items():
        x[i] += by
    return one.correction(x, asked + [2.0, 0.0, 0.0, 0.0], rate, DT, RNG(0))


def test_the_gain_is_that_of_least_cost():
    """Value iteration: what the last row costs, carried back row by row until nothing changes.

    Rotor speeds cost by their fraction of trim, tilts by themselves, states by what is tolerated.
    """
    A, B, *_, trim = sampled(LAMA, DT)
    held = [i for i in range(N_FLOWN) if i not in (S.X, S.Y)]
    A, B = A[np.ix_(held, held)], B[held]
    u = pilot._EFFORT * np.array([trim[0], trim[1], 1.0, 1.0])
    R = np.diag(1.0 / u**2)
    tolerated = dict(enumerate(pilot._TOLERATED))
    Q = np.diag([tolerated.get(i, math.inf) ** -2.0 for i in held])
    P = Q.copy()
    for _ in range(6000):
        K = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
        P = Q + A.T @ P @ (A - B @ K)
    gain = Pilot(LAMA, 2.0, DT).gain
    np.testing.assert_allclose(gain[:, held], K, rtol=1e-5, atol=1e-6 * np.abs(K).max())
    assert not gain[:, [S.X, S.Y]].any(), "he does not hold a place"


def test_who_does_what_he_is_asked_for_is_not_corrected(flown):
    """Height, velocities and heading as asked, climbing and turning at the asked rates; any place."""
    asked, rate = np.array([0.7, 0.4, -0.3, 1.1]), np.array([0.5, 0.0, 0.0, -0.2])
    there = {
        S.Z: -0.7, S.U: 0.4, S.V: -0.3, S.PSI: 1.1 + 2.0 * math.pi,
        S.W: -0.5, S.R: -0.2, S.X: 30.0, S.Y: -40.0,
    }  # fmt: skip
    np.testing.assert_allclose(correction(flown, there, asked, rate), 0.0, atol=1e-9)


@pytest.mark.parametrize("name", ["U", "W", "R", "Z", "PSI"])
def test_he_reacts_in_proportion_but_throws_no_stick(flown, name):
    """Twice the error, twice the correction; what is far off is answered as if it were nearer."""
    i = getattr(S, name)
    once, twice = correction(flown, {i: 0.1}), correction(flown, {i: 0.2})
    assert np.abs(once).max() > 0.0
    np.testing.assert_allclose(twice, 2.0 * once, rtol=1e-9, atol=1e-12)
    if name != "PSI":
        far, farther = correction(flown, {i: 10.0}), correction(flown, {i: 100.0})
        np.testing.assert_allclose(far, farther)


def test_corrections_go_against_the_error(flown):
    """Too low: more lift from both rotors. Forward too fast: thrust back. Right: thrust to the left."""
    assert (correction(flown, {S.Z: 0.1})[:2] > 0.0).all()
    assert correction(flown, {S.U: 0.1})[2] > 0.0 > correction(flown, {S.V: 0.1})[3]
    turning = correction(flown, {S.R: 0.1})  # the rotors push against the turn, apart
    assert turning[0] * turning[1] < 0.0


@pytest.mark.slow
def test_hands_tremble_with_their_std_and_memory():
    """A first-order process: correlation e^-1 after its memory, at whatever rate he is asked."""
    lasts = 600.0  # s
    for dt in (0.01, 0.04):
        one = Pilot(LAMA, 2.0, dt, tremor=2.0)
        rng = RNG(1)
        x = np.zeros(N_FULL)
        x[:N_FLOWN] = one.trim_state
        asked = np.array([2.0, 0.0, 0.0, 0.0])
        hands = np.array(
            [one.correction(x, asked, STILL, dt, rng) for _ in range(round(lasts / dt))]
        )
        hands = hands[round(2.0 / dt) :]
        np.testing.assert_allclose(hands.std(axis=0), 2.0 * TREMOR, rtol=0.06)
        lag = round(TREMOR_MEMORY / dt)
        for column in hands.T:
            found = np.mean(column[lag:] * column[:-lag]) / np.mean(column**2)
            assert found == pytest.approx(math.exp(-1.0), abs=0.06)


def test_corners_are_rounded_over_the_rows_and_nothing_else_moves():
    """A centred running mean: what is straight stays, a step becomes a ramp of so many rows."""
    n, rows = 400, 100
    straight = np.column_stack([np.full(n, 3.0), 0.02 * np.arange(n) - 1.0])
    found = rounded(straight, rows)
    assert found.shape == straight.shape
    np.testing.assert_allclose(found[:, 0], 3.0)
    inside = slice(rows, n - rows)
    np.testing.assert_allclose(found[inside, 1], straight[inside, 1], atol=1e-12)
    step = rounded((np.arange(n) >= 200).astype(float)[:, None], rows)[:, 0]
    ramp = np.flatnonzero((step > 1e-9) & (step < 1.0 - 1e-9))
    assert len(ramp) == rows and abs(ramp.mean() - 199.5) <= 0.5
    np.testing.assert_allclose(np.diff(step[ramp]), 1.0 / (rows + 1), rtol=1e-9)
