"""The report page of a finished run: one HTML file without external resources."""

from neuroslam.report.page import write_report

__all__ = ["write_report"]
