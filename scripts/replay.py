"""Show what the simulation gets wrong on a flight: open-loop prediction error per channel."""

import command_line

from coax_env import report
from coax_env.errors import InputError
from coax_env.estimation.prediction import replay
from coax_env.files import make_folder, write_json


def main() -> None:
    parser = command_line.parser("replay", __doc__)
    command_line.add_flight(parser)
    command_line.add_waive(parser)
    parser.add_argument("--horizon", type=float, default=1.0, help="seconds (default: 1.0)")
    options = parser.parse_args()
    if not 0.05 <= options.horizon <= 60.0:
        raise InputError(f"--horizon must be between 0.05 and 60 s, found {options.horizon:g}")

    with command_line.progress("replay") as report_progress:
        result = replay(
            options.flight,
            options.vehicle,
            options.horizon,
            report_progress,
            waive=options.waive,
        )
    make_folder(options.out)
    path = write_json(options.out / "replay.json", result.findings)
    for run, table in result.findings["runs"].items():
        cells = (
            f"{c} " + ("diverged" if e.get("diverged") else f"{e['rms']:.3g} {e['unit']}")
            for c, e in table.items()
            if e.get("diverged") or e["rms"] is not None
        )
        print(f"{run}: {', '.join(cells)}")
    command = command_line.typed("replay")
    page = command_line.write_report(
        options.out / "report.html", lambda: report.replay_page(result, command)
    )
    print(f"replay {path}, {page}")


if __name__ == "__main__":
    command_line.run(main)
