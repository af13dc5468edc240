"""Evaluation: what a model answers beside what is true, and the scores that follow."""
