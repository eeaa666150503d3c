"""The loops over a batch of helicopters, compiled: one control period, new flights, targets.

Every loop takes a share of the rows, first..last-1, so that threads can have one each, and a mask. Rows
know nothing of each other. For batches without effects there are faster loops, in fleet_simd.py.
"""

import math

import numpy as np

from coax_env.env import hover, tasks
from coax_env.env.hover import EAST, NORTH
from coax_env.env.period import (
    DT,
    FORCE,
    MOMENT,
    add_gusts,
    command,
    copy_row,
    fly_period,
    give_command,
    next_azimuth,
    take_samples,
    true_readings,
)
from coax_env.env.turbulence import ACROSS, ALONG, DOWN, draw_filters, turbulence_step
from coax_env.kernel.compilation import compiled
from coax_env.kernel.random_streams import two_normals, uniform
from coax_env.model import effects
from coax_env.model import inputs as U
from coax_env.model import parameters as P
from coax_env.model import state as S
from coax_env.model.actuators import limit
from coax_env.model.dynamics import WORK_SIZE
from coax_env.model.layout import N_CHANNELS, N_COMMANDS
from coax_env.model.sampling import BIAS, BIAS_STD, DELAY, delayed, measured_quantities

WIND_NORTH = effects.parameter_index("wind.north")
WIND_EAST = WIND_NORTH + 1


@compiled()
def _sense(i, x, p, heli, world, readings, values, work, out):
    """New readings of row `i` where they are due: held, and as an observation into `out`."""
    sensors = world.sensors[heli.kinds[i]]
    true_readings(x, heli.u[i], p, heli.azimuth[i], work, readings)
    measured_quantities(x, readings, sensors, values)
    past, row = heli.past[i], heli.rows[i]
    if len(past) > 0:
        for k in range(len(sensors)):
            values[k] = delayed(values[k], past, row, k, sensors[k, DELAY])
    take_samples(values, row, sensors, heli.bias[i], heli.streams[i], world.flags, heli.held[i])
    copy_row(heli.held[i], out)


@compiled()
def _move_air(x, p, stream, filters, steady, turbulence, air):
    """Wind of the coming period into `p`: steady (2,), turbulence along and across it, and down."""
    turbulence_step(stream, filters, -x[S.Z], turbulence, DT, air)
    speed = math.sqrt(steady[NORTH] * steady[NORTH] + steady[EAST] * steady[EAST])
    north = steady[NORTH] / speed if speed > 0.0 else 1.0
    east = steady[EAST] / speed if speed > 0.0 else 0.0
    p[WIND_NORTH] = steady[NORTH] + north * air[ALONG] - east * air[ACROSS]
    p[WIND_EAST] = steady[EAST] + east * air[ALONG] + north * air[ACROSS]
    p[P.AIR_DOWN] = air[DOWN]


@compiled(makes_arrays=True)
def disturb_rows(first, last, active, x, heli, world):
    """Gusts and turbulence of the coming period for the active rows first..last-1.

    Args:
        first, last: the share of the rows. active: which of them fly, (n,) bool.
        x: full states, (n, 29), whose gusts change. heli, world: the batch's arrays, arrays.py.
    """
    air = np.empty(3)
    many = len(heli.params) > 1
    gust = world.gust
    for i in range(first, last):
        if active[i]:
            p = heli.params[i if many else 0]
            if gust[FORCE] > 0.0 or gust[MOMENT] > 0.0:
                add_gusts(x[i], p, gust, heli.streams[i])
            if world.turbulence > 0.0:
                _move_air(
                    x[i], p, heli.streams[i], heli.filters[i], heli.steady_wind[i],
                    world.turbulence, air,
                )  # fmt: skip


@compiled(makes_arrays=True)
def fly_rows(first, last, active, actions, x, heli, world, mission, outcome):
    """One control period of the active rows first..last-1.

    Args:
        first, last: the share of the rows. active: which of them fly, (n,) bool.
        actions: (n, 4), clipped in place. x: full states, (n, 29), in place.
        heli, world, mission, outcome: the batch's arrays, arrays.py.
    """
    work = np.empty(WORK_SIZE)
    readings, values = np.empty(N_CHANNELS), np.empty(world.sensors.shape[1])
    many = len(heli.params) > 1
    rewards, terms, over = outcome.rewards, outcome.terms, outcome.over
    for i in range(first, last):
        for k in range(len(mission.weights)):
            terms[i, k] = 0.0
        if not active[i]:
            copy_row(heli.held[i], outcome.observations[i])
            rewards[i] = 0.0
            over[i] = False
            continue
        p = heli.params[i if many else 0]
        u, ring, row = heli.u[i], heli.command_ring[i], heli.rows[i]
        command(actions[i], world.trim, world.scale, u)
        give_command(u, heli.last_commands[i], world.limits[heli.kinds[i]], ring, row, DT)
        fly_period(x[i], u, p, ring, row, DT, work)
        heli.rows[i] = row + 1
        heli.azimuth[i] = next_azimuth(heli.azimuth[i], x[i, S.OMEGA_U], DT)
        u[U.TIME] = (row + 1) * DT
        rewards[i] = hover.reward(
            x[i], actions[i], heli.targets[i], mission.weights, mission.scales, terms[i]
        )
        over[i] = hover.is_over(x[i])
        _sense(i, x[i], p, heli, world, readings, values, work, outcome.observations[i])


@compiled()
def pay_waypoints(first, last, active, x, heli, mission, outcome):
    """Pay the active rows first..last-1 that have reached their targets, and give them others.

    Args:
        first, last: the share of the rows. active: which of them fly, (n,) bool.
        x: full states, (n, 29). heli, mission, outcome: the batch's arrays, arrays.py.
    """
    bonus = mission.weights[hover.N_TERMS]
    for i in range(first, last):
        target, progress = heli.targets[i], heli.progress[i]
        if active[i] and tasks.reaches(x[i], target, mission.dwell, progress, mission.course):
            outcome.terms[i, hover.N_TERMS] = bonus
            outcome.rewards[i] += bonus
            tasks.next_target(
                heli.streams[i], mission.course, mission.box, progress[tasks.REACHED], target
            )


@compiled()
def observe_targets(first, last, which, heli, mission, observations):
    """The way to the target by the readings held, observed, for the rows first..last-1 of a mask.

    Args:
        first, last: the share of the rows. which: those of them to observe, (n,) bool.
        heli, mission: the batch's arrays, arrays.py. observations: (n, n_observed), in place.
    """
    begin = heli.held.shape[1] - tasks.N_WAY
    for i in range(first, last):
        if which[i]:
            held = heli.held[i]
            tasks.way_to_target(
                held, mission.places, mission.height_sign, heli.targets[i], held[begin:]
            )
            for k in range(begin, len(held)):
                observations[i, k] = held[k]


@compiled(makes_arrays=True)
def restart_rows(first, last, which, keep_state, x, heli, world, mission, observations):
    """New flights for the rows first..last-1 of a mask.

    Args:
        first, last: the share of the rows. which: those of them that start anew, (n,) bool.
        keep_state: from what stands in `x` (n, 29), not from a random start.
        heli, world, mission: the batch's arrays, arrays.py. observations: (n, n_observed).
    """
    work = np.empty(WORK_SIZE)
    readings, values = np.empty(N_CHANNELS), np.empty(world.sensors.shape[1])
    many = len(heli.params) > 1
    trim = world.trim
    for i in range(first, last):
        if not which[i]:
            continue
        stream = heli.streams[i]
        if world.wind_speed > 0.0:
            angle = uniform(stream, -math.pi, math.pi)
            heli.params[i, WIND_NORTH] += world.wind_speed * math.cos(angle)
            heli.params[i, WIND_EAST] += world.wind_speed * math.sin(angle)
        p = heli.params[i if many else 0]
        _draw_bias(stream, world.sensors[heli.kinds[i]], heli.bias[i])
        if not keep_state:
            hover.random_start(stream, trim, x[i])
        if world.turbulence > 0.0:
            steady = heli.steady_wind[i]
            steady[NORTH], steady[EAST] = p[WIND_NORTH], p[WIND_EAST]
            draw_filters(stream, heli.filters[i])
        progress = heli.progress[i]
        progress[tasks.WITHIN] = progress[tasks.REACHED] = 0
        tasks.next_target(stream, mission.course, mission.box, 0, heli.targets[i])
        u, ring = heli.u[i], heli.command_ring[i]
        for k in range(N_COMMANDS):
            u[k] = heli.last_commands[i, k] = trim[k]
        limit(u, heli.last_commands[i], world.limits[heli.kinds[i]], DT)
        u[U.TIME] = 0.0
        heli.rows[i] = 0
        heli.azimuth[i] = 0.0
        for k in range(len(ring)):
            copy_row(u[:N_COMMANDS], ring[k])
        for k in range(heli.held.shape[1]):
            heli.held[i, k] = 0.0
        _sense(i, x[i], p, heli, world, readings, values, work, observations[i])


@compiled()
def _draw_bias(stream, sensors, bias):
    """The biases of a flight, (n_sensors,): the file's, and one drawn where it has a std."""
    for k in range(len(sensors)):
        bias[k] = sensors[k, BIAS]
        if sensors[k, BIAS_STD] > 0.0:
            drawn, _ = two_normals(stream)
            bias[k] += sensors[k, BIAS_STD] * drawn
