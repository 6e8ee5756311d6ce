"""The tables and figures of the paper, measured on any checkpoint: one module each."""

from lsmgeo._old_names import old_names
from lsmgeo.evaluation.evaluate import REPORTS, evaluate
from lsmgeo.evaluation.held_out_shapes import Shapes, open_shapes
from lsmgeo.evaluation.methods import Method, Options, Training, open_methods
from lsmgeo.evaluation.report import Cell, Report, Row, Table, format_table, write_report

__all__ = [
    "REPORTS",
    "Cell",
    "Method",
    "Options",
    "Report",
    "Row",
    "Shapes",
    "Table",
    "Training",
    "evaluate",
    "format_table",
    "open_methods",
    "open_shapes",
    "write_report",
]

__getattr__ = old_names(__name__, {"Contender": "Method", "open_contenders": "open_methods"})
