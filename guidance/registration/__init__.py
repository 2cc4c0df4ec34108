"""Registration: where is the patient in the tracker's frame? By landmarks, or by points digitised on a surface."""

from guidance.registration.landmarks import LandmarkRegistration, register_landmarks
from guidance.registration.matching import match_landmarks
from guidance.registration.points import RegistrationError
from guidance.registration.surface import SurfaceRegistration, register_surface

__all__ = [
    "LandmarkRegistration",
    "RegistrationError",
    "SurfaceRegistration",
    "match_landmarks",
    "register_landmarks",
    "register_surface",
]
