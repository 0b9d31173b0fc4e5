"""graphnav: smooths recorded drives with a factor graph, beside the Kalman filter it replaces.

Conventions, everywhere in the package
--------------------------------------
Frames
    n   navigation: one fixed east-north-up tangent frame at the recording's origin
    l   local east-north-up at the point itself (what files hold)
    b   body: x right, y forward, z up (RFU), origin at the IMU
    e   Earth-centred, Earth-fixed
Symbols
    R_nb        body to navigation, v_n = R_nb v_b         lever_arm   m, in b, from the IMU
    p_n, v_n    position, velocity in n, m, m/s            f_b         specific force, m/s^2 (+9.8 up at rest)
    b_g, b_a    gyro and accelerometer bias                omega_b     turn rate to inertial space, rad/s
                measured = true + bias
Attitude
    roll right side down, pitch nose up, heading clockwise from true north; radians inside, degrees in files
Units
    SI and seconds, on one clock; an IMU row is the mean over the sample period that ends at its time
Error state
    theta, p, v, b_a, b_g with R_nb <- R_nb Exp(theta), the rest additive (`graphnav.core.state`)
Residuals
    predicted minus measured
"""

from __future__ import annotations

from typing import TYPE_CHECKING

__version__ = "0.1.0"

_HOME = {
    "load": ("graphnav.recording.formats", "read"),
    "run": ("graphnav.estimation.pipeline", "run"),
    "Settings": ("graphnav.config", "Settings"),
    "read_settings": ("graphnav.config", "read_settings"),
    "Recording": ("graphnav.recording", "Recording"),
    "Solution": ("graphnav.estimation.solution", "Solution"),
    "Trajectory": ("graphnav.core.trajectory", "Trajectory"),
    "GraphnavError": ("graphnav.core.errors", "GraphnavError"),
    "evaluate_recording": ("graphnav.evaluation.evaluate", "evaluate_recording"),
}
__all__ = [
    "GraphnavError",
    "Recording",
    "Settings",
    "Solution",
    "Trajectory",
    "__version__",
    "evaluate_recording",
    "load",
    "read_settings",
    "run",
]

if TYPE_CHECKING:
    from graphnav.config import Settings, read_settings
    from graphnav.core.errors import GraphnavError
    from graphnav.core.trajectory import Trajectory
    from graphnav.estimation.pipeline import run
    from graphnav.estimation.solution import Solution
    from graphnav.evaluation.evaluate import evaluate_recording
    from graphnav.recording import Recording
    from graphnav.recording.formats import read as load


def __getattr__(name: str) -> object:
    """Public names are imported when first used, so that ``graphnav --help`` need not wait for GTSAM."""
    if name not in _HOME:
        raise AttributeError(f"module 'graphnav' has no attribute '{name}'")
    import importlib

    module, attribute = _HOME[name]
    return getattr(importlib.import_module(module), attribute)
