"""SIMD batches: several helicopters in one register fly, sense and end as each would alone."""

import ast
import math
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from corrected import FOUR, LATE_AND_ASKEW, NINE

import coax_env
from coax_env.env import fleet
from coax_env.env.vector_env import CoaxVectorEnv
from coax_env.kernel import simd
from coax_env.kernel.compilation import compiled
from coax_env.kernel.random_streams import normals_of
from coax_env.kernel.simd import SIMD_WIDTH, simd_view, simd_view_uint64
from coax_env.model import effects
from coax_env.model import inputs as U
from coax_env.model import state as S
from coax_env.model.dynamics import (
    WORK_SIZE,
    full_state,
    hover_trim,
    measure,
    motion_of_registers,
    step,
)
from coax_env.model.dynamics import measure_bare as measure_any
from coax_env.model.dynamics import step_bare as step_any
from coax_env.model.layout import N_CHANNELS, N_FULL, N_INPUTS

SLOW = pytest.mark.slow  # has a variant of its own to compile
LAMA = coax_env.load_vehicle("lama400d")
TERMS = (
    "unlisted_Z.abs_w_w", "unlisted_Z.height", "unlisted_L.u_q", "unlisted_M.sin_3psi",
    "unlisted_M.cos_theta", "unlisted_M.omega_u_l", "unlisted_N.omega_u", "unlisted_N.delta_lat",
    "unlisted_N.omega_l_rate", "unlisted_N.lon_direction",
)  # fmt: skip
"""A generic term of each kind."""
EVERY = tuple(
    name for effect in effects.CATALOGUE.values() for name in effect.names()
) + TERMS  # fmt: skip
step_every, measure_every, _ = motion_of_registers()


@compiled(makes_arrays=True)
def _step_registers(x, u, p, work, out):
    step_any(simd_view(x), simd_view(u), 0.01, simd_view(p), simd_view(work), simd_view(out))


@compiled(makes_arrays=True)
def _measure_registers(x, u, p, work, out):
    measure_any(simd_view(x), simd_view(u), simd_view(p), simd_view(work), simd_view(out))


@compiled(makes_arrays=True)
def _step_every(x, u, p, work, out):
    step_every(simd_view(x), simd_view(u), 0.01, simd_view(p), simd_view(work), simd_view(out))


@compiled(makes_arrays=True)
def _measure_every(x, u, p, work, out):
    measure_every(simd_view(x), simd_view(u), simd_view(p), simd_view(work), simd_view(out))


@compiled(makes_arrays=True)
def _seldom_needed(x, power, tangent, sine, angle):
    for i in range(len(x)):
        simd_view(power)[i] = (1.0 + abs(simd_view(x)[i])) ** simd_view(x)[i]
        simd_view(tangent)[i] = math.tanh(simd_view(x)[i])
        simd_view(sine)[i] = math.asin(math.tanh(simd_view(x)[i]))
        simd_view(angle)[i] = math.atan2(simd_view(x)[i], math.copysign(2.0, -simd_view(x)[i]))


@compiled(makes_arrays=True)
def _of_two_angles(x, sine, cosine, other_sine, other_cosine):
    for i in range(len(x)):
        (
            (simd_view(sine)[i], simd_view(cosine)[i]),
            (simd_view(other_sine)[i], simd_view(other_cosine)[i]),
        ) = simd.sines_and_cosines(simd_view(x)[i], -0.5 * simd_view(x)[i])


@compiled(makes_arrays=True)
def _over_root(y, out):
    for i in range(len(y)):
        simd_view(out)[i] = simd.over_root(3.0 * simd_view(y)[i], simd_view(y)[i])


@compiled(makes_arrays=True)
def _sine_and_cosine(x, sine, cosine):
    for i in range(len(x)):
        simd_view(sine)[i], simd_view(cosine)[i] = simd.sine_and_cosine(simd_view(x)[i])


@compiled(makes_arrays=True)
def _sine_and_cosine_of_numbers(x, sine, cosine):
    for i in range(len(x)):
        sine[i], cosine[i] = simd.sine_and_cosine(x[i])


@compiled(makes_arrays=True)
def _exponential(x, out):
    for i in range(len(x)):
        simd_view(out)[i] = math.exp(simd_view(x)[i])


@compiled(makes_arrays=True)
def _logarithm(x, out):
    for i in range(len(x)):
        simd_view(out)[i] = math.log(simd_view(x)[i])


@compiled(makes_arrays=True)
def _normals(bits, first, second):
    for i in range(len(bits)):
        simd_view(first)[i], simd_view(second)[i] = normals_of(simd_view_uint64(bits)[i])


def applied(function, x: np.ndarray, results: int = 1) -> list[np.ndarray]:
    """A function of registers at numbers, whose count is a multiple of SIMD_WIDTH."""
    outs = [np.empty((len(x) // SIMD_WIDTH, SIMD_WIDTH)) for _ in range(results)]
    function(np.ascontiguousarray(x.reshape(-1, SIMD_WIDTH)), *outs)
    return [out.ravel() for out in outs]


# --- functions ------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [1e-9, 0.1, math.pi, 100.0, 1e5, 1.5e6])
def test_sine_and_cosine_are_right_to_the_last_bits(size):
    x = np.concatenate(
        [np.linspace(-size, size, 8000), np.random.default_rng(0).uniform(-size, size, 8000)]
    )
    sine, cosine = applied(_sine_and_cosine, x, 2)
    assert np.abs(sine - np.sin(x)).max() < 4e-16
    assert np.abs(cosine - np.cos(x)).max() < 4e-16
    _sine_and_cosine_of_numbers(x, sine, cosine)
    assert np.abs(sine - np.sin(x)).max() < 4e-16
    assert np.abs(cosine - np.cos(x)).max() < 4e-16


@pytest.mark.parametrize("size", [0.01, 0.25, 0.3, math.pi, 100.0])
def test_sines_and_cosines_of_two_angles_are_right_to_the_last_bits(size):
    x = np.sort(np.random.default_rng(5).uniform(-size, size, 8000))
    found = applied(_of_two_angles, x, 4)
    expected = np.sin(x), np.cos(x), np.sin(-0.5 * x), np.cos(-0.5 * x)
    assert np.abs(np.array(found) - expected).max() < 4e-16


@pytest.mark.parametrize("far", [1e-6, 1e-3, 1.1e-3, 0.9])
def test_a_number_over_a_root_is_right_to_the_last_bits_near_one_and_far_from_it(far):
    y = np.random.default_rng(7).uniform(1.0 - far, 1.0 + far, 8000)
    assert np.abs(applied(_over_root, y)[0] / (3.0 * np.sqrt(y)) - 1.0).max() < 7e-16
    y[2] = math.nan
    assert np.flatnonzero(np.isnan(applied(_over_root, y)[0])).tolist() == [2]


def test_sine_and_cosine_at_the_quarter_turns_and_of_what_is_not_finite():
    quarters = np.arange(-4000, 4000) * (math.pi / 2.0)
    beside = np.concatenate([quarters, np.nextafter(quarters, 9e9), quarters + 1e-8])
    sine, cosine = applied(_sine_and_cosine, beside, 2)
    assert np.abs(sine - np.sin(beside)).max() < 4e-16
    assert np.abs(cosine - np.cos(beside)).max() < 4e-16
    small = applied(_sine_and_cosine, np.full(SIMD_WIDTH, 1e-300), 2)[0]
    assert (small == 1e-300).all()
    for wrong in (math.nan, math.inf, -math.inf, 1e300):
        assert np.isnan(applied(_sine_and_cosine, np.full(SIMD_WIDTH, wrong), 2)).all()


def test_exponential_and_logarithm_are_right_to_the_last_bits():
    rng = np.random.default_rng(1)
    x = np.concatenate([np.linspace(-700.0, 700.0, 8000), rng.uniform(-1.0, 1.0, 8000)])
    assert np.abs(applied(_exponential, x)[0] / np.exp(x) - 1.0).max() < 5e-16
    x = np.concatenate([rng.uniform(0.0, 1.0, 8000), np.exp(rng.uniform(-700.0, 700.0, 8000))])
    x = np.concatenate([x, [2.0**-33, 1.0, np.nextafter(1.0, 0.0), math.sqrt(0.5)] * SIMD_WIDTH])
    error = applied(_logarithm, x)[0] - np.log(x)
    assert (np.abs(error) <= 3e-16 * np.abs(np.log(x)) + 1e-300).all()
    for wrong in (0.0, -1.0, math.nan):
        assert np.isnan(applied(_logarithm, np.full(SIMD_WIDTH, wrong))).all()


def test_powers_and_what_is_done_lane_by_lane():
    x = np.random.default_rng(6).uniform(-6.0, 6.0, 4000 * SIMD_WIDTH)
    power, tangent, sine, angle = applied(_seldom_needed, x, 4)
    assert np.abs(power / (1.0 + np.abs(x)) ** x - 1.0).max() < 1e-14
    assert np.abs(tangent - np.tanh(x)).max() < 4e-16
    assert np.abs(sine - np.arcsin(tangent)).max() < 4e-16
    assert np.abs(angle - np.arctan2(x, np.copysign(2.0, -x))).max() < 1e-15


def test_angles_within_and_beyond_an_eighth_of_a_turn_do_not_hurt_each_other():
    x = np.random.default_rng(4).uniform(-0.7, 0.7, 800 * SIMD_WIDTH)
    small = applied(_sine_and_cosine, x, 2)
    beside = x.copy()
    beside[::SIMD_WIDTH] = 50.0
    beside[1::SIMD_WIDTH] = math.nan
    mixed = applied(_sine_and_cosine, beside, 2)
    kept = np.ones(len(x), dtype=bool)
    kept[::SIMD_WIDTH] = kept[1::SIMD_WIDTH] = False
    for one, other in zip(small, mixed, strict=True):
        assert np.abs(one - other)[kept].max() < 4e-16
        assert np.isnan(other[1::SIMD_WIDTH]).all()


def test_normal_numbers_are_those_of_box_and_muller():
    rng = np.random.default_rng(3)
    bits = rng.integers(0, 2**64, 16000, dtype=np.uint64, endpoint=False)
    corners = [0, 1, 2**30, 2**31 - 1, 2**31, 2**31 + 1, 2**32 - 1]
    pairs = [(a << 32) | b for a in corners for b in corners]
    bits = np.concatenate([bits, np.array(pairs * SIMD_WIDTH, dtype=np.uint64)])
    radius = np.sqrt(-2.0 * np.log(((bits >> np.uint64(32)) + 0.5) / 2.0**32))
    angle = 2.0 * math.pi * (bits & np.uint64(0xFFFFFFFF)) / 2.0**32
    for found, expected in zip(
        applied(_normals, bits, 2), (radius * np.cos(angle), radius * np.sin(angle)), strict=True
    ):
        assert np.abs(found - expected).max() < 5e-11
    alone = np.array([normals_of(number) for number in bits[:2000]]).T
    assert np.abs(alone - applied(_normals, bits[: 250 * SIMD_WIDTH], 2)).max() < 1e-14


# --- dynamics -------------------------------------------------------------------------------------


def drawn(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States anywhere in flight (29, SIMD_WIDTH), inputs (6, SIMD_WIDTH), vehicles (n, SIMD_WIDTH)."""
    rng = np.random.default_rng(seed)
    state, command = hover_trim(LAMA)
    x = full_state(state, command, LAMA)[:, None] + rng.normal(0.0, 0.3, (N_FULL, SIMD_WIDTH))
    x[S.PSI] += rng.uniform(-30.0, 30.0, SIMD_WIDTH)
    u = np.zeros((N_INPUTS, SIMD_WIDTH))
    u[: U.TIME] = command[:, None] * (1.0 + rng.normal(0.0, 0.1, (4, SIMD_WIDTH)))
    u[U.DELTA_LON : U.TIME] += rng.normal(0.0, 0.1, (2, SIMD_WIDTH))
    p = np.array([LAMA.draw(rng).vector for _ in range(SIMD_WIDTH)]).T
    return x, u, np.ascontiguousarray(p)


def each_lane_is_one_helicopter(step_lanes, measure_lanes, given, error):
    """Each lane of x, u and p flies as it does alone; readings within ten times the error."""
    x = given[0]
    work = np.zeros((WORK_SIZE, SIMD_WIDTH))
    flown, readings = np.empty_like(x), np.empty((N_CHANNELS, SIMD_WIDTH))
    step_lanes(*given, work, flown)
    measure_lanes(*given, work, readings)
    for j in range(SIMD_WIDTH):
        one = [np.ascontiguousarray(a[:, j]) for a in given]
        expected, measured = np.empty(N_FULL), np.empty(N_CHANNELS)
        step(one[0], one[1], 0.01, one[2], np.zeros(WORK_SIZE), expected)
        measure(*one, np.zeros(WORK_SIZE), measured)
        assert flown[:, j] == pytest.approx(expected, rel=error, abs=error)
        assert readings[:, j] == pytest.approx(measured, rel=10.0 * error, abs=10.0 * error)


@pytest.mark.parametrize("seed", range(20))
def test_each_lane_flies_and_measures_as_one_helicopter(seed):
    x, u, p = drawn(seed)
    each_lane_is_one_helicopter(_step_registers, _measure_registers, (x, u, p), 1e-12)


def with_every_effect(rng: np.random.Generator, lane: int) -> np.ndarray:
    """A parameter vector: every effect on, or about half of them, or a few."""
    vector = LAMA.draw(rng).vector
    for effect in effects.GROUPS.values():
        for name, parameter in zip(effect.names(), effect.parameters, strict=True):
            if name in EVERY and not parameter.held and rng.random() < (1.0, 0.5, 0.1)[lane % 3]:
                vector[effects.parameter_index(name)] = parameter.at(rng.uniform(0.3, 1.0))
    effects.set_switches(vector)
    return vector


def test_each_lane_flies_and_measures_with_its_own_effects():
    """All effects of the catalogue, and generic terms of each kind, on in some lanes only."""
    for seed in range(10):
        x, u, _ = drawn(seed)
        rng = np.random.default_rng(100 + seed)
        u[U.TIME], u[U.BATTERY] = rng.uniform(0.0, 20.0, (2, SIMD_WIDTH))
        u[U.BATTERY] = rng.normal(0.0, 0.5, SIMD_WIDTH)
        x[S.SWASH_LON, :2] = u[U.DELTA_LON, :2]  # in a deadband: stands still
        p = np.array([with_every_effect(rng, lane) for lane in range(SIMD_WIDTH)]).T.copy()
        each_lane_is_one_helicopter(_step_every, _measure_every, (x, u, p), 1e-11)


def test_what_is_not_a_number_stays_in_its_lane():
    x, u, p = drawn(0)
    work, clean, spoilt = np.zeros((WORK_SIZE, SIMD_WIDTH)), np.empty_like(x), np.empty_like(x)
    _step_registers(x, u, p, work, clean)
    x[S.P, 2] = math.nan
    u[U.OMEGA_U, 5 % SIMD_WIDTH] = math.inf
    _step_registers(x, u, p, work, spoilt)
    hit = [2, 5 % SIMD_WIDTH]
    assert not np.isfinite(spoilt[:, hit]).all(axis=0).any()
    others = np.setdiff1d(np.arange(SIMD_WIDTH), hit)
    assert np.array_equal(spoilt[:, others], clean[:, others])


# --- rows in and out --------------------------------------------------------------------------------


@pytest.mark.parametrize("columns", [1, 2, 4, 5, 18, 26])
@pytest.mark.parametrize("kind", [np.float64, np.float32])
def test_rows_go_into_registers_and_back_to_where_they_were(columns, kind):
    rng = np.random.default_rng(columns)
    rows = rng.normal(size=(40, columns))
    which = rng.permutation(40)[:SIMD_WIDTH]
    block = np.empty((columns, SIMD_WIDTH))
    simd.gather(rows, which, block)
    assert np.array_equal(block, rows[which].T)
    for some in (SIMD_WIDTH, SIMD_WIDTH - 3):
        back = np.zeros((40, columns), dtype=kind)
        simd.scatter(block, which, some, back)
        expected = np.zeros((40, columns), dtype=kind)
        expected[which[:some]] = rows[which[:some]]
        assert np.array_equal(back, expected)


# --- the fleet ------------------------------------------------------------------------------------


SIX = FOUR.with_effect("battery_sag", rate=0.002).with_effect("vibration", tilt=2e-3, heave=3e-4)
"""What is hidden in the bundled flight, and what follows each row's own clock and rotor."""
LATE = FOUR.with_sensor("h", delay=0.033, dropout=0.2, bias_std=0.05).with_actuators(
    swash_travel=0.15, rotor_acceleration=2000.0
)


def spread_out(vehicle, *names: str):
    """A vehicle of whose numbers some are a fifth uncertain."""
    return vehicle.with_parameters(
        {name: replace(vehicle[name], std=0.2 * abs(vehicle[name].value)) for name in names}
    )


def flown(monkeypatch, side_by_side: bool, count: int, **arguments) -> dict[str, np.ndarray]:
    """A flight of a batch through ends and resets: what came, (steps, count, ...)."""
    for fewest in ("SIMD_FROM", "SIMD_VARIANT_FROM"):
        monkeypatch.setattr(fleet, fewest, 2 if side_by_side else 10**9)
    env = CoaxVectorEnv(count, max_episode_steps=90, threads=1, **arguments)
    env.reset(seed=7)
    rng = np.random.default_rng(2)
    came = []
    for k in range(200):
        action = rng.uniform(-1.0, 1.0, (count, 4)) * np.linspace(0.1, 2.0, count)[:, None]
        if k == 20:
            action[-1, 1] = math.nan
        observations, rewards, terminated, truncated, info = env.step(action)
        terms = np.column_stack([info["reward_terms"][name] for name in env.fleet.task.terms])
        numbers = np.column_stack([rewards, terms, info["state"]])
        came.append((observations, numbers, np.column_stack([terminated, truncated])))
    return dict(
        zip(("readings", "numbers", "ends"), map(np.array, zip(*came, strict=True)), strict=True)
    )


@pytest.mark.parametrize(
    ("count", "arguments"),
    [
        (SIMD_WIDTH, {}),
        (2 * SIMD_WIDTH + 3, {"gusts": (0.3, 0.01)}),
        (2, {"sensors": "mocap", "task": "position"}),
        (SIMD_WIDTH + 1, {"randomize": "posterior", "gusts": (0.3, 0.01)}),
        (13, {"sensors": "mocap", "task": "waypoints", "target": [(0, 0, 1.5, 0), (0, 0, 1.6, 0)]}),
        pytest.param(11, {"vehicle": SIX, "gusts": (0.3, 0.01)}, marks=SLOW),
        pytest.param(11, {"vehicle": SIX, "sensors": "paper"}, marks=SLOW),
        pytest.param(11, {"vehicle": SIX, "sensors": "state", "task": "waypoints"}, marks=SLOW),
        pytest.param(11, {"vehicle": SIX, "sensors": "mocap", "task": "position"}, marks=SLOW),
        pytest.param(
            11,
            {
                "vehicle": spread_out(NINE, "command_delay.time", "motor_droop.upper")
                .with_sensor("p", delay=0.015),
                "randomize": "posterior", "wind": (1.0, -2.0), "turbulence": 5.0,
                "gusts": (0.1, 0.01), "sensors": "mocap", "task": "waypoints",
            },
            marks=SLOW,
        ),
        pytest.param(
            19, {"randomize": [LAMA, FOUR, LATE, "skybotix_coax"]}, marks=pytest.mark.slow
        ),
        pytest.param(11, {"vehicle": LATE_AND_ASKEW}, marks=SLOW),
    ],
    ids=[
        "one group", "and three more", "fewer than a group", "own vehicles", "waypoints",
        "six effects", "six, paper", "six, state", "six, mocap",
        "nine effects, each their own, in turbulence, late sensors", "a list", "a late servo",
    ],
)  # fmt: skip
def test_rows_in_a_simd_batch_fly_as_rows_one_by_one(monkeypatch, count, arguments):
    side_by_side = flown(monkeypatch, True, count, **arguments)
    one_by_one = flown(monkeypatch, False, count, **arguments)
    assert np.array_equal(side_by_side["ends"], one_by_one["ends"])
    assert one_by_one["ends"][20:40, -1, 0].any()  # what is not a number has arrived
    assert one_by_one["ends"].sum() >= 2 * count
    for what, error in (("numbers", 1e-9), ("readings", 1e-6)):
        ours, theirs = side_by_side[what], one_by_one[what]
        assert np.array_equal(np.isnan(ours), np.isnan(theirs))
        assert np.nanmax(np.abs(ours - theirs) / (1.0 + np.abs(theirs))) < error


def test_a_batch_is_compiled_for_what_its_vehicles_have():
    plain = CoaxVectorEnv(SIMD_WIDTH).fleet
    assert not any(plain.makeup)
    drawn = CoaxVectorEnv(SIMD_WIDTH, randomize="posterior").fleet
    assert drawn.makeup == plain.makeup._replace(own=True)
    light = CoaxVectorEnv(SIMD_WIDTH, FOUR.with_effect("unlisted_M", sin_psi=0.01)).fleet.makeup
    groups = {name.partition(".")[0] for name in light.used}
    assert groups == {"motor_lag", "wind", "rotor_drag", "gyro_bias", "unlisted_M"}
    assert [n for n in light.used if n.startswith("unlisted")] == ["unlisted_M.sin_psi"]
    assert not light.own and not light.delayed and not light.turbulent and not light.late
    off = CoaxVectorEnv(SIMD_WIDTH, LAMA.with_effect("rotor_drag", coefficient=0.0)).fleet
    assert not any(off.makeup)


def test_few_helicopters_are_not_worth_a_variant():
    few = fleet.SIMD_VARIANT_FROM - 1
    for count, vehicle, expected in (
        (fleet.SIMD_FROM - 1, LAMA, False),
        (fleet.SIMD_FROM, LAMA, True),
        (few, FOUR, False),
        (few + 1, FOUR, True),
    ):
        assert CoaxVectorEnv(count, vehicle).fleet._side_by_side is expected


@compiled(makes_arrays=True)
def _branching(x, f, p, e):
    if x[S.R] > 0.0:
        f[0] += p[e]


@compiled(makes_arrays=True)
def _selecting(x, f, p, e):
    f[0] += simd.select(x[S.R] > 0.0, p[e], 0.0)


def test_a_users_effect_with_a_branch_flies_one_by_one_and_says_so(monkeypatch):
    monkeypatch.setattr(fleet, "SIMD_VARIANT_FROM", SIMD_WIDTH)
    damped = LAMA.with_effect("yaw_damping", coefficient=0.004)
    for function, fits in ((_selecting, True), (_branching, False)):
        entry = replace(effects.GROUPS["yaw_damping"], users=True, function=function)
        monkeypatch.setitem(effects.GROUPS, "yaw_damping", entry)
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            env = CoaxVectorEnv(SIMD_WIDTH, damped)
        assert [("one by one" in str(w.message)) for w in said] == [True] * (not fits)
    env.reset(seed=0)
    assert np.isfinite(env.step(np.zeros((SIMD_WIDTH, 4)))[0]).all()


# --- numba ----------------------------------------------------------------------------------------


def test_only_one_module_uses_what_numba_does_not_document():
    """Its documented interface is numba itself, numba.types and numba.extending."""
    for path in sorted(Path(coax_env.__file__).parent.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(text if "numba" in text else "")):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            private = {n for n in names if n.startswith("numba.") and n != "numba.extending"}
            assert not private or path.name == "numba_internals.py", (path, private)
