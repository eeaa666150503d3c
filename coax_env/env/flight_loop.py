"""The loops over a batch of helicopters, compiled: one control period, new flights, targets.

Every loop takes a share of the rows, first..last-1, so that threads can have one each, and a mask. Rows
know nothing of each other. From fleet.SIMD_FROM helicopters on fleet_simd.py's loops are faster.
"""

import math

import numpy as np

from coax_env.env import hover, tasks
from coax_env.env.arrays import AIR_DOWN, AIR_EAST, AIR_NORTH
from coax_env.env.hover import EAST, HEADING, NORTH
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
from coax_env.kernel.simd import select
from coax_env.model import inputs as U
from coax_env.model import state as S
from coax_env.model.actuators import limit
from coax_env.model.dynamics import WORK_SIZE
from coax_env.model.layout import N_CHANNELS, N_COMMANDS
from coax_env.model.sampling import BIAS, BIAS_STD, DELAY, delayed, measured_quantities


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
def own_numbers(own, places, p):
    """Put a helicopter's own parameters (k,) at their places (k,) in a parameter vector.

    Args:
        own: numbers, (k,). places: in `p`, (k,). p: parameter vector, changed in place.
    """
    for k in range(len(places)):
        p[places[k]] = own[k]


@compiled()
def move_air(x, own, stream, filters, steady, turbulence, air):
    """The air's velocity in the coming period: steady, with turbulence along and across it, and down.

    Args:
        x: full state, (29,). own: the helicopter's own parameters, (k,), whose first are the air's.
        stream: key and counter, (2,) uint64. filters: states of the forming filters, (N_FILTERS,).
        steady: north and east [m/s], (2,). turbulence: mean wind at 6 m [m/s]. air: scratch, (3,).
    """
    turbulence_step(stream, filters, -x[S.Z], turbulence, DT, air)
    speed = math.sqrt(steady[NORTH] * steady[NORTH] + steady[EAST] * steady[EAST])
    north = select(speed > 0.0, steady[NORTH] / speed, 1.0)
    east = select(speed > 0.0, steady[EAST] / speed, 0.0)
    own[AIR_NORTH] = steady[NORTH] + north * air[ALONG] - east * air[ACROSS]
    own[AIR_EAST] = steady[EAST] + east * air[ALONG] + north * air[ACROSS]
    own[AIR_DOWN] = air[DOWN]


@compiled(makes_arrays=True)
def disturb_rows(first, last, active, x, heli, world):
    """Gusts and turbulence of the coming period for the active rows first..last-1.

    Args:
        first, last: the share of the rows. active: which of them fly, (n,) bool.
        x: full states, (n, 29), whose gusts change. heli, world: the batch's arrays, arrays.py.
    """
    air, p = np.empty(3), world.params.copy()
    gust = world.gust
    for i in range(first, last):
        if active[i]:
            if gust[FORCE] > 0.0 or gust[MOMENT] > 0.0:
                own_numbers(heli.own[i], world.own, p)
                add_gusts(x[i], p, gust, heli.streams[i])
            if world.turbulence > 0.0:
                move_air(
                    x[i], heli.own[i], heli.streams[i], heli.filters[i], heli.steady_wind[i],
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
    p = world.params.copy() if len(world.own) > 0 else world.params
    rewards, terms, over = outcome.rewards, outcome.terms, outcome.over
    for i in range(first, last):
        for k in range(len(mission.weights)):
            terms[i, k] = 0.0
        if not active[i]:
            copy_row(heli.held[i], outcome.observations[i])
            rewards[i] = 0.0
            over[i] = False
            continue
        own_numbers(heli.own[i], world.own, p)
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
def move_targets(first, last, active, heli, mission):
    """The targets of the active rows first..last-1 where the path has got to by now.

    Args:
        first, last: the share of the rows. active: which of them fly, (n,) bool.
        heli, mission: the batch's arrays, arrays.py.
    """
    rows = len(mission.path)
    for i in range(first, last):
        if active[i]:
            row = tasks.row_of_path(heli.rows[i], rows, mission.again)
            copy_row(mission.path[row, :4], heli.targets[i])


@compiled()
def observe_targets(first, last, which, heli, mission, observations):
    """The way to the target by the readings held, observed, for the rows first..last-1 of a mask.

    Args:
        first, last: the share of the rows. which: those of them to observe, (n,) bool.
        heli, mission: the batch's arrays, arrays.py. observations: (n, n_observed), in place.
    """
    rows = len(mission.path)
    begin = heli.held.shape[1] - tasks.N_WAY - (tasks.N_MOTION if rows > 0 else 0)
    end = begin + tasks.N_WAY
    for i in range(first, last):
        if which[i]:
            held = heli.held[i]
            tasks.way_to_target(
                held, mission.places, mission.height_sign, heli.targets[i], held[begin:end]
            )
            if rows > 0:
                row = tasks.row_of_path(heli.rows[i], rows, mission.again)
                psi = held[mission.places[HEADING]]
                tasks.motion_of_target(mission.path[row], psi, held[end:])
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
    p = world.params.copy() if len(world.own) > 0 else world.params
    trim = world.trim
    for i in range(first, last):
        if not which[i]:
            continue
        stream = heli.streams[i]
        if world.wind_speed > 0.0:
            angle = uniform(stream, -math.pi, math.pi)
            speed = world.wind_speed
            if world.wind_slowest < speed:
                speed = uniform(stream, world.wind_slowest, speed)
            heli.own[i, AIR_NORTH] += speed * math.cos(angle)
            heli.own[i, AIR_EAST] += speed * math.sin(angle)
        own_numbers(heli.own[i], world.own, p)
        _draw_bias(stream, world.sensors[heli.kinds[i]], heli.bias[i])
        if not keep_state:
            hover.random_start(stream, trim, x[i])
        if world.turbulence > 0.0:
            steady = heli.steady_wind[i]
            steady[NORTH], steady[EAST] = heli.own[i, AIR_NORTH], heli.own[i, AIR_EAST]
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
