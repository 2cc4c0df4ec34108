"""Comparators with the interface of a fit: what HHSR is measured against."""
