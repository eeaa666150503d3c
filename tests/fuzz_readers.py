"""Whatever lies in a card, a log, a vehicle file or an autopilot's log: read, or refused in one line.

Each target takes bytes. tests/test_fuzz.py feeds them from hypothesis; run as a script, libFuzzer does,
guided by coverage (``pip install atheris``, in an environment of its own)::

    python tests/fuzz_readers.py card log vehicle --seconds 600
"""

import argparse
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

if __name__ == "__main__" and sys.argv[1:2] == [
    "--target"
]:  # instrument before anything is imported
    import atheris

    LOGS = (
        "autopilot_logs", "card", "columns", "csv_log", "dataflash", "flight", "outliers",
        "repairs", "signals", "ulog", "units",
    )  # fmt: skip
    with atheris.instrument_imports(
        include=[*(f"coax_env.logs.{name}" for name in LOGS), "coax_env.model.vehicle",
                 "coax_env.model.vehicle_file", "pyulog.core", "pymavlink.DFReader"],
    ):  # fmt: skip
        import pyulog.core  # noqa: F401

        import coax_env.logs.autopilot_logs
        import coax_env.model.vehicle_file  # noqa: F401

import numpy as np
from autopilot_files import dataflash, px4_flight

from coax_env.errors import InputError
from coax_env.logs.autopilot_logs import import_log
from coax_env.logs.flight import read_flight
from coax_env.model.vehicle_file import SHIPPED, load_vehicle, vehicle_toml

CARD = """[vehicle]
name = "lama400d"
[air]
density = 1.14
[noise]
q = 0.01
[columns]
q = { name = "gyro_y", unit = "deg/s" }
[[run]]
name = "hover"
file = "hover.csv"
maneuver = "hover"
"""
LOG = "t,rpm_upper_cmd,rpm_lower_cmd,delta_lon,gyro_y,h\n" + "".join(
    f"{0.1 * k:.1f},1994,2138,0.0,{'' if k % 3 else 0.5},1.0\n" for k in range(30)
)
ULOG = px4_flight(seconds=2.2, share=0.04)
DATAFLASH = dataflash(seconds=2.2, rate=10.0)
VEHICLE = (SHIPPED / "lama400d.toml").read_text(encoding="utf-8") + """
[effects.ground_effect]
gain = { value = 0.1, std = 0.02, unit = "1", source = "a guess" }
[covariance]
names = ["mass", "ground_effect.gain"]
correlation = [[1.0, 0.2], [0.2, 1.0]]
[provenance]
flights = ["0123"]
"""  # fmt: skip

REPLACEMENTS = (
    "", " ", "0", "-1", "1e308", "1e999", "nan", "inf", "true", "[]", "{}", "[[]]", '""', '"\\n"',
    '"\\u0000"', "9" * 400, "1979-05-27", "0x1f", "''", "\n", "\r", "[run]", "[[run]]", "'t'", "#",
    '"hover.csv"', "[" * 3000, '{ value = 1, std = 0, unit = "1", source = "" }', ",", '"', "=",
)  # fmt: skip
_TOKEN = re.compile(r"[A-Za-z0-9_.+-]+|\"[^\"]*\"|[^\sA-Za-z0-9]")


def spoilt(text: str, changes: Sequence[tuple[int, str]]) -> bytes:
    """A sound file with some of its words replaced, by their number."""
    words = list(_TOKEN.finditer(text))
    places = {place % len(words): new for place, new in changes}
    parts, end = [], 0
    for place in sorted(places):
        parts += [text[end : words[place].start()], places[place]]
        end = words[place].end()
    return "".join([*parts, text[end:]]).encode("utf-8", "surrogatepass")


def refused_in_one_line(read: Callable[[], object]) -> bool:
    """Whether a reader refuses, in one line; anything else that it raises is a defect."""
    try:
        read()
    except InputError as error:
        assert str(error).strip() and str(error).isprintable(), repr(str(error))
        assert len(str(error)) < 1000, len(str(error))
        return True
    return False


def flight_of(folder: Path, card: bytes, log: bytes) -> None:
    """A flight of one run, read where it can be."""
    (folder / "card.toml").write_bytes(card)
    (folder / "hover.csv").write_bytes(log)

    def read() -> None:
        for run in read_flight(folder).runs:
            assert np.isfinite(run.command).all() and np.isfinite(run.t).all()
            assert (np.diff(run.t) > 0).all()
            for values in run.measured.values():
                assert not np.isinf(values).any()

    refused_in_one_line(read)


def a_card(folder: Path, content: bytes) -> None:
    """The flight test card."""
    flight_of(folder, content, LOG.encode())


def a_log(folder: Path, content: bytes) -> None:
    """A run's CSV."""
    flight_of(folder, CARD.encode(), content)


def a_vehicle(folder: Path, content: bytes) -> None:
    """A vehicle file: what is accepted can be flown and written again."""
    path = folder / "vehicle.toml"
    path.write_bytes(content)

    def read() -> None:
        vehicle = load_vehicle(path)
        assert np.isfinite(vehicle.vector).all()
        assert list(vehicle.seen(["hash"]).provenance["flights"])[-1] == "hash"
        path.write_text(vehicle_toml(vehicle), encoding="utf-8")
        assert load_vehicle(path).values() == vehicle.values()

    refused_in_one_line(read)


def an_autopilot_log(folder: Path, content: bytes, ending: str) -> None:
    """What import_log.py is given."""
    path = folder / f"log{ending}"
    path.write_bytes(content)

    def read() -> None:
        for run in import_log(path, "lama400d").runs:
            assert np.isfinite(run.command).all() and (np.diff(run.t) > 0).all()

    refused_in_one_line(read)


TARGETS: dict[str, tuple[Callable[[Path, bytes], None], str | bytes]] = {
    "card": (a_card, CARD),
    "log": (a_log, LOG),
    "vehicle": (a_vehicle, VEHICLE),
    "ulog": (partial(an_autopilot_log, ending=".ulg"), ULOG),
    "dataflash": (partial(an_autopilot_log, ending=".log"), DATAFLASH),
}
"""Name -> what takes the bytes, and a sound file: a text is spoilt word by word, bytes as they are."""


# --- libFuzzer ----------------------------------------------------------------------------------


def changed(data: bytes, sound: str | bytes) -> bytes:
    """Bytes from libFuzzer: as they are, or as changes of a sound text."""
    if isinstance(sound, bytes):
        return data
    provider = atheris.FuzzedDataProvider(data)
    if provider.ConsumeBool():
        return provider.ConsumeBytes(len(data))
    changes = []
    for _ in range(provider.ConsumeIntInRange(1, 4)):
        place = provider.ConsumeIntInRange(0, 4000)
        if provider.ConsumeBool():
            new = provider.PickValueInList(list(REPLACEMENTS))
        else:
            new = provider.ConsumeUnicode(12)
        changes.append((place, new))
    return spoilt(sound, changes)


def fuzz(name: str, words: Sequence[str]) -> None:
    """Let libFuzzer run one target; it leaves the process when it is done."""
    target, sound = TARGETS[name]
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        atheris.Setup([sys.argv[0], *words], lambda data: target(place, changed(data, sound)))
        atheris.Fuzz()


def main() -> None:
    if sys.argv[1:2] == ["--target"]:
        fuzz(sys.argv[2], sys.argv[3:])
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", choices=[[], *TARGETS], help="default: all")
    parser.add_argument("--seconds", type=int, default=60, help="of each (default: 60)")
    parser.add_argument("--out", type=Path, default=Path("runs/fuzz"), help="findings and corpus")
    options = parser.parse_args()
    failed = []
    for name in options.names or TARGETS:
        corpus = options.out / name
        corpus.mkdir(parents=True, exist_ok=True)
        sound = TARGETS[name][1]
        if isinstance(sound, str):
            sound = sound.encode() + b"\x01"  # the last byte: as they are
        (corpus / "sound").write_bytes(sound)
        done = subprocess.run(
            [sys.executable, __file__, "--target", name, str(corpus), "-timeout=20",
             f"-max_total_time={options.seconds}", f"-artifact_prefix={options.out}/{name}-",
             "-print_final_stats=1", "-max_len=8192", "-verbosity=1"],
            check=False,
        )  # fmt: skip
        if done.returncode:
            failed.append(name)
    with suppress(BrokenPipeError):
        print("defects in: " + ", ".join(failed) if failed else "no defect found")
    sys.exit(bool(failed))


if __name__ == "__main__":
    main()
