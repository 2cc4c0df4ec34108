"""From files to an organ's surface in LPS millimetres, with a quality report."""

from hhsr.read.quality import QualityReport
from hhsr.read.surface import Surface, read_surface

__all__ = ["QualityReport", "Surface", "read_surface"]
