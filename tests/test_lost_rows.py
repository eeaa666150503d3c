"""Rows that a log lost: where they were, and what flies through them."""

import numpy as np
import pytest

from coax_env import load_vehicle
from coax_env.estimation.engine import Engine
from coax_env.estimation.helicopter import HeliModel, record_of
from coax_env.estimation.lost_rows import lost_rows
from coax_env.estimation.state_space import Noise, Record
from coax_env.logs.flight import Run
from coax_env.model import dynamics
from coax_env.model.layout import CHANNELS, N_FULL

LAMA = load_vehicle("lama400d").with_effect("spin_up_reaction", gain=1.0)
ROW = 1.0 / 60.0
PSI = CHANNELS.index("psi")


@pytest.mark.parametrize("off", [0.0, 0.002])
def test_missing_rows_of_an_even_clock_are_found(off):
    """Also where rows are up to an eighth of a step early or late."""
    even = 3.0 + ROW * np.arange(400)
    t = even + off * np.random.default_rng(0).uniform(-1.0, 1.0, even.size)
    lost = np.isin(np.arange(400), [7, 100, 101, 102, 250, 251, 252, 253, 254])
    found = lost_rows(t[~lost], 0.25)
    assert found.size == lost.sum()
    np.testing.assert_allclose(found, even[lost], atol=2.0 * off + 1e-9)
    assert lost_rows(even, 0.25).size == 0
    lost[300:320] = True  # a gap in which nothing is known
    assert lost_rows(t[~lost], 0.25).size == found.size


def test_a_clock_that_is_uneven_has_lost_nothing():
    rng = np.random.default_rng(1)
    t = np.cumsum(ROW * rng.uniform(0.5, 1.5, 400))
    t[200:] += 4.0 * ROW
    assert lost_rows(t, 0.25).size == 0
    assert lost_rows(t[:1], 0.25).size == 0


def spinning(row_count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, commands that wind up and down by 60 rad/s2, and readings without noise."""
    t = ROW * np.arange(row_count)
    state, hover = dynamics.hover_trim(LAMA, height=50.0)
    command = np.tile(hover, (row_count, 1))
    command[:, 0] += 60.0 * np.abs(0.3 - (t % 0.6)) - 9.0
    x, work = dynamics.full_state(state, command[0], LAMA), np.zeros(dynamics.WORK_SIZE)
    z = np.full((row_count, len(CHANNELS)), np.nan)
    for k in range(row_count):
        u = dynamics.kernel_input(command[k])
        dynamics.measure(x, u, LAMA.vector, work, z[k])
        following = np.zeros(N_FULL)
        dynamics.step(x, u, ROW, LAMA.vector, work, following)
        x = following
    return t, command, z


def test_a_command_that_moves_is_on_a_line_through_lost_rows():
    """A heading behind a gap is as the flight went on: held commands have its rotors wind up late."""
    t, command, z = spinning(240)
    lost = np.zeros(240, bool)
    lost[133:138] = True
    kept = ~lost
    run = Run("a", t[kept], command[kept], {"psi": z[kept, PSI], "h": z[kept, CHANNELS.index("h")]})
    record = record_of(run)
    np.testing.assert_allclose(record.t, t)
    np.testing.assert_allclose(record.command, command, atol=0.2)
    assert np.isnan(record.z[lost]).all()
    np.testing.assert_array_equal(record.z[kept, PSI], z[kept, PSI])
    held = Record("a", t[kept], command[kept], record.z[kept])
    noise = Noise({"rotor_speed": 1e-3}, {"psi": 0.003, "h": 0.01})
    model = HeliModel(LAMA)
    behind = []
    for one, row in ((record, 138), (held, 133)):
        (run_pass,) = Engine(model, [one]).filter(dict(model.bare_values), noise)
        behind.append(abs(run_pass.innovations[row, PSI]))
    assert behind[0] < 0.5 and behind[1] > 5.0


def test_an_uneven_log_stays_as_it_is():
    t = np.cumsum(ROW * np.random.default_rng(2).uniform(0.5, 1.5, 60))
    command = np.random.default_rng(3).normal(200.0, 1.0, (60, 4))
    battery = np.linspace(12.0, 11.0, 60)
    record = record_of(Run("a", t, command, {"psi": t}, battery=battery))
    np.testing.assert_array_equal(record.t, t)
    np.testing.assert_array_equal(record.command, command)
    np.testing.assert_array_equal(record.battery, battery)
