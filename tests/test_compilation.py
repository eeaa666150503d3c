"""Compilation: what is compiled, when, and by how many processes at once."""

import gc
import math
import subprocess
import threading
import time
from pathlib import Path

import numba
import numpy as np
import pytest
from numba import float64
from numba.extending import overload

from coax_env.estimation import (
    beginnings,
    compile_ahead,
    compiled_model,
    frozen_gains,
    kalman,
    noise_score,
)
from coax_env.kernel import compilation
from coax_env.kernel.compilation import compiled, compiled_when_called
from coax_env.kernel.lazy import compiled_apart
from coax_env.kernel.numba_internals import PackagedCacheLocator, cached_in


def test_what_only_python_calls_is_compiled_when_it_is_called(tmp_path, monkeypatch):
    """And once, whatever effects of their own users have."""
    monkeypatch.setattr(compilation, "OF_PACKAGE", tmp_path)
    monkeypatch.setattr(compilation, "CACHE_DIR", tmp_path / "with a user's effect")

    @compiled_when_called(float64(float64))
    def doubled(x):
        return x + x

    assert not list(tmp_path.rglob("*doubled*"))
    assert doubled(1.5) == 3.0 and doubled.prepare() is doubled.prepare()
    assert list(tmp_path.rglob("*doubled*.nbc"))
    assert not (tmp_path / "with a user's effect").exists()


def test_what_compiled_code_alone_calls_has_no_wrapper_until_python_calls_it(tmp_path, monkeypatch):
    """And no machine code: what calls it has its own copy."""
    monkeypatch.setattr(compilation, "CACHE_DIR", tmp_path)

    def a_new_process():
        @compiled()
        def doubled(x):
            return x + x

        @compiled()
        def and_one(x):
            return doubled(x) + 1.0

        return doubled, and_one

    def compiled_now(*functions):
        return [sum(f.stats.cache_misses.values()) for f in functions]

    def has_machine_code(name):
        return any(b"\x7fELF" in path.read_bytes() for path in tmp_path.rglob(f"*.{name}-*.nbc"))

    doubled, and_one = a_new_process()
    assert and_one(1.5) == 4.0 and compiled_now(doubled, and_one) == [1, 1]
    assert has_machine_code("and_one") and not has_machine_code("doubled")
    assert doubled(1.5) == 3.0 and and_one(2.5) == 6.0
    assert compiled_now(doubled, and_one) == [2, 1] and has_machine_code("doubled")
    stored, another = a_new_process()
    assert another(1.5) == 4.0 and stored(1.5) == 3.0
    assert compiled_now(stored) == [0], "with a wrapper it serves both"


def test_what_is_compiled_apart_is_called_and_no_part_of_what_calls_it(tmp_path, monkeypatch):
    monkeypatch.setattr(compilation, "CACHE_DIR", tmp_path)

    def slanted(x, dt, out):
        for i in range(x.size):
            out[i] = x[i] + dt * math.sin(x[i])

    apart, linked = compiled_apart(slanted, float64[::1]), numba.njit(slanted)
    assert list(tmp_path.rglob("*slanted*.nbc"))  # already
    x, codes = np.linspace(0.0, 1.0, 5), []
    for called in (apart, linked):

        @numba.njit
        def caller(x, dt, out, called=called):
            called(x, dt, out)

        out = np.empty(5)
        caller(x, 0.5, out)
        assert out == pytest.approx(x + 0.5 * np.sin(x), rel=1e-15)
        codes.append(caller.inspect_llvm(caller.signatures[0]))
    assert ["llvm.sin" in code or "@sin" in code for code in codes] == [False, True]


def test_a_copy_of_the_package_loads_what_was_compiled_for_the_other(tmp_path):
    """The place in the cache is the file's in the package; a user's own file keeps its whole path."""
    package = Path(compilation.__file__).parents[1]
    place = PackagedCacheLocator.get_suitable_cache_subpath
    assert place(str(package / "model" / "dynamics.py")) == "coax_env_model"
    assert place(str(tmp_path / "a" / "own.py")) != place(str(tmp_path / "b" / "own.py"))
    used = [d for d in compilation.CACHE_DIR.iterdir() if d.name.startswith("coax_env_")]
    assert used and not any(len(d.name) > 40 for d in used), "a hash of a path"


def probed(x):
    """Of which the compiler asks, while it compiles, how it is to be compiled."""


def test_settings_of_one_thread_are_not_those_of_another(tmp_path):
    """They were: what a batch of two threads compiled was now and then cached in the working folder."""
    before = numba.config.CACHE_DIR
    entered, found = threading.Event(), []

    def one_more() -> None:
        with cached_in(str(tmp_path / "first")):
            entered.set()
            time.sleep(0.05)  # [s] the other comes to its own
            found.append(numba.config.CACHE_DIR)

    thread = threading.Thread(target=one_more)
    thread.start()
    entered.wait()
    with cached_in(str(tmp_path / "second")):
        thread.join()
        assert str(tmp_path / "second") == numba.config.CACHE_DIR
    assert found == [str(tmp_path / "first")] and before == numba.config.CACHE_DIR


def test_no_garbage_is_collected_while_numba_compiles_and_it_is_again_afterwards():
    seen = []

    @overload(probed)
    def _probed(x):
        seen.append(gc.isenabled())
        return (lambda x: x) if x == float64 else None

    assert numba.njit(lambda x: probed(x))(3.0) == 3.0
    with pytest.raises(numba.core.errors.TypingError):
        numba.njit(lambda x: probed(x))("no number")
    assert seen and not any(seen) and gc.isenabled()
    gc.disable()
    try:
        numba.njit(lambda x: 3.0 * x)(1.0)
        assert not gc.isenabled()
    finally:
        gc.enable()


def test_a_new_checkout_is_compiled_by_two_processes_and_a_filled_one_by_none(
    tmp_path, monkeypatch
):
    begun, made = [], []

    class Process:
        def __init__(self, command, **options):
            begun.append(command)

        def __enter__(self):
            return self

        def __exit__(self, *error):
            made.append("waited")

    monkeypatch.setattr(subprocess, "Popen", Process)
    monkeypatch.setattr(compilation, "CACHE_DIR", tmp_path)
    monkeypatch.setattr(compile_ahead, "compile_passes", lambda: made.append("passes"))
    monkeypatch.setattr(compile_ahead.os, "cpu_count", lambda: 2)
    compile_ahead.fill_cache()
    assert [command[1:] for command in begun] == [["-m", "coax_env.estimation.compile_ahead"]]
    assert made == ["passes", "waited"]
    (tmp_path / "sources").mkdir()
    (tmp_path / "sources" / f"{kalman.__name__.rpartition('.')[2]}.filter_pass-600.nbi").touch()
    compile_ahead.fill_cache()
    assert len(begun) == 1


def test_every_pass_is_compiled_ahead():
    rooms = (kalman, compiled_model, frozen_gains, noise_score, beginnings)
    passes = {f for room in rooms for f in vars(room).values() if hasattr(f, "prepare")}
    assert len(passes) > 2 and set(compile_ahead.PASSES) == passes
