"""Shared by all tests: real data where it lies beside the project, hypothesis without a wall clock."""

from __future__ import annotations

import os
from pathlib import Path

import matplotlib
import pytest
from hypothesis import HealthCheck, settings

matplotlib.use("Agg")

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"

# Compiled code makes a first example slow, so no deadline; in CI the examples are the same every time.
settings.register_profile("default", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("ci", settings.get_profile("default"), derandomize=True)
settings.load_profile("ci" if os.environ.get("CI") else "default")


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of real organs and tracker recordings; a test that asks for it skips where it is missing."""
    if not DATA.is_dir():
        pytest.skip(f"real data not found at {DATA}")
    return DATA
