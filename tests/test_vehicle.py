"""Vehicle files: the paper's tables, an exact round trip, every bad field named in one line."""

import math
import tomllib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coax_env import InputError, load_vehicle
from coax_env.model import effects, parameters
from coax_env.model.vehicle import Parameter
from coax_env.model.vehicle_file import shipped_vehicles, vehicle_toml

LAMA = load_vehicle("lama400d")

# Huynh et al. 2012, Tables I-IV, as design/paper.md restores them
PAPER = {
    "mass": (0.8, 0.01), "gravity": (9.804, 0), "air_density": (1.14, 0), "rotor_radius": (0.25, 0),
    "fuselage_length": (0.14, 0.01), "fuselage_width": (0.04, 0.01),
    "arm_upper": (0.185, 0.01), "arm_lower": (0.105, 0.01),
    "inertia_xx": (5.33e-3, 0.05), "inertia_yy": (6.26e-3, 0.05), "inertia_zz": (2.50e-3, 0.05),
    "rotor_inertia_upper": (7.66e-4, 0.05), "rotor_inertia_lower": (7.66e-4, 0.05),
    "flybar_inertia": (2.55e-4, 0.05),
    "flap_time_constant": (0.05, 0.07), "flybar_time_constant": (3.0, 0.07),
    "swash_to_flap": (0.91, 0.03), "flybar_to_rotor_lon": (0.54, 0.03),
    "flybar_to_rotor_lat": (0.54, 0.03),
    "thrust_coefficient_upper": (7.18e-3, 0.02), "thrust_coefficient_lower": (4.98e-3, 0.02),
    "torque_coefficient_upper": (5.98e-4, 0.02), "torque_coefficient_lower": (5.20e-4, 0.02),
    "flap_coupling_lon": (0.0, 0), "flap_coupling_lat": (0.0, 0),
}  # fmt: skip
"""Value, and the relative std that contract.md gives where the paper states none."""


@pytest.mark.parametrize("name", list(PAPER))
def test_numbers_of_the_paper(name):
    value, spread = PAPER[name]
    found = LAMA[name]
    assert found.value == value
    assert found.std == pytest.approx(spread * value, rel=1e-3)
    assert "Table" in found.source or "eq" in found.source or "Bandung" in found.source


def test_derived_numbers_of_the_paper():
    v = LAMA.values()
    k_T = v["air_density"] * math.pi * v["rotor_radius"] ** 4
    assert k_T == pytest.approx(1.40e-2, rel=0.005)
    assert k_T * v["rotor_radius"] == pytest.approx(3.49e-3, rel=0.005)


def test_numbers_of_the_real_helicopter():
    """shared/flights/README.md: mass, arms, k_T and k_M of the bench."""
    v = load_vehicle("skybotix_coax").values()
    assert (v["mass"], v["arm_upper"], v["arm_lower"]) == (0.302, 0.165, 0.103)
    k_T = v["air_density"] * math.pi * v["rotor_radius"] ** 4
    assert v["thrust_coefficient_upper"] * k_T == pytest.approx(2.2607e-5, rel=1e-4)
    assert v["thrust_coefficient_lower"] * k_T == pytest.approx(3.1531e-5, rel=1e-4)
    k_Q = k_T * v["rotor_radius"]
    assert v["torque_coefficient_upper"] * k_Q == pytest.approx(9.9708e-7, rel=1e-4)
    assert v["torque_coefficient_lower"] * k_Q == pytest.approx(8.9737e-7, rel=1e-4)


@pytest.mark.parametrize("name", shipped_vehicles())
def test_shipped_files_are_complete(name):
    vehicle = load_vehicle(name)
    assert set(vehicle.parameters) == set(parameters.BASE)
    assert bool(vehicle.effects) is name.endswith("_outdoor")  # the others are bare
    own = [p for table in (*vehicle.effects.values(), vehicle.actuators) for p in table.values()]
    for parameter in (*vehicle.parameters.values(), *own):
        assert parameter.std >= 0 and parameter.source


# --- round trip ---------------------------------------------------------------------------------

finite = st.floats(allow_nan=False, allow_infinity=False, width=64)
positive = st.floats(min_value=1e-12, max_value=1e12)


def same(a, b):
    assert a.values() == b.values()
    assert dict(a.parameters) == dict(b.parameters)
    assert {k: dict(t) for k, t in a.effects.items()} == {k: dict(t) for k, t in b.effects.items()}
    assert (a.name, a.description, a.correlated) == (b.name, b.description, b.correlated)
    np.testing.assert_array_equal(a.vector, b.vector)
    assert (a.correlation is None) == (b.correlation is None)
    if a.correlation is not None:
        np.testing.assert_array_equal(a.correlation, b.correlation)


@settings(max_examples=30, deadline=None)
@given(value=positive, std=positive, gain=finite, text=st.text(max_size=40))
def test_round_trip_is_exact(tmp_path_factory, value, std, gain, text):
    text = "".join(c for c in text if c.isprintable())
    vehicle = LAMA.with_parameters(
        {
            "mass": Parameter(value, std, "kg", text),
            "ground_effect.gain": Parameter(gain, std, "1", "fit"),
        }
    )
    path = tmp_path_factory.mktemp("vehicle") / "v.toml"
    path.write_text(vehicle_toml(vehicle), encoding="utf-8")
    same(load_vehicle(path), vehicle)


def test_round_trip_with_every_effect_covariance_and_provenance(tmp_path):
    from dataclasses import replace

    vehicle = LAMA
    for entry in effects.CATALOGUE.values():
        values = {p.name: p.off + 0.1 * p.usual for p in entry.parameters}
        vehicle = vehicle.with_effect(entry.name, **values)
    vehicle = replace(
        vehicle,
        correlated=("mass", "ground_effect.gain"),
        correlation=np.array([[1.0, 1 / 3], [1 / 3, 1.0]]),
        provenance={"flights": ["00ff"], "command": "scripts/identify.py x"},
    )
    path = tmp_path / "v.toml"
    path.write_text(vehicle_toml(vehicle), encoding="utf-8")
    back = load_vehicle(str(path))
    same(back, vehicle)
    assert back.provenance == {"flights": ["00ff"], "command": "scripts/identify.py x"}
    assert load_vehicle(back) is back


def test_bare_model_of_an_extended_one():
    extended = LAMA.with_effect("ground_effect", gain=0.3)
    assert extended["ground_effect.gain"].value == 0.3
    assert extended["ground_effect.decay"].value == 2.0
    same(extended.without_effects(), LAMA)
    assert "ground_effect" not in LAMA.effects  # copies, not changes


# --- bad files ----------------------------------------------------------------------------------


def edited(change):
    """The shipped file as text, after a change to its table."""
    import tomlkit

    document = tomllib.loads(vehicle_toml(LAMA))
    change(document)
    return tomlkit.dumps(document)


def effect_entry(**fields):
    return {"value": 0.1, "std": 0.0, "unit": "1", "source": "test"} | fields


def correlated(names, matrix):
    return lambda d: d.update(covariance={"names": names, "correlation": matrix})


BAD = {
    "no parameters": (lambda d: d.pop("parameters"), r"\[parameters\] is missing"),
    "parameters no table": (lambda d: d.update(parameters=3), r"\[parameters\]"),
    "missing": (lambda d: d["parameters"].pop("mass"), "parameters.mass is missing"),
    "unknown": (
        lambda d: d["parameters"].update(wingspan=d["parameters"]["mass"]),
        "parameters.wingspan is not",
    ),
    "no table": (lambda d: d["parameters"].update(mass=0.8), "parameters.mass must have value"),
    "no std": (lambda d: d["parameters"]["mass"].pop("std"), "parameters.mass has no std"),
    "no source": (lambda d: d["parameters"]["mass"].pop("source"), "parameters.mass has no source"),
    "text": (
        lambda d: d["parameters"]["mass"].update(value="heavy"),
        "mass.value must be a number",
    ),
    "true": (lambda d: d["parameters"]["mass"].update(value=True), "mass.value must be a number"),
    "nan": (lambda d: d["parameters"]["mass"].update(value=math.nan), "mass.value must be finite"),
    "inf": (lambda d: d["parameters"]["mass"].update(std=math.inf), "mass.std must be finite"),
    "negative std": (lambda d: d["parameters"]["mass"].update(std=-1.0), "must not be negative"),
    "zero mass": (lambda d: d["parameters"]["mass"].update(value=0), "mass must be positive"),
    "unit": (lambda d: d["parameters"]["mass"].update(unit="g"), "must be in 'kg', found 'g'"),
    "effects no table": (lambda d: d.update(effects=[1]), r"\[effects\]"),
    "unknown effect": (
        lambda d: d.update(effects={"magic": {"gain": effect_entry()}}),
        "effects.magic is not in the catalogue",
    ),
    "unknown effect parameter": (
        lambda d: d.update(effects={"ground_effect": {"size": effect_entry()}}),
        "ground_effect.size is not a parameter",
    ),
    "effect unit": (
        lambda d: d.update(effects={"ground_effect": {"gain": effect_entry(unit="m")}}),
        "ground_effect.gain must be in '1'",
    ),
    "covariance without names": (
        lambda d: d.update(covariance={"correlation": [[1.0]]}),
        r"\[covariance\] needs names",
    ),
    "covariance shape": (correlated(["mass"], [[1.0, 0.0], [0.0, 1.0]]), "must be 1 x 1"),
    "covariance twice": (
        correlated(["mass", "mass"], [[1.0, 0.0], [0.0, 1.0]]),
        "has a name twice",
    ),
    "covariance asymmetric": (
        correlated(["mass", "arm_lower"], [[1.0, 0.5], [0.1, 1.0]]),
        "must be symmetric",
    ),
    "covariance diagonal": (
        correlated(["mass", "arm_lower"], [[2.0, 0.5], [0.5, 1.0]]),
        "unit diagonal",
    ),
    "covariance indefinite": (
        correlated(["mass", "arm_lower"], [[1.0, 1.5], [1.5, 1.0]]),
        "not positive definite",
    ),
    "covariance of nothing": (
        correlated(["mass", "magic"], [[1.0, 0.5], [0.5, 1.0]]),
        "'magic'",
    ),
}


@pytest.mark.parametrize("case", list(BAD))
def test_bad_file_is_told_in_one_line(tmp_path, case):
    change, message = BAD[case]
    path = tmp_path / "bad.toml"
    path.write_text(edited(change))
    with pytest.raises(InputError, match=message) as caught:
        load_vehicle(path)
    assert "bad.toml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_bad_paths_are_told_in_one_line(tmp_path):
    (tmp_path / "broken.toml").write_text("name = [")
    (tmp_path / "binary.toml").write_bytes(b"\xff\x00\xfe")
    for source, message in (
        ("lama500", "no vehicle 'lama500'"),
        (tmp_path / "gone.toml", "no vehicle"),
        (tmp_path, "folder"),
        (tmp_path / "broken.toml", "not valid TOML"),
        (tmp_path / "binary.toml", "binary, not text"),
    ):
        with pytest.raises(InputError, match=message) as caught:
            load_vehicle(source)
        assert "\n" not in str(caught.value)


def test_unknown_names_in_python():
    with pytest.raises(KeyError, match="wingspan"):
        LAMA.with_values({"wingspan": 1.0})
    with pytest.raises(KeyError, match="size"):
        LAMA.with_effect("ground_effect", size=1.0)
    with pytest.raises(KeyError, match="ground_effect"):
        LAMA["ground_effect.gain"]


# --- draws --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_draws_are_log_normal_with_the_files_mean_and_spread():
    wide = LAMA.with_parameters({"inertia_zz": Parameter(2.5e-3, 1.5e-3, "kg m2", "test")})
    wide = wide.with_parameters({"cg_offset.x": Parameter(0.001, 0.002, "m", "test")})
    rng = np.random.default_rng(0)
    drawn = [wide.draw(rng) for _ in range(2000)]
    inertia = np.array([v["inertia_zz"].value for v in drawn])
    offset = np.array([v["cg_offset.x"].value for v in drawn])
    assert inertia.min() > 0.0
    assert inertia.mean() == pytest.approx(2.5e-3, rel=0.05)
    assert inertia.std() == pytest.approx(1.5e-3, rel=0.12)
    logs = np.log(inertia)
    skew = np.mean((logs - logs.mean()) ** 3) / logs.std() ** 3
    assert abs(skew) < 0.2
    assert (offset < 0).any() and offset.mean() == pytest.approx(0.001, abs=2e-4)
    assert all(v["gravity"].value == 9.804 for v in drawn[:5])  # exact numbers stay


def test_draws_keep_the_correlation():
    from dataclasses import replace

    tied = replace(
        LAMA,
        correlated=("thrust_coefficient_upper", "thrust_coefficient_lower"),
        correlation=np.array([[1.0, -0.9], [-0.9, 1.0]]),
    )
    rng = np.random.default_rng(1)
    pairs = np.array(
        [[d[n].value for n in tied.correlated] for d in (tied.draw(rng) for _ in range(1500))]
    )
    assert np.corrcoef(np.log(pairs.T))[0, 1] == pytest.approx(-0.9, abs=0.02)


def test_same_seed_same_vehicle():
    draws = [LAMA.draw(np.random.default_rng(7)).values() for _ in range(2)]
    assert draws[0] == draws[1]


def test_flight_cards_air_replaces_the_files():
    vehicle = LAMA.in_air({"density": 1.2})
    assert vehicle["air_density"].value == 1.2 and vehicle["gravity"].value == 9.804
    assert vehicle["air_density"].source == "flight card"
