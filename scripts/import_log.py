"""Turn a PX4 (.ulg) or ArduPilot (.bin, .log) log into a flight folder."""

from pathlib import Path

import command_line

from coax_env.errors import InputError
from coax_env.logs.autopilot_logs import import_log
from coax_env.logs.flight import read_flight, write_flight
from coax_env.logs.signals import Taken


def main() -> None:
    parser = command_line.parser("import_log", __doc__)
    parser.add_argument("log", type=Path, help="the autopilot's log")
    parser.add_argument("--vehicle", default="lama400d", help="shipped name or TOML file")
    parser.add_argument(
        "--take", action="append", default=[], metavar="CHANNEL=TOPIC.FIELD*SCALE+OFFSET",
        help="a channel that the autopilot cannot name: rotor speeds [rev/min] and swash tilt [rad]; "
        "may be given several times",
    )  # fmt: skip
    parser.add_argument(
        "--cut", default="", metavar="FROM-TO,FROM-TO",
        help="runs, in seconds of the log (default: the whole log is one)",
    )  # fmt: skip
    options = parser.parse_args()

    take = {}
    for text in options.take:
        channel, _, source = text.partition("=")
        take[channel.strip()] = Taken.of(source)
    flight = import_log(options.log, options.vehicle, take, [*map(seconds, cuts(options.cut))])
    folder = write_flight(flight, options.out)
    for run in read_flight(folder).runs:
        print(f"{run.name}: {run.duration:.1f} s, {len(run.t)} rows, {' '.join(run.measured)}")
    print(f"flight {folder}")


def cuts(text: str) -> list[str]:
    """The parts of ``12-30,40-60``."""
    return [part for part in text.split(",") if part]


def seconds(text: str) -> tuple[float, float]:
    """Begin and end of ``12-30``."""
    begin, _, end = text.partition("-")
    try:
        return float(begin), float(end)
    except ValueError:
        raise InputError(f"--cut {text!r} is not of the form FROM-TO, in seconds") from None


if __name__ == "__main__":
    command_line.run(main)
