"""The report of a run: figures, tables and one HTML page, drawn from the run folder alone."""

from lcopa_bayes.report.page import write_page as write_page
from lcopa_bayes.report.pages import write_report as write_report
