"""Maneuver design: distances with a known answer, the winner where physics says what must win."""

import math
from dataclasses import replace

import numpy as np
import pytest

from coax_env import load_vehicle, read_flight
from coax_env.design.candidates import Envelope, candidates
from coax_env.design.discrimination import ROW, Alternative, distance
from coax_env.design.flight_card import write_flight_card
from coax_env.design.next_maneuver import advise, design
from coax_env.diagnosis.fits import fitted
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.estimation.engine import Engine
from coax_env.estimation.helicopter import HeliModel, record_of
from coax_env.estimation.helicopter_noise import MEMORIES, starting_noise
from coax_env.estimation.state_space import Noise
from coax_env.model.layout import CHANNELS
from coax_env.simulation.maneuvers import AXES, Maneuver, maneuver, steps_3211
from coax_env.simulation.simulate import Gusts, fly, simulate

LAMA = load_vehicle("lama400d")
MODEL = HeliModel(LAMA)
RATES = {c: 100.0 for c in CHANNELS if c not in ("pn", "pe", "v")} | {"h": 20.0, "vn": 10.0}
STILL = Noise(
    {"force_xy": 0.01, "force_z": 0.01, "moment_xy": 1e-3, "moment_z": 5e-4,
     **dict.fromkeys(MEMORIES, 0.5)},
    {"rpm_upper": 2.0, "rpm_lower": 2.0, "p": 0.035, "q": 0.035, "r": 0.035, "ax": 0.1, "ay": 0.1,
     "az": 0.1, "phi": 0.009, "theta": 0.009, "psi": 0.009, "h": 0.05, "vn": 0.2, "ve": 0.2,
     "vd": 0.2},
)  # fmt: skip
HOVER = maneuver("hover", duration=5.0)
HEAVE = Maneuver("heave", 6.0, "heave", injected={"collective": steps_3211(0.05, 1.0, 0.5)})


def alternative(effect: str, base_free: bool = True, **values: float) -> Alternative:
    free = MODEL.effect_parameters(effect)
    at = {f.name: f.value for f in free} | {f"{effect}.{k}": v for k, v in values.items()}
    base = MODEL.base_parameters() if base_free else []
    return Alternative.of(effect, LAMA, base + free, {**MODEL.bare_values, **at})


def tied_on_a_hover(
    truth, effects: tuple[str, ...], common: tuple[str, ...], gusts: Gusts
) -> tuple[list[Alternative], Noise, dict[str, float]]:
    """Both descriptions fitted to one windy hover, with what it determined of their numbers."""
    flight = simulate(truth, maneuver("hover", duration=12.0), gusts=gusts, seed=3)
    records = [record_of(run) for run in flight.runs]
    problem = Problem.of(MODEL, records, (*effects, *common))
    noise = replace(
        starting_noise(flight, LAMA),
        process=dict(
            force_xy=gusts.force_N[0], force_z=gusts.force_N[2],
            moment_xy=gusts.moment_Nm[0], moment_z=gusts.moment_Nm[2], memory=gusts.memory_s,
        ),
    )  # fmt: skip
    start = {f.name: f.value for f in problem.parameters}
    start |= MODEL.bare_values
    found = []
    for effect in effects:
        fit = fitted(problem, Fit((*common, effect), start, noise), steps=3)
        free = problem.free(fit.active)
        _, lin = problem.engine.linearise(fit.values, noise, free)
        found.append(Alternative.of(effect, LAMA, free, fit.values, lin.information.sum(0)))
    return found, noise, {c: RATES.get(c, 100.0) for c in flight.channels}


# --- the distance -----------------------------------------------------------------------------------


def test_a_model_is_no_distance_from_itself():
    own = alternative("cg_offset", x=1.5e-3, y=-1e-3)
    flown = fly(own.vehicle, HEAVE, dt=ROW)
    assert distance(flown, own, STILL, RATES) == pytest.approx(0.0, abs=1e-9)


def test_a_scale_error_of_the_accelerometer_in_closed_form():
    """Bias for scale: what stays of az is its scatter times the scale error, sample by sample.

    With nothing else free the half square of it is the distance, up to what the gust states absorb.
    """
    scale = 0.03
    truth = alternative("accel_scale", base_free=False, z=scale)
    bias = alternative("accel_bias", base_free=False, z=-0.3)
    nats = {}
    for plan in (HOVER, HEAVE):
        flown = fly(truth.vehicle, plan, dt=ROW)
        az = flown.reading("az")
        samples = ROW * RATES["az"]
        expected = 0.5 * samples * np.sum((az - az.mean()) ** 2) * (scale / (1 + scale) / 0.1) ** 2
        nats[plan.name] = distance(flown, bias, STILL, RATES)
        assert nats[plan.name] < 1.05 * expected + 0.1
        if plan is HEAVE:
            assert nats[plan.name] > 0.5 * expected
    assert nats["heave"] > 50.0 * nats["hover"]


def test_the_distance_does_not_depend_on_who_is_first():
    pair = [alternative("accel_scale", z=0.03), alternative("accel_bias", z=-0.3)]
    one = design(pair, STILL, RATES, maneuvers=[HOVER, HEAVE])
    two = design(pair[::-1], STILL, RATES, maneuvers=[HOVER, HEAVE])
    assert [p.nats for p in one.ranked] == pytest.approx([p.nats for p in two.ranked], rel=1e-9)


def test_rows_of_the_design_tell_as_much_as_rows_of_the_log():
    """Half the rows with half the variance: the distance stays within a tenth."""
    truth, other = alternative("accel_scale", z=0.03), alternative("accel_bias", z=-0.3)
    nats = [distance(fly(truth.vehicle, HEAVE, dt=dt), other, STILL, RATES) for dt in (0.01, 0.02)]
    assert nats[1] == pytest.approx(nats[0], rel=0.1)


def test_flights_bring_the_evidence_that_was_expected():
    """The log-likelihood ratio of truth and other scatters about d with a variance of 2 d."""
    truth = alternative("accel_bias", base_free=False, z=0.06)
    other = alternative("accel_bias", base_free=False, z=0.0)
    other = replace(other, known=1e12 * np.eye(3))  # nothing may move
    plan = replace(HEAVE, duration=4.0)
    expected = distance(fly(truth.vehicle, plan, dt=ROW), other, STILL, RATES)
    assert expected > 5.0
    level = STILL.process
    air = Gusts(
        (level["force_xy"], level["force_xy"], level["force_z"]),
        (level["moment_xy"], level["moment_xy"], level["moment_z"]),
    )
    ratios = []
    for seed in range(12):
        flight = simulate(truth.vehicle, plan, sensors="onboard", gusts=air, seed=seed)
        noise = replace(STILL, reading=dict(flight.noise))
        engine = Engine(MODEL, [record_of(run) for run in flight.runs])
        of_truth, of_other = (
            engine.log_likelihood(a.vehicle.values(), noise) for a in (truth, other)
        )
        ratios.append(of_truth - of_other)
    assert np.mean(ratios) == pytest.approx(expected, abs=4.0 * math.sqrt(2.0 * expected / 12))


# --- the winner -------------------------------------------------------------------------------------


@pytest.mark.slow
def test_bias_and_scale_of_az_are_parted_by_vertical_acceleration():
    found = design([alternative("accel_scale", z=0.03), alternative("accel_bias", z=-0.3)],
                   STILL, RATES)  # fmt: skip
    best = found.ranked[0].maneuver
    assert "collective" in best.injected or "height" in best.asked
    assert found.ranked[0].nats > 20.0 * found.worth("hover")
    assert [p.nats for p in found.ranked] == sorted((p.nats for p in found.ranked), reverse=True)


@pytest.mark.slow
def test_rigging_and_centre_of_gravity_are_parted_by_uneven_rotor_speeds():
    """T x against T_l's arm and tilt: both follow both speeds' square, so that only the share of
    the lower rotor parts the two moments; heave hardly beats hover."""
    truth = LAMA.with_effect("cg_offset", x=1.5e-3, y=-1e-3)
    air = Gusts((0.2, 0.2, 0.2), (2e-3, 2e-3, 1e-3))
    pair, noise, rates = tied_on_a_hover(truth, ("cg_offset", "swash_offset"), (), air)
    found = design(pair, noise, rates)
    assert "differential" in found.ranked[0].maneuver.injected
    assert found.ranked[0].nats > 2.0 * found.worth("hover")
    assert found.worth("heave_doublet") < 0.5 * found.ranked[0].nats


@pytest.mark.slow
def test_wind_and_rigging_are_parted_by_a_turn():
    truth = LAMA.with_effect("wind", north=1.2, east=0.5)
    truth = truth.with_effect("flap_blowback", gain=0.0075)
    truth = truth.with_effect("rotor_drag", coefficient=4e-4)
    air = Gusts((0.2, 0.2, 0.2), (6e-3, 6e-3, 3e-3))
    pair, noise, rates = tied_on_a_hover(
        truth, ("wind", "swash_offset"), ("flap_blowback", "rotor_drag"), air
    )
    found = design(pair, noise, rates)
    assert found.ranked[0].maneuver.name == "heading_turn"
    assert found.ranked[0].nats > found.worth("hover")


# --- the envelope -----------------------------------------------------------------------------------


@pytest.mark.slow
def test_every_candidate_but_few_is_safe_with_the_bare_vehicle():
    flown = {plan.summary: Envelope().breach(fly(LAMA, plan, dt=ROW)) for plan in candidates()}
    assert sum(bool(why) for why in flown.values()) <= 2, flown
    assert len(flown) >= 20
    assert {axis for plan in candidates() for axis in plan.injected} == set(AXES)


@pytest.mark.parametrize(
    ("limits", "plan"),
    [
        (Envelope(ceiling=1.6), HEAVE),
        (Envelope(lowest=1.45), HEAVE),
        (Envelope(speed=1.0), maneuver("forward_run")),
        (Envelope(room=3.0), maneuver("forward_run")),
        (Envelope(tilt=math.radians(3.0)), maneuver("lon_3211")),
        (Envelope(turning=math.radians(5.0)), maneuver("yaw_3211")),
    ],
)
def test_what_leaves_the_envelope_is_never_proposed(limits, plan):
    pair = [alternative("accel_scale", z=0.03), alternative("accel_bias", z=-0.3)]
    found = design(pair, STILL, RATES, envelope=limits, maneuvers=[HOVER, plan])
    assert [p.maneuver.name for p in found.ranked] == ["hover"]
    assert [(p.name, bool(why)) for p, why in found.refused] == [(plan.name, True)]


# --- what is said and written -----------------------------------------------------------------------


def test_the_advice_says_what_to_expect(tmp_path):
    pair = [alternative("accel_scale", z=0.03), alternative("accel_bias", z=-0.3)]
    found = design(pair, STILL, RATES, maneuvers=[HOVER, HEAVE])
    said = advise(found, 0.5 * found.ranked[0].nats)
    assert said["maneuver"] == "heave" and said["separates"] == ["accel_scale", "accel_bias"]
    assert f"by {found.ranked[0].nats:.1f} nats; hover by 0.0" in said["why"]
    assert (
        "No maneuver" not in said["why"]
        and "No maneuver" in advise(found, 2.0 * found.ranked[0].nats)["why"]
    )
    assert advise(None, 12.0) is None

    flight = simulate(LAMA, HOVER)
    folder = write_flight_card(found, flight, tmp_path / "next_flight")
    card = read_flight(folder)
    assert card.run_names == ("heave",) and card.runs[0].duration == pytest.approx(6.0)
    asked = np.genfromtxt(folder / "asked.csv", delimiter=",", names=True)
    assert set(asked["height_m"]) == {1.5}
    steps = asked["add_rpm_upper"] / (asked["add_rpm_upper"].max() / 0.05)
    assert np.allclose(sorted(set(np.round(steps, 4))), [-0.05, 0.0, 0.05])
