"""Online smoothing: rows of sensors in, a live state and a settled trajectory out."""

from graphnav.online.ahead import Live
from graphnav.online.lines import LineUnits, make_setup
from graphnav.online.replay import drop_rows, list_rows
from graphnav.online.rows import Fix, ImuSample, Reading, WheelSpeed, live_setup, live_trajectory
from graphnav.online.sensors import Row, Sensors
from graphnav.online.session import Session
from graphnav.online.steady import Online
from graphnav.online.tracker import Tracker

__all__ = [
    "Fix",
    "ImuSample",
    "LineUnits",
    "Live",
    "Online",
    "Reading",
    "Row",
    "Sensors",
    "Session",
    "Tracker",
    "WheelSpeed",
    "drop_rows",
    "list_rows",
    "live_setup",
    "live_trajectory",
    "make_setup",
]
