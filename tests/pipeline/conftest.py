"""The simulated drive of `tests/simulated_sequence.py` as a fixture."""

from tests.simulated_sequence import drive  # noqa: F401
