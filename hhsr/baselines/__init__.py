"""Comparators with the interface of a fit: what HHSR is measured against, each in the strongest form we can make."""

from hhsr.baselines.methods import METHODS, Baseline, fit_baseline

__all__ = ["METHODS", "Baseline", "fit_baseline"]
