"""How often the diagnosis names a cause where there is none, as measured on clean flights.

`calibration.json` beside this file is written by ``scripts/study_diagnosis.py --calibrate --adopt``,
with the command, the code and the threshold that it was measured with. A threshold that has been
changed since makes it void.
"""

import json
from pathlib import Path

PATH = Path(__file__).with_name("calibration.json")


def false_alarm_rate(threshold: float) -> float | None:
    """Share of clean flights on which something is named; None until measured with `threshold`."""
    if not PATH.exists():
        return None
    measured = json.loads(PATH.read_text(encoding="utf-8"))
    if measured["threshold_used_nats"] != threshold:
        return None
    return float(measured["false_alarm_rate"])
