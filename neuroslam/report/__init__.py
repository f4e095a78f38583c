"""One page that explains a finished run: all that a browser needs is in the file."""

from neuroslam.report.page import write_report

__all__ = ["write_report"]
