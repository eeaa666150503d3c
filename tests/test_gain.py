"""What correcting a model is worth, on traces made by hand: contract.md's formula in numbers.

error_removed_percent = 100 (1 - mean over channels of e_after/e_before), e^2 = max(rms^2 - noise^2, 0).
"""

import json
import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from coax_env.diagnosis.gain import BLOCK, LEAST_BLOCKS, flies_worse, gain_of
from coax_env.diagnosis.remarks import lost_in_noise
from coax_env.estimation.prediction import ChannelReplay, RunReplay

NOISE = {"h": 0.3, "q": 0.05, "psi": 0.01}


def run(
    errors: Mapping[str, np.ndarray | float],
    name: str = "run",
    starts: int = 40,
    diverged: bool = False,
    floor: Mapping[str, float] | None = None,
) -> RunReplay:
    """A run whose prediction errors are these, one number or one for each start."""
    channels = {}
    for channel, given in errors.items():
        error = np.broadcast_to(np.asarray(given, float), starts).copy()
        t = 2.0 + 0.25 * np.arange(starts)
        channels[channel] = ChannelReplay(t, np.zeros(starts), error, error, error)
    return RunReplay(name, channels, diverged, floor or {})


def gain(before, refitted, after, noise=NOISE, **more):
    """`gain_of` single runs, or lists of them; JSON, as findings.json has it."""
    groups = [g if isinstance(g, list) else [g] for g in (before, refitted, after)]
    result = gain_of(*groups, noise, 1.0, **more)
    assert json.loads(json.dumps(result, allow_nan=False)) == result
    return result


def test_the_share_removed_is_the_contracts():
    """Height 0.5 over a noise of 0.3 is an error of 0.4; pitch rate 0.13 over 0.05 one of 0.12."""
    found = gain(
        run({"h": 0.5, "q": 0.13}),
        run({"h": math.hypot(0.3, 0.3), "q": 0.13}),
        run({"h": math.hypot(0.3, 0.1), "q": math.hypot(0.05, 0.03)}),
    )
    assert found["error_removed_percent"] == pytest.approx(100.0 * (1 - (1 / 4 + 1 / 4) / 2))
    assert found["refitted_base_percent"] == pytest.approx(100.0 * (1 - (3 / 4 + 1) / 2))
    assert found["horizon_s"] == 1.0 and found["held_out"] == []
    h, q = found["channels"]["h"], found["channels"]["q"]
    assert set(found["channels"]) == {"h", "q"}
    assert (h["before"], h["noise"], h["unit"]) == (pytest.approx(0.5), 0.3, "m")
    assert h["before_refitted"] == pytest.approx(math.sqrt(0.18))
    assert (q["after"], q["unit"]) == (pytest.approx(math.sqrt(0.0034)), "rad/s")
    assert "black_box_percent" not in found


def test_a_worse_model_removes_less_than_nothing():
    found = gain(run({"h": 0.5}), run({"h": 0.5}), run({"h": math.hypot(0.3, 0.8)}))
    assert found["error_removed_percent"] == pytest.approx(-100.0)


@pytest.mark.parametrize(
    ("interval", "worse"),
    [([-40.0, -2.0], True), ([-40.0, 2.0], False), ([2.0, 40.0], False), ([None, None], False)],
)
def test_it_flies_worse_where_chance_does_not_do_that(interval, worse):
    assert flies_worse({"ci95": interval}, begun=False) == worse
    assert not flies_worse({"ci95": interval}, begun=True), "they may have been flown before"
    assert not flies_worse(None, begun=False)


def test_below_the_noise_nothing_is_left_and_no_error_is_no_channel():
    """A channel without an error before says nothing; with none at all there is no percentage."""
    both = gain(run({"h": 0.5, "q": 0.04}), run({"h": 0.5, "q": 0.04}), run({"h": 0.2, "q": 5.0}))
    assert both["error_removed_percent"] == pytest.approx(100.0)
    none = gain(run({"q": 0.04}), run({"q": 0.04}), run({"q": 0.04}))
    assert none["error_removed_percent"] is None and none["ci95"] == [None, None]
    assert none["channels"]["q"]["after"] == pytest.approx(0.04)


def test_of_few_starts_the_interval_has_a_width_and_of_nothing_flown_there_is_no_gain():
    """Of one block every draw is the same, as though nothing were by chance."""
    rng = np.random.default_rng(2)
    for starts in (LEAST_BLOCKS, BLOCK, 3 * BLOCK, 10 * BLOCK):
        h = rng.uniform(0.4, 0.6, starts)
        found = gain(*(run({"h": x * h}, starts=starts) for x in (1.0, 1.0, 1.2)))
        low, high = found["ci95"]
        assert low < found["error_removed_percent"] < high
        low, high = found["channels"]["h"]["ci95"]
        assert low < found["channels"]["h"]["after"] < high
    none = run({}, starts=0)
    assert gain(none, none, none) is None


def test_a_channel_that_is_lost_in_noise_counts_by_chance():
    """Pitch rate 0.0502 by chance over a noise of 0.05, an error of 0.0045, then 0.0135: thrice."""
    rng = np.random.default_rng(3)

    def drawn(rms: float) -> np.ndarray:
        noise = rng.standard_normal(400)
        return rms * noise / np.sqrt(np.mean(noise**2))

    bare = run({"h": 0.5, "q": drawn(0.0502)}, starts=400)
    after = run({"h": math.hypot(0.3, 0.2), "q": drawn(math.hypot(0.05, 0.0135))}, starts=400)
    found = gain(bare, bare, after)
    assert found["error_removed_percent"] == pytest.approx(100.0 * (1 - (0.5 + 3.0) / 2), abs=2.0)
    other = found["beyond_noise"]
    assert other["without"] == ["q"]
    assert other["error_removed_percent"] == pytest.approx(50.0)
    assert other["ci95"] == pytest.approx([50.0, 50.0])
    (words,) = lost_in_noise(found)
    assert "pitch rate" in words and "50 %" in words
    assert not flies_worse(found, begun=False)
    told = gain(run({"h": 0.5, "q": 0.13}), bare, after)
    assert "beyond_noise" not in told and lost_in_noise(told) == [] and lost_in_noise(None) == []


def test_the_rms_is_over_all_starts_of_all_runs():
    """40 starts of 3 and 10 of 8: rms^2 = (40 9 + 10 64)/50; missing readings count for nothing."""
    some = np.full(20, 8.0)
    some[::2] = np.nan
    pair = [run({"h": 3.0}), run({"h": some}, starts=20)]
    found = gain(pair, pair, pair, {"h": 0.0})
    assert found["channels"]["h"]["before"] == pytest.approx(math.sqrt(20.0))


def test_a_run_that_diverged_and_channels_that_are_not_compared_do_not_count():
    pair = [run({"h": 0.5, "az": 9.0}), run({"h": 100.0, "az": 9.0}, diverged=True)]
    found = gain(pair, pair, pair)
    assert set(found["channels"]) == {"h"}
    assert found["channels"]["h"]["before"] == pytest.approx(0.5)


def test_a_run_that_does_not_read_a_channel_counts_for_the_others():
    """Its blocks are drawn with all others; what it does not read is neither right nor wrong."""
    rng = np.random.default_rng(8)
    both = run({"phi": rng.normal(0.0, 0.2, 40), "h": rng.normal(0.0, 0.3, 40)}, "both")
    one = run({"phi": rng.normal(0.0, 0.2, 80)}, "no height", 80)
    found = gain([both, one], [both, one], [both, one], {"phi": 0.0, "h": 0.0})
    for channel, flown in (("phi", [both, one]), ("h", [both])):
        errors = np.concatenate([r.channels[channel].error for r in flown])
        known = found["channels"][channel]
        assert known["before"] == pytest.approx(np.sqrt(np.mean(errors**2)))
        assert known["ci95"][0] < known["after"] < known["ci95"][1]


def test_intervals_without_scatter_are_points():
    found = gain(run({"h": 0.5}), run({"h": 0.4}), run({"h": math.hypot(0.3, 0.1)}))
    assert found["ci95"] == pytest.approx([75.0, 75.0])
    assert found["channels"]["h"]["ci95"] == pytest.approx([math.sqrt(0.1)] * 2)


def test_an_interval_is_that_of_independent_blocks():
    """rms of n independent errors: std sigma/sqrt(2n); one error for each block: n the blocks."""
    rng = np.random.default_rng(3)
    widths = []
    for errors in (
        rng.standard_normal(400 * BLOCK),
        np.repeat(rng.standard_normal(400), BLOCK),
    ):
        one = run({"h": errors}, starts=errors.size)
        low, high = gain(one, one, one, {"h": 0.0})["channels"]["h"]["ci95"]
        assert low < math.sqrt(np.mean(errors**2)) < high
        widths.append(high - low)
    expected = [2 * 1.96 / math.sqrt(2 * n) for n in (400 * BLOCK, 400)]
    assert widths == pytest.approx(expected, rel=0.25)


def test_before_and_after_are_drawn_together():
    """What halves every error halves it in every draw, however much the errors scatter."""
    errors = np.random.default_rng(4).standard_normal(400)
    one, half = (run({"h": factor * errors}, starts=400) for factor in (1.0, 0.5))
    found = gain(one, one, half, {"h": 0.0})
    assert found["error_removed_percent"] == pytest.approx(50.0)
    assert found["ci95"] == pytest.approx([50.0, 50.0])


def test_the_floor_is_what_the_uncertainty_of_the_start_leaves():
    """Two runs' floors 0.1 and 0.3 over the noise: sqrt(0.05) of 0.4 cannot be removed."""
    before = run({"h": 0.5})
    after = [run({"h": 0.45}, floor={"h": 0.1}), run({"h": 0.45}, floor={"h": 0.3})]
    refitted = run({"h": 0.4})
    found = gain([before, before], [refitted, refitted], after)
    assert found["noise_floor_percent"] == pytest.approx(100.0 * (1 - math.sqrt(0.05) / 0.4))
    lucky = gain(before, refitted, run({"h": 0.3}, floor={"h": 0.2}))
    assert lucky["error_removed_percent"] == pytest.approx(100.0)
    assert lucky["noise_floor_percent"] == pytest.approx(50.0), "not lifted to a lucky gain"


def test_that_nothing_moves_is_a_prediction_too():
    """It errs by 0.5 where the bare model errs by 0.4 beside the noise: a quarter worse."""
    after = replace(run({"h": 0.3}), still={"h": np.full(40, math.hypot(0.3, 0.5))})
    found = gain(run({"h": 0.5}), run({"h": 0.5}), after)
    assert found["persistence_percent"] == pytest.approx(-25.0)
    assert found["channels"]["h"]["persistence"] == pytest.approx(math.hypot(0.3, 0.5))
    assert gain(run({"h": 0.5}), run({"h": 0.5}), run({"h": 0.3}))["persistence_percent"] is None


def test_the_black_box_is_compared_with_the_same_before():
    box = [run({"h": math.hypot(0.3, 0.3)})]
    found = gain(run({"h": 0.5}), run({"h": 0.4}), run({"h": 0.35}), black_box=box)
    assert found["black_box_percent"] == pytest.approx(25.0)
