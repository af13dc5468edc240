"""The report of a run: one HTML file that opens anywhere; and the same run in 3D."""

from nolbo_ppl.io.run_folder import RunFolder, read_run
from nolbo_ppl.report.page import build_page, write_report

__all__ = ["RunFolder", "build_page", "read_run", "write_report"]
