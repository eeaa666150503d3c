"""The study of the diagnosis: how often it is right, on flights whose truth is known.

Data flow::

    plan.py, or arms.py for the arms -> one planned flight
            -> one_flight.py: tests/injector.py flies it, the package gets the folder and nothing else,
               baselines.py the same
            -> DIR/flights/*.json (store.py) -> judge.py: right or wrong
            -> table.py: figures, matrix; arm_table.py: figures of each arm
            -> threshold.py: what 1 % false alarms asks for; classes.py: on which flights it holds

The generator shares no code with the package; it lies with the tests.
"""

import sys
from pathlib import Path

_TESTS = str(Path(__file__).resolve().parents[2] / "tests")
if _TESTS not in sys.path:
    sys.path.append(_TESTS)
