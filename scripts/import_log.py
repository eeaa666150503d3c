"""Turn a log of another form into a flight folder: PX4, ArduPilot, ROS, MCAP, MATLAB, Parquet or
CSV."""

from pathlib import Path

import command_line

from coax_env.errors import InputError
from coax_env.logs.autopilot_logs import READERS, import_log, signals_of
from coax_env.logs.card import CARD
from coax_env.logs.flight import read_flight, write_flight
from coax_env.logs.signals import Taken, untaken
from coax_env.logs.tables import import_table, is_table
from coax_env.logs.units import SWASH_COMMANDS, without
from coax_env.model.vehicle_file import load_vehicle


def main() -> None:
    parser = command_line.parser("import_log", __doc__)
    parser.add_argument(
        "log", type=Path,
        help=f"{', '.join(filter(None, READERS))}, the folder of a ROS 2 bag, .mat, .parquet or .csv",
    )  # fmt: skip
    parser.add_argument("--vehicle", default="lama400d", help="shipped name or TOML file")
    parser.add_argument(
        "--take", action="append", default=[], metavar="CHANNEL=TOPIC.FIELD*SCALE+OFFSET",
        help="a channel that the log cannot name: rotor speeds [rev/min] and swash tilt [rad]; "
        "may be given several times",
    )  # fmt: skip
    parser.add_argument(
        "--leave", default="", metavar="CHANNEL,CHANNEL",
        help="channels not to take, such as what an estimator made of other sensors",
    )  # fmt: skip
    parser.add_argument(
        "--cut", default="", metavar="FROM-TO,FROM-TO",
        help="runs, in seconds of the log (default: the whole log is one)",
    )  # fmt: skip
    parser.add_argument(
        "--overwrite", action="store_true", help="replace the flight that --out holds already"
    )
    options = parser.parse_args()
    if (options.out / CARD).exists() and not options.overwrite:
        raise InputError(
            f"{options.out} holds a flight already: give another --out, or --overwrite to replace it"
        )
    load_vehicle(options.vehicle)
    if is_table(options.log):
        if options.take or options.cut or options.leave:
            raise InputError(
                f"{options.log}: --take, --cut and --leave are not for tables: edit the drafted card"
            )
        table(options.log, options.vehicle, options.out)
    else:
        take = {}
        for text in options.take:
            channel, _, source = text.partition("=")
            take[channel.strip()] = Taken.of(source)
        leave = [name for name in options.leave.split(",") if name]
        signals(options.log, options.vehicle, take, cuts(options.cut), leave, options.out)
    print(command_line.as_called(f"next: scripts/check_flight.py {options.out}"))


def table(log: Path, vehicle: str, out: Path) -> None:
    """A log that is one table: its columns as they are, and a drafted card."""
    guessed = import_table(log, vehicle, out)
    print(f"flight {out}; its card is a draft: look at every line of {out / CARD}")
    for guess in guessed:
        print(f"  guessed: {guess.line()}")


def signals(
    log: Path,
    vehicle: str,
    take: dict[str, Taken],
    parts: list[tuple[float, float]],
    leave: list[str],
    out: Path,
) -> None:
    """A log of signals with clocks of their own."""
    flight = import_log(log, vehicle, take, parts, leave)
    folder = write_flight(flight, out)
    found = read_flight(folder)
    for run in found.runs:
        print(f"{run.name}: {run.duration:.1f} s, {len(run.t)} rows, {' '.join(run.measured)}")
    for guess in untaken(signals_of(log), {*found.channels, *take, *leave}):
        print(f"not taken, but perhaps: --take {guess.channel}={guess.name} ({guess.unit}?)")
    for command in SWASH_COMMANDS:
        if found.counts.get(without(command)):
            print(f"no {command} in it: what steers this machine cannot be told from a fault."
                  f" Import it again with --take {command}=TOPIC.FIELD*SCALE+OFFSET")  # fmt: skip
    print(f"flight {folder}")


def cuts(text: str) -> list[tuple[float, float]]:
    """The parts of ``12-30,40-60``."""
    return [seconds(part) for part in text.split(",") if part]


def seconds(text: str) -> tuple[float, float]:
    """Begin and end of ``12-30``."""
    begin, _, end = text.partition("-")
    try:
        return float(begin), float(end)
    except ValueError:
        raise InputError(f"--cut {text!r} is not of the form FROM-TO, in seconds") from None


if __name__ == "__main__":
    command_line.run(main)
