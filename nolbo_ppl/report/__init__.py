"""The report of a run: one HTML file that opens anywhere; and the same run in 3D."""

from nolbo_ppl.report.page import build_page, write_report
from nolbo_ppl.report.run_folder import RunFolder, read_run

__all__ = ["RunFolder", "build_page", "read_run", "write_report"]
