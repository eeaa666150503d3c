"""The injector itself: it shares nothing with the package, flies, and hides what it says."""

import ast
import json
import math
from collections.abc import Mapping
from pathlib import Path

import injector
import numpy as np
import pytest
from injector_air import DISTURBANCES, GUSTS, Air, disturbances
from injector_craft import COAX, LAMA, Craft, draw, rotors_of, spread, write_vehicle
from injector_sensors import MIXED, MIXED_POSES, NOISE, POSE, SENSORS, kit
from shared_flights import shared_flight

import coax_env
from coax_env.logs.csv_log import read_csv
from coax_env.logs.flight import read_flight
from coax_env.model.vehicle import Vehicle


@pytest.mark.parametrize("module", ["", "_air", "_craft", "_sensors"])
def test_it_shares_no_code_with_the_package(module: str) -> None:
    tree = ast.parse(Path(injector.__file__).with_name(f"injector{module}.py").read_text())
    modules = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import)
               for alias in node.names}  # fmt: skip
    modules |= {node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert not [name for name in modules if name.split(".")[0] == "coax_env"]


def test_bare_physics_are_the_packages_at_random_states() -> None:
    """Quaternion, hub forces and inertial velocity against eqs (26)-(44) in body axes."""
    rng = np.random.default_rng(4)
    compare_physics(LAMA, coax_env.load_vehicle("lama400d"), rng)
    air = {"density": 1.2, "gravity": 9.81}
    compare_physics(COAX, coax_env.load_vehicle("skybotix_coax").in_air(air), rng)


def test_a_drawn_vehicle_is_what_its_file_says(tmp_path: Path) -> None:
    """Its physics against the package's, which reads the file and nothing else."""
    rng = np.random.default_rng(5)
    for i in range(4):
        craft = draw(rng)
        write_vehicle(craft, tmp_path / f"{i}.toml")
        compare_physics(craft, coax_env.load_vehicle(tmp_path / f"{i}.toml"), rng)


def compare_physics(craft: Craft, vehicle: Vehicle, rng: np.random.Generator) -> None:
    rotors = rotors_of(craft)
    for _ in range(50):
        state = rng.normal(0, 1, 16) * [2, 2, 2, 1, 1, 1, *[0.1] * 4, 0.4, 0.4, 2, 1, 1, 0.3]
        state[15] -= 5.0
        speeds = rotors.hover_upper * rng.uniform(0.85, 1.2, 2)
        command = np.array([*speeds, *rng.normal(0, 0.05, 2)])
        phi, theta, psi = state[10:13]
        half = [
            np.array([math.cos(angle / 2), *(math.sin(angle / 2) * np.eye(3)[axis])])
            for axis, angle in ((2, psi), (1, theta), (0, phi))
        ]
        s = np.zeros(injector.N_STATE)
        s[0:3] = state[13:16]
        s[6:10] = _product(_product(half[0], half[1]), half[2])
        R = injector._rotation(s)
        s[3:6] = R @ state[0:3]
        s[10:13] = state[3:6]
        s[13:17] = state[6:10]
        s[17:21] = command
        ds = injector._derivative(
            s, command, np.zeros(DISTURBANCES), injector.Hidden(), craft, rotors, np.zeros(6)
        )
        expected = coax_env.derivative(state, command, vehicle)
        body_acceleration = R.T @ ds[3:6] - np.cross(state[3:6], state[0:3])
        np.testing.assert_allclose(body_acceleration, expected[0:3], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(ds[10:13], expected[3:6], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(ds[13:17], expected[6:10], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(ds[0:3], expected[13:16], rtol=1e-9, atol=1e-9)
        h = 1e-6
        turn = injector._euler(injector._rotation(s + h * ds)) - injector._euler(
            injector._rotation(s - h * ds)
        )
        np.testing.assert_allclose(turn / (2 * h), expected[10:13], rtol=1e-5, atol=1e-6)


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Quaternion product."""
    return np.array([a[0] * b[0] - a[1:] @ b[1:], *(a[0] * b[1:] + b[0] * a[1:]
                                                   + np.cross(a[1:], b[1:]))])  # fmt: skip


@pytest.mark.slow
@pytest.mark.needs_shared_flights
def test_a_flight_of_it_looks_like_open_none(tmp_path: Path) -> None:
    """Same noise reading to reading, and the same order of motion."""
    ours = read_flight(injector.fly(tmp_path / "none", {}, seed=3))
    theirs = read_flight(shared_flight("open_none"))
    assert ours.run_names == theirs.run_names
    assert ours.channels == theirs.channels
    assert (ours.air, ours.noise) == (theirs.air, theirs.noise)
    for name in ours.run_names:
        for channel in ours.channels:
            a, b = ours.run(name).measured[channel], theirs.run(name).measured[channel]
            jitter = np.median(abs(np.diff(a, 2))) / np.median(abs(np.diff(b, 2)))
            assert jitter == pytest.approx(1.0, abs=0.2), (name, channel)
        assert ours.run(name).measured["h"].min() > -0.1
        assert 0.3 < ours.run(name).command[:, 2].std() / theirs.run(name).command[:, 2].std() < 3


def as_logged(folder: Path, run: str) -> Mapping[str, np.ndarray]:
    """A run's columns, of which nothing is repaired: that takes longer than to fly."""
    return read_csv(folder / f"{run}.csv", {}).data


@pytest.mark.slow
@pytest.mark.parametrize("effect", injector.EFFECTS)
def test_every_effect_can_be_flown_with(tmp_path: Path, effect: str) -> None:
    runs = ["lon_doublet", "heading_turn"]
    injector.fly(tmp_path, {effect: {}}, runs=runs, longest=8.0)
    for run in runs:
        logged = as_logged(tmp_path, run)
        assert np.nanmax(abs(logged["theta"])) < 0.4
        assert 0.8 < np.nanmedian(logged["h"]) < 2.5
    assert json.loads((tmp_path / "truth.json").read_text())["hidden"] == [effect]


@pytest.mark.slow
def test_gusts_sensors_and_dropouts(tmp_path: Path) -> None:
    folder = injector.fly(
        tmp_path, {"rotor_drag": 5e-4, "wind": {"north": 1.0}}, gusts=True, sensors="onboard",
        lost_echoes=True, radio_gaps=True, seed=2,
    )  # fmt: skip
    flight = read_flight(folder)
    assert flight.counts["outliers in h removed"] > 0
    assert flight.counts["gaps of more than 0.1 s without any reading"] > 0
    hover = flight.run("hover")
    share = {c: np.mean(~np.isnan(hover.measured[c])) for c in ("p", "theta", "h", "vn")}
    assert share == pytest.approx({"p": 0.98, "theta": 0.49, "h": 0.195, "vn": 0.098}, abs=0.02)
    truth = json.loads((folder / "truth.json").read_text())
    assert truth["values"] == {
        "rotor_drag.coefficient": 5e-4, "wind.north": 1.0, "wind.east": 0.0,
    }  # fmt: skip


def test_same_seed_same_flight(tmp_path: Path) -> None:
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        injector.fly(tmp_path / name, {}, gusts=True, seed=seed, runs=["lat_3211"])
    a, b, c = ((tmp_path / name / "lat_3211.csv").read_bytes() for name in "abc")
    assert a == b
    assert a != c


def test_what_is_not_in_the_table_is_refused(tmp_path: Path) -> None:
    with pytest.raises(KeyError):
        injector.fly(tmp_path, {"gremlins": {}})
    with pytest.raises(KeyError):
        injector.fly(tmp_path, {"wind": {"up": 1.0}})


# --- its inputs ---------------------------------------------------------------------------------------


def test_hover_is_where_thrust_is_the_weight_and_torques_balance() -> None:
    rng = np.random.default_rng(1)
    for craft in (LAMA, COAX, *(draw(rng) for _ in range(20))):
        rotors = rotors_of(craft)
        s = np.zeros(injector.N_STATE)
        s[2], s[6], s[17:19] = -2.0, 1.0, rotors[-2:]
        ds = injector._derivative(
            s, s[17:21], np.zeros(DISTURBANCES), injector.Hidden(), craft, rotors, np.zeros(6)
        )
        np.testing.assert_allclose(ds, 0.0, atol=1e-9 * craft.gravity)


def test_drawn_vehicles_are_of_all_sizes_and_bodies_that_can_be() -> None:
    crafts = [draw(np.random.default_rng(i)) for i in range(200)]
    masses = np.array([c.mass for c in crafts])
    assert masses.min() < 0.1 and masses.max() > 2.5 and 0.25 < np.mean(masses < 0.5) < 0.75
    for c in crafts:
        moments = sorted((c.inertia_x, c.inertia_y, c.inertia_z))
        assert moments[2] <= moments[0] + moments[1]
        assert moments[2] < c.mass * c.radius**2 and c.rotor_upper < c.inertia_z


def test_a_vehicle_within_its_files_spread_keeps_the_file(tmp_path: Path) -> None:
    craft = spread(LAMA, np.random.default_rng(3))
    file = coax_env.load_vehicle("lama400d")
    for name, field in (
        ("mass", "mass"),
        ("inertia_zz", "inertia_z"),
        ("swash_to_flap", "swash_gain"),
    ):
        off = (getattr(craft, field) - file[name].value) / file[name].std
        assert 0.0 < abs(off) <= 1.5 + 1e-9
    offs = [(spread(LAMA, np.random.default_rng(i)).mass / 0.8 - 1.0) / 0.01 for i in range(200)]
    assert abs(np.mean(offs)) < 0.2 and 0.75 < np.std(offs) < 1.0
    assert (craft.radius, craft.gravity, craft.density) == (0.25, 9.804, 1.14)
    injector.fly(tmp_path, {}, craft=craft, known_as=LAMA, runs=["lat_3211"])
    assert read_flight(tmp_path).vehicle == "lama400d" and not (tmp_path / "vehicle.toml").exists()


@pytest.mark.parametrize(
    "memory",
    [0.03, pytest.param(0.5, marks=pytest.mark.slow), pytest.param(2.0, marks=pytest.mark.slow)],
)
@pytest.mark.parametrize("gusts", ["markov", "heavy_tails"])
def test_gusts_have_the_std_and_memory_asked(gusts: str, memory: float) -> None:
    air = Air(gusts, memory=(memory, 0.5 * memory))
    rng = np.random.default_rng(1)
    history = disturbances(air, LAMA, 100_000, 5, 0.002, rng)
    np.testing.assert_allclose(
        history[1000:, :6].std(axis=0), [0.2] * 3 + [0.006] * 2 + [0.003], rtol=0.25
    )
    for columns, lasting in ((slice(0, 3), memory), (slice(3, 6), 0.5 * memory)):
        x = history[:, columns]
        lag = round(lasting / 0.002)
        alike = np.mean(x[lag:] * x[:-lag], axis=0) / np.mean(x * x, axis=0)
        np.testing.assert_allclose(alike, math.exp(-1.0), atol=0.12)
    shocks = np.diff(history[:, 0].reshape(-1)[1:][::5])
    tails = np.mean(shocks**4) / np.mean(shocks**2) ** 2
    assert (tails > 4.0) == (gusts == "heavy_tails")


@pytest.mark.slow
def test_dryden_has_the_standards_proportions() -> None:
    """MIL-F-8785C at 1.6 m: sigma_u / sigma_w = (0.177 + 0.0043)^-0.4 = 1.98, down in 1.6 m."""
    air = Air("dryden", wind=3.0)
    rng = np.random.default_rng(3)
    history = disturbances(air, LAMA, 400_000, 5, 0.002, rng)[:, 10:13]
    std = history.std(axis=0)
    assert std[2] == pytest.approx(0.2, rel=0.05)
    assert np.hypot(*std[:2]) / math.sqrt(2.0) == pytest.approx(1.98 * 0.2, rel=0.1)
    down = history[:, 2]
    lag = round(1.6 / 3.0 / 0.002)
    # of (1 + sqrt3 T s) / (1 + T s)^2 the correlation after t is exp(-t/T) (1 - t / 2T)
    assert np.mean(down[lag:] * down[:-lag]) / np.mean(down**2) == pytest.approx(
        0.5 * math.exp(-1.0), abs=0.05
    )


def test_single_gusts_come_and_go() -> None:
    history = disturbances(
        Air("one_minus_cosine"), LAMA, 20_000, 5, 0.002, np.random.default_rng(1)
    )
    push = abs(history[:, 0]) / 0.2
    assert 1.5 < push.max() < 5.0
    assert 0.2 < np.mean(push > 0.75) < 0.6, "with calm between them"


def history_of(gusts: str, rows: int = 100_000, seed: int = 1) -> np.ndarray:
    """Gusts in shares of their levels."""
    rng = np.random.default_rng(seed)
    history = disturbances(Air(gusts), LAMA, rows, 5, 0.002, rng)[1000:, :6]
    return history / [0.2, 0.2, 0.2, 0.006, 0.006, 0.003]


@pytest.mark.slow
def test_one_sided_gusts_are_log_normal() -> None:
    """Of a log-normal the skewness is (exp(s^2) + 2) sqrt(exp(s^2) - 1), here 3.7; its mean is 0."""
    gusts = history_of("one_sided", 400_000)
    np.testing.assert_allclose(gusts.std(axis=0), 1.0, rtol=0.2)
    np.testing.assert_allclose(gusts.mean(axis=0), 0.0, atol=0.15)
    np.testing.assert_allclose(abs(np.mean(gusts**3, axis=0)), 3.7, rtol=0.6)


def test_a_gust_that_comes_together_turns_and_lifts() -> None:
    alike = np.corrcoef(history_of("together").T)
    for source, target, share in ((0, 4, -0.9), (1, 3, 0.9), (1, 5, 0.6), (0, 2, 0.5)):
        assert alike[source, target] == pytest.approx(share, abs=0.1)
    assert abs(alike[0, 1]) < 0.15 and abs(alike[0, 3]) < 0.15


@pytest.mark.slow
def test_each_day_has_its_own_gusts() -> None:
    stds = [history_of("days", 20_000, seed).std() for seed in range(30)]
    assert min(stds) < 0.5 and max(stds) > 1.3
    assert min(stds) > 0.15 and max(stds) < 2.6


@pytest.fixture(scope="module")
def turns(tmp_path_factory: pytest.TempPathFactory):
    """The same run of the heading by other sensors and pilots."""

    def flown(sensors: str = "full", pilot: str = "usual"):
        folder = tmp_path_factory.mktemp("turn") / f"{sensors}_{pilot}"
        runs = ["heading_turn"]
        injector.fly(folder, {}, sensors=sensors, pilot=pilot, runs=runs, seed=2)
        return read_flight(folder).run("heading_turn")

    return flown


def off(run, channel: str) -> np.ndarray:
    """What a channel is off from a running mean over 0.2 s."""
    values = run.measured[channel]
    values = np.unwrap(values) if channel == "psi" else values
    return (values - np.convolve(values, np.ones(21) / 21, "same"))[50:-50]


def test_flicker_is_an_error_of_every_memory(turns) -> None:
    """Four memories of 0.4 of the noise's std each: sqrt(1 + 4 * 0.16) as large, and it lasts."""
    flicker, full = (turns(sensors).measured["phi"] for sensors in ("flicker", "full"))
    more = flicker - full  # the noise's own draws come first and are the same
    assert more.std() == pytest.approx(0.8 * NOISE["phi"], rel=0.4)
    assert np.mean(more[100:] * more[:-100]) > 0.2 * more.var()


def test_noise_in_common_is_half_of_the_variance(turns) -> None:
    run = turns("common")
    alike = np.corrcoef([off(run, c) for c in ("p", "phi", "ax", "h")])
    np.testing.assert_allclose(alike[0, 1:3], 0.5, atol=0.1)
    assert abs(alike[0, 3]) < 0.1
    assert off(run, "phi").std() == pytest.approx(NOISE["phi"], rel=0.1)


@pytest.mark.slow
def test_an_onboard_filters_attitude_is_carried_by_its_gyros(turns) -> None:
    """A row adds what the gyro says, and goes back a hundredth of 0.03 rad of noise."""
    run = turns("fused")
    more = np.diff(run.measured["phi"]) - 0.01 * run.measured["p"][:-1]
    assert more[100:].std() < 2.0 * 0.01 * 0.03
    full = turns()
    assert np.diff(full.measured["phi"]).std() > 10.0 * more[100:].std()


def test_times_of_rows_may_be_wrong(turns) -> None:
    steps = np.diff(turns("stamped").t)
    assert steps.min() > 0.0
    assert steps.std() == pytest.approx(0.002 * math.sqrt(2.0), rel=0.1)


def test_readings_between_two_are_straight_lines_or_the_last_one(tmp_path: Path) -> None:
    """Of ten rows; as they are logged: the package sees that these are no readings."""
    for sensors, order in (("resampled", 2), ("held", 1)):
        injector.fly(tmp_path, {}, sensors=sensors, runs=["heading_turn"], seed=2)
        logged = np.genfromtxt(tmp_path / "heading_turn.csv", delimiter=",", names=True)["vn"]
        pieces = logged[:1000].reshape(100, 10)
        np.testing.assert_allclose(np.diff(pieces, order), 0.0, atol=0.0021)
        assert np.diff(pieces[:, 0]).std() > 0.1


def test_late_readings_are_of_as_many_seconds_before_between_rows_too() -> None:
    """Of even rows and of uneven ones; whole rows late they are those of these rows."""
    rng = np.random.default_rng(0)
    even = 0.01 * np.arange(-50, 300)
    for times in (even, even + rng.uniform(-0.002, 0.002, even.size)):
        shown = np.column_stack([np.sin(5.0 * times), np.cos(7.0 * times)])
        then = times[50:] - 0.0245
        expected = np.column_stack([np.sin(5.0 * then), np.cos(7.0 * then)])
        np.testing.assert_allclose(injector._late(times, 50, shown, 0.0245), expected, atol=1e-6)
    np.testing.assert_allclose(injector._late(even, 50, even, 0.03), even[47:-3], atol=1e-12)


def test_a_motion_captures_software_steadies_without_delay(tmp_path: Path) -> None:
    """10 Hz of second order, forwards and back: white noise is a fifth as steep and less, and where the
    machine is is said when it is there. As logged: the package reads one in five."""
    injector.fly(tmp_path, {}, sensors="pose_steadied", runs=["forward_run"], seed=2)
    logged = np.genfromtxt(tmp_path / "forward_run.csv", delimiter=",", names=True)
    assert np.diff(logged["pn"], 2).std() < 0.2 * math.sqrt(6.0) * 5e-4
    run = read_flight(tmp_path).run("forward_run")
    assert np.isfinite(run.measured["pn"]).mean() == pytest.approx(0.2, abs=0.05)
    injector.fly(tmp_path, {}, sensors="lab", runs=["forward_run"], seed=2)
    there = np.genfromtxt(tmp_path / "forward_run.csv", delimiter=",", names=True)["pn"]
    off = [
        np.abs(logged["pn"][100:-100] - there[100 + k : k - 100 or None]).max() for k in (-2, 0, 2)
    ]
    assert off[1] < 0.005 < min(off[0], off[2])


def test_a_radio_loses_commands_in_bursts(turns) -> None:
    arrives = injector._arrives(20_000, 0.03, np.random.default_rng(1))
    assert 1.0 - arrives.mean() == pytest.approx(0.03, rel=0.15)
    lost = np.split(arrives, np.flatnonzero(np.diff(arrives.astype(int))) + 1)
    assert np.mean([len(burst) <= 4 for burst in lost if not burst[0]]) > 0.9
    usual, radio = turns(), turns(pilot="by_radio")
    assert abs(usual.measured["theta"][-100:] - radio.measured["theta"][-100:]).max() > 1e-3


def test_commands_may_arrive_in_steps(turns) -> None:
    """Of 0.4 % of the hover speed, 0.8 rad/s: off by up to half of that, evenly."""
    run = turns(pilot="by_steps")
    speed = run.measured["rpm_upper"] / injector.RPM - run.command[:, 0]
    step = 0.004 * injector.rotors_of(LAMA).hover_upper
    expected = math.hypot(step / math.sqrt(12.0), NOISE["rpm_upper"] / injector.RPM)
    assert np.nanstd(speed) == pytest.approx(expected, rel=0.1)


@pytest.mark.slow
def test_unrest_of_rotors_and_trim(tmp_path: Path) -> None:
    air = Air(jitter=1.0, trim_torque=0.01, trim_thrust=0.005)
    history = disturbances(air, LAMA, 50_000, 5, 0.002, np.random.default_rng(1))
    assert not history[:, :6].any() and not history[:, 10:].any()
    np.testing.assert_allclose(history[:, 8:10].std(axis=0), 1.0, rtol=0.05)
    steps = np.diff(history[:, 6:8], axis=0).std(axis=0) / math.sqrt(0.002)
    np.testing.assert_allclose(steps, [0.005, 0.01], rtol=0.02)
    flights = [
        injector.fly(tmp_path / str(i), {}, gusts=a, runs=["hover"], seed=1)
        for i, a in enumerate((Air(jitter=1.0), Air()))
    ]
    shaken, still = (read_flight(folder).run("hover") for folder in flights)
    speed = shaken.measured["rpm_upper"] - shaken.command[:, 0] * injector.RPM
    assert np.nanstd(speed) == pytest.approx(math.hypot(2.0, injector.RPM), rel=0.1)
    # what the rotors gain in angular momentum the body loses
    expected = math.hypot(LAMA.rotor_upper + LAMA.bar, LAMA.rotor_lower) / LAMA.inertia_z
    turn = math.sqrt(np.nanvar(shaken.measured["r"]) - np.nanvar(still.measured["r"]))
    assert turn == pytest.approx(expected, rel=0.3)


CRAFTS_FLOWN = (LAMA, COAX, draw(np.random.default_rng(8)))


@pytest.mark.slow
@pytest.mark.parametrize("gusts", GUSTS)
def test_every_pilot_flies_every_craft_and_in_every_air(tmp_path: Path, gusts: str) -> None:
    """Each in each air, on one craft of the three; each craft with each pilot, and in each air."""
    air = list(GUSTS).index(gusts)
    for number, pilot in enumerate(injector.PILOTS):
        craft = CRAFTS_FLOWN[-(air + number) % len(CRAFTS_FLOWN)]
        runs = ["lon_3211", "yaw_3211", "forward_run"]
        injector.fly(
            tmp_path / pilot, {}, gusts=Air(gusts), craft=craft, pilot=pilot, longest=6.0,
            runs=runs, seed=3,
        )  # fmt: skip
        for run in runs:
            logged = as_logged(tmp_path / pilot, run)
            assert logged["t"][-1] - logged["t"][0] == pytest.approx(5.99)
            assert np.nanmax(abs(logged["theta"])) < 0.6
            assert 0.5 < np.nanmedian(logged["h"]) < 3.0


def test_a_pose_looks_like_the_coax_log(tmp_path: Path) -> None:
    """150 rows a second on an uneven clock, short losses; noise that third differences see."""
    flight = read_flight(
        injector.fly(tmp_path, {}, gusts=True, sensors="pose", craft=COAX, runs=["hover"])
    )
    run = flight.run("hover")
    assert set(flight.channels) >= set(POSE) and "p" not in flight.channels
    step = np.diff(run.t)
    assert np.median(step) == pytest.approx(1 / 150, rel=0.03)
    assert 1e-3 < step[step < 0.012].std() < 3e-3 and 0.012 < step.max() < 0.06
    for channel in ("phi", "theta", "psi"):
        third = np.diff(run.measured[channel], 3)
        noise = 1.4826 * np.nanmedian(abs(third)) / math.sqrt(20.0)
        assert 0.9 < noise / POSE[channel] < 1.5, "and some of the motion itself"


def test_telemetry_is_slow_and_has_gaps(tmp_path: Path) -> None:
    flight = read_flight(
        injector.fly(
            tmp_path, {}, sensors="telemetry", craft=COAX, runs=["lon_3211", "hover"],
            card_noise=None,
        )
    )  # fmt: skip
    assert flight.noise == {} and "pn" not in flight.channels and "rpm_upper" not in flight.channels
    first, second = (np.diff(run.t) for run in flight.runs)
    for step in (first, second):
        assert set(np.round(step, 2)) >= {0.03, 0.04} and np.median(step) == pytest.approx(0.04)
    assert first.max() > 1.3 > second.max() > 0.1
    height = flight.run("hover").measured["h"]
    seen = height[~np.isnan(height)]
    np.testing.assert_allclose(seen, np.round(seen, 2), atol=1e-9)
    assert 0.3 < len(seen) / len(height) < 0.7


def test_mixed_sensors_have_several_faults_of_every_kind() -> None:
    drawn = [kit(MIXED, seed) for seed in range(200)]
    assert kit(MIXED, 7) == kit(MIXED, 7) != kit(MIXED, 8)
    plain = SENSORS["full"]._replace(every={}, formats={})._asdict()
    faults = [
        {fault for fault, x in of_one._asdict().items() if x != plain[fault]} for of_one in drawn
    ]
    faults = [of_one - {"noise", "formats"} for of_one in faults]
    assert set().union(*faults) == {
        "every", "held", "between", "wander", "flicker", "smooth", "common", "fused", "stamps",
        "outliers", "quanta", "lost",
    }  # fmt: skip
    assert 2.0 < np.mean([len(of_one) for of_one in faults]) < 4.0
    for of_one in drawn:
        assert of_one.noise.keys() == NOISE.keys()
        assert all(1.0 / 3.0 <= std / NOISE[c] <= 3.0 for c, std in of_one.noise.items())


def test_mixed_poses_are_of_every_rate_and_fault() -> None:
    drawn = [kit(MIXED_POSES, seed) for seed in range(200)]
    assert {round(1.0 / of_one.step) for of_one in drawn} == {60, 100, 150, 240}
    for fault in ("unrest", "stamps", "lost", "outliers", "steadied", "wander"):
        assert 20 < sum(bool(getattr(of_one, fault)) for of_one in drawn) < 150
    for of_one in drawn:
        assert all(1.0 <= std / POSE[c] <= 10.0 for c, std in of_one.noise.items())


@pytest.mark.parametrize("factor", [pytest.param(0.5, marks=pytest.mark.slow), 2.0])
def test_a_wrong_card_changes_the_card_alone(tmp_path: Path, factor: float) -> None:
    for name, said in (("right", 1.0), ("wrong", factor)):
        injector.fly(tmp_path / name, {}, runs=["lat_3211"], seed=1, card_noise=said)
    right, wrong = (tmp_path / name for name in ("right", "wrong"))
    assert (right / "lat_3211.csv").read_bytes() == (wrong / "lat_3211.csv").read_bytes()
    noise = read_flight(wrong).noise
    for channel, std in SENSORS["full"].noise.items():
        assert noise[channel] == pytest.approx(factor * std)
