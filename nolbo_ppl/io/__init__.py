"""Files: one module a format, reader and writer side by side."""

from nolbo_ppl._moved import moved_names

__getattr__ = moved_names("nolbo_ppl.io", "nolbo_ppl.io.files")
