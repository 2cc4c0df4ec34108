"""The thresholds by which the monitor judges, all in one place and all in the log."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from guidance.errors import InputError


@dataclass(frozen=True)
class Limits:
    """When a pose counts, and when a structure is approached.

    Parameters
    ----------
    stale_s : float
        A pose older than this is no longer known.
    approach_s : float
        APPROACHING when contact lies this near ahead at the present motion.
    hysteresis_mm, hysteresis_share, hold_s : float
        A graver state is left only when the distance (by mm) and the time ahead (by this share) are clearly better,
        for `hold_s` on end.
    contact_hysteresis_mm : float
        The same for leaving CONTACT and INSIDE.
    horizon_s : float
        How far ahead contacts are sought.
    max_tracker_error_mm : float
        A pose whose tracker states a larger error is not trusted.
    max_speed_mm_s : float
        A pose that would need a faster needle is taken as an outlier, until three in a row agree.
    rigid_tolerance : float
        Of the rotation part, |R Rᵀ − 1|.
    noise_mm, noise_rad : float
        First guess of the noise of tip and direction, one standard deviation per axis; then estimated from the poses.
    acceleration_psd : float
        mm²/s³: how much a hand may change its speed; 0.05 lets it wander by 0.22 mm/s in a second (one sigma).
    coverage_sigmas : float
        Half width of stated intervals, in standard deviations.
    timing_s : float
        How far the stated time of a pose may be off; widens the interval on both sides.
    min_speed_mm_s : float
        Slower than this is resting: no time is forecast.
    """

    stale_s: float = 0.5
    approach_s: float = 3.0
    hysteresis_mm: float = 1.0
    hysteresis_share: float = 0.3
    contact_hysteresis_mm: float = 0.3
    hold_s: float = 0.25
    horizon_s: float = 8.0
    max_tracker_error_mm: float = 2.0
    max_speed_mm_s: float = 1000.0
    rigid_tolerance: float = 1e-3
    noise_mm: float = 0.3
    noise_rad: float = 0.005
    acceleration_psd: float = 0.05
    coverage_sigmas: float = 3.0
    timing_s: float = 0.02
    min_speed_mm_s: float = 0.5

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if not (np.isfinite(value) and value >= 0.0):
                raise InputError(f"limit {name} is {value!r}; expected a finite number that is not negative")
        for name in ("stale_s", "horizon_s", "max_speed_mm_s", "noise_mm", "noise_rad"):
            if getattr(self, name) == 0.0:
                raise InputError(f"limit {name} must be above 0")

    def to_record(self) -> dict[str, Any]:
        """Plain numbers for JSON."""
        return asdict(self)
