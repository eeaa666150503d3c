"""One mutation at a time: a copy of the tree, the change, the tests.

The copy lies at one place for all trials of a job, so that numba's machine code of what is not broken
is found again. A change of the kernel (`compilation.kernel_sources`) has machine code of its own, in
a folder that is removed afterwards.
"""

import hashlib
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from coax_env.errors import InputError
from coax_env.files import make_folder
from mutation.draw import matches
from mutation.sites import Mutation

QUICK = "not slow"
COPIED = ("coax_env", "controllers", "scripts", "tests", "pyproject.toml", "README.md")
LIMIT = 900.0
"""[s] for the tests of one mutation. Quick ones that need longer are caught in an endless loop; slow
ones of sound code may need as long on a busy machine: what they have not found by then is no catch."""

_ENV = ("tests/test_sensors.py", "tests/test_hover.py", "tests/test_world.py", "tests/test_env.py")
_MODEL = ("tests/test_dynamics.py", "tests/test_vehicle.py", "tests/test_linear.py", *_ENV)
OWN: dict[str, tuple[str, ...]] = {
    "coax_env/model/linear.py": ("tests/test_linear.py", "tests/test_controllers.py"),
    "coax_env/model/sensors.py": _ENV,
    "coax_env/model/actuators.py": _ENV,
    "coax_env/model/generic_terms.py": ("tests/test_unlisted.py", *_MODEL),
    "coax_env/model/sampling.py": _ENV,
    "coax_env/model/dynamics.py": (*_MODEL, "tests/test_actuator_effects.py"),
    "coax_env/model/*": _MODEL,
    "coax_env/env/fl*": (*_ENV, "tests/test_simd.py"),
    "coax_env/env/simd_loops.py": ("tests/test_simd.py", *_ENV),
    "coax_env/env/paths.py": ("tests/test_trajectory.py", *_ENV),
    "coax_env/env/turbulence.py": ("tests/test_turbulence.py", *_ENV),
    "coax_env/env/gym_env.py": (*_ENV, "tests/test_rendering.py", "tests/test_action_levels.py"),
    "coax_env/env/*": _ENV,
    "coax_env/simulation/multisine.py": ("tests/test_flight_plan.py",),
    "coax_env/simulation/pilot.py": ("tests/test_pilot.py", "tests/test_simulation.py"),
    "coax_env/simulation/*": ("tests/test_simulation.py", "tests/test_sensors.py"),
    "controllers/estimator*.py": (
        "tests/test_estimator.py", "tests/test_faulty_sensors.py", "tests/test_controllers.py",
    ),
    "coax_env/estimation/beginnings.py": ("tests/test_onset.py",),
    "coax_env/estimation/changing_model.py": ("tests/test_onset.py",),
    "coax_env/estimation/sparse.py": (
        "tests/test_kalman.py", "tests/test_side_by_side.py", "tests/test_estimation.py",
    ),
    "coax_env/estimation/flown.py": ("tests/test_blinding_logs.py", "tests/test_estimation.py"),
    "coax_env/estimation/parted_engine.py": ("tests/test_compare.py", "tests/test_estimation.py"),
    "coax_env/estimation/quadratic.py": ("tests/test_quadratic.py", "tests/test_diagnosis.py"),
    "coax_env/estimation/prediction.py": ("tests/test_prediction.py", "tests/test_diagnosis.py"),
    "coax_env/estimation/trajectories.py": ("tests/test_trajectories.py", "tests/test_report.py"),
    "coax_env/estimation/vibration.py": ("tests/test_vibration.py", "tests/test_unlisted.py"),
    "coax_env/estimation/order_tracking.py": ("tests/test_vibration.py", "tests/test_unlisted.py"),
    "coax_env/estimation/*noise*": (
        "tests/test_noise_levels.py", "tests/test_estimation.py", "tests/test_helicopter.py",
        "tests/test_kalman.py", "tests/test_diagnosis.py",
    ),
    "coax_env/estimation/*": (
        "tests/test_estimation.py", "tests/test_kalman.py", "tests/test_helicopter.py",
        "tests/test_fitted_vehicle.py",
        "tests/test_input_innovations.py", "tests/test_quadratic.py", "tests/test_prediction.py",
        "tests/test_diagnosis.py",
    ),
    "coax_env/identification/two_step/*": ("tests/test_two_step.py",),
    "coax_env/identification/*": (
        "tests/test_run_estimates.py", "tests/test_identification.py", "tests/test_two_step.py",
    ),
    "coax_env/comparison/two_logs/*": ("tests/test_changes.py", "tests/test_edits.py"),
    "coax_env/diagnosis/onsets/*": ("tests/test_onset.py",),
    "coax_env/diagnosis/searches/*": ("tests/test_searches.py",),
    "coax_env/diagnosis/gain.py": ("tests/test_gain.py", "tests/test_diagnosis.py"),
    "coax_env/diagnosis/unseen.py": ("tests/test_unseen.py", "tests/test_trust.py"),
    "coax_env/diagnosis/shock_evidence.py": ("tests/test_shock_evidence.py",),
    "coax_env/diagnosis/doubts.py": ("tests/test_trust.py",),
    "coax_env/diagnosis/large_numbers.py": ("tests/test_large_numbers.py",),
    "coax_env/diagnosis/trust.py": ("tests/test_trust.py", "tests/test_diagnosis.py"),
    "coax_env/diagnosis/replication.py": (
        "tests/test_trust.py", "tests/test_noise_variation.py", "tests/test_diagnosis.py",
    ),
    "coax_env/diagnosis/evidence.py": ("tests/test_fits.py", "tests/test_diagnosis.py"),
    "coax_env/diagnosis/refinement.py": (
        "tests/test_refinement.py", "tests/test_diagnosis.py", "tests/test_unlisted.py",
    ),
    "coax_env/diagnosis/hold_out.py": (
        "tests/test_hold_out.py", "tests/test_trust.py", "tests/test_diagnosis.py",
    ),
    "coax_env/diagnosis/unlisted.py": (
        "tests/test_unlisted.py", "tests/test_terms_weighed.py", "tests/test_diagnosis.py",
        "tests/test_input_innovations.py",
    ),
    "coax_env/diagnosis/calibration.py": ("tests/test_study.py",),
    "coax_env/diagnosis/*": (
        "tests/test_scores.py", "tests/test_diagnosis.py", "tests/test_unlisted.py",
        "tests/test_input_innovations.py", "tests/test_gain.py", "tests/test_moves.py",
    ),
}  # fmt: skip
"""Pattern of files -> the tests that belong to them, tried first, in this order; the first fit."""

WHOLE_FLIGHTS = ("coax_env/diagnosis/*", "coax_env/identification/identify.py")
"""Files that are judged by whole flights: their own tests are tried with the slow ones among them."""


def own_tests(file: str) -> tuple[str, ...]:
    """The tests of a file: those of its name, where there are any, and those of its pattern."""
    named = f"tests/test_{Path(file).stem}.py"
    fitting = next((tests for pattern, tests in OWN.items() if fnmatchcase(file, pattern)), ())
    return tuple(dict.fromkeys((named, *fitting)))


APART = (
    "tests/test_house.py", "tests/test_readme.py", "tests/test_wheel.py", "tests/test_mutation.py",
    "tests/test_killed.py", "tests/test_fuzz.py",
)  # fmt: skip
"""Tests of the house and not of its numbers: what they catch is not counted."""

_FAILED = re.compile(r"^(?:FAILED|ERROR) (\S+)", re.MULTILINE)


class Tree:
    """A copy of the project in which code is broken and tested, one trial after the other."""

    def __init__(self, root: Path, place: Path) -> None:
        self.place = place / "tree"
        self.cache = place / "cache"
        shutil.rmtree(self.place, ignore_errors=True)
        make_folder(self.place)
        for name in COPIED:
            source = root / name
            if source.is_dir():
                ignored = shutil.ignore_patterns("__pycache__", "runs", ".*")
                shutil.copytree(source, self.place / name, ignore=ignored)
            elif source.exists():
                shutil.copy2(source, self.place / name)
        self._running: subprocess.Popen | None = None
        self._stopped = threading.Event()

    def stop(self) -> None:
        """End the tests that run, and start no more."""
        self._stopped.set()
        running = self._running
        if running and running.poll() is None:
            os.killpg(running.pid, signal.SIGKILL)

    def try_out(self, mutation: Mutation, rest: bool) -> dict[str, Any]:
        """Break the code, test it (by the `rest` of the tests too), restore it: the row's result."""
        path = self.place / mutation.file
        kept = self._machine_code()
        whole, stamp = path.read_text(encoding="utf-8"), path.stat().st_mtime_ns
        path.write_text(mutation.applied(whole), encoding="utf-8")
        start = time.monotonic()
        try:
            own = [name for name in own_tests(mutation.file) if (self.place / name).exists()]
            by = self.test(own)
            if not by and matches(mutation.file, WHOLE_FLIGHTS):
                by = self.test(own, "slow")
            if not by and rest:
                left_out = {*own, *APART}
                others = sorted(p.name for p in (self.place / "tests").glob("test_*.py"))
                by = self.test([n for n in (f"tests/{o}" for o in others) if n not in left_out])
        finally:
            path.write_text(whole, encoding="utf-8")
            os.utime(path, ns=(stamp, stamp))  # numba knows its machine code by this
            for compiled in path.parent.glob(f"__pycache__/{path.stem}.*"):
                compiled.unlink()
            for folder in self._machine_code() - kept:
                shutil.rmtree(folder, ignore_errors=True)
        seconds = round(time.monotonic() - start, 1)
        return {"caught": bool(by), "by": by, "rest": rest, "seconds": seconds}

    def test(self, tests: Sequence[str], which: str = QUICK) -> str:
        """The first of these tests that fails in the tree as it stands; empty where all pass.

        Args:
            tests: files of them. which: by pytest's markers.
        """
        if not tests:
            return ""
        environment = os.environ | {  # bytecode goes by seconds and bytes: it would outlive a mutation
            "PYTHONDONTWRITEBYTECODE": "1",
            "PYTHONPATH": str(self.place), "COAX_CACHE_DIR": str(self.cache),
            "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",
        }  # fmt: skip
        command = [
            sys.executable, "-m", "pytest", "-x", "-q", "--tb=line", "-m", which,
            "-p", "no:cacheprovider", *tests,
        ]  # fmt: skip
        if self._stopped.is_set():
            raise KeyboardInterrupt
        self._running = subprocess.Popen(
            command, cwd=self.place, env=environment, start_new_session=True, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip
        try:
            said, _ = self._running.communicate(timeout=LIMIT)
        except subprocess.TimeoutExpired:
            os.killpg(self._running.pid, signal.SIGKILL)
            self._running.communicate()
            return f"no end within {LIMIT:.0f} s" if which == QUICK else ""
        except BaseException:
            os.killpg(self._running.pid, signal.SIGKILL)
            raise
        if self._stopped.is_set():
            raise KeyboardInterrupt
        return _verdict(self._running.returncode, said)

    def _machine_code(self) -> set[Path]:
        return set(self.cache.iterdir()) if self.cache.exists() else set()


def _verdict(code: int, said: str) -> str:
    """What pytest's exit code means: the failing test; empty where all passed."""
    if code in (0, 5):  # all passed, or none of them is of this kind
        return ""
    if code in (3, 4):  # pytest's own fault, or its command line's
        raise InputError(f"pytest ended with {code}: {said.strip().splitlines()[-1]:.200}")
    found = _FAILED.search(said)
    return found[1] if found else f"pytest ended with {code}"


def fingerprint(*paths: Path) -> str:
    """Twelve hex digits over files."""
    digest = hashlib.sha256()
    for path in sorted(paths):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:12]
