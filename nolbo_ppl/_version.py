"""The version, alone, so that every room may state it."""

__version__ = "0.2.0"
