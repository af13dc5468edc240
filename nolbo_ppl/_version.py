"""The version, alone, so that every room may state it."""

__version__ = "0.1.0"
