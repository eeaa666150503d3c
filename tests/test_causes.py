"""The check of causes can fail: on findings made by hand, one thing wrong at a time."""

from typing import Any

import pytest
from causes import check_causes

TRUTH = {"servo_lag.time": 0.04, "wind.north": 1.0, "wind.east": 0.0}
HIDDEN = ("wind", "servo_lag")


def cause(effect: str, alike: tuple[str, ...] = (), **parameters: tuple[float, float]) -> dict:
    return {
        "effect": effect,
        "confusable_with": list(alike),
        "parameters": {
            f"{effect}.{name}": {"value": value, "std": std}
            for name, (value, std) in parameters.items()
        },
    }


WIND = cause("wind", north=(1.02, 0.01), east=(-0.02, 0.01))
SERVO = cause("servo_lag", ("servo_delay",), time=(0.042, 0.003))


def findings(*causes: dict, verdict: str = "explained") -> dict[str, Any]:
    return {"verdict": verdict, "causes": list(causes), "unexplained": []}


def test_what_is_right_passes():
    check_causes(findings(WIND, SERVO), HIDDEN, TRUTH)
    check_causes(findings(verdict="consistent"), [], {})


WRONG = {
    "the truth as confounded alternative": findings(
        WIND, cause("servo_delay", ("servo_lag",), time=(0.02, 0.003))
    ),
    "one missing": findings(WIND),
    "one too many": findings(WIND, SERVO, cause("gyro_bias", ("wind",), x=(0.0, 1e-4))),
    "twice the same": findings(WIND, SERVO, SERVO),
    "a value four std off": findings(cause("wind", north=(1.04, 0.01), east=(0.0, 0.01)), SERVO),
    "a value whose std says nothing": findings(
        cause("wind", north=(2.0, 0.5), east=(0.0, 0.01)), SERVO
    ),
    "no std": findings(cause("wind", north=(1.0, 0.0), east=(0.0, 0.01)), SERVO),
    "a value left out": findings(cause("wind", north=(1.0, 0.01)), SERVO),
    "a value without a truth": findings(WIND, cause("servo_lag", time=(0.04, 3e-3), x=(0.0, 1.0))),
    "not explained": findings(WIND, SERVO, verdict="partly explained"),
}


@pytest.mark.parametrize("what", WRONG)
def test_what_is_wrong_fails(what):
    with pytest.raises(AssertionError):
        check_causes(WRONG[what], HIDDEN, TRUTH)


def test_another_form_may_be_a_tenth_off_and_no_more():
    def ground(gain: float) -> dict[str, Any]:
        return findings(cause("ground_effect", gain=(gain, 0.005), decay=(1.3, 0.02)))

    truth = {"ground_effect.gain": 0.22, "ground_effect.decay": 1.3}
    check_causes(ground(0.25), ["ground_effect"], truth)
    with pytest.raises(AssertionError):
        check_causes(ground(0.26), ["ground_effect"], truth)
