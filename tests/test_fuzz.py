"""Cards, logs and vehicle files as nobody should write them: read, or refused in one line.

More of the same, guided by coverage: ``python tests/fuzz_readers.py``.
"""

from pathlib import Path

import fuzz_readers
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

FILES = ("card", "log", "vehicle")
CHANGES = st.lists(
    st.tuples(
        st.integers(0, 4000),
        st.one_of(st.sampled_from(fuzz_readers.REPLACEMENTS), st.text(max_size=12)),
    ),
    min_size=1,
    max_size=4,
)


def some(examples: int) -> settings:
    return settings(
        max_examples=examples,
        deadline=None,
        suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
    )


def try_changes(name: str, folder: Path, changes: list[tuple[int, str]]) -> None:
    target, text = fuzz_readers.TARGETS[name]
    target(folder, fuzz_readers.spoilt(text, changes))


def try_bytes(name: str, folder: Path, content: bytes) -> None:
    fuzz_readers.TARGETS[name][0](folder, content)


@pytest.mark.parametrize("name", FILES)
@some(60)
@given(changes=CHANGES)
def test_a_spoilt_file_is_read_or_refused(name, tmp_path, changes):
    try_changes(name, tmp_path, changes)


@pytest.mark.slow
@pytest.mark.parametrize("name", FILES)
@some(800)
@given(changes=CHANGES)
def test_many_spoilt_files_are_read_or_refused(name, tmp_path, changes):
    try_changes(name, tmp_path, changes)


@pytest.mark.parametrize("name", fuzz_readers.TARGETS)
@some(40)
@given(content=st.binary(max_size=300))
def test_any_bytes_are_read_or_refused(name, tmp_path, content):
    try_bytes(name, tmp_path, content)


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize(
    "new",
    [
        pytest.param(new, marks=pytest.mark.slow) if k % 2 else new
        for k, new in enumerate(fuzz_readers.REPLACEMENTS)
    ],
)
def test_every_word_of_a_sound_file_can_be_replaced(name, new, tmp_path):
    """Every kind of nonsense at every tenth word: of the cells of a log, one row's are enough."""
    _, text = fuzz_readers.TARGETS[name]
    words = len(fuzz_readers._TOKEN.findall(text))
    for place in range(hash_of(new) % 10, min(words, 400), 10):
        try_changes(name, tmp_path, [(place, new)])


def hash_of(text: str) -> int:
    return sum(text.encode()[:40])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ulog", "dataflash"])
@some(80)
@given(changes=st.lists(st.tuples(st.integers(0, 8000), st.binary(max_size=4)), max_size=5))
@example(changes=[(2855, b"\x00\x81\x7f")])  # a signalling NaN
def test_a_log_with_bytes_changed_is_read_or_refused(name, tmp_path, changes):
    pytest.importorskip("pyulog" if name == "ulog" else "pymavlink")
    _, sound = fuzz_readers.TARGETS[name]
    content = bytearray(sound if isinstance(sound, bytes) else sound.encode())
    for place, new in changes:
        place %= len(content)
        content[place : place + max(1, len(new))] = new  # fewer bytes, as many, or other ones
    try_bytes(name, tmp_path, bytes(content))


@pytest.mark.parametrize("name", fuzz_readers.TARGETS)
def test_the_sound_files_are_sound(name, tmp_path, monkeypatch):
    """What is spoilt above is accepted as it stands."""
    refused = []
    keep = fuzz_readers.refused_in_one_line
    monkeypatch.setattr(
        fuzz_readers, "refused_in_one_line", lambda read: refused.append(keep(read))
    )
    if name in ("ulog", "dataflash"):
        pytest.importorskip("pyulog" if name == "ulog" else "pymavlink")
    target, sound = fuzz_readers.TARGETS[name]
    target(tmp_path, sound if isinstance(sound, bytes) else sound.encode())
    assert refused == [False]


BAD_VALUES = {
    "huge": "1" + "0" * 400, "hexadecimal": "0x" + "f" * 5000, "too many digits": "9" * 5000,
    "deep": "[" * 5000 + "]" * 5000,
}  # fmt: skip


@pytest.mark.parametrize("what", BAD_VALUES)
@pytest.mark.parametrize("name", ["card", "vehicle"])
def test_numbers_that_no_float_holds(what, name, tmp_path):
    _, text = fuzz_readers.TARGETS[name]
    old = {"card": "density = 1.14", "vehicle": "value = 0.1,"}[name]
    assert old in text
    key, _, _ = old.partition(" = ")
    end = "," if name == "vehicle" else ""
    spoilt = text.replace(old, f"{key} = {BAD_VALUES[what]}{end}").encode()
    fuzz_readers.TARGETS[name][0](tmp_path, spoilt)
