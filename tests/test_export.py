"""Exported controllers: the C does what the original does, by itself, and says what it needs."""

import re
import shutil
import subprocess
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from coax_env import InputError, load_vehicle
from coax_env.model.sensors import slow_instruments, suite
from controllers.export import c_values, compiled
from controllers.export.c_code import c_files
from controllers.loading import make_controller

LAMA = load_vehicle("lama400d")
BAR = 1e-4  # of a command's range, over a whole flight
needs_compiler = pytest.mark.skipif(compiled.compiler() is None, reason="no C compiler")

KINDS = (
    ("lqg", "onboard"), ("lqg", "mocap"), ("scheduled", "mocap"), ("pid", "onboard"),
    ("pid", "mocap"), ("ppo", None), ("ppo_outdoor", "onboard"), ("ppo_outdoor", "mocap"),
)  # fmt: skip
QUICK = (("pid", "onboard"), ("ppo_outdoor", "mocap"))
FAR = [(10.0, 0.0, 1.5, 0.0), (12.0, 0.5, 2.0, 0.5)]


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """Kind and sensors -> the controller, its compiled export, and the folder."""
    made = {}

    def make(kind, sensors):
        if (kind, sensors) not in made:
            controller = make_controller(kind, LAMA, sensors=sensors)
            folder = tmp_path_factory.mktemp(kind)
            for name, text in c_files(controller).items():
                (folder / name).write_text(text)
            work = tmp_path_factory.mktemp("work")
            made[kind, sensors] = controller, compiled.Compiled(controller, folder, work), folder
        return made[kind, sensors]

    return make


def readings(sensors: str, count: int, rows: int, seed: int) -> np.ndarray:
    """Observations (rows, count, n): about hover, the heading anywhere, flags by chance."""
    rng = np.random.default_rng(seed)
    own = suite(sensors)
    size = {"rev/min": 40.0, "rad": 0.1, "rad/s": 0.3, "m/s2": 0.3, "m/s": 0.3, "m": 0.5}
    at = {"rpm_upper": 2000.0, "rpm_lower": 2000.0, "az": -9.8, "h": 1.5}
    found = np.stack(
        [at.get(s.name, 0.0) + size[s.unit] * rng.standard_normal((rows, count)) for s in own], -1
    )
    names = [s.name for s in own]
    found[..., names.index("psi")] = rng.uniform(-3.1, 3.1, (1, count))
    found[..., names.index("psi")] += 0.02 * rng.standard_normal((rows, count))
    flags = rng.uniform(size=(rows, count, len(slow_instruments(own)))) < 0.5
    return np.concatenate([found, flags], axis=-1).astype(np.float32)


@needs_compiler
@pytest.mark.parametrize(
    ("kind", "sensors"),
    [k if k in QUICK else pytest.param(*k, marks=pytest.mark.slow) for k in KINDS],
)
def test_any_readings_give_the_same_commands(kind, sensors, exported):
    controller, c, _ = exported(kind, sensors)
    seen = readings(controller.sensors, 4, 300, seed=3)
    controller.reset(4)
    c.reset(4)
    for row in seen:
        asked, given = controller.act(row), c.act(row)
        np.testing.assert_allclose(given, asked, rtol=0.0, atol=2.0 * BAR)
        trim, scale = controller.nominal
        np.testing.assert_allclose(c.commands, trim + scale * given, rtol=1e-6)


@needs_compiler
@pytest.mark.parametrize(
    ("kind", "sensors", "flown"),
    [
        ("pid", "onboard", {}),
        ("ppo_outdoor", "mocap", {"task": "waypoints", "wind": 4.0, "turbulence": "moderate"}),
        *(
            pytest.param(*flown, marks=pytest.mark.slow)
            for flown in (
                ("lqg", "onboard", {}),
                ("ppo", None, {"wind": 2.0, "turbulence": "light"}),
                ("lqg", "mocap", {"task": "waypoints"}),
                ("scheduled", "mocap", {"task": "waypoints", "target": FAR}),
                ("pid", "mocap", {"task": "waypoints"}),
            )
        ),
    ],
)
def test_it_flies_the_same_flight(kind, sensors, flown, exported):
    controller, c, _ = exported(kind, sensors)
    vehicle = LAMA.with_effect("rotor_drag", coefficient=3e-4) if "wind" in flown else LAMA
    difference = compiled.command_difference(controller, c, vehicle, 10.0, 2, 5, flown)
    assert 0.0 < difference <= BAR


@needs_compiler
@pytest.mark.parametrize("kind", ["lqg", "pid"])
def test_a_reading_that_is_no_number_is_none(kind, exported):
    """A filter ignores it, as the original does; the cascade takes the last one that was a number."""
    controller, c, _ = exported(kind, "onboard")
    seen = readings("onboard", 3, 200, seed=4)
    gone = np.random.default_rng(5).uniform(size=seen.shape) < 0.1
    gone[0] = False
    gone[..., len(suite("onboard")) :] = False
    lost = np.where(gone, np.nan, seen)
    held = seen.copy()
    for k in range(1, len(held)):
        held[k] = np.where(gone[k], held[k - 1], held[k])
    controller.reset(3)
    c.reset(3)
    for k in range(len(seen)):
        wanted = controller.act(held[k] if kind == "pid" else lost[k])
        np.testing.assert_allclose(c.act(lost[k]), wanted, rtol=0.0, atol=2.0 * BAR)


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize(("kind", "sensors"), KINDS)
def test_no_readings_at_all_give_commands_that_are_numbers(kind, sensors, exported):
    controller, c, _ = exported(kind, sensors)
    width = len(readings(controller.sensors, 1, 1, 0)[0, 0])
    way = 4 if controller.sensors == "mocap" else 0
    c.reset(1)
    for k in range(100):
        row = np.full((1, width + way), (np.nan, np.inf, -np.inf)[k % 3], dtype=np.float32)
        assert (np.abs(c.act(row)) <= 1.0).all() and np.isfinite(c.commands).all()


@pytest.mark.slow
@needs_compiler
@pytest.mark.skipif(shutil.which("nm") is None, reason="no nm")
@pytest.mark.parametrize(("kind", "sensors"), KINDS)
def test_it_needs_nothing_but_mathematics(kind, sensors, exported, tmp_path):
    """No heap, no files, no double: what the object asks the linker for, and nothing that changes."""
    _, _, folder = exported(kind, sensors)
    part = compiled.build(
        [folder / "coax_controller.c"], tmp_path / "controller.o", "-c", "-fno-pic"
    )
    said = subprocess.run(["nm", str(part)], capture_output=True, text=True, check=True).stdout
    wanted = {line.split()[-1] for line in said.splitlines() if " U " in line}
    assert wanted <= {
        "sinf", "cosf", "sincosf", "hypotf", "floorf", "tanhf", "fmaxf", "fminf", "memset",
        "memcpy", "memmove", "_GLOBAL_OFFSET_TABLE_", "__stack_chk_fail", "sqrtf",
    }  # fmt: skip
    assert not re.search(r" [bBdDC] ", said), "a variable outlives the call"


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "sensors"), KINDS)
def test_the_interface_names_the_envs_observations(kind, sensors):
    controller = make_controller(kind, LAMA, sensors=sensors)
    text = c_files(controller)["coax_controller.h"]
    block = text[text.index("enum {") : text.index("COAX_OBSERVED\n")]
    entries = re.findall(r"COAX_(\w+),\s+/\* (?:\[(\S+ ?\S*)\] )?", block)
    env = gymnasium.make("CoaxHeli-v0", sensors=controller.sensors).unwrapped
    assert len(entries) == len(env.observation_names)
    for (name, unit), theirs, their_unit in zip(
        entries, env.observation_names, env.observation_units, strict=True
    ):
        assert name.lower().removesuffix("_is_new") in theirs
        assert not unit or unit == their_unit
    assert f"every {1 / env.metadata.get('control_hz', 100):g} s" in text


def test_another_kind_is_refused():
    with pytest.raises(InputError, match="lqi"):
        c_files(make_controller("lqi", LAMA))


def test_a_literal_is_the_float_it_was():
    for value in np.float32([0.0, 1.0, -1.5, 1e-30, 3.0e8, 1 / 3, np.pi, -123456.78]):
        text = c_values.literal(value)
        assert text.endswith("f") and np.float32(text[:-1]) == value
        assert "." in text or "e" in text
    with pytest.raises(ValueError, match="nan"):
        c_values.literal(np.nan)


@pytest.mark.parametrize(
    ("kind", "sensors", "size"), [("ppo", None, 30.0), ("ppo_outdoor", "mocap", 1.0)]
)
def test_the_network_as_onnx(kind, sensors, size):
    onnx = pytest.importorskip("onnx")
    from onnx.reference import ReferenceEvaluator

    from controllers.export.onnx_network import onnx_bytes

    policy = make_controller(kind, sensors=sensors)
    policy.reset(7)
    model = onnx.load_from_string(onnx_bytes(policy))
    onnx.checker.check_model(model, full_check=True)
    known = size * policy.scales * np.random.default_rng(1).standard_normal((7, len(policy.scales)))
    (found,) = ReferenceEvaluator(model).run(None, {"known": known.astype(np.float32)})
    wanted = np.clip(policy.actions_from_estimate(known), -1.0, 1.0)
    np.testing.assert_allclose(found, wanted, rtol=0.0, atol=1e-5)
    assert found.std() > 0.1
    facts = {entry.key: entry.value for entry in model.metadata_props}
    assert facts["known"].split()[: len(policy.estimator.states)] == list(policy.estimator.states)
    assert len(facts["known"].split()) == len(policy.scales)


@needs_compiler
def test_its_cost_is_measured(exported, tmp_path):
    _, _, folder = exported("pid", "onboard")
    cost = compiled.cost(folder, tmp_path)
    assert 0.0 < cost.microseconds < 1e4 and 0 < cost.memory < 4096
    assert Path(folder, "coax_numbers.h").stat().st_size > 0
