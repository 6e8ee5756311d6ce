"""The tables and figures of the paper, measured on any checkpoint: one module each."""

from lsmgeo.models.evaluation.contenders import Contender, Training, open_contenders
from lsmgeo.models.evaluation.evaluate import REPORTS, evaluate
from lsmgeo.models.evaluation.options import Options
from lsmgeo.models.evaluation.report import Cell, Report, Row, Table, format_table, write_report
from lsmgeo.models.evaluation.shapes import Shapes, open_shapes

__all__ = [
    "REPORTS",
    "Cell",
    "Contender",
    "Options",
    "Report",
    "Row",
    "Shapes",
    "Table",
    "Training",
    "evaluate",
    "format_table",
    "open_contenders",
    "open_shapes",
    "write_report",
]
