"""Prior sigmas of codes, Doppler shifts and carrier phases.

Noise falls with the signal's power (sigma-epsilon: Hartinger and Brunner 1999, "Variances of GPS phase observations"),
multipath with elevation; the models of the atmosphere are good to half of Klobuchar's delay (IS-GPS-200N) and to a
few decimetres of Saastamoinen's (RTKLIB 2.4.3, pntpos.c, varerr).
"""

from __future__ import annotations

import numpy as np

from graphnav.core.rotation import Array

_CODE, _CODE_POWER = 0.3, 1.1e4  # m at the zenith; m^2 Hz of a consumer receiver: 0.6 m at 45 dB-Hz
_RATE, _RATE_POWER = 0.03, 60.0  # m/s; (m/s)^2 Hz: 0.04 m/s at 45 dB-Hz
_BANDWIDTH = 15.0  # Hz, of a receiver's carrier loop (Kaplan and Hegarty 2006, section 5.6)
_PHASE = 1e-3  # m at the zenith: multipath and the loop's other errors; grows with 1 / sin(elevation)
_IONOSPHERE, _TROPOSPHERE = 0.5, 0.3
_CARRIER_REFLECTIONS = 0.003  # m at the zenith, of carrier-phase multipath (RTKLIB 2.4.3, rtkpos.c, varerr)
# s, correlation time of multipath: 13 and 30 s by the residuals of two drives in motion, longer at rest
REFLECTED = 20.0
LEAST = 20.0  # dB-Hz, lower bound of C/N0, and the value where none is reported
_DEFAULT = 45.0  # dB-Hz where a file has no C/N0


def compute_code_sigma(cn0: Array, elevation: Array, ionosphere: Array) -> Array:
    """(N,) m, 1-sigma of a code; `ionosphere` (N,) m is the delay that was modelled."""
    rising = 1.0 / np.maximum(np.sin(elevation), 0.1)
    own = _CODE_POWER * 10.0 ** (-0.1 * _compute_power(cn0)) + (_CODE * rising) ** 2
    return np.asarray(np.sqrt(own + (_IONOSPHERE * ionosphere) ** 2 + (0.1 * _TROPOSPHERE * rising) ** 2))


def compute_code_reflection_sigma(elevation: Array) -> Array:
    """(N,) m, 1-sigma of the time-correlated multipath error of a receiver's code."""
    return np.asarray(_CODE / np.maximum(np.sin(elevation), 0.1))


def compute_rate_sigma(cn0: Array, elevation: Array) -> Array:
    """(N,) m/s, 1-sigma of a range rate."""
    rising = 1.0 / np.maximum(np.sin(elevation), 0.1)
    return np.asarray(np.sqrt(_RATE_POWER * 10.0 ** (-0.1 * _compute_power(cn0)) + (_RATE * rising) ** 2))


def compute_carrier_sigma(cn0: Array, elevation: Array, wavelength: Array) -> Array:
    """(N,) m, 1-sigma of a carrier phase: thermal noise, wavelength / 2 pi sqrt(B / C/N0), and multipath."""
    rising = 1.0 / np.maximum(np.sin(elevation), 0.1)
    return np.asarray(np.sqrt(_compute_thermal(cn0, wavelength) + (_PHASE * rising) ** 2))


def compute_carrier_difference_sigma(cn0: Array, elevation: Array, wavelength: Array) -> Array:
    """(N,) m, 1-sigma of the between-receiver difference of carrier phases."""
    return np.asarray(np.sqrt(2.0 * (_compute_thermal(cn0, wavelength) + compute_reflection_sigma(elevation) ** 2)))


def compute_reflection_sigma(elevation: Array) -> Array:
    """(N,) m, 1-sigma of the time-correlated multipath error of a receiver's carrier phase."""
    rising = 1.0 / np.maximum(np.sin(elevation), 0.1)
    return np.asarray(_CARRIER_REFLECTIONS * np.sqrt(1.0 + rising**2))


def _compute_thermal(cn0: Array, wavelength: Array) -> Array:
    return np.asarray((wavelength / (2.0 * np.pi)) ** 2 * _BANDWIDTH * 10.0 ** (-0.1 * _compute_power(cn0)))


def _compute_power(cn0: Array) -> Array:
    return np.maximum(np.where(np.isfinite(cn0), cn0, _DEFAULT), LEAST)
