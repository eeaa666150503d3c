"""Report what a flight folder contains, what is wrong with it, and what it can determine."""

import inspect
import math
from pathlib import Path
from typing import TYPE_CHECKING

import command_line

from coax_env.files import write_json
from coax_env.logs import flight as flight_form
from coax_env.logs.columns import draft_card
from coax_env.model.vehicle_file import load_vehicle

if TYPE_CHECKING:
    from coax_env.inspection.flight_check import FlightCheck


def main() -> None:
    parser = command_line.parser("check_flight", __doc__)
    parser.add_argument("flight", type=Path, nargs="?", help="flight folder")
    parser.add_argument("--vehicle", help="shipped name or TOML file (default: the card's)")
    parser.add_argument(
        "--form", action="store_true",
        help="print what a flight folder holds: columns, units, signs, a card with every key; and stop",
    )  # fmt: skip
    parser.add_argument(
        "--draft", action="store_true",
        help="write a first card.toml for a folder of CSVs, guessed from their columns, and stop",
    )  # fmt: skip
    options = parser.parse_args()
    if options.form:
        print(inspect.cleandoc(flight_form.__doc__ or ""))
        return
    if options.flight is None:
        parser.error("which flight folder? (--form says what one holds)")
    if options.draft:
        draft(options.flight, options.vehicle or "lama400d")
        return
    from coax_env.inspection.flight_check import check_flight  # compiles the kernel

    with command_line.progress("check") as report_progress:
        found = check_flight(options.flight, options.vehicle, report_progress)
    write_json(options.out / "check.json", found.as_json())
    show(found)
    print(f"\nall numbers {options.out / 'check.json'}")


def draft(folder: Path, vehicle: str) -> None:
    """Write a card and report what was guessed."""
    load_vehicle(vehicle)
    card, guessed = draft_card(folder, vehicle)
    print(f"{card}: look at every line")
    for guess in guessed:
        print(f"  guessed: {guess.line()}")
    print(command_line.as_called(f"next: scripts/check_flight.py {folder}"))


def show(found: "FlightCheck") -> None:
    """The check as tables and sentences."""
    print(f"{found.flight}, {found.vehicle}\n")
    rows = [["run", "s", "rows", "rows/s", "gaps"]]
    for run in found.runs:
        rows.append(
            [run.name, f"{run.seconds:.1f}", str(run.rows), f"{run.rate:.0f}", str(run.gaps or "")]
        )
    command_line.print_columns(rows)
    print()
    rows = [["channel", "readings/s", "noise std", "unit", "longest gap", "runs"]]
    for c in found.channels:
        gap = f"{c.longest_gap:.2g} s"
        rows.append([c.channel, f"{c.rate:.3g}", f"{c.std:.2g}", c.unit, gap, str(c.runs)])
    command_line.print_columns(rows)
    print("not measured:", " ".join(found.missing) or "nothing")
    for note in found.repaired:
        print("repaired:", note)
    if found.unread:
        print("columns not read:", ", ".join(found.unread))
    if found.unseen:
        print("sign not seen by any check:", " ".join(found.unseen))
    for words in found.oscillating:
        print("oscillates:", words)
    for waived in found.waived:
        print("waived:", waived)
    for suspicion in found.suspicions:
        print("SUSPICIOUS:", suspicion)
    print()
    rows = [
        ["effect at its usual size", "verdict", "nats", "std / usual", "best in", "confounded with"]
    ]
    for e in found.effects:
        ratio = max(e.std[name] / e.usual[name] for name in e.std)
        cells = (f"{e.nats:.0f}", "-" if math.isinf(ratio) else f"{ratio:.2g}", e.run)
        rows.append([e.effect, e.verdict, *cells, ", ".join(e.alike)])
    command_line.print_columns(rows)
    print("(with the vehicle as given: wind, say, acts through a drag that must be in the file)\n")
    rows = [["parameter", "std in the file", "std after a fit", "left"]]
    for n in found.own_numbers:
        left = f"{100 * n.std_after / n.std_before:.0f} %"
        rows.append([n.name, f"{n.std_before:.2g} {n.unit}", f"{n.std_after:.2g}", left])
    command_line.print_columns(rows)
    if found.undetermined:
        print("undetermined:", "; ".join(found.directions) or ", ".join(found.undetermined))
    print("\nnext:", command_line.as_called(found.next_step))


if __name__ == "__main__":
    command_line.run(main)
