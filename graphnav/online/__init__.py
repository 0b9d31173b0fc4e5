"""Smoothing while the drive happens: rows of sensors in, a live state and a settled trajectory out."""

from graphnav.online.ahead import Live
from graphnav.online.sensors import Row, Sensors, rows_of, without_rows
from graphnav.online.session import Session
from graphnav.online.steady import Online
from graphnav.online.tracker import Tracker

__all__ = ["Live", "Online", "Row", "Sensors", "Session", "Tracker", "rows_of", "without_rows"]
