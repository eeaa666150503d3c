"""Several flights under one set of numbers, on pendulums: parts of unequal length, each by itself."""

from dataclasses import replace

import numpy as np
import pytest
from test_estimation import NOISE, TRUTH, Pendulum, prior, swing

from coax_env.estimation.engine import Engine
from coax_env.estimation.parted_engine import Part, PartedEngine, joint_noise, of_part
from coax_env.estimation.quadratic import penalty
from coax_env.estimation.state_space import Noise

COUNTS = {"A": 1, "B": 3, "C": 2}
LOUD = replace(NOISE, process={"torque": 0.7})
NOISES = {"A": NOISE, "B": LOUD, "C": NOISE}
JOINT = joint_noise(NOISES)
VALUES = {**TRUTH, "damping@B": 0.2, "bias@C": 0.05}
OWN = {"A": TRUTH, "B": {**TRUTH, "damping": 0.8}, "C": {**TRUTH, "bias": 0.05}}


@pytest.fixture(scope="module")
def engine() -> PartedEngine:
    """Six records in three parts, each with a model and records of its own."""
    seeds = iter(range(20, 40))
    parts = [
        Part(name, Engine(Pendulum(), [swing(next(seeds), n=80 + 20 * k) for k in range(count)]))
        for name, count in COUNTS.items()
    ]
    return PartedEngine(parts)


def test_records_are_those_of_all_parts_in_their_order(engine):
    assert engine.records == tuple(r for part in engine.parts for r in part.engine.records)
    assert engine.model is engine.parts[0].engine.model
    assert len({r.name for r in engine.records}) == 6


def test_each_parts_records_are_filtered_with_its_own_numbers_and_noise(engine):
    alone = [
        run.log_likelihood
        for part in engine.parts
        for run in part.engine.filter(OWN[part.name], NOISES[part.name])
    ]
    found = [run.log_likelihood for run in engine.filter(VALUES, JOINT)]
    assert found == alone and len(set(found)) == 6
    some = [run.log_likelihood for run in engine.filter(VALUES, JOINT, which=[0, 2, 5])]
    assert some == [alone[0], alone[2], alone[5]]


def test_rows_are_kept_record_by_record(engine):
    rows = [np.arange(k + 1) for k in range(6)]
    kept = [run.start_covariances.shape[0] for run in engine.filter(VALUES, JOINT, start_rows=rows)]
    assert kept == [1, 2, 3, 4, 5, 6]


def test_the_cost_at_frozen_gains_is_the_parts_sum_and_the_priors(engine):
    free = [prior("damping", 0.3), prior("bias", 0.1)]
    passes = engine.filter(VALUES, JOINT, keep=True)
    moved = {**VALUES, "stiffness": 9.3, "bias": 0.02}
    expected, first = penalty(free, moved), 0
    for part in engine.parts:
        own = {**OWN[part.name], "stiffness": 9.3}
        own["bias"] += 0.02
        count = COUNTS[part.name]
        ours = passes[first : first + count]
        expected += part.engine.frozen_cost(ours, (), own, NOISES[part.name])
        first += count
    assert engine.frozen_cost(passes, free, moved, JOINT) == pytest.approx(expected, rel=1e-12)


def test_a_joint_numbers_column_stands_in_every_part_that_it_moves(engine):
    """The plain one's in all, a part's in its own records alone; its change is the part's own."""
    free = [prior("damping", 0.3), replace(prior("damping", 0.3), name="damping@B", value=0.0)]
    _, lin = engine.linearise(VALUES, JOINT, free)
    assert lin.names == ("damping", "damping@B") and lin.information.shape == (6, 2, 2)
    inside = np.array([False, True, True, True, False, False])
    np.testing.assert_array_equal(lin.slope[:, 1], np.where(inside, lin.slope[:, 0], 0.0))
    one = lin.information[:, 0, 0]
    assert (one > 0.0).all()
    for i, j in ((0, 1), (1, 1)):
        np.testing.assert_array_equal(lin.information[:, i, j], np.where(inside, one, 0.0))
    np.testing.assert_array_equal(
        lin.by_channel[:, 1], lin.by_channel[:, 0] * inside[:, None]
    )  # fmt: skip
    blocks = np.abs(lin.blocks)
    assert blocks.shape[0] > 6 and 0 < (blocks[:, 1] > 0.0).sum() < len(blocks)


def test_a_parts_numbers_are_the_joint_ones_its_own_and_its_changes_within_limits():
    part = Part("B", None, {"gravity": 9.7}, {"time": (0.0, 0.5)})  # type: ignore[arg-type]
    joint = {"gravity": 9.8, "time": 0.1, "time@B": -0.3, "mass": 0.8, "mass@A": 0.1, "lag@B": 0.2}
    expected = {"gravity": 9.7, "time": 0.0, "mass": 0.8, "lag": 0.2}
    assert part.values(joint) == pytest.approx(expected)
    assert part.values({**joint, "time@B": 0.9})["time"] == 0.5
    assert part.levels(["torque@A", "torque@B", "p@B"]) == ("torque", "p")


def test_noise_of_all_parts_comes_back_part_by_part(engine):
    for part in engine.parts:
        assert part.noise(JOINT) == Noise(
            NOISES[part.name].process, NOISES[part.name].reading, NOISES[part.name].floor
        )
    assert JOINT.process[of_part("torque", "B")] == 0.7 and "torque" not in JOINT.process
    with pytest.raises(NotImplementedError):
        engine.noise_score(VALUES, JOINT)
