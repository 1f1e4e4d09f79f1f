"""Numbers to pictures and tables."""

from pcdata.report.figures.figure import figure
from pcdata.report.page import Page
from pcdata.report.pipeline_figure import save_pipeline_figure
from pcdata.report.plain_table import text_table

__all__ = ["Page", "figure", "save_pipeline_figure", "text_table"]
