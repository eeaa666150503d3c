"""Start, reward, end and cost of a flight, and its targets, written a second time in numpy."""

import math

import numpy as np
import pytest

from coax_env.env import flight_loop, hover, period, tasks
from coax_env.kernel.random_streams import stream_key, two_normals
from coax_env.model import parameters as P
from coax_env.model.layout import N_FULL, STATES
from coax_env.model.sensors import suite

X = {name: i for i, (name, _) in enumerate(STATES)}
DEGREE = math.pi / 180.0


def stream(seed: int = 0) -> np.ndarray:
    return np.array([stream_key(np.uint64(seed)), 0], dtype=np.uint64)


def somewhere(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A state, an action and a target, x y z psi."""
    rng = np.random.default_rng(seed)
    x = np.zeros(29)
    x[:16] = rng.uniform(-1, 1, 16) * [1, 1, 1, 2, 2, 2, 0.1, 0.1, 0.1, 0.1, 0.5, 0.5, 9, 3, 3, 1]
    return x, rng.uniform(-1, 1, 4), rng.uniform(-1, 1, 4) * [2, 2, 1, 3]


def errors(x: np.ndarray, action: np.ndarray, target: np.ndarray) -> dict[str, float]:
    """Sizes of what a flight is judged by."""
    turn = x[12] - target[3]
    return {
        "height": abs(x[15] - target[2]), "position": math.dist(x[13:15], target[:2]),
        "speed": float(np.linalg.norm(x[:3])), "rates": float(np.linalg.norm(x[3:6])),
        "heading": abs(math.atan2(math.sin(turn), math.cos(turn))),
        "effort": float(np.linalg.norm(action)),
    }  # fmt: skip


@pytest.mark.parametrize("seed", range(5))
def test_each_reward_term_is_halved_at_its_scale(seed):
    x, action, target = somewhere(seed)
    scales = np.array([1.0, *hover.REWARD_SCALES.values()])
    weights = np.array(list(hover.REWARD_WEIGHTS.values()))
    terms = np.zeros(hover.N_TERMS)
    total = hover.reward(x, action, target, weights, scales, terms)
    found = dict(zip(hover.REWARD_TERMS, terms, strict=True))
    assert found.pop("alive") == hover.REWARD_WEIGHTS["alive"]
    for name, error in errors(x, action, target).items():
        scale, weight = hover.REWARD_SCALES[name], hover.REWARD_WEIGHTS[name]
        assert found[name] == pytest.approx(weight / (1.0 + error / scale)), name
    assert total == pytest.approx(terms.sum())
    x[7] = math.nan  # a flap does not enter
    assert hover.reward(x, action, target, weights, scales, terms) == total
    x[3] = math.nan
    assert hover.reward(x, action, target, weights, scales, terms) == 0.0 and not terms.any()


@pytest.mark.parametrize("seed", range(5))
def test_the_cost_is_quadratic_in_units_of_the_limits(seed):
    x, action, target = somewhere(seed)
    expected = sum(
        hover.COST_WEIGHTS[name] * (error / hover.LIMITS[name]) ** 2
        for name, error in errors(x, action, target).items()
    )
    assert hover.cost(x, action, target) == pytest.approx(expected)
    still = np.array([0.0, 0.0, -1.5, 0.0])
    assert hover.cost(x, action) == pytest.approx(float(hover.cost(x, action, still)))
    both = hover.cost(np.stack([x, 2 * x]), np.stack([action, action]), np.stack([target, target]))
    assert both.shape == (2,) and both[0] == pytest.approx(expected)


FAR = 1.0 / math.sqrt(2.0)
ENDS = [
    # where, just within, just without
    ({"z": -1.0}, 0.051, 0.049), ({"z": -1.0}, 5.99, 6.01),
    ({"phi": DEGREE}, 59.9, 60.1), ({"phi": -DEGREE}, 59.9, 60.1),
    ({"theta": DEGREE}, 59.9, 60.1), ({"theta": -DEGREE}, 59.9, 60.1),
    ({"x": 1.0}, 24.9, 25.1), ({"y": -1.0}, 24.9, 25.1), ({"x": FAR, "y": FAR}, 24.9, 25.1),
    ({"u": 1.0}, 14.9, 15.1), ({"v": -1.0}, 14.9, 15.1), ({"w": 1.0}, 14.9, 15.1),
    ({"u": FAR, "w": -FAR}, 14.9, 15.1), ({"psi": 1.0, "p": 3.0, "r": -5.0}, 40.0, math.inf),
]  # fmt: skip


@pytest.mark.parametrize(("where", "within", "without"), ENDS)
def test_a_flight_ends_at_its_bounds(where, within, without):
    for size, over in ((within, False), (without, True)):
        x = np.zeros(29)
        x[15] = -1.5
        for name, share in where.items():
            x[X[name]] = size * share
        assert bool(hover.is_over(x)) is over


@pytest.mark.parametrize("i", range(29))
def test_a_state_that_is_no_number_ends_the_flight(i):
    for wrong in (math.nan, math.inf, -math.inf):
        x = np.zeros(29)
        x[15] = -1.5
        x[i] = wrong
        assert bool(hover.is_over(x))


def test_starts_are_uniform_about_hover_and_settled():
    command, own = np.array([210.0, 225.0, 0.01, -0.02]), stream(1)
    starts = np.full((3000, N_FULL), 7.0)
    for x in starts:
        hover.random_start(own, command, x)
    centre = np.zeros(N_FULL)
    centre[15], centre[16:20] = -1.5, command
    half = np.zeros(N_FULL)
    half[:3], half[3:6], half[10:12], half[12] = 0.3, 10 * DEGREE, 5 * DEGREE, 20 * DEGREE
    half[15] = 0.3
    away = starts - centre
    assert (np.abs(away) <= half + 1e-12).all()
    np.testing.assert_allclose(away.std(axis=0), half / math.sqrt(3.0), rtol=0.06)
    assert (np.abs(away.mean(axis=0)) <= 4.0 * half / math.sqrt(9000.0)).all()
    assert np.abs(np.corrcoef(away[:, half > 0.0].T) - np.eye(10)).max() < 0.1


@pytest.mark.parametrize("gust", [(0.3, 2e-3), (0.3, 0.0), (0.0, 2e-3)])
def test_each_gust_is_kicked_by_what_its_own_memory_loses(gust):
    """From nothing: std times sqrt(1 - exp(-2 dt/T)) of a normal number each, a pair and one."""
    p = np.zeros(P.GUST_MEMORIES.stop)
    p[P.GUST_MEMORIES] = memories = np.array([0.2, 0.5, 0.9, 1.7])
    own, copy = stream(4), stream(4)
    x, expected = np.zeros(N_FULL), np.zeros(6)
    period.add_gusts(x, p, np.array(gust), own)
    share = np.sqrt(-np.expm1(-2.0 * period.DT / memories))
    for half, first in ((0, 0), (1, 3)):
        if gust[half]:
            pair, single = two_normals(copy), two_normals(copy)
            expected[first : first + 2] = gust[half] * share[2 * half] * np.array(pair)
            expected[first + 2] = gust[half] * share[2 * half + 1] * single[0]
    np.testing.assert_allclose(x[20:26], expected, rtol=1e-12)
    assert np.array_equal(own, copy) and not x[:20].any()


@pytest.mark.parametrize("steady", [(2.0, -1.5), (-0.4, 3.0), (0.0, 0.0)])
def test_turbulence_blows_along_the_wind_and_across_it_to_the_right(steady):
    """On top of the steady wind; where there is none, along is north."""
    x, own, air = np.zeros(N_FULL), np.zeros(3), np.zeros(3)
    x[15] = -2.0
    flight_loop.move_air(x, own, stream(5), np.ones(5), np.array(steady), 4.0, air)
    along, across, down = air
    assert min(abs(air)) > 0.05
    wind = complex(*steady)
    direction = wind / abs(wind) if wind else 1.0
    found = complex(own[flight_loop.AIR_NORTH], own[flight_loop.AIR_EAST])
    assert found == pytest.approx(wind + direction * complex(along, across))
    assert own[flight_loop.AIR_DOWN] == down


# --- targets --------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("name", ["mocap", "state"])
def test_the_way_to_the_target_is_in_the_headings_axes(name, seed):
    """Ahead, right, up and round: from where the readings say that the machine is."""
    rng = np.random.default_rng(seed)
    sensors = suite(name)
    places = tasks.places("position", sensors)
    held = rng.standard_normal(len(sensors))
    psi = held[places[3]] = rng.uniform(-3.0, 3.0)
    target, out = rng.uniform(-3, 3, 4), np.zeros(4)
    tasks.way_to_target(held, places, tasks.height_sign("position", sensors), target, out)
    north, east = target[:2] - held[places[:2]]
    bearing, distance = math.atan2(east, north) - psi, math.hypot(north, east)
    height = held[places[2]] if name == "mocap" else -held[places[2]]
    expected = [distance * math.cos(bearing), distance * math.sin(bearing), -target[2] - height]
    np.testing.assert_allclose(out[:3], expected, atol=1e-12)
    assert math.cos(out[3] - (target[3] - psi)) == pytest.approx(1.0)
    assert -math.pi <= out[3] < math.pi


@pytest.mark.parametrize("psi", [0.0, 0.9, -2.5])
def test_how_a_target_moves_is_told_in_the_headings_axes_and_within_bounds(psi):
    """Velocity and acceleration ahead, right and up, and the turn; each no more than its bound."""
    point = np.array([9.0, 9.0, 9.0, 9.0, 0.8, -0.5, 0.3, 0.2, -0.6, 0.4, 0.7])
    out = np.zeros(tasks.N_MOTION)
    tasks.motion_of_target(point, psi, out)
    turn = np.exp(-1j * psi)
    velocity, acceleration = complex(0.8, -0.5) * turn, complex(-0.6, 0.4) * turn
    expected = [velocity.real, velocity.imag, -0.3, 0.2, acceleration.real, acceleration.imag, -0.7]
    np.testing.assert_allclose(out, expected, atol=1e-12)
    for side in (-1.0, 1.0):
        tasks.motion_of_target(side * 1e4 * point, 0.0, out)
        wanted = np.sign([0.8, -0.5, -0.3, 0.2, -0.6, 0.4, -0.7]) * tasks._MOTION_BOUNDS
        np.testing.assert_allclose(out, side * wanted)


def test_a_path_goes_on_from_its_seam():
    """Ten rows of which the fourth follows the last."""
    rows = [int(tasks.row_of_path(row, 10, 4)) for row in range(24)]
    assert rows == [*range(10), *range(4, 10), *range(4, 10), 4, 5]


def test_the_way_is_held_within_its_bounds():
    sensors = suite("mocap")
    places, out = tasks.places("position", sensors), np.zeros(4)
    for side in (-1.0, 1.0):
        target = side * np.array([1e3, 1e3, -1e3, 0.0])
        tasks.way_to_target(np.zeros(len(sensors)), places, -1.0, target, out)
        np.testing.assert_allclose(out, side * np.array([50.0, 50.0, 10.0, 0.0]))


def test_the_height_sign_is_that_of_the_reading():
    assert tasks.height_sign("position", suite("mocap")) == -1.0  # h is up, z down
    assert tasks.height_sign("position", suite("state")) == 1.0


@pytest.mark.parametrize("name", tasks.TASKS)
def test_drawn_targets_fill_their_box(name):
    box, own = tasks.box(name), stream(3)
    drawn = np.zeros((2000, 4))
    for target in drawn:
        tasks.next_target(own, np.empty((0, 4)), box, 0, target)
    low, high = box.min(axis=0), box.max(axis=0)
    assert (drawn >= low).all() and (drawn <= high).all()
    np.testing.assert_allclose(drawn.mean(axis=0), (low + high) / 2, atol=4 * np.ptp(box) / 150)
    np.testing.assert_allclose(drawn.std(axis=0), (high - low) / math.sqrt(12.0), rtol=0.05)
    assert (-box[:, 2] > 0.9).all(), "heights are up, z is down"


def test_a_course_is_flown_in_order_and_its_last_target_stays():
    course = np.arange(12.0).reshape(3, 4)
    target = np.zeros(4)
    for reached, row in ((0, 0), (1, 1), (2, 2), (3, 2), (9, 2)):
        tasks.next_target(stream(), course, np.zeros((2, 4)), reached, target)
        assert np.array_equal(target, course[row])


AT = np.array([1.0, -2.0, -1.5, 3.0])
AWAY = [
    ({}, True), ({"x": 0.29}, True), ({"x": -0.31}, False), ({"y": 0.29}, True),
    ({"y": 0.31}, False), ({"z": -0.29}, True), ({"z": 0.31}, False),
    ({"x": 0.2, "y": 0.2, "z": 0.2}, False), ({"psi": 14.9 * DEGREE}, True),
    ({"psi": -15.1 * DEGREE}, False), ({"psi": 2.0 * math.pi + 0.1}, True),
]  # fmt: skip


@pytest.mark.parametrize(("away", "there"), AWAY)
def test_a_waypoint_is_reached_after_a_dwell_within_its_reach(away, there):
    x = np.zeros(29)
    x[13:16], x[12] = AT[:3], AT[3]
    for name, size in away.items():
        x[X[name]] += size
    progress = np.zeros(2, dtype=np.int64)
    came = [bool(tasks.reaches(x, AT, 5, progress, np.empty((0, 4)))) for _ in range(12)]
    assert [k for k, it in enumerate(came) if it] == ([4, 9] if there else [])
    assert progress[tasks.REACHED] == (2 if there else 0)


def test_leaving_begins_the_dwell_anew_and_a_course_ends():
    x, away = np.zeros(29), np.zeros(29)
    x[13:16], x[12] = AT[:3], AT[3]
    progress, course = np.zeros(2, dtype=np.int64), np.array([AT, AT])
    track = [x] * 4 + [away] + [x] * 30
    came = [bool(tasks.reaches(at, AT, 5, progress, course)) for at in track]
    assert [k for k, it in enumerate(came) if it] == [9, 14], "two targets, and no more"
    assert not any(tasks.reaches(x, AT, 0, progress, course) for _ in range(20)), "no dwell: never"


@pytest.mark.parametrize(
    ("what", "size"),
    [("height", 0.10), ("speed", 0.25), ("heading", 10.0 * DEGREE), ("drift", 2.0)],
)
def test_success_is_the_contracts(what, size):
    """After 3 s: rms of height, speed and heading, farthest drift; the way there does not count."""
    column = {"height": 15, "speed": 0, "heading": 12, "drift": 13}[what]
    goal = np.zeros((1000, 4))
    for factor, fine in ((0.98, True), (1.02, False), (-0.98, True), (-1.02, False)):
        x = np.zeros((1000, 16))
        x[:250] = 50.0
        x[250:, column] = factor * size
        assert tasks.succeeded("position", x, goal, 1000) is fine
    x = np.zeros((1000, 16))
    assert tasks.succeeded("position", x, goal, 1000)
    assert not tasks.succeeded("position", x, goal, 1001), "not flown to the end"
    x[5, 7] = math.nan
    assert not tasks.succeeded("position", x, goal, 1000)


def test_in_hover_drift_counts_from_where_it_was_after_three_seconds():
    x = np.zeros((1000, 16))
    x[:, 13], x[:, 15] = 7.0, -1.5
    goal = np.tile([0.0, 0.0, -1.5, 0.0], (1000, 1))
    assert tasks.succeeded("hover", x, goal, 1000)
    assert not tasks.succeeded("position", x, goal, 1000)
    x[-1, 14] = 2.1
    assert not tasks.succeeded("hover", x, goal, 1000)


def test_waypoints_succeed_by_number():
    x, goal = np.full((10, 16), 9.0), np.zeros((10, 4))
    assert tasks.succeeded("waypoints", x, goal, 10, reached=3, wanted=3)
    assert not tasks.succeeded("waypoints", x, goal, 10, reached=2, wanted=3)


def test_a_target_of_the_user_is_up_and_that_of_the_kernel_down():
    assert tasks.course("position", (1, 2, 1.5, 0.3)).tolist() == [[1.0, 2.0, -1.5, 0.3]]
    assert tasks.course("hover").tolist() == [[0.0, 0.0, -1.5, 0.0]]
    assert tasks.course("waypoints").shape == (0, 4)
