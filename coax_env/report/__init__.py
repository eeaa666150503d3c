"""Reports: results as self-contained pages, the verdict first; templates/ has their HTML."""

from coax_env.report.comparison import change_headline, comparison_page
from coax_env.report.diagnosis import diagnosis_page, headline, lead
from coax_env.report.gain import ControllerScores
from coax_env.report.identification import identification_page
from coax_env.report.logbook import logbook_page
from coax_env.report.many_flights import HEADER as MANY_FLIGHTS_HEADER
from coax_env.report.many_flights import many_flights_page, summary_cells
from coax_env.report.page import Section, page
from coax_env.report.replay import replay_page
from coax_env.report.simulation import DOUBLET_HEADER, doublet_rows, simulation_page
from coax_env.report.two_step import two_step_page

__all__ = [
    "DOUBLET_HEADER",
    "MANY_FLIGHTS_HEADER",
    "ControllerScores",
    "Section",
    "change_headline",
    "comparison_page",
    "diagnosis_page",
    "doublet_rows",
    "headline",
    "identification_page",
    "lead",
    "logbook_page",
    "many_flights_page",
    "page",
    "replay_page",
    "simulation_page",
    "summary_cells",
    "two_step_page",
]
