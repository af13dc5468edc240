"""Inference: the bound and its optimisation, queries on posteriors, association, and SLAM by expectation-maximisation."""
