"""What a search found wrong with the log itself: done to the runs held out too, and said in words."""

from collections.abc import Sequence

from coax_env.diagnosis import (
    late_imu,
    late_rotor_speeds,
    sensor_low_pass,
)
from coax_env.diagnosis.problem import Problem
from coax_env.diagnosis.searches.once import Searched
from coax_env.estimation import between_rows, late_commands
from coax_env.estimation.clock_errors import with_clock_error
from coax_env.estimation.low_pass import records_before
from coax_env.estimation.state_space import Record
from coax_env.model.layout import CHANNELS, ROTOR_SPEEDS


def undone(held: Sequence[Record], given: Problem, found: Searched) -> list[Record]:
    """The runs held out, with all done to them that was done to those that were searched.

    Args:
        held: as logged. given: the problem as logged. found: its search.
    """
    problem, records = found.problem, list(held)
    if _without_rotor_speeds(given, problem):
        records = late_rotor_speeds.without_rotor_speeds(records, CHANNELS)
    records = late_commands.acting_sooner(records, problem.commands_late)
    records = late_imu.on_time(records, problem.late_imu, problem.row)
    records = records_before(records, CHANNELS, problem.low_passes)
    records = with_clock_error(records, problem.clock_error)
    return between_rows.with_between(records, between_rows.of_rows(problem.engine.records))


def remarks(given: Problem, found: Searched) -> list[str]:
    """What was done, for who reads the findings.

    Args:
        given: the problem as logged. found: its search.
    """
    problem = found.problem
    said = []
    if _without_rotor_speeds(given, problem):
        said.append(late_rotor_speeds.REMARK)
    if problem.low_passes:
        unasked = set(given.candidates) - set(problem.candidates)
        said.append(sensor_low_pass.remark(problem.low_passes, unasked))
    if problem.commands_late > 0.0:
        said.append(late_commands.remark(problem.commands_late))
    if problem.late_imu:
        said.append(late_imu.remark(problem.late_imu, problem.row))
    return said + between_rows.remarks(between_rows.of_rows(problem.engine.records))


def _without_rotor_speeds(given: Problem, problem: Problem) -> bool:
    """Whether rotor speeds that were logged are not used."""
    unread = problem.aboard.isdisjoint(ROTOR_SPEEDS)
    return unread and not given.aboard.isdisjoint(ROTOR_SPEEDS)
