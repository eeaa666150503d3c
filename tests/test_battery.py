"""What the battery does to speeds: by measured speeds, by the felt thrust; its nominal voltage.

Flights here are made by hand, or by the injector's other code, with commands that a battery asks for.
"""

import csv
import math
from dataclasses import replace
from pathlib import Path

import injector
import numpy as np
import pytest
from scipy.stats import multivariate_normal

import coax_env
from coax_env.diagnosis import preparation
from coax_env.diagnosis.diagnose import diagnose
from coax_env.diagnosis.settings import SETTINGS
from coax_env.diagnosis.trust import BETWEEN_RUNS, of_voltage
from coax_env.estimation.battery import STEEPEST, WIDE, FeltVoltage, felt_voltage, stated
from coax_env.estimation.helicopter import HeliModel, record_of
from coax_env.estimation.prediction import pooled_rms
from coax_env.identification.identify import identify
from coax_env.logs.flight import Flight, Run, read_flight
from coax_env.model import dynamics
from coax_env.model import inputs as U
from coax_env.model.effects import CATALOGUE

LAMA = coax_env.load_vehicle("lama400d")
HOVER = dynamics.hover_trim(LAMA)[1]
ROW = 0.01  # s
NOMINAL = "battery_voltage.nominal"


def flown(
    voltages: list[np.ndarray], seen: dict[str, np.ndarray] | None = None, seed: int = 0
) -> Flight:
    """Hovers with these batteries (n,), at hover's commands, the same readings `seen` in each."""
    rng = np.random.default_rng(seed)
    runs = []
    for k, battery in enumerate(voltages):
        n = len(battery)
        measured = {"h": 1.5 + 0.01 * rng.standard_normal(n)} | (seen or {})
        command = np.tile(HOVER, (n, 1))
        runs.append(Run(f"hover_{k}", ROW * np.arange(n), command, measured, battery=battery))
    return Flight("lama400d", tuple(runs))


def felt(
    flight: Flight,
    per_volt: float,
    nominal: float,
    *,
    droop: float = 0.0,
    stirred: float = 0.02,
    noise: float = 0.5,
    seed: int = 1,
) -> Flight:
    """Commands where speeds are command (1 + per_volt (V - nominal)), but for a droop about hover; of
    another speed each second, with a std `stirred`; and an accelerometer that feels the thrust."""
    rng = np.random.default_rng(seed)
    runs = []
    for run in flight.runs:
        assert run.battery is not None
        second = (run.t + 0.5 * ROW).astype(int)
        speed = 1.0 + stirred * rng.standard_normal(second[-1] + 1)[second]
        asked = 1.0 + (speed - 1.0) / (1.0 - droop)
        command = run.command.copy()
        command[:, :2] *= (asked / (1.0 + per_volt * (run.battery - nominal)))[:, None]
        az = -LAMA["gravity"].value * speed**2 + noise * rng.standard_normal(len(run.t))
        runs.append(replace(run, command=command, measured={**run.measured, "az": az}))
    return replace(flight, runs=tuple(runs))


TWO_STATES = [np.linspace(12.1, 12.0, 900), np.linspace(11.0, 10.9, 2500)]
FOUR_RUNS = [*TWO_STATES, np.linspace(12.15, 12.05, 900), np.linspace(10.95, 10.85, 2500)]


def test_without_speeds_or_thrust_it_is_the_mean_and_nothing_else_is_fitted():
    flight = flown([np.linspace(12.4, 11.84, 400)])
    assert stated(flight, LAMA) == {NOMINAL: 12.1}
    model = HeliModel(LAMA, stated(flight, LAMA))
    assert [f.name for f in model.effect_parameters("battery_voltage")] == [
        "battery_voltage.per_volt"
    ]
    u = model.inputs(record_of(flight.runs[0]), model.vector(model.bare_values))
    np.testing.assert_allclose(u[:, U.BATTERY], np.linspace(0.3, -0.26, 400), atol=1e-12)
    own = LAMA.with_effect("battery_voltage", per_volt=0.05, nominal=10.0)
    assert HeliModel(own, stated(flight, LAMA)).bare_values[NOMINAL] == 10.0
    unlogged = replace(flight, runs=(replace(flight.runs[0], battery=None),))
    assert stated(unlogged, LAMA) == {}


def test_measured_speeds_say_it():
    """Before the felt thrust, which a heavier machine asks more of."""
    battery = np.linspace(12.4, 11.84, 400)
    rng = np.random.default_rng(2)
    speeds = HOVER * (1.0 + 0.07 * (battery[:, None] - 11.5))
    seen = {
        name: 30.0 / math.pi * speeds[:, k] + 5.0 * rng.standard_normal(400)
        for k, name in enumerate(("rpm_upper", "rpm_lower"))
    }
    seen["az"] = -1.3 * LAMA["gravity"].value * (1.0 + 0.05 * (battery - 11.5))
    assert stated(flown([battery], seen), LAMA)[NOMINAL] == pytest.approx(11.5, abs=0.03)


@pytest.mark.parametrize(
    ("nominal", "droop", "stirred"),
    [(11.5, 0.0, 0.02), (12.3, 0.3, 0.02), (13.5, -0.2, 0.02)],
)
def test_the_felt_thrust_says_it_where_no_speed_is_read(nominal, droop, stirred):
    """Two batteries, of which the long flights' is nearly empty; a drive that follows the voltage in
    proportion, beside motors that droop, too."""
    flight = felt(flown(TWO_STATES), 1.0 / nominal, nominal, droop=droop, stirred=stirred)
    found = felt_voltage(flight, LAMA)
    assert found.line is not None and found.is_shown(SETTINGS.evidence)
    assert stated(flight, LAMA) == {NOMINAL: pytest.approx(nominal, abs=0.1)}
    assert found.line.nominal == stated(flight, LAMA)[NOMINAL]
    assert found.line.per_volt == pytest.approx(1.0 / nominal, rel=0.05)
    vehicle = found.known(LAMA, "a flight")
    numbers = vehicle.effects["battery_voltage"]
    assert numbers["per_volt"].value == found.line.per_volt
    assert numbers["per_volt"].std == found.line.std and numbers["per_volt"].source == "a flight"
    assert numbers["nominal"].value == found.line.nominal


def test_in_mere_hover_a_droop_would_look_the_same():
    """However clearly commands differ: they differ with the voltage alone."""
    found = felt_voltage(felt(flown(TWO_STATES), 0.08, 11.5, stirred=0.0, noise=0.1), LAMA)
    assert not found.is_shown(SETTINGS.evidence)


def test_a_slopes_std_is_what_it_scatters_by():
    """Over 200 flights, thrust shaken and commands stirred by much, so that priors say little."""
    off = []
    for seed in range(200):
        flight = felt(flown(TWO_STATES), 0.08, 11.5, stirred=0.1, noise=3.0, seed=seed)
        line = felt_voltage(flight, LAMA).line
        assert line is not None
        off.append((line.per_volt - 0.08) / line.std)
    assert abs(np.mean(off)) < 4.0 / math.sqrt(200)
    assert np.std(off) == pytest.approx(1.0, abs=4.0 / math.sqrt(400))


@pytest.mark.parametrize(
    ("per_volt", "noise", "said"),
    [
        (0.08, 0.5, True),
        (0.5 * STEEPEST / 12.0, 0.5, True),
        (1.2 * STEEPEST / 11.25, 0.5, False),  # something else changes between the flights
        (-0.05, 0.5, False),
        (0.0, 0.5, False),  # a governor keeps the speeds
        (0.004, 30.0, False),  # not shown
    ],
)
def test_where_thrust_shows_no_slope_that_a_battery_has_it_is_not_known(per_volt, noise, said):
    flight = felt(flown(TWO_STATES), per_volt, 11.5, noise=noise)
    assert felt_voltage(flight, LAMA).is_shown(SETTINGS.evidence) == said


def test_a_nominal_voltage_that_no_such_battery_has_is_not_believed():
    flight = felt(flown(TWO_STATES), 0.025, 20.0)
    found = felt_voltage(flight, LAMA)
    assert found.line is not None and found.evidence > SETTINGS.evidence
    assert found.line.nominal == pytest.approx(20.0, rel=0.05)
    assert not found.is_shown(SETTINGS.evidence)


def test_by_chance_it_is_shown_on_no_flight_of_two_hundred():
    """A governor's speeds, thrust shaken. By a Bayes factor log 100 nats come once in a hundred."""
    found = [
        felt_voltage(felt(flown(TWO_STATES), 0.0, 12.0, noise=3.0, seed=seed), LAMA)
        for seed in range(200)
    ]
    assert np.mean([one.evidence > math.log(100.0) for one in found]) <= 0.01
    assert not any(one.is_shown(SETTINGS.evidence) for one in found)


def test_evidence_is_the_log_of_the_ratio_of_two_marginal_likelihoods():
    """Of Gaussian priors, by the readings' covariance with the slope and without."""
    rng = np.random.default_rng(3)
    volts = np.repeat([12.0, 11.0], 20)
    command = 1.0 + 0.05 * rng.standard_normal(40)
    noise = 0.02 * (-1.0) ** np.arange(40)  # neighbours are not alike
    speed = 0.2 + 0.8 * command * (1.0 + 0.06 * (volts - 11.5)) + noise
    line = FeltVoltage({"one": np.stack((volts, speed, command))}).line
    columns = np.stack(
        (np.ones(40), command, (command - 1.0) ** 2, command * (volts - 11.5)), axis=1
    )
    left = speed - columns @ np.linalg.lstsq(columns, speed, rcond=None)[0]
    prior = np.array([WIDE, WIDE, WIDE, CATALOGUE["battery_voltage"].parameters[0].usual])

    def marginal(count: int) -> float:
        spread = columns[:, :count] * prior[:count]
        covariance = spread @ spread.T + left @ left / 36.0 * np.eye(40)
        return float(multivariate_normal(command, covariance).logpdf(speed))

    assert line is not None and line.evidence == pytest.approx(marginal(4) - marginal(3), rel=1e-6)


@pytest.mark.parametrize("power", [0.7, 1.0, 1.4])
def test_a_battery_that_sags_with_its_load_does_not_stand_for_another_law_of_thrust(power):
    """Of a governor's speeds, thrust goes with another power of them."""
    for seed in range(50):
        rng = np.random.default_rng(seed)
        command = 1.0 + 0.1 * rng.standard_normal(100)
        volts = 12.0 - 0.005 * np.arange(100) - 0.8 * (command**2 - 1.0)
        felt_speed = command**power + 0.001 * rng.standard_normal(100)
        found = FeltVoltage({"one": np.stack((volts, felt_speed, command))})
        assert found.line is not None and not found.is_shown(SETTINGS.evidence)


def test_thrust_that_drifts_from_second_to_second_says_less():
    """As a gust of some seconds does, which makes neighbours alike."""
    rng = np.random.default_rng(5)
    slow = np.repeat(rng.standard_normal(40), 5)
    quick = rng.permutation(slow)
    worth = []
    for shaken in (quick, slow):
        points = {}
        for name, volts, part in (("full", 12.0, slice(0, 100)), ("low", 11.0, slice(100, 200))):
            n = part.stop - part.start
            command = 1.0 + 0.02 * rng.standard_normal(n)
            points[name] = np.stack((np.full(n, volts), command + 0.01 * shaken[part], command))
        line = FeltVoltage(points).line
        assert line is not None
        worth.append(line.std)
    assert worth[1] > 1.5 * worth[0]


def test_seconds_without_thrust_or_command_are_left_out():
    """Rotors that stand still, and a machine that falls or lies on its back."""
    flight = felt(flown(TWO_STATES), 0.08, 11.5)
    first, second = flight.runs
    command, az = first.command.copy(), np.array(first.measured["az"])
    command[:100] = 0.0
    az[200:300], az[400:450] = 5.0, np.nan
    odd = replace(first, command=command, measured={**first.measured, "az": az})
    points = felt_voltage(replace(flight, runs=(odd, second)), LAMA).points
    assert [own.shape for own in points.values()] == [(3, 7), (3, 25)]
    assert stated(replace(flight, runs=(odd, second)), LAMA)[NOMINAL] == pytest.approx(
        11.5, abs=0.1
    )


@pytest.mark.parametrize("gone", ["az", "battery", "nothing"])
def test_what_is_not_read_says_nothing_and_read_speeds_are_asked_themselves(gone):
    flight = felt(flown(TWO_STATES), 0.08, 11.5)
    runs = []
    for run in flight.runs:
        measured = dict(run.measured)
        if gone == "az":
            del measured["az"]
        elif gone == "nothing":
            measured["rpm_upper"] = 30.0 / math.pi * run.command[:, 0]
        runs.append(
            replace(run, measured=measured, battery=None if gone == "battery" else run.battery)
        )
    found = felt_voltage(replace(flight, runs=tuple(runs)), LAMA)
    assert found.line is None and found.evidence == -math.inf
    assert not found.is_shown(SETTINGS.evidence)


# --- whether it may be believed -----------------------------------------------------------------------


def test_what_differs_between_runs_alone_is_in_doubt():
    """Two batteries: another load on half of the runs would look the same. It holds without any run."""
    trust = of_voltage(felt_voltage(felt(flown(FOUR_RUNS), 0.08, 11.5), LAMA))
    assert trust.doubts == (BETWEEN_RUNS,) and trust.word == "doubtful"
    assert trust.runs == 1.0 and trust.kept == 1.0


def test_what_shows_in_each_run_is_sure():
    """Batteries that fall by a volt in flight."""
    falling = [np.linspace(12.4, 11.4, 2000) for _ in range(3)]
    trust = of_voltage(felt_voltage(felt(flown(falling), 0.08, 11.5), LAMA))
    assert trust.doubts == () and trust.runs == 1.0


def test_what_rests_on_one_run_says_so():
    """The only one on a full battery."""
    flight = felt(flown([TWO_STATES[0], TWO_STATES[1], FOUR_RUNS[3]]), 0.08, 11.5, noise=5.0)
    trust = of_voltage(felt_voltage(flight, LAMA))
    assert "it rests on hover_0 alone" in trust.doubts and trust.runs == pytest.approx(2.0 / 3.0)


# --- hidden by other code, and found -----------------------------------------------------------------


def on_batteries(folder: Path, voltages: dict[str, float], nominal: float) -> None:
    """A flight's commands as they must be for the speeds that were asked for, at these voltages, which
    fall by 10 mV a second; no rotor speed is read."""
    for name, full in voltages.items():
        path = folder / f"{name}.csv"
        rows = list(csv.DictReader(path.read_text().splitlines()))
        first = float(rows[0]["t"])
        for row in rows:
            volts = full - 0.01 * (float(row["t"]) - first)
            row["battery_v"] = f"{volts:.3f}"
            for channel in ("rpm_upper", "rpm_lower"):
                row.pop(channel)
                row[f"{channel}_cmd"] = f"{float(row[f'{channel}_cmd']) * nominal / volts:.4f}"
        with path.open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)


FULL, LOW = ("heave_3211", "lon_3211"), ("climb_descend", "yaw_3211")


@pytest.fixture(scope="module")
def on_two_batteries(tmp_path_factory):
    """In gusts, half of the runs on a battery that is full; the voltage of commands is 12.3 V."""
    folder = tmp_path_factory.mktemp("batteries")
    injector.fly(folder, {}, gusts=True, runs=[*FULL, *LOW], seed=6, longest=12.0)
    on_batteries(folder, dict.fromkeys(FULL, 12.1) | dict.fromkeys(LOW, 10.9), 12.3)
    return read_flight(folder)


@pytest.mark.slow
def test_speeds_that_follow_the_voltage_are_named_where_none_is_read(on_two_batteries, monkeypatch):
    """What is held out has no say in it."""
    asked = []

    def of_fitted(flight: Flight, vehicle: coax_env.Vehicle) -> FeltVoltage:
        asked.append({run.whole for run in flight.runs})
        return felt_voltage(flight, vehicle)

    monkeypatch.setattr(preparation, "felt_voltage", of_fitted)
    found = diagnose(on_two_batteries, hold_out=["yaw_3211"])
    (cause,) = found.findings["causes"]
    assert cause["effect"] == "battery_voltage" and BETWEEN_RUNS in cause["doubts"]
    per_volt = cause["parameters"]["battery_voltage.per_volt"]
    assert abs(per_volt["value"] - 1.0 / 12.3) < 3.0 * per_volt["std"] < 0.03
    assert asked == [{*FULL, *LOW} - {"yaw_3211"}]
    corrected = found.vehicle_after.effects["battery_voltage"]
    assert corrected["per_volt"].value == per_volt["value"]
    assert corrected["nominal"].value == pytest.approx(12.3, abs=0.3)
    assert "battery_voltage" not in found.vehicle_before.effects
    flown = found.findings["gain"]["channels"]["h"]
    assert flown["after"] < 0.7 * flown["before"]
    # refitted it has gusts as long as a run for it, which carry on for a second
    assert flown["after"] < flown["before_refitted"]


@pytest.mark.slow
@pytest.mark.parametrize("also", [(), ("battery_voltage",)])
def test_identified_numbers_do_not_answer_for_the_voltage(on_two_batteries, also):
    """By the felt thrust, or fitted with them; without a voltage in the log they do."""
    found = identify(on_two_batteries, also=also)
    known = found.after.effects["battery_voltage"]
    assert abs(known["per_volt"].value - 1.0 / 12.3) < 3.0 * known["per_volt"].std < 0.03
    assert known["nominal"].value == pytest.approx(12.3, abs=0.1)
    assert any("low battery" in line for line in found.remarks) == (not also)
    assert "battery_voltage" not in found.before.effects
    own = [name for name in found.fitted if name in LAMA.parameters]
    assert len(own) == len(found.fitted) - len(also)
    off = [abs(found.after[n].value - LAMA[n].value) / found.after[n].std for n in own]
    assert max(off) < 3.0
    before, after = (pooled_rms(r)["h"] for r in (found.replay_before, found.replay_after))
    assert after < 0.2 * before
    runs = tuple(replace(run, battery=None) for run in on_two_batteries.runs)
    blind = identify(replace(on_two_batteries, runs=runs))
    assert not blind.after.effects
    as_given, blindly = (pooled_rms(r)["h"] for r in (blind.replay_before, blind.replay_after))
    assert blindly > 5.0 * after
    assert before == pytest.approx(as_given, rel=0.05)
